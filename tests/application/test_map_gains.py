"""The script that measures what the map gains: its scores and shares by hand, altered IMUs, and a short flight."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3
from dronevio.models.state import NavState, Trajectory

S = 1_000_000_000


@pytest.fixture(scope="module")
def gains(script: Callable[[str], Any]) -> Any:
    """The script."""
    return script("map_gains")


@pytest.fixture(scope="module")
def tables(script: Callable[[str], Any], gains: Any) -> Any:
    """The tables of the script."""
    return script("map_gain_tables")


def path_along(p_m: Any) -> Trajectory:
    """Return poses at positions (N, 3) [m], one second apart."""
    zero = np.zeros(3)
    Ts = np.tile(np.eye(4), (len(p_m), 1, 1))
    Ts[:, :3, 3] = p_m
    return Trajectory.from_states(NavState(i * S, T, zero, zero, zero) for i, T in enumerate(Ts))


@pytest.fixture(scope="module")
def flight(tables: Any) -> Callable[..., Any]:
    """Makes flights by the ATEs of odometry, online and final path [mm], and by scale errors and NEES."""

    def make(
        mm: tuple[float, float, float],
        percent: tuple[float, float] = (0.0, 0.0),
        nees: float = 3.0,
        loops: int = 1,
        name: str = "MH_04",
        freed_mm: tuple[float, float, float] = (1.0, 1.0, 1.0),
        se3_mm: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> Any:
        odometry, online, final = (
            tables.PathScores(*scores, 0.5)
            for scores in zip(mm, freed_mm, (percent[0], 0.0, percent[1]), (3.0, nees, 3.0), se3_mm, strict=True)
        )
        return tables.Flight(
            name, 1, 0.0, None, "none", "adjusted", loops, 0, 100.0, odometry, online, final, "a machine"
        )

    return make


def test_freed_scale_by_hand(tables: Any) -> None:
    """A square with sides of 2 m that is 10 % too large, and of which one pair of corners is 0.1 m too high."""
    corners = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
    found = tables.PathScores.of(score_trajectory(path_along(corners), path_along(1.1 * corners)))
    assert found.ate_mm == pytest.approx(1e2 * math.sqrt(2.0))
    assert (found.freed_mm, found.scale_percent, found.nees) == (
        pytest.approx(0.0, abs=1e-6),
        pytest.approx(10.0),
        None,
    )
    saddle = 1.1 * corners + [[0.0, 0.0, 0.1], [0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.0, 0.0, -0.1]]
    found = tables.PathScores.of(score_trajectory(path_along(corners), path_along(saddle)))
    factor = 2.2 / (2.2 * 1.1 + 0.01)  # Σ t·e / Σ e·e
    expected_m = math.sqrt(2.0 * (1.0 - 1.1 * factor) ** 2 + (0.1 * factor) ** 2)
    assert found.freed_mm == pytest.approx(1e3 * expected_m)


def test_bounds_at_their_limits(tables: Any, flight: Callable[..., Any]) -> None:
    assert tables.keeps_final(flight((100.0, 1.0, 105.0))) and not tables.keeps_final(flight((100.0, 1.0, 105.1)))
    assert tables.keeps_online(flight((100.0, 105.0, 1.0))) and not tables.keeps_online(flight((100.0, 105.1, 1.0)))
    assert tables.keeps_online(flight((2.5, 3.0, 1.0))) and not tables.keeps_online(flight((2.5, 3.01, 1.0)))
    still = (1.0, 1.0, 1.0)
    assert tables.keeps_scale(flight(still, (-0.5, 0.59))) and not tables.keeps_scale(flight(still, (0.5, -0.61)))
    assert [tables.keeps_nees(flight(still, nees=nees)) for nees in (1.4, 1.5, 5.0, 5.1)] == [False, True, True, False]


def test_vertical_of_the_truth_by_hand(tables: Any) -> None:
    """A square with sides of 2 m that is inclined by 0.01 rad: its corners are up to √2 · 0.01 m too high or low."""
    corners = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
    inclined = corners @ exp_so3(0.01 * np.array([1.0, 0.0, 0.0])).T
    found = tables.PathScores.of(score_trajectory(path_along(corners), path_along(inclined)))
    assert found.ate_mm == pytest.approx(10.0, rel=1e-3)
    assert found.se3_mm == pytest.approx(0.0, abs=1e-6) and found.tilt_deg == pytest.approx(math.degrees(0.01))
    line = np.outer(np.arange(4.0), [1.0, 0.0, 0.0])
    found = tables.PathScores.of(score_trajectory(path_along(line), path_along(line)))
    assert found.se3_mm is None and math.isinf(tables.se3_mm(found))


def test_flights_by_what_their_data_can_judge(tables: Any, flight: Callable[..., Any]) -> None:
    """V1 with the scale freed, V2 with the rotation aligned, and others as they are."""
    worse, freed, aligned = (10.0, 20.0, 20.0), (8.0, 4.0, 4.0), (8.0, 2.0, 2.0)
    for name, error, gain in (("V1_02", 4.0, 0.5), ("V2_01", 2.0, 0.25), ("MH_04", 20.0, 2.0)):
        one = flight(worse, name=name, freed_mm=freed, se3_mm=aligned)
        assert tables.error_of(one)(one.final) == error
        kept = [keeps(one) for bound, keeps in tables.BOUNDS.items() if "V1 with" in bound or "V1 and" in bound]
        assert kept == [gain < 1.0] * 2
        assert not tables.keeps_final(one) and not tables.keeps_online(one)
        assert tables.median_gain([one]) == 2.0 and tables.median_gain([one], tables.error_of) == gain
    kept = tables.BOUNDS["the same, V1 by the ATE with the scale freed"]
    small, far = (4.0, 8.0, 8.0), (0.0, 1.0)
    assert kept(flight(worse, far, name="V1_02", freed_mm=freed, se3_mm=small))
    assert not kept(flight(worse, name="V1_02", freed_mm=small)) and not kept(flight(worse, far, name="V2_01"))


def test_failures_are_the_worst(tables: Any, flight: Callable[..., Any]) -> None:
    """They keep no bound, and are in the median."""
    good = flight((10.0, 10.0, 5.0))
    failed = replace(good, odometry=None, online=None, final=None, loops=0, outcome="failed:\nno pose | at all")
    without_map = replace(good, online=None, final=None, loops=0)
    for keeps in tables.BOUNDS.values():
        assert [keeps(each) for each in (good, failed, without_map)] == [True, False, False]
    assert tables.median_gain([good, good, failed]) == 0.5
    assert math.isinf(tables.median_gain([good, failed, without_map]))
    assert tables.cells(failed)[6] == "∞" and tables.cells(failed)[-1] == "failed: no pose / at all"
    two = replace(good, cameras=2)
    shares = [line for line in tables.summary([good, failed, two]).splitlines() if "1.05 × odometry |" in line]
    assert shares == ["| final ≤ 1.05 × odometry | 2 of 3, 67 % | 1 of 2, 50 % | 1 of 1, 100 % |"]


def test_flights_without_loops_are_not_in_the_median(tables: Any, flight: Callable[..., Any]) -> None:
    still, better = flight((10.0, 10.0, 10.0), loops=0), flight((10.0, 10.0, 4.0))
    assert tables.median_gain([still, still, better]) == pytest.approx(0.4)
    assert tables.median_gain([still]) is None


def test_altered_samples(gains: Any, script: Callable[[str], Any], noise_recording: Callable[..., Any]) -> None:
    """The noise that is added has √8 times the stated density, so that with the stated one it has three times."""
    short = noise_recording(frames=2000)
    recording = script("measuring").ChangedRecording("n", short.rig, short.imu, short.frame_times_ns, short.frame)
    model, added = short.rig.imu, {}
    for name in gains.ALTERATIONS:
        altered = gains.ALTERATIONS[name](recording, np.random.default_rng(1)).imu
        added[name] = altered.gyro_rad_s - short.imu.gyro_rad_s, altered.accel_m_s2 - short.imu.accel_m_s2
        again = gains.ALTERATIONS[name](recording, np.random.default_rng(1)).imu
        np.testing.assert_array_equal(altered.accel_m_s2, again.accel_m_s2)
    assert not np.any(added["none"])
    per_sample = math.sqrt(8.0 * model.rate_hz)
    densities = model.gyro_noise_density, model.accel_noise_density
    for noise, density in zip(added["noise"], densities, strict=True):
        np.testing.assert_allclose(noise.std(axis=0), per_sample * density, rtol=0.03)
    for bias, sigma in zip(added["bias"], (model.gyro_turn_on_bias_rad_s, model.accel_turn_on_bias_m_s2), strict=True):
        np.testing.assert_allclose(np.abs(bias), 3.0 * sigma)
    assert not np.any(added["scale"][0])
    np.testing.assert_allclose(added["scale"][1], 0.01 * short.imu.accel_m_s2, atol=1e-12)


def test_a_file_is_continued(
    gains: Any, flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "gains.jsonl"
    command = gains.MapGainsCommand((flown.folder,), out, cameras=(1,), duration_s=5.0, alterations=("none",))
    gains.main(command)
    first, (line,) = capsys.readouterr(), out.read_text(encoding="utf-8").splitlines()
    measured = gains.Flight.from_json(line)
    assert measured.odometry is not None and measured.final is not None and measured.coverage_percent == 100.0
    assert 0.0 < measured.odometry.ate_mm < 50.0 and "numpy" in measured.made_by
    assert f"| `{flown.folder.name}` | 1 | 0 | none | 0 |" in first.out
    assert "| final ≤ 1.05 × odometry | 1 of 1, 100 % |" in first.out

    def breaks(*_: object) -> None:
        raise RuntimeError("the run ends")

    monkeypatch.setattr(gains, "estimate", breaks)
    gains.main(replace(command, alterations=("none", "bias")))
    same, broken = (gains.Flight.from_json(each) for each in out.read_text(encoding="utf-8").splitlines())
    assert asdict(same) == asdict(measured)
    assert (broken.alteration, broken.outcome, broken.final) == ("bias", "DEFECT: RuntimeError: the run ends", None)
    assert "| final ≤ 1.05 × odometry | 1 of 2, 50 % |" in capsys.readouterr().out


def test_bad_arguments(gains: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown alteration 'heat'"):
        gains.main(gains.MapGainsCommand((tmp_path,), tmp_path / "out", alterations=("heat",)))
    with pytest.raises(ConfigError, match="different names"):
        gains.main(gains.MapGainsCommand((tmp_path / "a", tmp_path / "b" / "a"), tmp_path / "out"))
