"""The scripts that measure the odometry: their statistics and tables, and runs on a short flight."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dronevio
from dronevio.estimator.types import Observations
from dronevio.models.errors import ConfigError
from dronevio.models.state import CameraFrame
from dronevio.sim.speed.image_rate import ImageRate


def fixture_of(name: str) -> Callable[[Callable[[str], Any]], Any]:
    """Return a fixture of a script."""

    def load(script: Callable[[str], Any]) -> Any:
        return script(name)

    return pytest.fixture(scope="module", name=name)(load)


measuring, corrupted_tracks, profiler, seeds = map(fixture_of, ("measuring", "corrupted_tracks", "profiler", "seeds"))


gym_speed, physics_errors, image_rates = map(fixture_of, ("gym_speed", "physics_errors", "image_rates"))


def test_rows_of_other_simulators(gym_speed: Any) -> None:
    measured = [{"version": "3.0.0", "settings": "two vehicles", "speed": 72.4}]
    rows = gym_speed.rows_of("rotorpy", measured)
    assert rows == [("rotorpy 3.0.0", "two vehicles", "72", gym_speed.LEFT_OUT["rotorpy"])]


def test_errors_of_the_physics_are_those_of_mujoco(physics_errors: Any, capsys: pytest.CaptureFixture[str]) -> None:
    physics_errors.measure(physics_errors.ErrorsCommand(count=4))
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "Hz" in line]
    energy, position = ([float(row[column]) for row in rows] for column in (-5, -4))
    assert energy[0] < 1e-6 and position[0] < 1e-6  # free flight
    np.testing.assert_allclose(np.array(energy[1:3]) / energy[3], [10.0, 4.0], rtol=0.2)  # of first order in the step


def test_rates_of_images_have_a_row_for_each_world(image_rates: Any) -> None:
    rates = [
        ImageRate("room", "grey", 64, 48, 99.6, 1.0),
        ImageRate("room", "flow", 64, 48, 50.2, 1.0),
        ImageRate("hall", "grey", 64, 48, 9.0, 1.0),
    ]
    assert image_rates.rows_of(rates) == [("room", "100", "50"), ("hall", "9")]
    assert image_rates.size_of("64x48") == (64, 48)
    with pytest.raises(ConfigError, match="'64x'; expected a width and a height"):
        image_rates.size_of("64x")


@settings(deadline=None)
@given(st.lists(st.integers(0, 30), min_size=1, max_size=6))
def test_numbers_are_lists_and_ranges(measuring: Any, numbers: list[int]) -> None:
    assert measuring.numbers(",".join(map(str, numbers))) == tuple(dict.fromkeys(numbers))
    first, last = min(numbers), max(numbers)
    assert measuring.numbers(f"{first}-{last}") == tuple(range(first, last + 1))


class StaticFrontEnd:
    """A front end that observes the same features in all frames."""

    def __init__(self, n: int = 2000) -> None:
        self.age, self.n = 0, n

    def track(self, frame: CameraFrame, *motion: object) -> Observations:
        self.age += 1
        return self.replenish()

    def replenish(self, calibration: object = None, at_exposure_of: object = None) -> Observations:
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


@pytest.mark.slow
def test_a_front_end_with_outliers_is_an_estimator(
    corrupted_tracks: Any, flown: Any, run_command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(corrupted_tracks.__file__).parent
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", f"{folder}:{Path(dronevio.__file__).parents[1]}")
    words = ["--estimators", "vio", "a=python:corrupted_tracks:outliers"]
    rows = run_command(
        tmp_path, "benchmark", "--recordings", flown.folder, *words, "--out", tmp_path / "rows", "--json"
    ).document["rows"]
    corrupted, clean = rows
    assert (corrupted["estimator"], corrupted["status"], clean["status"]) == ("a", "ok", "ok")
    assert clean["ate_m"] != corrupted["ate_m"] < 0.1
    assert corrupted_tracks.random_30_stereo.keywords["cameras"] is None
    with pytest.raises(AttributeError, match="no estimator random_31; expected one of outliers, random-10"):
        _ = corrupted_tracks.random_31


def test_profile_of_a_flight_has_the_stages(profiler: Any, flown: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert profiler.main(profiler.ProfileCommand(flown.folder)) == 0
    printed = capsys.readouterr().out
    assert "| KLT |" in printed and "| linearization of observations |" in printed
    assert profiler.OUTSIDE not in printed
    assert "decode_grey" not in printed  # images are read outside the estimator


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
    module = tmp_path / "estimator" / "odometry.py"
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
