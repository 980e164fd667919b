"""The benchmarks of honest covariances and of wrong intrinsics."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Health, Trajectory

Result = Any  # the class of conftest, which cannot be imported


@pytest.fixture(scope="module")
def honesty(script: Callable[[str], Any]) -> Any:
    return script("honesty")


def trajectory(count: int = 400) -> Trajectory:
    """Return a smooth path of 20 s that turns about all axes."""
    t = np.linspace(0.0, 20.0, count)
    p = np.column_stack([2.0 * np.sin(0.7 * t), np.cos(0.9 * t), 0.5 * np.sin(1.3 * t)])
    rotations = exp_so3(np.column_stack([0.3 * np.sin(t), 0.2 * np.cos(1.1 * t), 0.4 * t]))
    return Trajectory((1e9 * t).astype(np.int64), p, quat_wxyz_from_matrix(rotations))


def test_errors_of_the_truth_are_found(script: Callable[[str], Any]) -> None:
    """Also if an estimate begins elsewhere with another yaw, and is short."""
    truth_errors = script("truth_errors")
    wrong = truth_errors.TruthErrors((0.005, -0.008), 0.0006, 0.003)
    exact = trajectory()
    moved = Trajectory(exact.t_ns, exact.p_world_imu + [1.0, -2.0, 0.3], exact.quat_wxyz)
    found = truth_errors.fitted(exact, [wrong.corrected(moved), wrong.corrected(exact)[100:200]])
    np.testing.assert_allclose(found.inclination_rad, wrong.inclination_rad, atol=2e-4)
    assert found.yaw_rate_rad_s == pytest.approx(wrong.yaw_rate_rad_s, rel=0.1)
    assert found.delay_s == pytest.approx(wrong.delay_s, abs=2e-4)


def test_conditions_change_what_they_name(script: Callable[[str], Any], flown: Result) -> None:
    conditions, measuring = script("sensor_conditions"), script("measuring")
    given = measuring.ChangedRecording.of(open_recording(flown.folder, 1))
    changed = {name: change(given, np.random.default_rng(0)) for name, change in conditions.CONDITIONS.items()}
    np.testing.assert_array_equal(changed["as-is"].imu.gyro_rad_s, given.imu.gyro_rad_s)
    added = changed["noise-3x"].imu.gyro_rad_s - given.imu.gyro_rad_s
    imu, n = given.rig.imu, len(given.imu)
    expected = np.sqrt(8.0 * imu.rate_hz) * imu.gyro_noise_density
    assert np.diff(added, axis=0).std() == pytest.approx(np.sqrt(2.0) * expected, rel=0.1)
    # Coloured noise: density at low frequencies, from means over ten time constants
    added = changed["coloured"].imu.accel_m_s2 - given.imu.accel_m_s2
    block = round(imu.rate_hz)
    means = added[: n // block * block].reshape(-1, block, 3).mean(axis=1)
    density = conditions.COLOUR_FACTOR * imu.accel_noise_density
    assert 0.4 * density < means.std() < 1.6 * density
    added = changed["vibrating"].imu.accel_m_s2 - given.imu.accel_m_s2
    assert np.linalg.norm(added, axis=1).max() == pytest.approx(conditions.VIBRATION[1], rel=0.05)
    assert changed["stated-tenth"].rig.imu.gyro_noise_density == pytest.approx(0.1 * imu.gyro_noise_density)
    # Half the size: a pixel is the mean of four, and its centre is theirs
    image, half = given.frame(0).images[0].astype(float), changed["half-size"].frame(0).images[0]
    assert abs(half[5, 7] - image[10:12, 14:16].mean()) <= 0.5
    model, small = given.rig.cameras[0].model, changed["half-size"].rig.cameras[0].model
    np.testing.assert_allclose(small.normalize(np.array([7.0, 5.0])), model.normalize(np.array([14.5, 10.5])))


def test_kept_runs_are_what_has_been_published(
    honesty: Any, script: Callable[[str], Any], flown: Result, tmp_path: Path
) -> None:
    job = honesty.Job(flown.folder, 1, "as-is", 0.0, 2.0)
    run = honesty.run_of(job, tmp_path, 0)
    file = tmp_path / job.file_name
    assert file.exists() and len(run.t_ns) == 41  # 2 s at 20 Hz, both ends
    np.testing.assert_array_equal(run.t_ns[run.rows()], run.trajectory.t_ns)
    assert set(run.health[run.rows()]) <= {Health.TRACKING, Health.INERTIAL_ONLY}
    written = file.stat().st_mtime_ns
    again = honesty.run_of(job, tmp_path, 0)
    assert file.stat().st_mtime_ns == written
    np.testing.assert_array_equal(again.trajectory.covariance, run.trajectory.covariance)


def test_scores_by_hand(honesty: Any, script: Callable[[str], Any]) -> None:
    """Errors of 3 cm beyond what the truth resolves, at standard deviations of 1 and 0.5 cm; one of them is said."""
    flight, error = trajectory(40), np.zeros((40, 3))
    p = flight.p_world_imu.copy()
    p[1] = p[0]
    exact = replace(flight, p_world_imu=p)  # begins at rest
    error[10:, 0] = 0.04  # the first pose is aligned
    covariance = np.tile(np.diag(np.repeat([1e-6, 0.01**2, 1e-4, 1e-8, 1e-6], 3)), (40, 1, 1))
    covariance[30:, 3:6, 3:6] = 0.005**2 * np.eye(3)
    estimate = Trajectory(exact.t_ns, exact.p_world_imu + error, exact.quat_wxyz, covariance=covariance)
    health = np.array(["tracking"] * 35 + ["inertial-only"] * 5)
    run = script("kept_runs").KeptRun(exact.t_ns, health, np.full(40, "INCONSISTENT"), np.ones(40), estimate, ())
    scores = honesty.Scores.of(run, exact, 0.01)
    np.testing.assert_allclose(scores.position_nees, [9.0] * 20 + [36.0] * 10)
    np.testing.assert_allclose(scores.sigmas, [0.0] * 10 + [3.0] * 20 + [6.0] * 10, atol=1e-9)
    assert scores.wrong == 5 and scores.untracked_percent == 0.0 and not scores.keeps_bounds
    # In motion, the variance of the first position, 1 cm², and a little of its yaw, belongs to each error
    moving = replace(estimate, p_world_imu=flight.p_world_imu + error)
    scores = honesty.Scores.of(replace(run, trajectory=moving), flight, 0.01)
    np.testing.assert_allclose(scores.position_nees, [4.5] * 20 + [7.2] * 10, rtol=0.04)
    assert not scores.wrong


@pytest.mark.slow
def test_honesty_prints_a_table(
    honesty: Any, flown: Result, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = honesty.HonestyCommand((flown.folder,), out=tmp_path, cameras=(1,), every_s=2.0, duration_s=2.0)
    honesty.main(command)
    out = capsys.readouterr().out
    assert "simulated, exact truth" in out and "as-is, in the air" in out and "bounds kept: " in out


def test_faults_change_the_intrinsics(script: Callable[[str], Any], flown: Result) -> None:
    intrinsics = script("intrinsics")
    camera = open_recording(flown.folder, 1).rig.cameras[0]
    changed = {name: fault.changed(camera).model for name, fault in intrinsics.FAULTS.items()}
    assert changed["right"] == camera.model
    assert changed["focal-5%"].fy == pytest.approx(0.95 * camera.model.fy)
    assert changed["centre+5px"].cx == camera.model.cx + 5.0
    assert changed["k1-0.02"].distortion[0] == pytest.approx(camera.model.distortion[0] - 0.02)
    given = intrinsics.config_of(intrinsics.IntrinsicsCommand((), given=True)).calibration
    assert not (given.focal.online or given.principal.online or given.radial.online) and given.rotation.online


@pytest.mark.slow
def test_intrinsics_prints_a_table(
    script: Callable[[str], Any], flown: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    intrinsics = script("intrinsics")
    command = intrinsics.IntrinsicsCommand((flown.folder,), faults=("right",), starts_s=(0.0,), begin_s=2.0)
    assert intrinsics.main(command) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "right" in line)
    assert row.split()[4:6] == ["1.00", "100"]
