"""The quadrotors: every constant of their bodies, rotors and batteries, and where their MJCF lies.

The vehicle frame is FLU (x forward, y left, z up) with its origin at the centre of mass.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.battery import Battery
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.vibration import STILL, RotorVibration

Array = npt.NDArray[np.float64]

_MJCF = Path(__file__).parent / "mjcf"

ROTOR_NAMES = ("rotor_front_right", "rotor_rear_left", "rotor_front_left", "rotor_rear_right")
"""The rotors' sites in the order of every motor command (that of PX4's ``Generic Quadcopter X``)."""

AIR_DENSITY_KG_M3 = 1.225
"""Density of the air [kg/m³] (ICAO standard atmosphere, sea level)."""

_SIDES = np.array([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0]])  # signs of x (front) and y (left)
_SPINS = np.array([1.0, 1.0, -1.0, -1.0])  # +1: anticlockwise seen from above, as PX4 turns them
_PACK = Battery(cells=3, capacity_ah=5.0, resistance_ohm=0.02)
_POSITIVE = (
    "mass_kg",
    "inertia_kg_m2",
    "arm_m",
    "thrust_n_per_rad2_s2",
    "torque_nm_per_rad2_s2",
    "rotor_radius_m",
    "rotor_inertia_kg_m2",
    "rotor_lag_s",
    "rotor_speed_max_rad_s",
    "rotor_speed_per_v",
    "motor_efficiency",
)


@dataclass(frozen=True)
class Quadrotor:
    """Mass, size, rotors and battery of a quadrotor in X configuration.

    The defaults are those of a research quadrotor of 1.5 kg, the size that carries a camera, an IMU and a small
    computer. Its thrust, torque and drag are those of the 10-inch propeller that RotorS identified on AscTec's Firefly
    (Furrer, Burri, Achtelik, Siegwart, "RotorS – A Modular Gazebo MAV Simulator Framework", 2016), a drone of the same
    mass.
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
    inflow_n_s2_per_rad_m: float = 3.3e-4
    """Thrust that a rotor loses by its speed and the air that comes to it from above [N/((rad/s)(m/s))]: blade element
    and momentum theory at hover for two blades with a chord of 20 mm and a lift slope of 5 (Leishman, "Principles of
    Helicopter Aerodynamics", 2006, §3.3). At hover 0.58 m/s² per m/s of climb."""
    rotor_lag_s: float = 0.03
    """Time constant of a rotor's speed behind its command [s]; typical of a 10-inch propeller on a 900 kV motor."""
    rotor_speed_max_rad_s: float = 1000.0
    """Greatest speed of a rotor [rad/s]; thrust to weight is 2.3 there."""
    rotor_radius_m: float = 0.127
    """Radius of a propeller [m]: 10 inches across."""
    rotor_inertia_kg_m2: float = 4.0e-5
    """Moment of inertia of a propeller and the part of its motor that turns [kg m²]: three fifths of a rod of 11 g and
    10 inches (blades thin out) and a bell of 30 g at 12 mm."""
    rotor_speed_per_v: float = 90.0
    """Rotor speed at full throttle by the battery's loaded voltage [(rad/s)/V]; a 920 kV motor, which without load
    would give 96, turns a 10-inch propeller so under load."""
    motor_efficiency: float = 0.8
    """Shaft power by electrical power of a motor and its controller; typical of brushless motors of this size."""
    avionics_w: float = 10.0
    """What computer, camera and radio draw [W]."""
    battery: Battery = _PACK
    """Three cells of 5 A h, each of 4 mΩ, and as much again in leads and switches."""
    drag_area_m2: tuple[float, float, float] = (0.013, 0.013, 0.033)
    """Drag coefficient × frontal area of body, arms and legs along x, y, z [m²]; the coefficient is a cube's, 1.05
    (Hoerner, "Fluid-Dynamic Drag", 1965, ch. 3)."""
    vibration: RotorVibration = STILL
    """How the rotors shake the IMU."""
    mjcf_name: str = "quadrotor"
    """Which MJCF has its shape and looks."""

    def __post_init__(self) -> None:
        """Check the constants that must not vanish.

        Raises:
            ConfigError: One of them is not a positive, finite number.
        """
        for name in _POSITIVE:
            value = np.asarray(getattr(self, name))
            if not (np.all(np.isfinite(value)) and np.all(value > 0.0)):
                raise ConfigError(f"quadrotor.{name} = {value.tolist()}; expected positive, finite numbers")

    @property
    def mjcf(self) -> Path:
        """The MJCF: shape, looks, feet and the sites that the simulator drives and senses."""
        return _MJCF / f"{self.mjcf_name}.xml"

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


RESEARCH = Quadrotor()
"""The research quadrotor of 1.5 kg."""

NANO = Quadrotor(
    # Bitcraze's Crazyflie 2.x weighs 27 g; the rest is a camera.
    mass_kg=0.030,
    # Förster, "System identification of the Crazyflie 2.0 nano quadrocopter", ETH Zürich 2015: moments of inertia,
    # torque by thrust (5.96 mm) and drag by rotor speed and airspeed, along and across the discs.
    inertia_kg_m2=(16.57e-6, 16.66e-6, 29.26e-6),
    torque_nm_per_rad2_s2=1.323e-10,
    drag_n_s2_per_rad_m=1.0251e-6,
    inflow_n_s2_per_rad_m=7.553e-7,
    # Bitcraze's drawing: motors 65 mm apart, the discs above the board.
    arm_m=0.046,
    rotor_height_m=0.012,
    rotor_radius_m=0.0231,
    # Bitcraze's thrust stand ("PWM to thrust": 4485 to 23 882 rpm, 1.6 to 57.9 g, 4.0 to 3.3 V, up to 4.4 A): thrust
    # by squared speed, speed by voltage at full throttle, efficiency from hover up, draw at rest, resistance.
    thrust_n_per_rad2_s2=2.218e-8,
    rotor_speed_per_v=800.0,
    motor_efficiency=0.52,
    avionics_w=0.96,
    battery=Battery(cells=1, capacity_ah=0.25, resistance_ohm=0.16),
    rotor_speed_max_rad_s=2600.0,
    # Eschmann, Albani, Loianno, "Data-driven system identification of quadrotors subject to motor delays", 2024.
    rotor_lag_s=0.072,
    # Three fifths of a rod of 0.25 g and 46 mm; identified values lie around it.
    rotor_inertia_kg_m2=2.7e-8,
    # A board of 30 mm, four motors of 7 × 16 mm and the camera, with a cube's coefficient.
    drag_area_m2=(0.9e-3, 0.9e-3, 2.0e-3),
    mjcf_name="nano",
)
"""A nano quadrotor of 30 g."""

VEHICLES: dict[str, Quadrotor] = {"research": RESEARCH, "nano": NANO}
"""What can be flown, by name."""


def vehicle_named(name: str) -> Quadrotor:
    """Return a vehicle.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in VEHICLES:
        raise ConfigError(f"unknown vehicle {name!r}; expected one of {', '.join(VEHICLES)}")
    return VEHICLES[name]
