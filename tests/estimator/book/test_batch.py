"""Full smoothing and reprojection errors, on a synthetic flight with known ground truth."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.baselines.eqvio import FilterSettings
from dronevio.estimator.book.batch import STRIDE, BatchAdjustment
from dronevio.estimator.book.eqvio import FeatureRecording
from dronevio.eval.metrics.alignment import align
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

Flown = tuple[FeatureRecording, Trajectory]

NOISE_PX = 0.5
OUTLIER_RATIO = 0.1


@pytest.fixture(scope="module")
def flown(make_flight: Callable[..., Any]) -> Flown:
    """A recording of ten seconds in which one feature in ten is an outlier, and its ground truth."""
    flight = make_flight(3, rest_s=-5.0, duration_s=10.0, pixel_noise=NOISE_PX, max_features=40)
    front_end, rng = flight.front_end(), np.random.default_rng(5)
    features = []
    for index in range(len(flight.frame_times_ns)):
        front_end.track(flight.frame(index), np.eye(3))
        seen = front_end.replenish()
        is_outlier = (rng.random(len(seen)) < OUTLIER_RATIO)[:, None]
        features.append((seen.ids, seen.xy + is_outlier * rng.normal(0.0, 0.05, (len(seen), 2))))
    recording = FeatureRecording(
        "synthetic", flight.rig, flight.imu, flight.frame_times_ns, tuple(features), FilterSettings()
    )
    return recording, flight.truth_at(flight.frame_times_ns)


def perturbed(truth: Trajectory, amplitude_m: float) -> Trajectory:
    """Return a trajectory that oscillates about the truth by some metres and by about a degree."""
    t_s, rng = truth.t_s[:, None], np.random.default_rng(6)
    offset_m = amplitude_m * np.sin(t_s * [0.9, 1.4, 1.9] + rng.uniform(0.0, 6.0, 3))
    rotations = truth.rotations @ exp_so3(0.02 * np.sin(t_s * [1.1, 0.7, 1.7]))
    rates = (truth.velocity_m_s, truth.gyro_bias_rad_s, truth.accel_bias_m_s2)
    return Trajectory(truth.t_ns, truth.p_world_imu + offset_m, quat_wxyz_from_matrix(rotations), *rates)


def test_full_smoothing_is_near_the_truth(flown: Flown) -> None:
    recording, truth = flown
    batch = BatchAdjustment(recording, perturbed(truth, 0.05))
    np.testing.assert_array_equal(batch.t_ns, truth.t_ns[::STRIDE])
    true_m, smoothed_m = truth.p_world_imu[::STRIDE], batch.full_smoothing()
    fit = align(true_m, smoothed_m, "yaw")
    error_m = np.linalg.norm(true_m - fit.positions(smoothed_m), axis=1)
    assert np.sqrt(np.mean(error_m**2)) < 0.01


def test_reprojection_errors_grow_with_position_errors(flown: Flown) -> None:
    recording, truth = flown
    batch = BatchAdjustment(recording, perturbed(truth, 0.05))
    errors = [
        batch.reprojection_errors(perturbed(truth, amplitude_m).p_world_imu[::STRIDE])
        for amplitude_m in (0.0, 0.06, 0.2)
    ]
    assert errors[0].observations > 500
    # The length of a two-dimensional normal error has a median of 1.18 sigma. Landmarks and orientations are fitted to
    # the same noise, which lowers it; outliers raise it.
    assert 0.8 * NOISE_PX < errors[0].median_px < 1.5 * NOISE_PX
    assert errors[1].median_px > 1.2 * errors[0].median_px and errors[1].rms_px > 1.2 * errors[0].rms_px
    assert errors[2].median_px > 1.2 * errors[1].median_px and errors[2].rms_px > 1.2 * errors[1].rms_px
