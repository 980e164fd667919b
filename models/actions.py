"""Actions of environments and policies: the names of the modes, and the values that actions of ±1 command.

`dronevio.sim.envs.episodes.actions` specifies the modes.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.models.ranges import Range, Settings

ACTION_MODES = ("rotors", "rates", "attitude", "velocity", "position")
"""Names of all action modes."""


@dataclass(frozen=True)
class ActionLimits(Settings):
    """Values that actions of ±1 command."""

    rate_rad_s: Annotated[float, Range(above=0.0, high=1e3)] = 6.0
    """Largest angular velocity about x and y in the mode ``rates`` [rad/s]."""
    yaw_rate_rad_s: Annotated[float, Range(above=0.0, high=1e3)] = 2.0
    """Largest angular velocity about z in all modes [rad/s]."""
    tilt_rad: Annotated[float, Range(above=0.0, below=np.pi)] = 0.6
    """Largest roll and pitch in the mode ``attitude`` [rad]."""
    velocity_m_s: Annotated[float, Range(above=0.0, high=1e3)] = 2.0
    """Largest velocity along each axis in the mode ``velocity``, and largest speed in the mode ``position`` [m/s]."""
    position_m: Annotated[float, Range(above=0.0, high=1e3)] = 2.0
    """Largest distance along each axis in the mode ``position`` [m]."""
    acceleration_m_s2: Annotated[float, Range(above=0.0, high=1e4)] = 6.0
    """Largest acceleration by the velocity error in the modes ``velocity`` and ``position`` [m/s²]."""
