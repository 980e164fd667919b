"""The odometry as factors of a pose graph: relative poses, directions of gravity, and some positions.

The priors of consecutive windows share information. A factor that holds all of one prior would count what the next one
repeats, so each keyframe that leaves the window adds only what is new: the growth of the covariance since the keyframe
before it, and what the accelerometer has added on roll and pitch. The marginal covariance of the keyframes in the
graph is then that of the odometry. It is the recovery of non-linear factors from a marginal prior (Usenko et al.,
"Visual-inertial mapping with non-linear factor recovery", RA-L 2020; Mazuran et al., IJRR 2016), matched to the
marginals of the poses.

The error of an odometry grows faster than a sum of independent errors, because the biases err for a long time in the
same direction: the relative covariances of neighbouring keyframes alone add up to half of the standard deviation after
50 s.

The uncertainty of an odometry can also decrease, as where an error of scale becomes known on the way back to the start.
A later keyframe is then known better than those before it, which no sum of relative poses expresses. Its position gets
a prior. The relative pose before it gets the covariance by which the previous keyframe is known worse: where one
estimate contains all that the other one knows, their difference has the difference of their covariances. The same holds
for roll and pitch, which become known in the first seconds.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy.linalg

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.observations import NO_OBSERVATIONS, ObservationTable
from dronevio.models.arrays import Array
from dronevio.models.rotation import adjoint, inverse_pose

MAX_DECREASE = 0.5
"""Ratio of the standard deviation of a keyframe's position to that by the factors before it, below which the position
gets a prior. What these factors repeat of the prior then reduces the standard deviation by 6 % at most."""

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
    observations: ObservationTable = NO_OBSERVATIONS
    """Observations of landmarks of each keyframe by the other one, of which the pose is the result, with standard
    deviations in pixels; none for an odometry."""

    @classmethod
    def measured(
        cls,
        first: int,
        second: int,
        T_first_second: Array,
        covariance: Array,
        observations: ObservationTable = NO_OBSERVATIONS,
    ) -> Self:
        """Return a relative pose whose measured position is uncertain in the frame of the first keyframe.

        Args:
            first: Number of the keyframe in whose frame the other one is measured.
            second: Number of the other keyframe.
            T_first_second: (4, 4) Pose of the second keyframe's IMU in the frame of the first one's.
            covariance: (6, 6) Covariance of δθ (right perturbation, IMU frame of the second keyframe) and δp (IMU frame
                of the first one).
            observations: Observations of landmarks of which the pose is the result.
        """
        S = np.eye(6)
        S[3:, 3:] = T_first_second[:3, :3].T
        return cls(first, second, T_first_second, S @ covariance @ S.T, observations)


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
class AbsolutePosition:
    """A measured position of a keyframe in the map frame."""

    keyframe: int
    """Number of the keyframe."""
    p_map: Array
    """(3,) Position of its IMU [m]."""
    covariance: Array
    """(3, 3) Covariance of that position in the map frame [m²]."""

    def moved(self, T: Array) -> Self:
        """Return the position where the map frame is moved by T (4, 4)."""
        R = T[:3, :3]
        return replace(self, p_map=R @ self.p_map + T[:3, 3], covariance=R @ self.covariance @ R.T)


@dataclass(frozen=True, eq=False)
class OdometryFactors:
    """The factors by which the odometry connects a keyframe with the one before it."""

    relative: RelativePose
    """Its pose in the frame of the previous keyframe."""
    gravity: GravityDirection | None = None
    """The direction of gravity, where the odometry knows it better than the factors before it."""
    position: AbsolutePosition | None = None
    """Its position, where the odometry knows it much better than the factors before it."""


@dataclass(frozen=True, eq=False)
class OdometryNode:
    """A keyframe of the odometry in the pose graph."""

    first: int
    """Number of the first keyframe of its track."""
    number: int
    """Number of the keyframe."""
    estimate: KeyframeEstimate
    """Its final estimate by the odometry."""
    covariance: Array
    """(6, 6) Marginal covariance of its pose by the factors of the odometry up to it."""


def first_node(number: int, estimate: KeyframeEstimate) -> OdometryNode:
    """Return the first keyframe of a track, whose pose has the covariance of the odometry."""
    return OdometryNode(number, number, estimate, estimate.covariance)


def odometry_factors(
    previous: OdometryNode, number: int, estimate: KeyframeEstimate, *, is_map_frame: bool = False
) -> tuple[OdometryNode, OdometryFactors]:
    """Return the next keyframe of the odometry and its factors.

    Args:
        previous: The keyframe that was marginalized before it.
        number: Number of the keyframe.
        estimate: Its final estimate.
        is_map_frame: Whether the odometry frame is the map frame. Where it is not, as after a loss, there are no
            positions in the map.
    """
    # Relative pose, with the growth of the covariance since the previous keyframe
    T = inverse_pose(previous.estimate.T_odom_imu) @ estimate.T_odom_imu
    transported = _transported(previous.covariance, T)
    least = _least_covariance(previous.estimate, estimate)
    expected = transported + least
    # Where the position has become known better, a prior on it takes the place of growth
    if is_map_frame and position_variance(estimate.covariance) < MAX_DECREASE**2 * position_variance(expected):
        R = estimate.T_odom_imu[:3, :3]
        P_map = R @ estimate.covariance[3:, 3:] @ R.T
        position = AbsolutePosition(number, estimate.T_odom_imu[:3, 3], P_map)
        added = least + _position_excess(expected, estimate.covariance)
    else:
        position, added = None, least + _missing_growth(estimate, expected)
    # Direction of gravity: the information that the factors before lack
    up = estimate.T_odom_imu[:3, :3].T @ _UP
    tilt = tilt_axes(up)
    # By the odometry and not by the factors before it, whose excess would grow from keyframe to keyframe.
    by_odometry = _transported(previous.estimate.covariance, T) + least
    added = added + _tilt_excess(by_odometry, estimate.covariance, tilt)
    relative = RelativePose(previous.number, number, T, added)
    P = transported + added
    information = _information(tilt, estimate.covariance) - _information(tilt, P)
    mean_information = float(np.trace(information)) / 2.0
    gravity = None if mean_information <= 0.0 else GravityDirection(number, up, mean_information**-0.5)
    # Marginal covariance of the keyframe by all of these factors
    P = propagated(previous.covariance, relative, gravity)
    if position is not None:
        H = np.hstack([np.zeros((3, 3)), np.eye(3)])
        P = _updated(P, H, estimate.covariance[3:, 3:])
    node = OdometryNode(previous.first, number, estimate, P)
    return node, OdometryFactors(relative, gravity, position)


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
    return _updated(P, H, gravity.sigma_rad**2 * np.eye(2))


def reversed_pose(relative: RelativePose) -> RelativePose:
    """Return a relative pose in the other direction: that of the first keyframe in the frame of the second one."""
    A = adjoint(relative.T_first_second)
    T_second_first = inverse_pose(relative.T_first_second)
    return RelativePose(relative.second, relative.first, T_second_first, A @ relative.covariance @ A.T)


def scaled(relative: RelativePose, scale: float) -> RelativePose:
    """Return a relative pose with another scale of its position; its covariance stays."""
    T = relative.T_first_second.copy()
    T[:3, 3] *= scale
    return replace(relative, T_first_second=T)


def composed(relative: RelativePose, following: RelativePose) -> RelativePose:
    """Return two relative poses with independent errors in succession as one.

    Args:
        relative: The first one.
        following: The second one, from the second keyframe of the first one.
    """
    T = relative.T_first_second @ following.T_first_second
    covariance = _transported(relative.covariance, following.T_first_second) + following.covariance
    return RelativePose(relative.first, following.second, T, covariance)


def position_variance(covariance: Array) -> float:
    """Return the trace of the covariance of a position [m²], of the covariance (6, 6) of its pose."""
    return float(np.trace(covariance[3:, 3:]))


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
    expected, own = S @ estimate.covariance @ S.T, S @ covariance @ S.T
    missing, horizontal = np.zeros((6, 6)), slice(3, 5)
    missing[2, 2] = max(expected[2, 2] - own[2, 2], 0.0)
    missing[5, 5] = max(expected[5, 5] - own[5, 5], 0.0)
    trace = np.trace(expected[horizontal, horizontal])
    share = max(1.0 - float(np.trace(own[horizontal, horizontal]) / trace), 0.0)
    missing[horizontal, horizontal] = share * expected[horizontal, horizontal]
    return np.asarray(S.T @ missing @ S)


def _position_excess(covariance: Array, smaller: Array) -> Array:
    """Return what a covariance (6, 6) of a position has beyond a smaller one; nothing where it is the smaller one."""
    excess = np.zeros((6, 6))
    excess[3:, 3:] = _excess(covariance[3:, 3:], smaller[3:, 3:])
    return excess


def _tilt_excess(covariance: Array, smaller: Array, tilt: Array) -> Array:
    """Return what a covariance (6, 6) of a direction of gravity has beyond a smaller one; see `_position_excess`.

    Args:
        covariance: (6, 6) Covariance of a pose.
        smaller: (6, 6) The other one.
        tilt: (2, 3) Axes across the direction of gravity.
    """
    excess = np.zeros((6, 6))
    two, other = (tilt @ each[:3, :3] @ tilt.T for each in (covariance, smaller))
    excess[:3, :3] = tilt.T @ _excess(two, other) @ tilt
    return excess


def _excess(covariance: Array, smaller: Array) -> Array:
    """Return the positive part of the difference of two covariances (M, M)."""
    ratios, V = scipy.linalg.eigh(covariance, smaller)  # V.T @ smaller @ V is the identity
    return np.asarray((smaller @ V * np.maximum(ratios - 1.0, 0.0)) @ (smaller @ V).T)


def _updated(P: Array, H: Array, R: Array) -> Array:
    """Return the covariance (6, 6) after a measurement with Jacobian H (M, 6) and covariance R (M, M)."""
    gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    P = P - gain @ H @ P
    return np.asarray(0.5 * (P + P.T))


def _information(axes: Array, covariance: Array) -> Array:
    """Return the marginal information (2, 2) on the rotation about two axes (2, 3)."""
    return np.asarray(np.linalg.inv(axes @ covariance[:3, :3] @ axes.T))
