"""Judging paths without their truth, on a flight made of formulas whose truth is known after all."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.baselines.eqvio import FilterSettings
from dronevio.estimator.book.eqvio import FeatureRecording
from dronevio.estimator.book.batch import STRIDE, Judge
from dronevio.eval.metrics.alignment import align
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

NOISE_PX = 0.5
WRONG = 0.1  # share of the features


@pytest.fixture(scope="module")
def flown(make_flight: Callable) -> tuple[FeatureRecording, Trajectory]:
    """Return what was sensed in ten seconds, one feature in ten of it wrong, and the truth."""
    flight = make_flight(3, rest_s=-5.0, duration_s=10.0, pixel_noise=NOISE_PX, max_features=40)
    front_end, rng = flight.front_end(), np.random.default_rng(5)
    features = []
    for index in range(len(flight.frame_times_ns)):
        front_end.track(flight.frame(index), np.eye(3))
        seen = front_end.replenish()
        wrong = (rng.random(len(seen)) < WRONG)[:, None]
        features.append((seen.ids, seen.xy + wrong * rng.normal(0.0, 0.05, (len(seen), 2))))
    recording = FeatureRecording(
        "formulas", flight.rig, flight.imu, flight.frame_times_ns, tuple(features), FilterSettings()
    )
    return recording, flight.truth_at(flight.frame_times_ns)


def disturbed(truth: Trajectory, metres: float) -> Trajectory:
    """Return a path that leaves the truth by some metres, to and fro, and by a few degrees."""
    t_s, rng = truth.t_s[:, None], np.random.default_rng(6)
    away_m = metres * np.sin(t_s * [0.9, 1.4, 1.9] + rng.uniform(0.0, 6.0, 3))
    turned = truth.rotations @ exp_so3(0.02 * np.sin(t_s * [1.1, 0.7, 1.7]))
    rates = (truth.velocity_m_s, truth.gyro_bias_rad_s, truth.accel_bias_m_s2)
    return Trajectory(truth.t_ns, truth.p_world_imu + away_m, quat_wxyz_from_matrix(turned), *rates)


def test_full_smoothing_is_near_the_truth_wherever_it_begins(flown: tuple[FeatureRecording, Trajectory]) -> None:
    recording, truth = flown
    path = disturbed(truth, 0.05)
    judge = Judge(recording, path)
    np.testing.assert_array_equal(judge.t_ns, truth.t_ns[::STRIDE])
    true_m, found_m = truth.p_world_imu[::STRIDE], judge.reference()
    fit = align(true_m, found_m, "yaw")
    away_m = np.linalg.norm(true_m - fit.positions(found_m), axis=1)
    assert np.sqrt(np.mean(away_m**2)) < 0.01


def test_residuals_rise_with_the_error_of_a_path(flown: tuple[FeatureRecording, Trajectory]) -> None:
    recording, truth = flown
    judge = Judge(recording, disturbed(truth, 0.05))
    left = [judge.residuals(disturbed(truth, metres).p_world_imu[::STRIDE]) for metres in (0.0, 0.06, 0.2)]
    assert left[0].sightings > 500
    # The distance from a point with normal noise in both directions has a median of 1.18 sigma; landmarks and
    # orientations that were fitted to the same noise leave less, and features that are wrong more.
    assert 0.8 * NOISE_PX < left[0].median_px < 1.5 * NOISE_PX
    assert left[1].median_px > 1.2 * left[0].median_px and left[1].rms_px > 1.2 * left[0].rms_px
    assert left[2].median_px > 1.2 * left[1].median_px and left[2].rms_px > 1.2 * left[1].rms_px
