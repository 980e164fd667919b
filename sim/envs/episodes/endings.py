"""Ends of episodes: the reasons why episodes terminate, by their index."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.vehicle_states import VehicleStates

REASONS = ("", "success", "no estimate", "flipped", "out of bounds", "ground", "collision", "diverged")
"""Reasons of a termination in ``info["termination"]``; empty while an episode goes on. If several apply, the last one
in this order is given."""
FIRST_FAILURE = 2
"""Index of the first reason that is a failure."""
GROUND_M = 0.03
"""Height above that of the standing vehicle below which a flight has ended on the ground [m]."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of the flight of a vehicle."""

    box_m: Array
    """(2, 3) Box that the vehicle must not leave [m]."""
    ground_m: float
    """Smallest height of the centre of mass in the world [m]."""


def failures(
    states: VehicleStates, touched: Mask, diverged: Mask, unestimated: Mask, bounds: Bounds
) -> npt.NDArray[np.int64]:
    """Return the indices (n,) in `REASONS` of the failures of n vehicles; 0 without a failure.

    Args:
        states: States of the vehicles.
        touched: (n,) Whether they have touched an obstacle.
        diverged: (n,) Whether their simulation has diverged.
        unestimated: (n,) Whether they fly without a state of their estimator.
        bounds: Limits of the flight.
    """
    position = states.position_m
    reason = np.zeros(len(position), dtype=np.int64)
    outside = (position < bounds.box_m[0]) | (position > bounds.box_m[1])
    failed = {
        "no estimate": unestimated,
        "flipped": states.R_world_vehicle[:, 2, 2] < 0.0,
        "out of bounds": outside.any(axis=1),
        "ground": position[:, 2] < bounds.ground_m,
        "collision": touched,
        "diverged": diverged,
    }
    for name in REASONS[FIRST_FAILURE:]:
        reason[failed[name]] = REASONS.index(name)
    return reason
