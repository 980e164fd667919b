"""The linear system of a sliding window: the sum of its marginal prior, its factors and its observations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.factors import KeyframeFactor, replaced_values, state_values
from dronevio.estimator.backend.marginal_prior import POINT_DIM, POSE_DIM, STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.observations import Integers
from dronevio.estimator.backend.reprojection import VisualSystem

Array = npt.NDArray[np.float64]
States = Mapping[int, KeyframeState]
"""States of the keyframes of a window by their numbers, in increasing order."""

IMU_ROBUST_SIGMAS = 5.0
"""Standard deviations at which the excess of a factor's residual halves its weight, as in Cauchy's loss, because the
IMU is unreliable after a shock, a saturation or a gap."""


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A linearized window: H δ = b for its K keyframes and P persistent landmarks."""

    H: Array
    """(15 K + 3 P, 15 K + 3 P) Information matrix, sum of all terms."""
    b: Array
    """(15 K + 3 P,) Right-hand side at the current estimates."""
    visual: VisualSystem
    """Normal equations of the observations, from which the eliminated landmarks are back-substituted."""


def linear_system(
    prior: MarginalPrior,
    points: Mapping[int, Array],
    states: States,
    factors: Sequence[KeyframeFactor],
    visual: VisualSystem,
    persistent_rows: Integers,
) -> LinearSystem:
    """Return the linear system of a prior, factors and observations.

    Args:
        prior: Marginal prior, whose landmarks are the persistent ones.
        points: Current positions (3,) of the persistent landmarks by their identities [m].
        states: Current estimates of the K keyframes.
        factors: Factors between the keyframes.
        visual: Normal equations of the observations, of all landmarks.
        persistent_rows: (P,) Rows of the persistent landmarks in these normal equations, in the order of the prior.
    """
    n = STATE_DIM * len(states) + POINT_DIM * len(prior.points)
    H, b = np.zeros((n, n)), np.zeros(n)
    _add_prior(H, b, prior, points, states)
    _add_factors(H, b, factors, states, linearization_points(prior, states))
    _add_observations(H, b, visual, persistent_rows)
    return LinearSystem(H, b, visual)


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
        r = factor.whitenedError(values)
        J = np.zeros((len(r), block.stop - block.start))
        J[:, keyframe_factor.columns] = factor.linearize(values_first).jacobian()[0]
        excess = max(float(r @ r) - len(r), 0.0)  # the expectation of rᵀr is the dimension of r
        weight = 1.0 / (1.0 + excess / IMU_ROBUST_SIGMAS**2)
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
