"""Frames of the covariances of relative poses, and the factors of an odometry whose drift is known."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.odometry_factors import RelativePose, first_node, odometry_factors
from dronevio.models.rotation import pose_matrix, rotation_z

Array = npt.NDArray[np.float64]

NO_LANDMARKS = np.zeros(0, np.int64), np.zeros((0, 3))


@dataclass(frozen=True)
class Drift:
    """Variances of an odometry at one keyframe; the tilt is known to 1 mrad."""

    yaw: float
    """Variance of the yaw [rad²]."""
    position: float
    """Variance of each component of the position [m²]."""


def estimate(index: int, T_odom_imu: Array, drift: Drift, tilt: float = 1e-6) -> KeyframeEstimate:
    """Return a keyframe every 0.2 s, whose relative covariance within the window is small."""
    covariance = np.diag([tilt, tilt, drift.yaw, *([drift.position] * 3)])
    t_ns = 200_000_000 * index
    return KeyframeEstimate(t_ns, T_odom_imu, covariance, t_ns + 200_000_000, 1e-10 * np.eye(6), *NO_LANDMARKS)


def test_position_covariance_is_turned_into_the_second_frame() -> None:
    T = pose_matrix(rotation_z(np.pi / 2.0), np.array([1.0, 2.0, 3.0]))
    measured = RelativePose.measured(3, 7, T, np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    # The x axis of the second frame is the y axis of the first one.
    np.testing.assert_allclose(measured.covariance, np.diag([1.0, 2.0, 3.0, 5.0, 4.0, 6.0]), atol=1e-12)
    assert (measured.first, measured.second) == (3, 7)


def test_covariance_grows_as_that_of_the_odometry() -> None:
    poses = [pose_matrix(np.eye(3), np.zeros(3)) for _ in range(3)]
    drifts = [Drift(1e-6, 1e-4), Drift(4e-6, 3e-4), Drift(9e-6, 7e-4)]
    node = first_node(0, estimate(0, poses[0], drifts[0]))
    for index in (1, 2):
        node, relative, _ = odometry_factors(node, index, estimate(index, poses[index], drifts[index]))
        np.testing.assert_allclose(np.diag(node.covariance)[2:], np.diag(node.estimate.covariance)[2:], rtol=1e-6)
        growth = drifts[index].position - drifts[index - 1].position
        np.testing.assert_allclose(np.diag(relative.covariance)[3:], growth, rtol=1e-3)


def test_yaw_moves_a_distant_keyframe() -> None:
    """A yaw of 2 mrad displaces a keyframe at 10 m by 20 mm, to which the odometry adds nothing."""
    drift = Drift(4e-6, 1e-4)
    far = estimate(1, pose_matrix(np.eye(3), np.array([10.0, 0.0, 0.0])), drift)
    node, relative, _ = odometry_factors(first_node(0, estimate(0, np.eye(4), drift)), 1, far)
    assert node.covariance[4, 4] == pytest.approx(1e-4 + 10.0**2 * 4e-6, rel=1e-3)
    np.testing.assert_allclose(np.diag(relative.covariance)[3:], 1e-10, rtol=1e-3)


def test_new_knowledge_of_the_tilt_is_a_direction_of_gravity() -> None:
    drift = Drift(1e-6, 1e-4)
    first = first_node(0, estimate(0, np.eye(4), drift, tilt=4e-6))
    node, _, gravity = odometry_factors(first, 1, estimate(1, np.eye(4), drift, tilt=1e-6))
    assert gravity is not None and gravity.keyframe == 1
    np.testing.assert_allclose(gravity.up_imu, [0.0, 0.0, 1.0], atol=1e-12)
    # Information adds: 1/1e-6 = 1/(4e-6 + 1e-10) + 1/σ².
    assert gravity.sigma_rad**-2 == pytest.approx(1.0 / 1e-6 - 1.0 / 4.0001e-6, rel=1e-6)
    np.testing.assert_allclose(np.diag(node.covariance)[:2], 1e-6, rtol=1e-6)


def test_nothing_new_on_the_tilt_is_no_factor() -> None:
    drift = Drift(1e-6, 1e-4)
    first = first_node(0, estimate(0, np.eye(4), drift, tilt=1e-6))
    _, _, gravity = odometry_factors(first, 1, estimate(1, np.eye(4), drift, tilt=2e-6))
    assert gravity is None
