"""Gains of the controller."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Gains:
    """Gains of the controller per unit mass and inertia, valid for quadrotors of any size."""

    position_per_s2: float = 9.0
    """Acceleration per position error [1/s²]: a natural frequency of 3 rad/s."""
    velocity_per_s: float = 5.0
    """Acceleration per velocity error [1/s]."""
    tilt_per_s2: float = 140.0
    """Angular acceleration of roll and pitch per attitude error [1/s²]: 12 rad/s, a third of the rotors' 33."""
    tilt_rate_per_s: float = 18.0
    """Angular acceleration of roll and pitch per rate error [1/s]."""
    yaw_per_s2: float = 30.0
    """Angular acceleration of yaw per attitude error [1/s²]; small, since the drag torque of rotors is weak."""
    yaw_rate_per_s: float = 9.0
    """Angular acceleration of yaw per rate error [1/s]."""
    force_observer_rad_s: float = 5.0
    """Poles of the force disturbance observer [rad/s], slower than the attitude loop."""
    force_max_m_s2: float = 5.0
    """Largest compensated force disturbance on each axis per unit mass [m/s²]."""
    torque_observer_rad_s: float = 12.0
    """Poles of the torque disturbance observer [rad/s], slower than the rotors."""
    torque_max_rad_s2: float = 60.0
    """Largest compensated torque disturbance on each axis per unit inertia [rad/s²]."""
    rotor_response_s: float = 0.03
    """Time constant to which the lead compensation speeds up slower rotors [s]."""
