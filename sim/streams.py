"""Random number streams: one independent stream for each subsystem, all derived from one seed.

A change of the number of draws in one subsystem therefore does not change another, and the noise of a frame does not
depend on the process that rendered earlier frames.
"""

from typing import Literal

import numpy as np

Stream = Literal["layout", "paint", "light", "images", "frames", "path", "imu", "wind", "faults", "goal"]
"""The subsystems: layout, textures and other light of the world, image noise, frame times, path, IMU errors, gusts,
faults and the goal of an exploration."""

_KEYS: dict[Stream, int] = {
    "layout": 10,
    "paint": 11,
    "light": 12,
    "images": 20,
    "frames": 21,
    "path": 30,
    "imu": 31,
    "wind": 32,
    "faults": 33,
    "goal": 34,
}


def generator(seed: int, stream: Stream, *part: int) -> np.random.Generator:
    """Return the random generator of a subsystem, or of one part of its work, independent of all others."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_KEYS[stream], *part)))
