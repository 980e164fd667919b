"""Disturbance observer: accelerations that a model of the drone does not explain."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class DisturbanceObserver:
    """Estimates the unmodelled acceleration from velocities, linear or angular.

    A Luenberger observer of velocity and a constant disturbance, with a double pole (as Tomić and Haddadin, "A unified
    framework for external wrench estimation …", IROS 2014). Only the error of the model is integrated, so that there is
    no windup when rotors saturate or the path is far.
    """

    def __init__(self, pole_rad_s: float, limit: float) -> None:
        self._velocity_gain = 2.0 * pole_rad_s
        self._disturbance_gain = pole_rad_s**2
        self._limit = limit
        self._predicted: Array | None = None
        self.disturbance = np.zeros(3)

    def update(self, velocity: Array, modelled: Array, dt_s: float) -> None:
        """Update with the current velocity (3,) and the modelled acceleration (3,) until the next call."""
        if self._predicted is None:
            self._predicted = velocity
        error = velocity - self._predicted
        disturbance = self.disturbance + self._disturbance_gain * dt_s * error
        self.disturbance = np.minimum(np.maximum(disturbance, -self._limit), self._limit)
        self._predicted = self._predicted + dt_s * (modelled + self.disturbance + self._velocity_gain * error)
