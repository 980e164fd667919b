"""Marginalization of a keyframe and its landmarks into the prior of a window."""

from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.backend.drift import with_rotation_error
from dronevio.estimator.backend.linear_system import WindowEstimate
from dronevio.estimator.backend.marginal_prior import POINT_DIM, STATE_DIM, MarginalPrior
from dronevio.estimator.backend.window_objective import WindowObjective
from dronevio.estimator.optimization.linalg import schur_complement
from dronevio.models.arrays import Array


@dataclass(frozen=True, eq=False)
class Drift:
    """A common error of rotation that the variables of a prior have got since."""

    pivot_m: Array
    """(3,) The point that it does not move, in the world frame [m]."""
    sigma_rad: float
    """Standard deviation about each axis [rad]."""


@dataclass(frozen=True, eq=False)
class PendingMarginalization:
    """A keyframe that has left the window, and what is needed to compute the prior that replaces it."""

    keyframe: int
    """Number of the keyframe."""
    objective: WindowObjective
    """The information that leaves: the prior before, the factors of the keyframe, and observations."""
    estimate: WindowEstimate
    """Estimates when the keyframe left."""
    landmarks: Set[int]
    """Identities of the landmarks that leave with the keyframe."""
    unobserved: Set[int]
    """Identities of persistent landmarks that no keyframe observes any more."""
    drift: Drift | None = None
    """Error of the window's orientation to be added to the prior."""

    def prior(self) -> MarginalPrior:
        """Return the marginal prior without the keyframe and the landmarks.

        Raises:
            SingularError: The information on what leaves is not positive definite.
        """
        x, before = self.estimate, self.objective.prior
        system = self.objective.linearize(x)
        of_states = np.repeat([k == self.keyframe for k in x.states], STATE_DIM)
        of_points = np.repeat([i in self.landmarks for i in before.points], POINT_DIM).astype(np.bool_)
        H, b = schur_complement(system.H, system.b, np.concatenate([of_states, of_points]))
        states = {k: state for k, state in x.states.items() if k != self.keyframe}
        current = self.objective.persistent_points(x)
        points = {i: point for i, point in current.items() if i not in self.landmarks}
        prior = MarginalPrior.from_current_estimates(H, b, states, points, before).without_points(self.unobserved)
        return prior if self.drift is None else with_rotation_error(prior, self.drift.pivot_m, self.drift.sigma_rad)
