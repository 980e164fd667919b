"""The linear system of a sliding window: the sum of its marginal prior, its factors and its observations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.backend.factors import KeyframeFactor, replaced_values, state_values
from dronevio.estimator.backend.marginal_prior import POINT_DIM, POSE_DIM, STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.reprojection import VisualSystem
from dronevio.estimator.optimization.robust import cauchy_inflation, cauchy_loss
from dronevio.models.arrays import Array, Integers

States = Mapping[int, KeyframeState]
"""States of the keyframes of a window by their numbers, in increasing order."""

IMU_ROBUST_SIGMAS = 5.0
"""Standard deviations at which the excess of a factor's residual halves its weight, as in Cauchy's loss, because the
IMU is unreliable after a shock, a saturation or a gap."""


@dataclass(frozen=True, eq=False)
class WindowEstimate:
    """The variables of a window."""

    states: States
    """States of the keyframes."""
    points: Array
    """(L, 3) Positions of the landmarks in the world frame, in the order of their identities [m]."""


@dataclass(frozen=True, eq=False)
class ObservationScales:
    """Scales of the robust loss of N observations."""

    variance: Array
    """(N,) Variances, in normalized coordinates; infinite for landmarks behind the camera."""
    threshold2: Array
    """(N,) Squared residuals, in units of the assumed variances, at which the weight is halved."""


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A linearized window: H δ = b for its K keyframes and P persistent landmarks."""

    H: Array
    """(15 K + 3 P, 15 K + 3 P) Information matrix, sum of all terms."""
    b: Array
    """(15 K + 3 P,) Right-hand side at the current estimates."""
    visual: VisualSystem
    """Normal equations of the observations, from which the eliminated landmarks are back-substituted."""
    x: WindowEstimate
    """The estimates at which it is linearized."""
    contained: Integers
    """Rows of the landmarks that `visual` contains, among all."""
    persistent: Integers
    """(P,) Rows of the persistent landmarks in `visual`, in the order of the prior."""
    scales: ObservationScales
    """Scales of the observations."""

    def retract(self, delta: Array) -> WindowEstimate:
        """Return the estimates after a step (n,), with the step of the landmarks that belongs to it."""
        K = len(self.x.states)
        delta_states = delta[: STATE_DIM * K].reshape(K, STATE_DIM)
        delta_points = self.visual.back_substitute(delta_states[:, :POSE_DIM])
        delta_points[self.persistent] = delta[STATE_DIM * K :].reshape(-1, POINT_DIM)
        points = self.x.points.copy()
        points[self.contained] += delta_points
        states = {k: state.retract(d) for (k, state), d in zip(self.x.states.items(), delta_states, strict=True)}
        return WindowEstimate(states, points)


def linear_system(
    prior: MarginalPrior,
    factors: Sequence[KeyframeFactor],
    visual: VisualSystem,
    x: WindowEstimate,
    contained: Integers,
    persistent: Integers,
    scales: ObservationScales,
) -> LinearSystem:
    """Return the linear system of a prior, factors and observations.

    Args:
        prior: Marginal prior, whose landmarks are the persistent ones.
        factors: Factors between the keyframes.
        visual: Normal equations of the observations, of all landmarks.
        x: Current estimates.
        contained: Rows of the landmarks of these normal equations, among all.
        persistent: (P,) Rows of the persistent landmarks in these normal equations, in the order of the prior.
        scales: Scales of the observations.
    """
    n = STATE_DIM * len(x.states) + POINT_DIM * len(prior.points)
    H, b = np.zeros((n, n)), np.zeros(n)
    points = dict(zip(prior.points, x.points[contained[persistent]], strict=True))
    _add_prior(H, b, prior, points, x.states)
    _add_factors(H, b, factors, x.states, linearization_points(prior, x.states))
    _add_observations(H, b, visual, persistent)
    return LinearSystem(H, b, visual, x, contained, persistent, scales)


def factor_loss(squared: float, dimension: int) -> float:
    """Return the loss of a factor's whitened squared residual: Cauchy's of its excess over the expectation.

    Args:
        squared: Squared residual.
        dimension: Its number of components, the expectation of the square.
    """
    return min(squared, dimension) + float(cauchy_loss(max(squared - dimension, 0.0), IMU_ROBUST_SIGMAS**2))


def linearization_points(prior: MarginalPrior, states: States) -> dict[int, KeyframeState]:
    """Return the states at which Jacobians are evaluated: first estimates where the prior has information."""
    return {k: prior.linearization_point(k, current) for k, current in states.items()}


def _add_prior(H: Array, b: Array, prior: MarginalPrior, points: Mapping[int, Array], states: States) -> None:
    """Add a marginal prior to a linear system.

    The keyframes that the prior lacks are the newest ones, between its other keyframes and its landmarks.
    """
    known, all_states = STATE_DIM * len(prior.states), STATE_DIM * len(states)
    blocks = (slice(0, known), slice(0, known)), (slice(all_states, None), slice(known, None))
    prior_b = prior.right_hand_side(states, points)
    for rows, prior_rows in blocks:
        b[rows] += prior_b[prior_rows]
        for columns, prior_columns in blocks:
            H[rows, columns] += prior.H[prior_rows, prior_columns]


def _add_factors(H: Array, b: Array, factors: Sequence[KeyframeFactor], states: States, first: States) -> None:
    """Add factors to a linear system, with residuals at the current states and Jacobians at the first estimates."""
    index, keyframes = _index(states), frozenset[int]().union(*(factor.keyframes for factor in factors))
    current = {k: states[k] for k in keyframes}
    values = state_values(current)
    values_first = replaced_values(values, current, first)
    for keyframe_factor in factors:
        factor, block = keyframe_factor.factor, keyframe_factor.block(index)
        root_weight = np.sqrt(keyframe_factor.weight)
        r = root_weight * factor.whitenedError(values)
        J = np.zeros((len(r), block.stop - block.start))
        J[:, keyframe_factor.columns] = root_weight * factor.linearize(values_first).jacobian()[0]
        excess = max(float(r @ r) - len(r), 0.0)  # the expectation of rᵀr is the dimension of r
        weight = 1.0 / float(cauchy_inflation(excess, IMU_ROBUST_SIGMAS**2))
        H[block, block] += weight * (J.T @ J)
        b[block] -= weight * (J.T @ r)


def _add_observations(H: Array, b: Array, visual: VisualSystem, persistent_rows: Integers) -> None:
    """Add normal equations of observations to a linear system, all but the persistent landmarks eliminated."""
    rows, K = persistent_rows, len(visual.H_pose)
    eliminated = np.ones(len(visual.H_point), dtype=np.bool_)
    eliminated[rows] = False
    poses = (STATE_DIM * np.arange(K)[:, None] + np.arange(POSE_DIM)).ravel()
    H_poses, b_poses = visual.reduced_system(eliminated)
    H[np.ix_(poses, poses)] += H_poses
    b[poses] += b_poses
    H_cross = visual.H_cross[rows].reshape(-1, POSE_DIM * K)
    H[STATE_DIM * K :, poses] += H_cross
    H[poses, STATE_DIM * K :] += H_cross.T
    points = STATE_DIM * K + np.arange(POINT_DIM * len(rows)).reshape(-1, POINT_DIM)
    H[points[:, :, None], points[:, None, :]] += visual.H_point[rows]
    b[points] += visual.b_point[rows]


def _index(states: States) -> dict[int, int]:
    """Return the position of each keyframe in the linear system."""
    return {k: i for i, k in enumerate(states)}
