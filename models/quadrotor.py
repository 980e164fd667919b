"""The quadrotor: every constant of its body and rotors, and where its MJCF lies.

A research quadrotor of 1.5 kg in X configuration, the size that carries a camera, an IMU and a small computer. The
vehicle frame is FLU (x forward, y left, z up) with its origin at the centre of mass.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import GRAVITY_M_S2

Array = npt.NDArray[np.float64]

QUADROTOR_MJCF = Path(__file__).parent / "mjcf" / "quadrotor.xml"
"""The MJCF: shape, looks, feet and the sites that the simulator drives and senses."""

ROTOR_NAMES = ("rotor_front_right", "rotor_rear_left", "rotor_front_left", "rotor_rear_right")
"""The rotors' sites in the order of every motor command (that of PX4's ``Generic Quadcopter X``)."""

_SIDES = np.array([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0]])  # signs of x (front) and y (left)
_SPINS = np.array([1.0, 1.0, -1.0, -1.0])  # +1: anticlockwise seen from above, as PX4 turns them


@dataclass(frozen=True)
class Quadrotor:
    """Mass, size and rotors of a quadrotor in X configuration.

    The aerodynamic constants are those of the 10-inch propeller that RotorS identified on AscTec's Firefly (Furrer,
    Burri, Achtelik, Siegwart, "RotorS – A Modular Gazebo MAV Simulator Framework", 2016), a drone of the same mass.
    """

    mass_kg: float = 1.5
    """Mass with battery, computer and rig [kg]."""
    inertia_kg_m2: tuple[float, float, float] = (0.0095, 0.0095, 0.0170)
    """Principal moments about x, y, z [kg m²]: four motors of 80 g at the arms' ends, the rest a box of 14×14×8 cm."""
    arm_m: float = 0.20
    """Distance from the centre of mass to each rotor's axis, in the horizontal plane [m]."""
    rotor_height_m: float = 0.03
    """Height of the rotors' discs above the centre of mass [m]."""
    thrust_n_per_rad2_s2: float = 8.54858e-6
    """Thrust of a rotor by the square of its speed, k in F = k ω² [N/(rad/s)²] (RotorS)."""
    torque_nm_per_rad2_s2: float = 1.36777e-7
    """Drag torque of a rotor by the square of its speed [N m/(rad/s)²] (RotorS: 0.016 m × the thrust's constant)."""
    drag_n_s2_per_rad_m: float = 8.06428e-5
    """In-plane drag of a rotor by its speed and the airspeed in its disc [N/((rad/s)(m/s))] (RotorS; Martin and
    Salaün, "The true role of accelerometer feedback in quadrotor control", 2010). At hover 0.14 m/s² per m/s."""
    rotor_lag_s: float = 0.03
    """Time constant of a rotor's speed behind its command [s]; typical of a 10-inch propeller on a 900 kV motor."""
    rotor_speed_max_rad_s: float = 1000.0
    """Greatest speed of a rotor [rad/s]; thrust to weight is 2.3 there."""

    @property
    def rotor_positions_m(self) -> Array:
        """(4, 3) Centres of the rotors' discs in the vehicle frame [m]."""
        height = np.full((4, 1), self.rotor_height_m)
        return np.hstack([_SIDES * self.arm_m / np.sqrt(2.0), height])

    @property
    def rotor_spins(self) -> Array:
        """(4,) Sense of rotation, +1 anticlockwise and −1 clockwise seen from above; the body feels the opposite."""
        return _SPINS.copy()

    @property
    def hover_speed_rad_s(self) -> float:
        """Rotor speed at which four rotors carry the weight [rad/s]."""
        return float(np.sqrt(self.mass_kg * GRAVITY_M_S2 / (4.0 * self.thrust_n_per_rad2_s2)))

    @property
    def allocation(self) -> Array:
        """(4, 4) Maps squared rotor speeds [(rad/s)²] to thrust [N] and torques about x, y, z [N m]."""
        x, y = self.rotor_positions_m[:, 0], self.rotor_positions_m[:, 1]
        k, km = self.thrust_n_per_rad2_s2, self.torque_nm_per_rad2_s2
        return np.stack([np.full(4, k), k * y, -k * x, -km * self.rotor_spins])
