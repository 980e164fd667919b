"""Latency: actions that take effect a number of IMU intervals after the observation."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask

LATENCY_MAX_S = 0.2
"""Largest latency [s]; larger ones are reduced to it."""


@dataclass(frozen=True, eq=False)
class DelayedActions:
    """Actions of n environments, each delayed by a whole number of IMU intervals."""

    recent: tuple[Array, ...]
    """(n, A) Actions of the last steps, the newest first; zeros before the start of an episode."""
    delay: npt.NDArray[np.int64]
    """(n,) Delays in IMU intervals."""
    samples: int
    """Number of IMU intervals per action."""
    interval_s: float
    """Length of an IMU interval [s]."""

    @classmethod
    def none(cls, count: int, samples: int, interval_s: float, size: int = 4) -> Self:
        """Return zero actions of ``count`` environments, with ``size`` numbers each, without delay."""
        depth = int(np.ceil(LATENCY_MAX_S / interval_s / samples)) + 1
        return cls((np.zeros((count, size)),) * depth, np.zeros(count, dtype=np.int64), samples, interval_s)

    def restarted(self, mask: Mask, latency_s: Array) -> Self:
        """Return zero actions and latencies (n,) [s] in a mask (n,), at the start of its episodes."""
        rounded = np.rint(np.clip(latency_s, 0.0, LATENCY_MAX_S) / self.interval_s).astype(np.int64)
        recent = tuple(np.where(mask[:, None], 0.0, actions) for actions in self.recent)
        return replace(self, recent=recent, delay=np.where(mask, rounded, self.delay))

    def pushed(self, actions: Array) -> Self:
        """Return the actions with those (n, A) of a new step."""
        return replace(self, recent=(actions, *self.recent[:-1]))

    def at(self, interval: int) -> Array:
        """Return the actions (n, A) that take effect in an IMU interval of the current step."""
        age = np.maximum(-((interval - self.delay) // self.samples), 0)
        oldest = int(age.max())
        if oldest == 0:
            return self.recent[0].copy()
        return np.asarray(np.stack(self.recent[: oldest + 1])[age, np.arange(len(age))])
