"""A built-in policy without learning: flight to the observed goal, a baseline for tasks with goals."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.actions import ActionLimits
from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z, yaw_rad_from_matrix

TURNING_FROM_M = 1.0
"""Horizontal distance from the goal beyond which the vehicle turns to it [m]."""


def fly_to_goal(
    observation: Mapping[str, npt.ArrayLike],
    limits: ActionLimits | None = None,
    *,
    gain_per_s: float = 1.2,
    speed_m_s: float = 1.0,
) -> npt.NDArray[np.float32]:
    """Return actions of the mode ``velocity`` that fly straight to the current goals, whatever is in between.

    The velocity is proportional to the distance, up to a limit. A vehicle that is far from its goal turns to it.

    Args:
        observation: Observations with the entries ``goals`` (…, K, 3) and ``rotation`` (…, 3, 3), of one environment or
            of many.
        limits: Limits of the actions of the environment; the defaults by default.
        gain_per_s: Velocity per distance [1/s].
        speed_m_s: Largest speed, within those of the limits [m/s].

    Returns:
        Actions (…, 4).
    """
    limits = limits or ActionLimits()
    R = np.asarray(observation["rotation"], dtype=np.float64)
    to_goal = np.asarray(observation["goals"], dtype=np.float64)[..., 0, :]
    level = rotation_z(yaw_rad_from_matrix(R)).mT @ R  # from the vehicle frame to the horizontal one with its heading
    ahead = np.matvec(level, to_goal)
    velocity = gain_per_s * ahead
    velocity *= np.minimum(1.0, speed_m_s / np.maximum(_length(velocity), 1e-9))[..., None]
    far = _length(ahead[..., :2]) > TURNING_FROM_M
    yaw_rate = np.where(far, gain_per_s * np.arctan2(ahead[..., 1], ahead[..., 0]), 0.0)
    scaled = np.concatenate([velocity / limits.velocity_m_s, (yaw_rate / limits.yaw_rate_rad_s)[..., None]], axis=-1)
    return np.asarray(np.clip(scaled, -1.0, 1.0), dtype=np.float32)


def _length(vectors: Array) -> Any:
    """Return the lengths (…) of vectors (…, D)."""
    return np.linalg.norm(vectors, axis=-1)
