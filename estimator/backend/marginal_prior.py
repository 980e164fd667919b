"""The state of a keyframe on its manifold, and the marginal prior of keyframes and landmarks that left the window.

A state has 15 degrees of freedom, in GTSAM's order: the pose (δθ, δp) in the IMU frame, the velocity in the world
frame, then the biases of accelerometer and gyroscope. A landmark in the prior has three. Linear systems hold the
keyframes first, then the landmarks.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np

from dronevio.estimator.optimization.linalg import schur_complement
from dronevio.models.arrays import Array

STATE_DIM, POSE_DIM, POINT_DIM = 15, 6, 3
"""Degrees of freedom of a keyframe's state, of its pose, and of a landmark."""


@dataclass(frozen=True, eq=False)
class KeyframeState:
    """The state of a keyframe."""

    pose: gtsam.Pose3
    """Pose of the IMU in the world frame, `T_world_imu`."""
    velocity: Array
    """(3,) Velocity of the IMU in the world frame [m/s]."""
    bias: gtsam.imuBias.ConstantBias
    """Biases of accelerometer [m/s²] and gyroscope [rad/s]."""

    def retract(self, delta: Array) -> "KeyframeState":
        """Return the state at a tangent vector (15,) from this one."""
        bias = self.bias.retract(delta[9:])
        return KeyframeState(self.pose.retract(delta[:6]), self.velocity + delta[6:9], bias)

    def local_coordinates(self, other: "KeyframeState") -> Array:
        """Return the tangent vector (15,) from this state to another, the inverse of `retract`."""
        pose = self.pose.localCoordinates(other.pose)
        bias = self.bias.localCoordinates(other.bias)
        return np.concatenate([pose, other.velocity - self.velocity, bias])


@dataclass(frozen=True, eq=False)
class MarginalPrior:
    """The Gaussian on the variables of the window that replaces all marginalized variables and factors.

    It is linear about the values at which its variables were first linearized. Jacobians of other factors of these
    variables are evaluated at the same values (first-estimates Jacobians), so that unobservable directions gain no
    information.

    References:
        Sibley, Matthies, Sukhatme, "Sliding window filter with application to planetary landing", JFR 2010.
        Huang, Mourikis, Roumeliotis, "A first-estimates Jacobian EKF for improving SLAM consistency", ISER 2008.
    """

    H: Array
    """(n, n) Information matrix, in the order of `states` and then `points`."""
    b: Array
    """(n,) Right-hand side of H δ = b, where δ is taken from the linearization points."""
    states: Mapping[int, KeyframeState]
    """Linearization points of the keyframes by their numbers, in increasing order."""
    points: Mapping[int, Array] = field(default_factory=dict)
    """Linearization points (3,) of the persistent landmarks by their identities, in the world frame [m]."""

    def linearization_point(self, k: int, current: KeyframeState) -> KeyframeState:
        """Return the state at which Jacobians by the variables of a keyframe are evaluated.

        Args:
            k: Number of the keyframe.
            current: Its current estimate.

        Returns:
            The linearization point of those of pose, velocity and biases on which the prior has information, and the
            current estimate of the others.
        """
        if k not in self.states:
            return current
        first, (pose, velocity, bias) = self.states[k], self._constrained[k]
        return KeyframeState(
            first.pose if pose else current.pose,
            first.velocity if velocity else current.velocity,
            first.bias if bias else current.bias,
        )

    @cached_property
    def _constrained(self) -> Mapping[int, tuple[bool, bool, bool]]:
        """Whether the prior has information on pose, velocity and biases of its keyframes."""
        rows = np.diag(self.H)[: STATE_DIM * len(self.states)].reshape(-1, STATE_DIM) > 0.0
        return {
            k: (bool(row[:6].any()), bool(row[6:9].any()), bool(row[9:].any()))
            for k, row in zip(self.states, rows, strict=True)
        }

    def right_hand_side(self, states: Mapping[int, KeyframeState], points: Mapping[int, Array]) -> Array:
        """Return the right-hand side (n,) of H δ = b where δ is taken from current estimates.

        Args:
            states: Current estimates, of the prior's keyframes at least.
            points: Current estimates (3,), of the prior's landmarks at least.
        """
        return np.asarray(self.b - self.H @ self._deviation(states, points))

    def cost(self, states: Mapping[int, KeyframeState], points: Mapping[int, Array]) -> float:
        """Return the negative logarithm of the prior's density at current estimates, up to a constant.

        Args:
            states: Current estimates, of the prior's keyframes at least.
            points: Current estimates (3,), of the prior's landmarks at least.
        """
        delta = self._deviation(states, points)
        return float(0.5 * delta @ self.H @ delta - self.b @ delta)

    @classmethod
    def from_current_estimates(
        cls,
        H: Array,
        b: Array,
        states: Mapping[int, KeyframeState],
        points: Mapping[int, Array],
        earlier: "MarginalPrior",
    ) -> "MarginalPrior":
        """Return the prior of a linear system about current estimates, with the linearization points of an earlier one.

        Args:
            H: (n, n) Information matrix.
            b: (n,) Right-hand side of H δ = b, where δ is taken from ``states`` and ``points``.
            states: Current estimates of all keyframes of the prior.
            points: Current estimates (3,) of all landmarks of the prior.
            earlier: The prior that keeps its linearization points; variables that it lacks are linearized here.
        """
        first = {k: earlier.linearization_point(k, current) for k, current in states.items()}
        prior = cls(H, b, first, {i: earlier.points.get(i, current) for i, current in points.items()})
        return cls(H, b + H @ prior._deviation(states, points), prior.states, prior.points)

    def with_points(self, points: Mapping[int, Array]) -> "MarginalPrior":
        """Return the prior with landmarks added on which it has no information.

        Args:
            points: Positions (3,) of the landmarks by their identities, in the world frame [m].
        """
        added = POINT_DIM * len(points)
        H, b = np.pad(self.H, (0, added)), np.pad(self.b, (0, added))
        return MarginalPrior(H, b, self.states, {**self.points, **points})

    def with_common_error(self, J: Array) -> "MarginalPrior":
        """Return the prior with an added error common to all variables; the mean is unchanged.

        The covariance P becomes P + J Jᵀ. By the Woodbury identity, this needs no inverse of the information.

        Args:
            J: (n, m) Derivative of the variables by the error, whose m components have unit variance.
        """
        HJ = self.H @ J
        gain = np.linalg.solve(np.eye(J.shape[1]) + J.T @ HJ, HJ.T)
        return MarginalPrior(self.H - HJ @ gain, self.b - gain.T @ (J.T @ self.b), self.states, self.points)

    def without_points(self, landmarks: Iterable[int]) -> "MarginalPrior":
        """Return the prior with some landmarks marginalized; those that it lacks are ignored.

        Raises:
            SingularError: The information on these landmarks is not positive definite.
        """
        removed = set(landmarks) & set(self.points)
        if not removed:
            return self
        of_states = [False] * len(self.states) * (STATE_DIM // POINT_DIM)
        eliminated = np.repeat(of_states + [i in removed for i in self.points], POINT_DIM)
        H, b = schur_complement(self.H, self.b, eliminated)
        return MarginalPrior(H, b, self.states, {i: point for i, point in self.points.items() if i not in removed})

    def _deviation(self, states: Mapping[int, KeyframeState], points: Mapping[int, Array]) -> Array:
        """Return the tangent vector (n,) from the linearization points to current estimates."""
        of_states = [first.local_coordinates(states[k]) for k, first in self.states.items()]
        return np.concatenate([*of_states, *(points[i] - first for i, first in self.points.items())])
