"""Latency: actions that take effect a number of IMU intervals after the observation."""

from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.sim.physics.vehicle_states import Mask

Array = npt.NDArray[np.float64]

LATENCY_MAX_S = 0.2
"""Largest latency [s]; larger ones are reduced to it."""


class DelayedActions:
    """Actions of n environments, each delayed by a whole number of IMU intervals."""

    def __init__(self, count: int, samples: int, interval_s: float) -> None:
        """Start with zero actions and without delay.

        Args:
            count: Number of environments.
            samples: Number of IMU intervals per action.
            interval_s: Length of an IMU interval [s].
        """
        self._samples, self._interval_s = samples, interval_s
        depth = int(np.ceil(LATENCY_MAX_S / interval_s / samples)) + 1
        self._recent: Array = np.zeros((depth, count, 4))  # a ring, in which newer actions precede older ones
        self._newest = 0
        self._delay = np.zeros(count, dtype=np.int64)
        self._environments = np.arange(count)

    def reset(self, mask: Mask, latency_s: Array) -> None:
        """Start the episodes of a mask (n,) with zero actions and latencies (n,) [s], of which masked rows are used."""
        rounded = np.rint(np.clip(latency_s, 0.0, LATENCY_MAX_S) / self._interval_s).astype(np.int64)
        self._delay = np.where(mask, rounded, self._delay)
        self._recent[:, mask] = 0.0

    def push(self, actions: Array) -> None:
        """Add the actions (n, 4) of a new step."""
        self._newest = (self._newest - 1) % len(self._recent)
        self._recent[self._newest] = actions

    def at(self, interval: int) -> Array:
        """Return the actions (n, 4) that take effect in an IMU interval of the current step."""
        age = np.maximum(-((interval - self._delay) // self._samples), 0)
        if not age.any():
            return np.array(self._recent[self._newest])
        return np.asarray(self._recent[(self._newest + age) % len(self._recent), self._environments])

    def save(self) -> dict[str, Any]:
        """Return a copy of actions and delays."""
        return {"recent": self._recent.copy(), "newest": self._newest, "delay": self._delay.copy()}

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`."""
        self._recent, self._newest, self._delay = saved["recent"].copy(), saved["newest"], saved["delay"].copy()
