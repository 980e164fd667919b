"""Ends of episodes: why they terminate."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.vehicle_states import Table, VehicleStates


class Termination(IntEnum):
    """Why an episode has terminated, as a number that arrays can hold. If several apply, the last one counts."""

    NONE = 0
    """It goes on, or was truncated."""
    SUCCESS = 1
    """The task is done."""
    NO_ESTIMATE = 2
    """The vehicle flew without a state of its estimator."""
    FLIPPED = 3
    """It was upside down."""
    OUT_OF_BOUNDS = 4
    """It left the box of the task."""
    GROUND = 5
    """It flew into the ground."""
    COLLISION = 6
    """It touched an obstacle."""
    DIVERGED = 7
    """The simulation has diverged."""
    TASK_FAILED = 8
    """It failed by a rule of the task (`Task.failed`)."""

    @property
    def text(self) -> str:
        """The reason in words; empty for `NONE`."""
        return "" if self is Termination.NONE else self.name.lower().replace("_", " ")


GROUND_M = 0.03
"""Height above that of the standing vehicle below which a flight has ended on the ground [m]."""


@dataclass(frozen=True, eq=False)
class Bounds(Table):
    """Limits of the flights of n vehicles."""

    box_m: Array
    """(n, 2, 3) Boxes that the vehicles must not leave [m]."""
    ground_m: Array
    """(n,) Smallest heights of the centres of mass in the world [m]."""


def failures(
    states: VehicleStates, touched: Mask, diverged: Mask, unestimated: Mask, bounds: Bounds
) -> npt.NDArray[np.int64]:
    """Return the failures (n,) of n vehicles as numbers of `Termination`; 0 without a failure.

    Args:
        states: States of the vehicles.
        touched: (n,) Whether they have touched an obstacle.
        diverged: (n,) Whether their simulation has diverged.
        unestimated: (n,) Whether they fly without a state of their estimator.
        bounds: Limits of the flights.
    """
    position = states.position_m
    reason = np.zeros(len(position), dtype=np.int64)
    outside = (position < bounds.box_m[:, 0]) | (position > bounds.box_m[:, 1])
    for termination, failed in (
        (Termination.NO_ESTIMATE, unestimated),
        (Termination.FLIPPED, states.R_world_vehicle[:, 2, 2] < 0.0),
        (Termination.OUT_OF_BOUNDS, outside.any(axis=1)),
        (Termination.GROUND, position[:, 2] < bounds.ground_m),
        (Termination.COLLISION, touched),
        (Termination.DIVERGED, diverged),
    ):
        reason[failed] = termination
    return reason
