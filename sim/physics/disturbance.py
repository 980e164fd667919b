"""Disturbance observer: accelerations that a model of the drone does not explain."""

from typing import NamedTuple

import numpy as np

from dronevio.models.arrays import Array


class ObserverState(NamedTuple):
    """State of a disturbance observer of one vehicle or many."""

    predicted: Array
    """(…, 3) Velocities that the model predicts for the time of the next update."""
    disturbance: Array
    """(…, 3) Estimated accelerations that the model does not explain."""


class DisturbanceObserver:
    """Estimates the unmodelled acceleration from velocities, linear or angular; broadcasts over leading axes.

    A Luenberger observer of velocity and a constant disturbance, with a double pole (as Tomić and Haddadin, "A unified
    framework for external wrench estimation …", IROS 2014). Only the error of the model is integrated, so that there is
    no windup when rotors saturate or the path is far.
    """

    def __init__(self, pole_rad_s: float, limit: float, interval_s: float) -> None:
        """Define the observer.

        Args:
            pole_rad_s: Magnitude of both poles [rad/s].
            limit: Largest disturbance on each axis.
            interval_s: Time between two updates [s].
        """
        self._velocity_gain = 2.0 * pole_rad_s
        self._disturbance_step = pole_rad_s**2 * interval_s
        self._limit = limit
        self._interval_s = interval_s

    @staticmethod
    def at(velocity: Array) -> ObserverState:
        """Return the state before the first update, with a velocity (…, 3) and no disturbance."""
        return ObserverState(velocity, np.zeros_like(velocity))

    def update(self, state: ObserverState, velocity: Array, modelled: Array) -> ObserverState:
        """Return the state after an update.

        Args:
            state: The state before.
            velocity: (…, 3) Current velocities.
            modelled: (…, 3) Modelled accelerations until the next update.
        """
        error = velocity - state.predicted
        disturbance = state.disturbance + self._disturbance_step * error
        disturbance = np.minimum(np.maximum(disturbance, -self._limit), self._limit)
        predicted = state.predicted + self._interval_s * (modelled + disturbance + self._velocity_gain * error)
        return ObserverState(predicted, disturbance)
