"""The disturbance observer: what pushes or turns a drone beside what its model knows of."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class DisturbanceObserver:
    """Estimates the acceleration that a model does not know, from velocities, linear or angular.

    A Luenberger observer of velocity and a constant disturbance, both poles at the same place (as Tomić and Haddadin,
    "A unified framework for external wrench estimation …", IROS 2014). Nothing is integrated but the model's error, so
    nothing winds up when rotors saturate or the path is far.
    """

    def __init__(self, pole_rad_s: float, limit: float) -> None:
        self._velocity_gain = 2.0 * pole_rad_s
        self._disturbance_gain = pole_rad_s**2
        self._limit = limit
        self._predicted: Array | None = None
        self.disturbance = np.zeros(3)

    def update(self, velocity: Array, modelled: Array, dt_s: float) -> None:
        """Take the velocity (3,) now, and the acceleration (3,) that the model expects until the next call."""
        if self._predicted is None:
            self._predicted = velocity
        error = velocity - self._predicted
        disturbance = self.disturbance + self._disturbance_gain * dt_s * error
        self.disturbance = np.minimum(np.maximum(disturbance, -self._limit), self._limit)
        self._predicted = self._predicted + dt_s * (modelled + self.disturbance + self._velocity_gain * error)
