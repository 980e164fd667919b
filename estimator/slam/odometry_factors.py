"""The odometry as factors of a pose graph: relative poses and directions of gravity between keyframes of the map.

The priors of consecutive windows share information. A factor that holds all of one prior would count what the next one
repeats, so each keyframe that leaves the window adds only what is new: the growth of the covariance since the keyframe
before it, and what the accelerometer has added on roll and pitch. The marginal covariance of the keyframes in the
graph is then that of the odometry. It is the recovery of non-linear factors from a marginal prior (Usenko et al.,
"Visual-inertial mapping with non-linear factor recovery", RA-L 2020; Mazuran et al., IJRR 2016), matched to the
marginals of the poses.

The error of an odometry grows faster than a sum of independent errors, because the biases err for a long time in the
same direction: the relative covariances of neighbouring keyframes alone add up to half of the standard deviation after
50 s.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.models.rotation import adjoint, inverse_pose

Array = npt.NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A measured pose of one keyframe in the frame of another."""

    first: int
    """Number of the keyframe in whose frame the other one is measured."""
    second: int
    """Number of the other keyframe."""
    T_first_second: Array
    """(4, 4) Pose of the second keyframe's IMU in the frame of the first one's."""
    covariance: Array
    """(6, 6) Covariance of that pose: δθ, then δp, both in the IMU frame of the second keyframe."""

    @classmethod
    def measured(cls, first: int, second: int, T_first_second: Array, covariance: Array) -> Self:
        """Return a relative pose whose measured position is uncertain in the frame of the first keyframe.

        Args:
            first: Number of the keyframe in whose frame the other one is measured.
            second: Number of the other keyframe.
            T_first_second: (4, 4) Pose of the second keyframe's IMU in the frame of the first one's.
            covariance: (6, 6) Covariance of δθ (right perturbation, IMU frame of the second keyframe) and δp (IMU frame
                of the first one).
        """
        S = np.eye(6)
        S[3:, 3:] = T_first_second[:3, :3].T
        return cls(first, second, T_first_second, S @ covariance @ S.T)


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """A measured direction of gravity at a keyframe."""

    keyframe: int
    """Number of the keyframe."""
    up_imu: Array
    """(3,) Unit vector against gravity in the IMU frame."""
    sigma_rad: float
    """Standard deviation of each of its two angles [rad]."""


@dataclass(frozen=True, eq=False)
class OdometryNode:
    """A keyframe of the odometry in the pose graph."""

    number: int
    """Number of the keyframe."""
    estimate: KeyframeEstimate
    """Its final estimate by the odometry."""
    covariance: Array
    """(6, 6) Marginal covariance of its pose by the factors of the odometry up to it."""


def first_node(number: int, estimate: KeyframeEstimate) -> OdometryNode:
    """Return the first keyframe of a map, whose pose has the covariance of the odometry."""
    return OdometryNode(number, estimate, estimate.covariance)


def odometry_factors(
    previous: OdometryNode, number: int, estimate: KeyframeEstimate
) -> tuple[OdometryNode, RelativePose, GravityDirection | None]:
    """Return the next keyframe of the odometry and its factors.

    Args:
        previous: The keyframe that was marginalized before it.
        number: Number of the keyframe.
        estimate: Its final estimate.

    Returns:
        The keyframe, its pose in the frame of the previous one, and the direction of gravity, None where the odometry
        knows nothing new about it.
    """
    T = inverse_pose(previous.estimate.T_odom_imu) @ estimate.T_odom_imu
    transported = _transported(previous.covariance, T)
    least = _least_covariance(previous.estimate, estimate)
    added = least + _missing_growth(estimate, transported + least)
    relative = RelativePose(previous.number, number, T, added)
    P = transported + added
    up = estimate.T_odom_imu[:3, :3].T @ _UP
    tilt = tilt_axes(up)
    information = _information(tilt, estimate.covariance) - _information(tilt, P)
    mean_information = float(np.trace(information)) / 2.0
    gravity = None if mean_information <= 0.0 else GravityDirection(number, up, mean_information**-0.5)
    return OdometryNode(number, estimate, propagated(previous.covariance, relative, gravity)), relative, gravity


def propagated(covariance: Array, relative: RelativePose, gravity: GravityDirection | None) -> Array:
    """Return the marginal covariance (6, 6) of the second keyframe of a relative pose, at the end of the graph.

    Args:
        covariance: (6, 6) Marginal covariance of the first keyframe: δθ, then δp, both in its IMU frame.
        relative: The relative pose, the only connection of the second keyframe to others.
        gravity: The direction of gravity at the second keyframe.
    """
    P = _transported(covariance, relative.T_first_second) + relative.covariance
    if gravity is None:
        return P
    H = np.hstack([tilt_axes(gravity.up_imu), np.zeros((2, 3))])
    gain = np.linalg.solve(H @ P @ H.T + gravity.sigma_rad**2 * np.eye(2), H @ P).T
    P = P - gain @ H @ P
    return np.asarray(0.5 * (P + P.T))


def reversed_pose(relative: RelativePose) -> RelativePose:
    """Return a relative pose in the other direction: that of the first keyframe in the frame of the second one."""
    A = adjoint(relative.T_first_second)
    T_second_first = inverse_pose(relative.T_first_second)
    return RelativePose(relative.second, relative.first, T_second_first, A @ relative.covariance @ A.T)


def composed(relative: RelativePose, following: RelativePose) -> RelativePose:
    """Return two relative poses with independent errors in succession as one.

    Args:
        relative: The first one.
        following: The second one, from the second keyframe of the first one.
    """
    T = relative.T_first_second @ following.T_first_second
    covariance = _transported(relative.covariance, following.T_first_second) + following.covariance
    return RelativePose(relative.first, following.second, T, covariance)


def tilt_axes(up: Array) -> Array:
    """Return two axes (2, 3) across the direction of gravity."""
    return np.asarray(np.linalg.svd(up[None])[2][1:])


def _transported(covariance: Array, T_first_second: Array) -> Array:
    """Return the covariance (6, 6) of a second pose that is rigidly connected to a first one."""
    A = adjoint(inverse_pose(T_first_second))
    return np.asarray(A @ covariance @ A.T)


def _least_covariance(previous: KeyframeEstimate, estimate: KeyframeEstimate) -> Array:
    """Return the covariance of the relative pose within the window, extended to keyframes that are further apart."""
    interval_ns = max(previous.next_t_ns - previous.t_ns, 1)
    return np.asarray(previous.relative_covariance * max((estimate.t_ns - previous.t_ns) / interval_ns, 1.0))


def _missing_growth(estimate: KeyframeEstimate, covariance: Array) -> Array:
    """Return what a covariance (6, 6) of a pose lacks to reach that of the odometry, at least zero.

    Yaw, height and the horizontal position are compared apart. Of the latter it is the trace, since an ellipse that
    turns, as by an error of scale while the vehicle flies around its start, would else grow at every turn.
    """
    S = np.kron(np.eye(2), estimate.T_odom_imu[:3, :3])  # from the IMU frame to the odometry frame
    expected, found = S @ estimate.covariance @ S.T, S @ covariance @ S.T
    missing, horizontal = np.zeros((6, 6)), slice(3, 5)
    missing[2, 2] = max(expected[2, 2] - found[2, 2], 0.0)
    missing[5, 5] = max(expected[5, 5] - found[5, 5], 0.0)
    trace = np.trace(expected[horizontal, horizontal])
    share = max(1.0 - float(np.trace(found[horizontal, horizontal]) / trace), 0.0)
    missing[horizontal, horizontal] = share * expected[horizontal, horizontal]
    return np.asarray(S.T @ missing @ S)


def _information(axes: Array, covariance: Array) -> Array:
    """Return the marginal information (2, 2) on the rotation about two axes (2, 3)."""
    return np.asarray(np.linalg.inv(axes @ covariance[:3, :3] @ axes.T))
