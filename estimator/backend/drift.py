"""Drift of the window: errors that tracks have in common turn it relative to what has left it.

Observations are weighted as if their errors were independent. The errors of tracks are not: patches slide along edges,
and their aspect changes with the motion in the same way all over the image. A window of a few seconds then turns slowly
with respect to the gravity and to the yaw that its marginal prior knows, by more than the covariance says. The prior
therefore has a random walk in the orientation common to its variables, as the multiplicative or additive inflation of
ensemble filters (Anderson and Anderson, "A Monte Carlo implementation of the nonlinear filtering problem", 1999) has in
all directions. The relative poses within the prior, and with them the scale, keep their information.
"""

import numpy as np

from dronevio.estimator.backend.marginal_prior import POINT_DIM, STATE_DIM, MarginalPrior
from dronevio.models.arrays import Array
from dronevio.models.rotation import skew


def with_rotation_error(prior: MarginalPrior, pivot_m: Array, sigma_rad: float) -> MarginalPrior:
    """Return a prior with an added common rotation error of its variables.

    Args:
        prior: The prior.
        pivot_m: (3,) The point in the world frame that the rotation does not move [m].
        sigma_rad: Standard deviation of the rotation about each axis [rad].
    """
    J = np.empty((len(prior.b), 3))
    of_states, of_points = np.split(J, [STATE_DIM * len(prior.states)])
    for rows, state in zip(of_states.reshape(-1, STATE_DIM, 3), prior.states.values(), strict=True):
        R_imu_world = state.pose.rotation().matrix().T
        rows[:3] = R_imu_world
        rows[3:6] = -R_imu_world @ skew(state.pose.translation() - pivot_m)
        rows[6:9] = -skew(state.velocity)
        rows[9:] = 0.0
    for rows, point in zip(of_points.reshape(-1, POINT_DIM, 3), prior.points.values(), strict=True):
        rows[:] = -skew(point - pivot_m)
    return prior.with_common_error(sigma_rad * J)
