"""IMU factors with and without a camera."""

import numpy as np
import pytest

from dronevio.estimator.book.visual_inertial import CameraStudy, run_camera_study
from dronevio.models.imu import EUROC_IMU
from dronevio.models.imu_presets import TACTICAL


@pytest.fixture(scope="module")
def study() -> CameraStudy:
    """Two flights of two and a half rounds of 12 s."""
    return run_camera_study(EUROC_IMU, np.random.default_rng(0), runs=2, duration_s=30.0)


def test_the_camera_stops_the_drift(study: CameraStudy) -> None:
    np.testing.assert_allclose(study.t_s, np.arange(2.5, 30.1, 2.5))
    assert study.imu_rms_m[-1] > 1.0
    assert study.rms_m.max() < 0.2 and study.rms_m[-4:].max() < 0.06
    second_round = study.t_s > 12.0
    assert study.sigma_m[:, second_round].max() < study.sigma_m[:, ~second_round].max()


def test_standard_deviations_with_a_camera_are_consistent(study: CameraStudy) -> None:
    normalized = np.sqrt(np.mean((study.error_m / study.sigma_m) ** 2))
    assert 0.5 < normalized < 2.0  # the errors of a flight are correlated
    assert 0.9 < study.normalized_error < 1.1
    assert np.all(study.sigma_m < study.imu_sigma_m)


def test_the_imu_alone_drifts_as_predicted(study: CameraStudy) -> None:
    assert np.all(np.diff(study.imu_sigma_m) > 0.0)
    assert 0.2 < study.imu_rms_m[-1] / study.imu_sigma_m[-1] < 3.0


def test_same_seed_gives_the_same_flight() -> None:
    one, other = (run_camera_study(TACTICAL, np.random.default_rng(4), runs=1, duration_s=5.0) for _ in range(2))
    np.testing.assert_array_equal(one.error_m, other.error_m)
    assert one.observations == other.observations > one.landmarks > 0
