"""Actions of environments and policies: the names of the modes, and the values that actions of ±1 command.

`dronevio.sim.envs.actions` specifies the modes.
"""

from dataclasses import dataclass, fields

import numpy as np

from dronevio.models.errors import ConfigError

ACTION_MODES = ("rotors", "rates", "attitude", "velocity")
"""Names of all action modes."""


@dataclass(frozen=True)
class ActionLimits:
    """Values that actions of ±1 command."""

    rate_rad_s: float = 6.0
    """Largest angular velocity about x and y in the mode ``rates`` [rad/s]."""
    yaw_rate_rad_s: float = 2.0
    """Largest angular velocity about z in all modes [rad/s]."""
    tilt_rad: float = 0.6
    """Largest roll and pitch in the mode ``attitude`` [rad]."""
    velocity_m_s: float = 2.0
    """Largest velocity along each axis in the mode ``velocity`` [m/s]."""
    acceleration_m_s2: float = 6.0
    """Largest acceleration by the velocity error in the mode ``velocity`` [m/s²]."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A value is not a positive, finite number.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 < value < np.inf:
                raise ConfigError(f"action_limits.{field.name} = {value}; expected a positive, finite number")
