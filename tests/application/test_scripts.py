"""The scripts that measure the odometry: their statistics and tables, and one run of each on a short flight."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dronevio
from dronevio.estimator.types import Observations
from dronevio.models.protocols import Recording
from dronevio.models.rotation import exp_so3
from dronevio.models.state import CameraFrame, Trajectory


def fixture_of(name: str) -> Callable[[Callable[[str], Any]], Any]:
    """Return a fixture of a script."""

    def load(script: Callable[[str], Any]) -> Any:
        return script(name)

    return pytest.fixture(scope="module", name=name)(load)


run_metrics, markdown_tables, suite, stress, semi_real = map(
    fixture_of, ("run_metrics", "markdown_tables", "suite", "stress", "semi_real")
)
corrupted_tracks, profiler, repeated_recording, processor_time, seeds, initialization_accuracy = map(
    fixture_of,
    (
        "corrupted_tracks",
        "profiler",
        "repeated_recording",
        "processor_time",
        "seeds",
        "initialization_accuracy",
    ),
)


gym_speed, physics_rates = map(fixture_of, ("gym_speed", "physics_rates"))


def test_rows_of_other_simulators_have_ratios(gym_speed: Any) -> None:
    measured = [{"version": "3.0.0", "settings": "two vehicles", "speed": 72.4}]
    rows = gym_speed.rows_of("rotorpy", measured, own=144.8)
    assert rows == [("rotorpy 3.0.0", "two vehicles", "72", "2", gym_speed.LEFT_OUT["rotorpy"])]


def test_errors_of_the_physics_shrink_with_the_step(physics_rates: Any) -> None:
    paths = physics_rates.random_paths(2)
    reference = physics_rates.fly_controlled(4000, paths, 0.5)
    coarse, fine = (
        physics_rates.errors(physics_rates.fly_controlled(rate_hz, paths, 0.5), reference) for rate_hz in (400, 1000)
    )
    # The integrator is of first order: (1/400 - 1/4000) / (1/1000 - 1/4000) = 3
    np.testing.assert_allclose(np.array(coarse) / np.array(fine), 3.0, rtol=0.2)
    again = physics_rates.fly_open(4000, paths, reference.commands)
    np.testing.assert_array_equal(again.position_m, reference.position_m)


@given(st.lists(st.integers(0, 30), min_size=1, max_size=6))
def test_numbers_are_lists_and_ranges(markdown_tables: Any, numbers: list[int]) -> None:
    assert markdown_tables.numbers(",".join(map(str, numbers))) == tuple(dict.fromkeys(numbers))
    first, last = min(numbers), max(numbers)
    assert markdown_tables.numbers(f"{first}-{last}") == tuple(range(first, last + 1))


def test_failed_runs_count_as_infinite_errors(run_metrics: Any, markdown_tables: Any) -> None:
    good, failed = 0.02, run_metrics.RunMetrics("V1_02-0", "mono", "failed").ate_m
    assert markdown_tables.median([good, good, failed]) == good
    assert markdown_tables.median([good, failed, failed]) == math.inf
    assert markdown_tables.geometric_mean([good, good, math.inf]) == math.inf
    assert markdown_tables.text(math.inf) == "∞"


@given(st.lists(st.floats(1e-4, 10.0), min_size=1, max_size=5), st.floats(0.1, 10.0))
@settings(deadline=None)
def test_geometric_mean_scales_and_is_between_the_extremes(
    markdown_tables: Any, values: list[float], factor: float
) -> None:
    mean = markdown_tables.geometric_mean
    assert min(values) * (1 - 1e-9) <= mean(values) <= max(values) * (1 + 1e-9)
    assert mean([factor * v for v in values]) == pytest.approx(factor * mean(values))


def test_nees_interval_has_the_probability_of_95_percent(suite: Any) -> None:
    rng = np.random.default_rng(3)
    inside = {1.0: 0, 0.4: 0, 2.5: 0}
    for _ in range(200):
        chi = rng.chisquare(3, (36, 1))  # the errors of one flight are correlated: one sample for all of it
        for factor in inside:
            values = np.repeat(factor * chi, 20, axis=1)
            found = suite.mean_nees(values.mean(axis=1).tolist(), values.tolist())
            inside[factor] += found.inside
            assert found.inside_percent == (100.0 if found.inside else 0.0)
    assert inside[1.0] / 200 == pytest.approx(0.95, abs=0.04)
    assert inside[0.4] == 0 and inside[2.5] == 0


def test_failed_flight_changes_mean_nees_and_not_its_median(suite: Any) -> None:
    found = suite.mean_nees([3.0, 3.0, math.inf], [[3.0], [3.0], []])
    assert found.mean == math.inf and not found.inside and found.median == 3.0


def test_tables_count_failures(suite: Any, semi_real: Any, run_metrics: Any) -> None:
    good = run_metrics.RunMetrics(
        "room-easy-v0-0", "mono", path_m=20.0, ate_m=0.02, coverage_percent=100.0, nees_position=3.0,
        nees_orientation=3.0, first_s=1.0,
    )  # fmt: skip
    lost = run_metrics.RunMetrics("room-easy-v0-1", "mono", "crashed", "killed")
    drifted = replace(good, flight="hall-easy-v0-0", ate_m=0.21)
    verdict = suite.verdict([good, lost, drifted], "mono")
    assert "failures 2" in verdict and "room-easy-v0-1: crashed killed" in verdict and "hall-easy-v0-0" in verdict
    rows = suite.summary([good, lost, drifted], "mono").splitlines()
    [room] = [row for row in rows if row.startswith("| room easy |")]
    assert room.split("|")[2:6] == [" 2 ", " ∞ ", " ∞ ", " **1** "]  # the median of a successful and a failed run
    assert len({row.count("|") for row in rows}) == 1
    runs = [replace(good, flight=f"V1_02-{seed}", ate_m=0.01 * (seed + 1)) for seed in (0, 1)]
    table = semi_real.summary(runs, "mono", ["V1_02"], (0, 1, 2))
    assert "| V1_02 | 0.0200 | 0.0100–∞ | 0.045 | yes |" in table  # the run of the third seed is missing
    assert len({row.count("|") for row in table.splitlines()}) == 1


class StaticFrontEnd:
    """A front end that observes the same features in all frames."""

    def __init__(self, n: int = 2000) -> None:
        self.age, self.n = 0, n

    def track(self, frame: CameraFrame, *motion: object) -> Observations:
        self.age += 1
        return self.replenish()

    def replenish(self, rig: object = None) -> Observations:
        xy = np.zeros((self.n, 2))
        return Observations(np.arange(self.n), xy, xy, np.full(self.n, self.age))

    def discard(self, ids: object) -> None:
        self.n = 0


def test_a_fifth_of_the_tracks_are_outliers(corrupted_tracks: Any) -> None:
    inner = StaticFrontEnd()
    front_end = corrupted_tracks.OutlierFrontEnd(inner)
    frame = CameraFrame(0, ())
    observed = [front_end.track(frame) for _ in range(30)]
    moved = np.array([np.abs(each.xy).max(axis=1) > 0.0 for each in observed])
    assert moved[5].mean() == pytest.approx(0.2, abs=0.03)
    assert np.array_equal(moved[5], moved[29])
    again = front_end.replenish()
    np.testing.assert_array_equal(again.xy, observed[-1].xy)  # the errors are the same within a frame
    steps = np.diff([each.xy[moved[29]] for each in observed[1:]], axis=0)
    steady = np.allclose(steps[0], steps[1]) or np.isclose(steps[0], steps[1]).all(axis=1)
    assert 0.3 < np.mean(steady) < 0.7  # one half drifts at a constant rate, the other half jumps
    assert np.abs(observed[-1].pixels).max() > 30.0
    front_end.discard(np.arange(5))
    assert inner.n == 0 and front_end.age == 30
    clean = corrupted_tracks.OutlierFrontEnd(StaticFrontEnd(), share=0.0).track(frame)
    assert not clean.xy.any()


def test_endings_of_runs_are_classified(stress: Any, run_metrics: Any) -> None:
    good = run_metrics.RunMetrics(
        "none-0", "mono", frames=100, duration_s=4.95, path_m=20.0, ate_m=0.02, max_m=0.05, coverage_percent=100.0,
        longest_gap_s=0.05, step_error_m=0.01, health={"initializing": 10.0, "tracking": 90.0, "lost": 0.0},
    )  # fmt: skip
    assert stress.ending(good) == "bounded"
    assert stress.ending(replace(good, not_finite=1)) == "**NOT FINITE**"
    assert stress.ending(replace(good, status="timeout")) == "**TIMEOUT**"
    assert stress.ending(replace(good, step_error_m=2.0)) == "**DISCONTINUOUS**"
    assert (
        stress.ending(replace(good, step_error_m=2.0, longest_gap_s=1.0)) == "bounded"
    )  # there are no poses in between
    assert stress.ending(replace(good, tracking_sigmas=4.9)) == "bounded"
    assert stress.ending(replace(good, tracking_sigmas=5.1)) == "**OVERCONFIDENT**"
    assert stress.ending(replace(good, max_m=3.0)) == "**UNBOUNDED**"
    lost = {"initializing": 10.0, "tracking": 60.0, "lost": 30.0}
    assert stress.ending(replace(good, max_m=3.0, health=lost)) == "loss reported"
    waiting = run_metrics.RunMetrics("x-0", "mono", "failed", health={"initializing": 100.0})
    assert stress.ending(waiting) == "never initialized"


def test_trials_cover_all_conditions(stress: Any) -> None:
    trials = stress.trials()
    wanted = {"dark-1s", "dark-5s", "drops", "outliers", "offset", "tilt", "noise", "saturated", "low-texture"}
    assert wanted | {"rotation", "motion", "hover"} <= set(trials)
    assert trials["dark-5s"].window_s == (12.0, 17.0)
    hover = trials["hover"]
    assert hover.window_s[1] - hover.window_s[0] == 60.0 and hover.scenario.plan.tour_s > 60.0
    rows = [stress.RunMetrics(f"{name}-0", mode, "crashed", "killed") for name in trials for mode in ("mono", "stereo")]
    table = stress.summary(rows, list(trials)).splitlines()
    assert len(table) == 2 + len(rows) and len({row.count("|") for row in table}) == 1
    assert "hover mono: drift in 60 s ∞ mm" in stress.verdicts(rows)


@pytest.mark.parametrize("laps", [1, 3])
def test_repeated_recording_is_continuous(
    repeated_recording: Any, noise_recording: Callable[..., Recording], laps: int
) -> None:
    one = noise_recording(frames=4)
    flown = repeated_recording.RepeatedRecording(one, laps)
    assert len(flown.frame_times_ns) == 4 * laps and flown.lap_ns == 4 * 50_000_000
    assert np.all(np.diff(flown.frame_times_ns) == 50_000_000)
    assert np.all(np.diff(flown.imu.t_ns) > 0) and len(flown.imu) == 37 * laps  # from the first frame on
    first, last = flown.frame(1), flown.frame(4 * (laps - 1) + 1)
    np.testing.assert_array_equal(first.images[0], last.images[0])
    assert last.t_ns - first.t_ns == (laps - 1) * flown.lap_ns
    truth = one.ground_truth
    assert truth is not None and truth.gyro_bias_rad_s is not None
    change = truth.gyro_bias_rad_s[-1] - truth.gyro_bias_rad_s[0]
    per_lap = len(flown.imu) // laps
    difference = flown.imu.gyro_rad_s[-per_lap:] - flown.imu.gyro_rad_s[:per_lap]
    np.testing.assert_allclose(difference, np.tile((laps - 1) * change, (per_lap, 1)), atol=1e-12)
    metres, degrees = flown.discontinuity()
    assert metres == pytest.approx(np.linalg.norm(truth.p_world_imu[-1] - truth.p_world_imu[0])) and degrees > 0.0


def test_growth_is_detected_and_variation_in_a_lap_is_not(processor_time: Any) -> None:
    lap = 10.0 + 5.0 * np.sin(np.linspace(0.0, 2.0 * np.pi, 800))
    constant = processor_time.growth(np.tile(lap, 15).tolist(), 800, 1200)
    assert constant.ratio == pytest.approx(1.0)
    growing = np.tile(lap, 15) * np.linspace(1.0, 1.2, 12_000)
    assert 1.1 < processor_time.growth(growing.tolist(), 800, 1200).ratio < 1.2
    assert math.isnan(processor_time.growth(lap.tolist(), 800, 1200).ratio)


def test_profiler_attributes_processor_time_to_stages(profiler: Any, tmp_path: Path) -> None:
    source = (
        "import cv2, numpy as np\n"
        "def busy(image, n):\n"
        "    for _ in range(n):\n"
        "        cv2.cornerMinEigenVal(image, 5)\n"
        "    total = 0\n"
        "\n\n\n"
        "    for k in range(n * 60000):\n"
        "        total += k\n"
    )
    module = tmp_path / "estimator" / "vio.py"
    module.parent.mkdir()
    module.write_text(source)
    space: dict[str, Any] = {}
    exec(compile(source, str(module), "exec"), space)
    profile = profiler.Profile()
    start_s = time.process_time()
    with profile.sampling():
        space["busy"](np.random.default_rng(0).integers(0, 255, (480, 752)).astype(np.uint8), 30)
    spent_s = time.process_time() - start_s
    assert 0.5 * spent_s < sum(profile.stages.values()) < 1.01 * spent_s
    assert set(profile.stages) <= {"corner detection", profiler.OTHER, profiler.OUTSIDE}
    assert profile.stages["corner detection"] > 0.1 * spent_s
    assert profile.stages[profiler.OTHER] > 0.1 * spent_s


def test_slow_samples_of_the_profiler_do_not_nest(profiler: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, a sample may take longer than the interval between two samples."""
    depth, deepest = 0, 0

    def slow(_: Any) -> str:
        nonlocal depth, deepest
        depth += 1
        deepest = max(deepest, depth)
        end_s = time.monotonic() + 5.0 * profiler.INTERVAL_S
        while time.monotonic() < end_s and depth < 10:
            pass
        depth -= 1
        return "slow"

    monkeypatch.setattr(profiler, "stage_of", slow)
    with profiler.Profile().sampling():
        end_s = time.monotonic() + 50.0 * profiler.INTERVAL_S
        while time.monotonic() < end_s:
            pass
    assert deepest == 1


def test_missed_bounds_of_processor_time_are_marked(processor_time: Any) -> None:
    measured = {
        "mode": "mono", "recording": "x", "lap_s": 30.0, "rate_hz": 20.0, "discontinuity": (0.0, 0.0),
        "cpu_ms": [9.0] * 12_000, "keyframe": [True, False] * 6_000, "memory_mb": [200.0] * 120,
        "health": {"tracking": 12_000}, "stages": {"KLT": 60.0, "corner detection": 40.0}, "functions": {"f": 100.0},
    }  # fmt: skip
    row = processor_time.mode_row(measured)
    assert len(row) == len(processor_time.HEADINGS) and "**no**" not in "".join(row)
    assert "**no**" in "".join(processor_time.mode_row({**measured, "cpu_ms": [10.5] * 12_000}))
    assert "**no**" in "".join(processor_time.mode_row({**measured, "cpu_ms": [8.0] * 11_000 + [9.0] * 1_000}))
    assert "| KLT | 60.0 | 5.00 |" in processor_time.profile_table(measured)


def test_suite_caches_its_runs(suite: Any, flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flights = tmp_path / "flights"
    flights.mkdir()
    (flights / "room-easy-v0-0").symlink_to(flown.folder)
    (flights / "room-easy-v0-12").symlink_to(flown.folder)  # its seed is not selected
    (flights / "hall-easy-v0-0" / "mav0").mkdir(parents=True)  # damaged
    command = suite.SuiteCommand(flights, tmp_path / "rows", modes=("mono",), json=tmp_path / "all.json")
    assert suite.main(command) == 1
    printed = capsys.readouterr().out
    assert "failures 1" in printed and "hall-easy-v0-0 mono: failed" in printed and "hover" not in printed
    [row] = [row for row in json.loads((tmp_path / "all.json").read_text())["runs"] if row["status"] == "ok"]
    assert row["flight"] == "room-easy-v0-0" and row["coverage_percent"] == 100.0
    assert 0.0 < row["ate_m"] < 0.05 and row["step_jump_m"] < 0.05 and row["not_finite"] == 0
    [kept] = (tmp_path / "rows").glob("room-easy-v0-0-mono-*.json")
    kept.write_text(kept.read_text().replace(f'"ate_m": {row["ate_m"]}', '"ate_m": 0.0123'))
    suite.main(command)
    [again] = [row for row in json.loads((tmp_path / "all.json").read_text())["runs"] if row["status"] == "ok"]
    assert again["ate_m"] == 0.0123  # read from the cache


def test_outliers_end_in_a_bounded_error(
    stress: Any, flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "none-0").symlink_to(flown.folder)
    command = stress.StressCommand(tmp_path, tmp_path / "rows", ("outliers", "hover"), ("mono",), fly=False)
    assert stress.main(command) == 0
    printed = capsys.readouterr().out
    assert "| outliers-0 | mono |" in printed and "Not simulated: hover-0." in printed
    assert stress.main(stress.StressCommand(tmp_path, tmp_path, ("nothing",))) == 2


def test_processor_time_of_a_flight_is_measured(
    processor_time: Any, flown: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    processor_time.main(processor_time.ProcessorTimeCommand(flown.folder, minutes=0.05, modes=("mono",), profile=True))
    printed = capsys.readouterr().out
    assert "| mono | 0.1 |" in printed and "| KLT |" in printed and "| linearization of observations |" in printed


def test_stages_of_the_profiler_name_existing_modules(profiler: Any) -> None:
    estimator = Path(dronevio.__file__).parent / "estimator"
    for stage, module, words in profiler.STAGES:
        assert stage and (module or words)
        assert not module or (estimator / module.removeprefix("estimator/")).exists(), module


def test_table_of_seeds_has_means_and_worst_values(seeds: Any) -> None:
    values = [[0.01, 0.1, 0.02, 0.2, -0.3, 99.0, 2.0, 8.0, 50.0, 60.0, 1.5], [0.03] + [0.3] * 4 + [100.0] + [1.0] * 5]
    rows = [row.split("|")[1:-1] for row in seeds.seeds_table((0, 4), values).splitlines()]
    assert len({len(row) for row in rows}) == 1 and len(rows) == 6
    assert [row[0].strip() for row in rows[2:]] == ["0", "4", "mean", "worst"]
    columns = dict(zip((title.strip() for title in rows[0]), zip(*rows[2:], strict=True), strict=True))
    assert [cell.strip() for cell in columns["ATE [m]"]] == ["0.010", "0.030", "0.020", "0.030"]
    assert [cell.strip() for cell in columns["scale error [%]"]] == ["-0.30", "+0.30", "+0.00", "-0.30"]
    assert [cell.strip() for cell in columns["coverage [%]"]] == ["99.0", "100.0", "99.5", "99.0"]


def test_scale_error_is_the_ratio_of_displacements(initialization_accuracy: Any) -> None:
    t_ns = 50_000_000 * np.arange(100)
    t_s = t_ns * 1e-9
    p = np.stack([np.sin(t_s), np.cos(2.0 * t_s), 0.1 * t_s], axis=1)
    quat_wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (100, 1))
    R = exp_so3(np.array([0.0, 0.0, 2.0]))
    truth, estimate = Trajectory(t_ns, p, quat_wxyz), Trajectory(t_ns, 1.03 * p @ R.T + 5.0, quat_wxyz)
    assert initialization_accuracy.scale_error(truth, estimate, 1.0, t_s) == pytest.approx(0.03)
    assert math.isnan(initialization_accuracy.scale_error(truth, estimate, 4.9, t_s))  # too few poses
    line = initialization_accuracy.summary("scale", np.array([0.01, -0.03, np.nan, 0.02]), 0.02)
    assert line.startswith("scale: 3 initializations, median 2.00 %") and line.endswith("67 % within 2 %")


def test_initializations_of_a_flight_are_measured(
    initialization_accuracy: Any, flown: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    command = initialization_accuracy.InitializationCommand((flown.folder,), every_s=2.0, duration_s=2.5)
    assert initialization_accuracy.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == initialization_accuracy.HEADER and "from 2.0 s" in lines[2]
    assert any(line.startswith("scale after 2 s, all: ") for line in lines)
