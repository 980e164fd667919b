"""Random numbers: one stream for each subsystem, all from one seed.

So one more random number in a world's paint does not change the IMU's noise, and the noise of a frame does not depend
on who drew the frames before it.
"""

from typing import Literal

import numpy as np

Stream = Literal["layout", "paint", "images", "frames", "path", "imu", "wind", "faults"]
"""Who draws: a world's layout and its looks, the images' noise, the frames' timing, the way, the IMU, gusts, faults."""

_KEYS: dict[Stream, int] = {
    "layout": 10,
    "paint": 11,
    "images": 20,
    "frames": 21,
    "path": 30,
    "imu": 31,
    "wind": 32,
    "faults": 33,
}


def generator(seed: int, stream: Stream, *part: int) -> np.random.Generator:
    """Return the random numbers of a subsystem, or of one part of its work, independent of all others."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_KEYS[stream], *part)))
