"""The scripts that measure the odometry: what they make of runs, and one run of each on a tiny flight."""

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

from dronevio.estimator.types import Observations
from dronevio.models.protocols import Recording
from dronevio.models.state import CameraFrame


def fixture_of(name: str) -> Callable[[Callable[[str], Any]], Any]:
    """Return a fixture that gives a script."""

    def load(script: Callable[[str], Any]) -> Any:
        return script(name)

    return pytest.fixture(scope="module", name=name)(load)


figures, measuring, tables, suite, stress = map(fixture_of, ("figures", "measuring", "tables", "suite", "stress"))
spoiling, long_flight, cost, semi_real = map(fixture_of, ("spoiling", "long_flight", "cost", "semi_real"))


@given(st.lists(st.integers(0, 30), min_size=1, max_size=6))
def test_numbers_are_read_as_they_are_written(tables: Any, numbers: list[int]) -> None:
    assert tables.numbers(",".join(map(str, numbers))) == tuple(dict.fromkeys(numbers))
    first, last = min(numbers), max(numbers)
    assert tables.numbers(f"{first}-{last}") == tuple(range(first, last + 1))


def test_failed_runs_are_the_worst_and_never_drop_out(figures: Any, tables: Any) -> None:
    good, bad = 0.02, figures.Figures("V1_02-0", "mono", "failed").ate_m
    assert tables.median([good, good, bad]) == good
    assert tables.median([good, bad, bad]) == math.inf
    assert tables.geometric_mean([good, good, math.inf]) == math.inf
    assert tables.text(math.inf) == "∞"


@given(st.lists(st.floats(1e-4, 10.0), min_size=1, max_size=5), st.floats(0.1, 10.0))
@settings(deadline=None)
def test_the_geometric_mean_scales_and_lies_between(tables: Any, values: list[float], factor: float) -> None:
    mean = tables.geometric_mean
    assert min(values) * (1 - 1e-9) <= mean(values) <= max(values) * (1 + 1e-9)
    assert mean([factor * v for v in values]) == pytest.approx(factor * mean(values))


def test_the_band_holds_the_mean_of_honest_flights_and_no_others(suite: Any) -> None:
    rng = np.random.default_rng(3)
    inside = {1.0: 0, 0.4: 0, 2.5: 0}
    for _ in range(200):
        chi = rng.chisquare(3, (36, 1))  # a flight's errors belong together: one draw for all of it
        for factor in inside:
            values = np.repeat(factor * chi, 20, axis=1)
            found = suite.anees(values.mean(axis=1).tolist(), values.tolist())
            inside[factor] += found.inside
            assert found.inside_percent == (100.0 if found.inside else 0.0)
    assert inside[1.0] / 200 == pytest.approx(0.95, abs=0.04)
    assert inside[0.4] == 0 and inside[2.5] == 0


def test_a_failed_flight_spoils_the_mean_nees_but_not_the_median(suite: Any) -> None:
    found = suite.anees([3.0, 3.0, math.inf], [[3.0], [3.0], []])
    assert found.mean == math.inf and not found.inside and found.median == 3.0


def test_tables_count_failures(suite: Any, semi_real: Any, figures: Any) -> None:
    good = figures.Figures(
        "room-easy-v0-0", "mono", path_m=20.0, ate_m=0.02, coverage_percent=100.0, nees_position=3.0,
        nees_orientation=3.0, first_s=1.0,
    )  # fmt: skip
    lost = figures.Figures("room-easy-v0-1", "mono", "crashed", "killed")
    drifted = replace(good, flight="hall-easy-v0-0", ate_m=0.21)
    told = suite.verdict([good, lost, drifted], "mono")
    assert "failures 2" in told and "room-easy-v0-1: crashed killed" in told and "hall-easy-v0-0" in told
    rows = suite.summary([good, lost, drifted], "mono").splitlines()
    [room] = [row for row in rows if row.startswith("| room easy |")]
    assert room.split("|")[2:6] == [" 2 ", " ∞ ", " ∞ ", " **1** "]  # the median of a good and a failed one
    assert len({row.count("|") for row in rows}) == 1
    named = [replace(good, flight=f"V1_02-{seed}", ate_m=0.01 * (seed + 1)) for seed in (0, 1)]
    told = semi_real.summary(named, "mono", ["V1_02"], (0, 1, 2))
    assert "| V1_02 | 0.0200 | 0.0100–∞ | 0.045 | yes |" in told  # the third seed's run is missing
    assert len({row.count("|") for row in told.splitlines()}) == 1


class Still:
    """A front end that sees the same features for ever."""

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


def test_a_fifth_of_the_tracks_are_outliers_and_always_the_same(spoiling: Any) -> None:
    inner = Still()
    front_end = spoiling.Outliers(inner)
    frame = CameraFrame(0, ())
    seen = [front_end.track(frame) for _ in range(30)]
    moved = np.array([np.abs(each.xy).max(axis=1) > 0.0 for each in seen])
    assert moved[5].mean() == pytest.approx(0.2, abs=0.03)
    assert np.array_equal(moved[5], moved[29])
    again = front_end.replenish()
    np.testing.assert_array_equal(again.xy, seen[-1].xy)  # in one frame, a track is in one place
    steps = np.diff([each.xy[moved[29]] for each in seen[1:]], axis=0)
    steady = np.allclose(steps[0], steps[1]) or np.isclose(steps[0], steps[1]).all(axis=1)
    assert 0.3 < np.mean(steady) < 0.7  # half of them drift evenly, the others are thrown about
    assert np.abs(seen[-1].pixels).max() > 30.0
    front_end.discard(np.arange(5))
    assert inner.n == 0 and front_end.age == 30
    clean = spoiling.Outliers(Still(), share=0.0).track(frame)
    assert not clean.xy.any()


def test_runs_end_in_words(stress: Any, figures: Any) -> None:
    good = figures.Figures(
        "none-0", "mono", frames=100, duration_s=4.95, path_m=20.0, ate_m=0.02, max_m=0.05, coverage_percent=100.0,
        longest_gap_s=0.05, step_error_m=0.01, health={"initializing": 10.0, "tracking": 90.0, "lost": 0.0},
    )  # fmt: skip
    assert stress.ending(good) == "bounded"
    assert stress.ending(replace(good, not_finite=1)) == "**NOT FINITE**"
    assert stress.ending(replace(good, status="timeout")) == "**TIMEOUT**"
    assert stress.ending(replace(good, step_error_m=2.0)) == "**TELEPORT**"
    assert stress.ending(replace(good, step_error_m=2.0, longest_gap_s=1.0)) == "bounded"  # it was silent meanwhile
    assert stress.ending(replace(good, max_m=3.0)) == "**UNBOUNDED**"
    lost = {"initializing": 10.0, "tracking": 60.0, "lost": 30.0}
    assert stress.ending(replace(good, max_m=3.0, health=lost)) == "lost, says so"
    waiting = figures.Figures("x-0", "mono", "failed", health={"initializing": 100.0})
    assert stress.ending(waiting) == "never started"


def test_there_is_a_trial_for_every_stress(stress: Any) -> None:
    known = stress.trials()
    wanted = {"dark-1s", "dark-5s", "drops", "outliers", "offset", "tilt", "noise", "saturated", "low-texture"}
    assert wanted | {"rotation", "motion", "hover"} <= set(known)
    assert known["dark-5s"].window_s == (12.0, 17.0)
    hover = known["hover"]
    assert hover.window_s[1] - hover.window_s[0] == 60.0 and hover.scenario.plan.tour_s > 60.0
    rows = [measuring_row(stress, f"{name}-0", mode) for name in known for mode in ("mono", "stereo")]
    told = stress.summary(rows, list(known)).splitlines()
    assert len(told) == 2 + len(rows) and len({row.count("|") for row in told}) == 1
    assert "hover mono: drift in 60 s ∞ mm" in stress.verdicts(rows)


def measuring_row(stress: Any, flight: str, mode: str) -> Any:
    return stress.Figures(flight, mode, "crashed", "killed")


@pytest.mark.parametrize("laps", [1, 3])
def test_a_repeated_flight_is_one_flight(
    long_flight: Any, noise_recording: Callable[..., Recording], laps: int
) -> None:
    one = noise_recording(frames=4)
    flown = long_flight.Repeated(one, laps)
    assert len(flown.frame_times_ns) == 4 * laps and flown.lap_ns == 4 * 50_000_000
    assert np.all(np.diff(flown.frame_times_ns) == 50_000_000)
    assert np.all(np.diff(flown.imu.t_ns) > 0) and len(flown.imu) == 37 * laps  # from the first frame on
    first, last = flown.frame(1), flown.frame(4 * (laps - 1) + 1)
    np.testing.assert_array_equal(first.images[0], last.images[0])
    assert last.t_ns - first.t_ns == (laps - 1) * flown.lap_ns
    truth = one.ground_truth
    assert truth is not None and truth.gyro_bias_rad_s is not None
    walked = truth.gyro_bias_rad_s[-1] - truth.gyro_bias_rad_s[0]
    per_lap = len(flown.imu) // laps
    difference = flown.imu.gyro_rad_s[-per_lap:] - flown.imu.gyro_rad_s[:per_lap]
    np.testing.assert_allclose(difference, np.tile((laps - 1) * walked, (per_lap, 1)), atol=1e-12)
    metres, degrees = flown.seam()
    assert metres == pytest.approx(np.linalg.norm(truth.p_world_imu[-1] - truth.p_world_imu[0])) and degrees > 0.0


def test_growing_cost_is_detected_and_variation_in_a_lap_is_not(cost: Any) -> None:
    lap = 10.0 + 5.0 * np.sin(np.linspace(0.0, 2.0 * np.pi, 800))
    even = cost.flatness(np.tile(lap, 15).tolist(), 800, 1200)
    assert even.ratio == pytest.approx(1.0)
    dearer = np.tile(lap, 15) * np.linspace(1.0, 1.2, 12_000)
    assert 1.1 < cost.flatness(dearer.tolist(), 800, 1200).ratio < 1.2
    assert math.isnan(cost.flatness(lap.tolist(), 800, 1200).ratio)


def test_the_profiler_sees_what_runs(long_flight: Any, tmp_path: Path) -> None:
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
    (tmp_path / "vio.py").write_text(source)
    space: dict[str, Any] = {}
    exec(compile(source, str(tmp_path / "vio.py"), "exec"), space)
    profile = long_flight.Profile()
    start_s = time.process_time()
    with profile.looking():
        space["busy"](np.random.default_rng(0).integers(0, 255, (480, 752)).astype(np.uint8), 30)
    spent_s = time.process_time() - start_s
    assert 0.5 * spent_s < sum(profile.stages.values()) < 1.01 * spent_s
    assert set(profile.stages) <= {"corner detection", "Python and the rest", "reading, not counted"}
    assert profile.stages["corner detection"] > 0.1 * spent_s
    assert profile.stages["Python and the rest"] > 0.1 * spent_s


def test_looks_of_the_profiler_do_not_pile_up(long_flight: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, a look may take longer than the time between two of them."""
    within, deepest = 0, 0

    def slow(_: Any) -> str:
        nonlocal within, deepest
        within += 1
        deepest = max(deepest, within)
        end_s = time.monotonic() + 5.0 * long_flight.TICK_S
        while time.monotonic() < end_s and within < 10:
            pass
        within -= 1
        return "slow"

    monkeypatch.setattr(long_flight, "stage_of", slow)
    with long_flight.Profile().looking():
        end_s = time.monotonic() + 50.0 * long_flight.TICK_S
        while time.monotonic() < end_s:
            pass
    assert deepest == 1


def test_costs_are_judged(cost: Any) -> None:
    found = {
        "mode": "mono", "recording": "x", "lap_s": 30.0, "rate_hz": 20.0, "seam": (0.0, 0.0),
        "cpu_ms": [9.0] * 12_000, "keyframe": [True, False] * 6_000, "memory_mb": [200.0] * 120,
        "health": {"tracking": 12_000}, "stages": {"KLT": 60.0, "corner detection": 40.0}, "functions": {"f": 100.0},
    }  # fmt: skip
    row = cost.cost_row(found)
    assert len(row) == len(cost.HEADINGS) and "**no**" not in "".join(row)
    assert "**no**" in "".join(cost.cost_row({**found, "cpu_ms": [10.5] * 12_000}))
    assert "**no**" in "".join(cost.cost_row({**found, "cpu_ms": [8.0] * 11_000 + [9.0] * 1_000}))
    assert "| KLT | 60.0 | 5.00 |" in cost.profile_table(found)


def test_a_suite_is_measured_once_and_goes_on(
    suite: Any, flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights = tmp_path / "flights"
    flights.mkdir()
    (flights / "room-easy-v0-0").symlink_to(flown.folder)
    (flights / "room-easy-v0-12").symlink_to(flown.folder)  # no seed that was asked for
    (flights / "hall-easy-v0-0" / "mav0").mkdir(parents=True)  # damaged
    command = suite.Suite(flights, tmp_path / "rows", modes=("mono",), json=tmp_path / "all.json")
    assert suite.main(command) == 1
    told = capsys.readouterr().out
    assert "failures 1" in told and "hall-easy-v0-0 mono: failed" in told and "hover" not in told
    [row] = [row for row in json.loads((tmp_path / "all.json").read_text())["runs"] if row["status"] == "ok"]
    assert row["flight"] == "room-easy-v0-0" and row["coverage_percent"] == 100.0
    assert 0.0 < row["ate_m"] < 0.05 and row["step_jump_m"] < 0.05 and row["not_finite"] == 0
    [kept] = (tmp_path / "rows").glob("room-easy-v0-0-mono-*.json")
    kept.write_text(kept.read_text().replace(f'"ate_m": {row["ate_m"]}', '"ate_m": 0.0123'))
    suite.main(command)
    [again] = [row for row in json.loads((tmp_path / "all.json").read_text())["runs"] if row["status"] == "ok"]
    assert again["ate_m"] == 0.0123  # read, not done again


def test_outliers_end_in_a_bounded_error(
    stress: Any, flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "none-0").symlink_to(flown.folder)
    command = stress.Stress(tmp_path, tmp_path / "rows", ("outliers", "hover"), ("mono",), fly=False)
    assert stress.main(command) == 0
    told = capsys.readouterr().out
    assert "| outliers-0 | mono |" in told and "Not flown: hover-0." in told
    assert stress.main(stress.Stress(tmp_path, tmp_path, ("nothing",))) == 2


def test_the_cost_of_a_flight_is_measured(cost: Any, flown: Any, capsys: pytest.CaptureFixture[str]) -> None:
    cost.main(cost.Cost(flown.folder, minutes=0.05, modes=("mono",), profile=True))
    told = capsys.readouterr().out
    assert "| mono | 0.1 |" in told and "| KLT |" in told and "window: sightings" in told
