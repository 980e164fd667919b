"""What a sliding window minimizes: a marginal prior, factors between keyframes, and reprojection errors.

Each is robust but the prior: factors by Cauchy's loss of their excess over the expectation, observations by Cauchy's
loss with a threshold for each keyframe. Variances and thresholds of observations follow from the medians of their
residuals, and are the scales of the problem.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dronevio.estimator.backend.factors import KeyframeFactor, state_values
from dronevio.estimator.backend.linear_system import (
    LinearSystem,
    ObservationScales,
    WindowEstimate,
    factor_loss,
    linear_system,
    linearization_points,
)
from dronevio.estimator.backend.marginal_prior import POINT_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.reprojection import ObservationIndices, VisualState, residuals, visual_system
from dronevio.estimator.backend.weighting import robust_thresholds, variance_factor
from dronevio.estimator.optimization.robust import cauchy_inflation, cauchy_loss
from dronevio.models.arrays import Array, Integers


@dataclass(frozen=True, eq=False)
class WindowObjective:
    """The information on the keyframes and landmarks of a window."""

    prior: MarginalPrior
    """The marginal prior, whose landmarks are the persistent ones."""
    factors: tuple[KeyframeFactor, ...]
    """Factors between the keyframes."""
    observations: ObservationTable
    """N observations of landmarks."""
    landmark_ids: Integers
    """(L,) Identities of all landmarks, in increasing order."""
    Ts_imu_cam: Array
    """(C, 4, 4) Poses of the rig's cameras."""
    sigma: float
    """Standard deviation of an observation, in normalized coordinates."""
    robust_sigmas: float
    """Threshold of Cauchy's loss in standard deviations, or in median residuals of the keyframe if these are larger."""

    def linearize(self, x: WindowEstimate) -> LinearSystem:
        """Return the normal equations, with the landmarks eliminated that are not persistent.

        They contain the landmarks of the observations and the persistent ones.
        """
        # Landmarks of the system, in the order of their identities
        indices, persistent = self._indices(x), self.rows(self.prior.points)
        is_contained = np.zeros(len(self.landmark_ids), dtype=np.bool_)
        is_contained[indices.landmark] = is_contained[persistent] = True
        system_row = np.cumsum(is_contained) - 1
        in_system = ObservationIndices(indices.keyframe, system_row[indices.landmark])
        # Residuals at the estimates, Jacobians at the first estimates
        residual, depth_m = self.residuals(x)
        squared, scales = self.squared(residual), self.scales(x, residual, depth_m)
        weight = 1.0 / (scales.variance * cauchy_inflation(squared, scales.threshold2))
        points = x.points.copy()
        points[persistent] = np.reshape(list(self.prior.points.values()), (-1, POINT_DIM))
        first = _visual_state(linearization_points(self.prior, x.states), points[is_contained])
        visual = visual_system(self.observations, in_system, self.Ts_imu_cam, first, residual, weight)
        contained, rows = np.flatnonzero(is_contained), system_row[persistent]
        return linear_system(self.prior, self.factors, visual, x, contained, rows, scales)

    def cost(self, x: WindowEstimate, scales: ObservationScales) -> float:
        """Return the negative logarithm of the posterior density at given scales, up to a constant."""
        squared = self.squared(self.residuals(x)[0])
        losses = cauchy_loss(squared, scales.threshold2) * self._sigma2 / scales.variance
        values = state_values(x.states)
        of_factors = sum(
            factor_loss(2.0 * each.weight * each.factor.error(values), each.factor.dim()) for each in self.factors
        )
        return self.prior.cost(x.states, self.persistent_points(x)) + 0.5 * (of_factors + float(losses.sum()))

    def residuals(self, x: WindowEstimate) -> tuple[Array, Array]:
        """Return the residuals (N, 2) of the observations, in normalized coordinates, and their depths (N,) [m]."""
        return residuals(self.observations, self._indices(x), self.Ts_imu_cam, _visual_state(x.states, x.points))

    def squared(self, residual: Array) -> Array:
        """Return the squares (N,) of residuals (N, 2) in units of the assumed variance."""
        return np.asarray((residual[:, 0] ** 2 + residual[:, 1] ** 2) / self._sigma2)  # faster than a sum along two

    def scales(self, x: WindowEstimate, residual: Array, depth_m: Array) -> ObservationScales:
        """Return the variances and thresholds that belong to residuals (N, 2) and depths (N,) [m].

        The errors of one track are correlated, so that variances grow with its age; but several cameras observe the
        depth at every keyframe, and growing errors do not change the scale.
        """
        squared = self.squared(residual)
        growth = self.observations.variance_growth if len(self.Ts_imu_cam) == 1 else 1.0
        variance = self._sigma2 * growth * variance_factor(squared)
        threshold = robust_thresholds(squared, self._indices(x).keyframe, self.robust_sigmas)
        return ObservationScales(np.where(depth_m > 0.0, variance, np.inf), threshold**2)

    def rows(self, landmarks: Iterable[int]) -> Integers:
        """Return the rows of landmarks, given by their identities, among all."""
        return np.asarray(np.searchsorted(self.landmark_ids, np.fromiter(landmarks, np.int64)))

    def persistent_points(self, x: WindowEstimate) -> dict[int, Array]:
        """Return the current positions (3,) of the persistent landmarks [m]."""
        return dict(zip(self.prior.points, x.points[self.rows(self.prior.points)], strict=True))

    @cached_property
    def _sigma2(self) -> Array:
        """(N,) Assumed variances of the observations, in normalized coordinates."""
        return np.asarray((self.sigma * self.observations.sigma_scale) ** 2)

    def _indices(self, x: WindowEstimate) -> ObservationIndices:
        """Return the indices of the keyframes and landmarks of the observations."""
        keyframe = np.searchsorted(list(x.states), self.observations.keyframe)
        return ObservationIndices(keyframe, self._landmark_rows)

    @cached_property
    def _landmark_rows(self) -> Integers:
        """(N,) Rows of the landmarks of the observations among all."""
        return np.asarray(np.searchsorted(self.landmark_ids, self.observations.landmark))


def _visual_state(states: Mapping[int, KeyframeState], points: Array) -> VisualState:
    """Return the poses of keyframes and the positions (L, 3) of landmarks."""
    Ts = np.stack([state.pose.matrix() for state in states.values()])
    return VisualState(Ts[:, :3, :3], Ts[:, :3, 3], points)
