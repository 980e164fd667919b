"""The state of a keyframe as the smoother moves it, and the prior that keyframes and landmarks leave behind.

A state changes as GTSAM has it: the pose by δθ, δp in the IMU's axes, then the velocity in the world, then the
accelerometer's and the gyroscope's bias: 15 numbers. A landmark that stays in the prior changes by 3 numbers. Linear
systems hold the keyframes first, then the landmarks.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.linalg import schur_complement

Array = npt.NDArray[np.float64]

STATE_DIM, POSE_DIM, POINT_DIM = 15, 6, 3
"""Numbers in which a keyframe's state, its pose alone, and a landmark can change."""


@dataclass(frozen=True, eq=False)
class KeyframeState:
    """The state of a keyframe."""

    pose: gtsam.Pose3
    """Of the IMU, in the world."""
    velocity: Array
    """(3,) In the world [m/s]."""
    bias: gtsam.imuBias.ConstantBias
    """Of accelerometer and gyroscope."""

    def retract(self, change: Array) -> "KeyframeState":
        """Return the state that differs by a change (15,)."""
        bias = self.bias.retract(change[9:])
        return KeyframeState(self.pose.retract(change[:6]), self.velocity + change[6:9], bias)

    def local_coordinates(self, other: "KeyframeState") -> Array:
        """Return the change (15,) that makes another state of this one."""
        turn_and_shift = self.pose.localCoordinates(other.pose)
        biases = self.bias.localCoordinates(other.bias)
        return np.concatenate([turn_and_shift, other.velocity - self.velocity, biases])


@dataclass(frozen=True, eq=False)
class MarginalPrior:
    """What is known of some variables from what has left the window: a Gaussian about their first estimates.

    (Sibley, Matthies, Sukhatme, "Sliding window filter with application to planetary landing", JFR 2010.)
    """

    H: Array
    """(n, n) Information, in the order of `states` and then `points`."""
    b: Array
    """(n,) Right side of H δ = b, where δ counts from the first estimates."""
    states: Mapping[int, KeyframeState]
    """First estimates of the keyframes, in their order."""
    points: Mapping[int, Array] = field(default_factory=dict)
    """First estimates (3,) of the long-lived landmarks."""

    def linearization_point(self, k: int, now: KeyframeState) -> KeyframeState:
        """Return where a keyframe is to be linearized: what the prior knows anything of, where it first was."""
        if k not in self.states:
            return now
        start = STATE_DIM * list(self.states).index(k)
        known, first = np.diag(self.H)[start : start + STATE_DIM] > 0.0, self.states[k]
        return KeyframeState(
            first.pose if known[:6].any() else now.pose,
            first.velocity if known[6:9].any() else now.velocity,
            first.bias if known[9:].any() else now.bias,
        )

    def right_hand_side(self, states: Mapping[int, KeyframeState], points: Mapping[int, Array]) -> Array:
        """Return the right side (n,), where δ counts from the present estimates of at least the prior's variables."""
        return np.asarray(self.b - self.H @ self._change(states, points))

    def cost(self, states: Mapping[int, KeyframeState], points: Mapping[int, Array]) -> float:
        """Return the negative logarithm of its density at the present estimates, up to a constant."""
        change = self._change(states, points)
        return float(0.5 * change @ self.H @ change - self.b @ change)

    @classmethod
    def from_current_estimates(
        cls,
        H: Array,
        b: Array,
        states: Mapping[int, KeyframeState],
        points: Mapping[int, Array],
        earlier: "MarginalPrior",
    ) -> "MarginalPrior":
        """Return the prior whose right side counts from the present estimates; what was in an earlier one stays there.

        Args:
            H: (n, n) Information.
            b: (n,) Right side, about ``states`` and ``points``.
            states: Present estimates of all of the prior's keyframes.
            points: Present estimates of all of its landmarks.
            earlier: Where its variables were linearized first.
        """
        first = {k: earlier.linearization_point(k, now) for k, now in states.items()}
        made = cls(H, b, first, {i: earlier.points.get(i, now) for i, now in points.items()})
        return cls(H, b + H @ made._change(states, points), made.states, made.points)

    def with_points(self, points: Mapping[int, Array]) -> "MarginalPrior":
        """Return the prior with landmarks added of which it knows nothing yet."""
        more = POINT_DIM * len(points)
        return MarginalPrior(
            np.pad(self.H, (0, more)), np.pad(self.b, (0, more)), self.states, {**self.points, **points}
        )

    def without_points(self, gone: Iterable[int]) -> "MarginalPrior":
        """Return the prior with some landmarks marginalized.

        Raises:
            SingularError: It knew too little of them.
        """
        lost = set(gone) & set(self.points)
        if not lost:
            return self
        leaving = np.repeat(
            [False] * len(self.states) * (STATE_DIM // POINT_DIM) + [i in lost for i in self.points], POINT_DIM
        )
        H, b = schur_complement(self.H, self.b, leaving)
        return MarginalPrior(H, b, self.states, {i: point for i, point in self.points.items() if i not in lost})

    def _change(self, states: Mapping[int, KeyframeState], points: Mapping[int, Array]) -> Array:
        """Return how far (n,) present estimates are from the first ones."""
        parts = [first.local_coordinates(states[k]) for k, first in self.states.items()]
        return np.concatenate([*parts, *(points[i] - first for i, first in self.points.items())])
