"""Earlier keyframes whose views are most like that of a new one, by their poses."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings

MIN_SEPARATION = 4
"""Number of keyframes between two in which one is localized, so that these show different landmarks."""


@dataclass(frozen=True)
class CovisibilityConfig(Settings):
    """Settings of the choice of keyframes that are expected to show the same place."""

    max_distance_m: Annotated[float, Range(0.01, 100.0)] = 1.5
    """Largest distance of two keyframes that are expected to show the same place [m]."""
    max_angle_deg: Annotated[float, Range(1.0, 180.0)] = 30.0
    """Largest angle between their orientations [°]."""
    references: Annotated[int, Range(1, 20)] = 2
    """Number of earlier keyframes in which one is localized."""


def nearest_views(Ts: Array, T: Array, config: CovisibilityConfig) -> list[int]:
    """Return the rows of the poses that are most like another one, the most similar first.

    Args:
        Ts: (N, 4, 4) Poses of keyframes in the order of time.
        T: (4, 4) The pose that they are compared with.
        config: Settings.
    """
    distance_m = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", Ts[:, :3, :3], T[:3, :3]) - 1.0) / 2.0
    angle_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    distance, angle = distance_m / config.max_distance_m, angle_rad / np.radians(config.max_angle_deg)
    near = np.flatnonzero(np.maximum(distance, angle) < 1.0)
    chosen: list[int] = []
    for row in near[np.argsort((distance + angle)[near])].tolist():
        if len(chosen) < config.references and all(abs(row - other) > MIN_SEPARATION for other in chosen):
            chosen.append(row)
    return chosen
