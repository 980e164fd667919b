"""The rotation of an IMU in a camera, by the rotation of the images against the gyroscope."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.calibration.image_rotation import RelativeRotations, tracked_rotations
from dronevio.estimator.calibration.imu_rotation import imu_rotation
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.gopro import imu_rotation_named
from dronevio.models.rotation import exp_so3, log_so3


def angle_deg(R: Array, other: Array) -> float:
    return float(np.degrees(np.linalg.norm(log_so3(R.T @ other))))


def measured(R_imu_cam: Array, offset_s: float, axes: Array, outliers: int = 0) -> tuple[RelativeRotations, ImuSamples]:
    """Return ten seconds of rotation about axes of the camera, seen by images at 15 Hz and a gyroscope at 200 Hz."""
    rng, t_s = np.random.default_rng(0), np.arange(2200, dtype=np.float64) * 0.005

    def integral(times: Array) -> Array:
        phases = np.array([0.1, 1.3, 2.2])
        waves = [np.sin(f * times[:, None] + phases) / f for f in (2.1, 3.7, 5.9)]
        return np.asarray(0.4 * sum(waves) @ np.diag(axes))

    def rate(times: Array) -> Array:
        return np.asarray((integral(times + 1e-4) - integral(times - 1e-4)) / 2e-4)

    gyro = rate(t_s) @ R_imu_cam.T + [0.01, -0.02, 0.015] + rng.normal(0.0, 1e-3, (len(t_s), 3))
    imu = ImuSamples((t_s * 1e9).astype(np.int64), gyro, np.zeros_like(gyro))
    start_s = 0.5 + np.arange(150) / 15.0
    end_s = start_s + 1.0 / 15.0
    image = integral(end_s + offset_s) - integral(start_s + offset_s) + rng.normal(0.0, 2e-4, (150, 3))
    image[:outliers] = rng.normal(0.0, 0.1, (outliers, 3))
    times = [(each * 1e9).astype(np.int64) for each in (start_s, end_s)]
    return RelativeRotations(times[0], times[1], image, np.full(150, 2e-4)), imu


@pytest.mark.parametrize("offset_s", [0.0, 0.1, -0.2])
@pytest.mark.parametrize("R_imu_cam", [imu_rotation_named("yxz"), exp_so3(np.array([1.0, -2.0, 0.5]))])
def test_the_rotation_is_found_without_a_prior(R_imu_cam: Array, offset_s: float) -> None:
    found = imu_rotation(*measured(R_imu_cam, offset_s, np.ones(3), outliers=12))
    assert found is not None and found.is_significant
    assert angle_deg(found.R_imu_cam, R_imu_cam) < 0.5 and found.offset_s == pytest.approx(offset_s, abs=0.004)


def test_two_axes_are_enough_and_one_is_not() -> None:
    R = imu_rotation_named("ZXY")
    two = imu_rotation(*measured(R, 0.0, np.array([1.0, 0.3, 0.0])))
    assert two is not None and two.is_significant and angle_deg(two.R_imu_cam, R) < 1.0
    one = imu_rotation(*measured(R, 0.0, np.array([0.0, 1.0, 0.0])))
    assert one is not None and not one.is_significant and one.explained > 0.9


def test_images_of_another_flight_are_not_significant() -> None:
    pairs, imu = measured(np.eye(3), 0.0, np.ones(3))
    reversed_ = ImuSamples(imu.t_ns, imu.gyro_rad_s[::-1] * [1.0, -0.3, 2.0], imu.accel_m_s2)
    found = imu_rotation(pairs, reversed_)
    assert found is not None and not found.is_significant
    assert imu_rotation(pairs[np.arange(5)], imu) is None


@pytest.mark.skipif("DRONEVIO_DATA" not in os.environ, reason="DRONEVIO_DATA, the folder of real data, is not set")
def test_the_rotation_of_a_real_camera_is_found() -> None:
    """The pose of the camera is replaced by the identity before, so that nothing tells the rotation."""
    from dataclasses import replace

    from dronevio.models.recordings.open import open_recording

    recording: Any = open_recording(Path(os.environ["DRONEVIO_DATA"]) / "euroc" / "MH_01_real", 1)
    camera = recording.rig.cameras[0]
    unknown = replace(recording.rig, cameras=(replace(camera, T_imu_cam=np.eye(4)),))
    found = imu_rotation(tracked_rotations(map(recording.frame, range(120)), unknown), recording.imu)
    assert found is not None and found.is_significant
    assert angle_deg(found.R_imu_cam, camera.T_imu_cam[:3, :3]) < 1.5 and abs(found.offset_s) <= 0.004
