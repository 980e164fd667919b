"""Multirotors: the parameters of airframe, rotors and battery, and the MJCF file of each.

The vehicle frame is FLU (x forward, y left, z up) with its origin at the centre of mass.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.battery import Battery
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotors import (
    ARRANGEMENTS,
    FEWEST_ROTORS,
    MOST_ROTORS,
    Rotor,
    arranged_directions,
    arranged_positions_m,
)
from dronevio.models.vibration import NO_VIBRATION, RotorVibration

_MJCF = Path(__file__).parent / "mjcf"

ROTOR_NAMES = ("rotor_front_right", "rotor_rear_left", "rotor_front_left", "rotor_rear_right")
"""Sites of four rotors in the packaged MJCF files, in the order of motor commands of ``quad-x``."""

AIR_DENSITY_KG_M3 = 1.225
"""Density of air in the ICAO standard atmosphere at sea level [kg/m³]."""

_OFF_CENTRE = 0.01  # largest distance of the centre of thrust from the centre of mass, relative to that of the rotors
_PACK = Battery(cells=3, capacity_ah=5.0, resistance_ohm=0.02)


class VehicleError(ConfigError):
    """A vehicle cannot fly, or a parameter of it is not plausible."""

    def __init__(self, field: str, found: str, expected: str) -> None:
        """Compose the message ``FIELD: FOUND; expected EXPECTED``.

        Args:
            field: Name of the field of `Quadrotor`.
            found: Description of what was found.
            expected: Description of what was expected.
        """
        self.field, self.found, self.expected = field, found, expected
        super().__init__(f"{field}: {found}; expected {expected}")


@dataclass(frozen=True)
class Quadrotor(Settings):
    """Mass, geometry, rotors and battery of a multirotor with four or more equal rotors on parallel axes.

    The name is that of its default. Rotors at equal speeds must not turn the vehicle, and their speeds must be able to
    turn it about each axis; both are checked on construction.

    The defaults describe a research quadrotor of 1.5 kg that carries a camera, an IMU and a small computer. Thrust,
    torque and drag are those of the 10-inch propeller of AscTec's Firefly, a drone of the same mass, as identified for
    RotorS (Furrer, Burri, Achtelik, Siegwart, "RotorS – A Modular Gazebo MAV Simulator Framework", 2016).
    """

    mass_kg: Annotated[float, Range(1e-3, 1e3)] = 1.5
    """Total mass with battery, computer and rig [kg]."""
    inertia_kg_m2: Annotated[tuple[float, float, float], Range(above=0.0, high=1e3)] = (0.0095, 0.0095, 0.0170)
    """Principal moments of inertia about x, y, z, of four motors of 80 g at the ends of the arms and a box of
    14×14×8 cm for the rest [kg m²]."""
    arm_m: Annotated[float, Range(above=0.0, high=10.0)] = 0.20
    """Horizontal distance from the centre of mass to the axis of each rotor of an arrangement [m]."""
    rotor_height_m: Annotated[float, Range(-10.0, 10.0)] = 0.03
    """Height of the rotor discs of an arrangement above the centre of mass [m]."""
    thrust_n_per_rad2_s2: Annotated[float, Range(above=0.0, high=1.0)] = 8.54858e-6
    """Thrust coefficient of a rotor (RotorS), k in F = k ω² [N/(rad/s)²]."""
    torque_nm_per_rad2_s2: Annotated[float, Range(above=0.0, high=1.0)] = 1.36777e-7
    """Drag torque coefficient of a rotor (RotorS: 0.016 m times the thrust coefficient) [N m/(rad/s)²]."""
    drag_n_s2_per_rad_m: Annotated[float, Range(0.0, 1.0)] = 8.06428e-5
    """In-plane drag of a rotor divided by its speed and the in-plane airspeed (RotorS; Martin and Salaün, "The true
    role of accelerometer feedback in quadrotor control", 2010), at hover 0.14 m/s² per m/s [N/((rad/s)(m/s))]."""
    inflow_n_s2_per_rad_m: Annotated[float, Range(0.0, 1.0)] = 3.3e-4
    """Loss of thrust of a rotor divided by its speed and the axial inflow velocity: blade element momentum theory at
    hover for two blades with a chord of 20 mm and a lift slope of 5 (Leishman, "Principles of Helicopter Aerodynamics",
    2006, §3.3), at hover 0.58 m/s² per m/s of climb rate [N/((rad/s)(m/s))]."""
    rotor_time_constant_s: Annotated[float, Range(above=0.0, high=10.0)] = 0.03
    """Time constant of the first-order response of the rotor speed to its command; typical of a 10-inch propeller on a
    900 kV motor [s]."""
    rotor_speed_max_rad_s: Annotated[float, Range(above=0.0, high=1e5)] = 1000.0
    """Largest rotor speed, at which the thrust-to-weight ratio is 2.3 [rad/s]."""
    rotor_radius_m: Annotated[float, Range(above=0.0, high=10.0)] = 0.127
    """Radius of a propeller of 10 inches diameter [m]."""
    rotor_inertia_kg_m2: Annotated[float, Range(above=0.0, high=10.0)] = 4.0e-5
    """Moment of inertia of a propeller and the rotor of its motor: three fifths of that of a rod of 11 g and 10 inches,
    because blades taper, and a bell of 30 g at 12 mm [kg m²]."""
    rotor_speed_per_v: Annotated[float, Range(above=0.0, high=1e5)] = 90.0
    """Rotor speed at full throttle divided by the voltage of the battery under load: that of a 920 kV motor with a
    10-inch propeller; without load it would be 96 [(rad/s)/V]."""
    motor_efficiency: Annotated[float, Range(above=0.0, high=1.0)] = 0.8
    """Efficiency of motor and speed controller, shaft power over electrical power; typical of this size."""
    avionics_w: Annotated[float, Range(0.0, 1e4)] = 10.0
    """Power consumption of computer, camera and radio [W]."""
    battery: Battery = _PACK
    """Battery of the drone: three cells of 5 A h with 4 mΩ each, and 8 mΩ of leads and switches."""
    drag_area_m2: Annotated[tuple[float, float, float], Range(0.0, 100.0)] = (0.013, 0.013, 0.033)
    """Drag coefficient times frontal area of body, arms and legs along x, y, z, with the coefficient of a cube, 1.05
    (Hoerner, "Fluid-Dynamic Drag", 1965, ch. 3) [m²]."""
    vibration: RotorVibration = NO_VIBRATION
    """Vibration that the rotors cause at the IMU."""
    mjcf_name: str | None = None
    """Name of an MJCF file of the package with geometry and appearance. By default, that of the research quadrotor if
    the rotors have its places and size; otherwise, a body is generated from the parameters."""
    rotors: str | tuple[Rotor, ...] = "quad-x"
    """Rotors in the order of motor commands: the name of an arrangement (`ARRANGEMENTS`) whose size is given by
    ``arm_m`` and ``rotor_height_m``, or 4 to 16 rotors one by one."""
    mjcf_file: Path | None = None
    """MJCF file of one's own with geometry and appearance, instead of ``mjcf_name``; see
    `dronevio.sim.physics.own_body`."""

    def __post_init__(self) -> None:
        """Check the numbers, and that the rotors can hold and turn the vehicle.

        Raises:
            RangeError: A number is outside its range.
            ConfigError: There is no such arrangement.
            VehicleError: The number of rotors is not supported, equal speeds turn the vehicle, or no speeds turn it
                about one of the axes.
        """
        super().__post_init__()
        if isinstance(self.rotors, str):
            if self.rotors not in ARRANGEMENTS:
                raise unknown_name("arrangement of rotors", self.rotors, ARRANGEMENTS)
            return
        if not (isinstance(self.rotors, tuple) and all(isinstance(rotor, Rotor) for rotor in self.rotors)):
            raise VehicleError("rotors", type(self.rotors).__name__, "the name of an arrangement, or a tuple of Rotor")
        if not FEWEST_ROTORS <= len(self.rotors) <= MOST_ROTORS:
            raise VehicleError("rotors", f"{len(self.rotors)} rotors", f"{FEWEST_ROTORS} to {MOST_ROTORS}")
        self._check_balance()

    @property
    def mjcf(self) -> Path | None:
        """MJCF file: geometry, appearance, landing gear, and the sites of sensors; None if the body is generated."""
        if self.mjcf_file is not None:
            return self.mjcf_file
        if self.mjcf_name is not None:
            return _MJCF / f"{self.mjcf_name}.xml"
        names = ("rotors", "arm_m", "rotor_height_m", "rotor_radius_m")
        as_research = all(getattr(self, name) == getattr(Quadrotor, name) for name in names)
        return _MJCF / "quadrotor.xml" if as_research else None

    @property
    def rotor_count(self) -> int:
        """Number R of rotors."""
        return len(ARRANGEMENTS[self.rotors] if isinstance(self.rotors, str) else self.rotors)

    @property
    def rotor_positions_m(self) -> Array:
        """(R, 3) Centres of the rotor discs in the vehicle frame [m]."""
        if isinstance(self.rotors, str):
            return arranged_positions_m(self.rotors, self.arm_m, self.rotor_height_m)
        return np.array([rotor.position_m for rotor in self.rotors], dtype=np.float64)

    @property
    def rotor_directions(self) -> Array:
        """(R,) Direction of rotation seen from above, +1 anticlockwise and −1 clockwise; the reaction is opposite."""
        if isinstance(self.rotors, str):
            directions = arranged_directions(self.rotors)
        else:
            directions = tuple(rotor.direction for rotor in self.rotors)
        return np.array([1.0 if direction == "ccw" else -1.0 for direction in directions])

    @property
    def reach_m(self) -> float:
        """Largest horizontal distance from the centre of mass to the axis of a rotor [m]."""
        if isinstance(self.rotors, str):
            return self.arm_m
        return float(np.hypot(*self.rotor_positions_m[:, :2].T).max())

    @property
    def hover_speed_rad_s(self) -> float:
        """Rotor speed at which the thrust of all rotors equals the weight [rad/s]."""
        return float(np.sqrt(self.mass_kg * GRAVITY_M_S2 / (float(self.rotor_count) * self.thrust_n_per_rad2_s2)))

    @property
    def full_speed_rad_s(self) -> float:
        """Speed that all rotors together reach with a full battery [rad/s]."""
        slow, fast = 0.0, self.rotor_speed_max_rad_s
        if self._reaches(fast):
            return fast
        for _ in range(60):  # bisection to the last digit: the voltage decreases as the speed increases
            middle = 0.5 * (slow + fast)
            slow, fast = (middle, fast) if self._reaches(middle) else (slow, middle)
        return slow

    @property
    def thrust_to_weight(self) -> float:
        """Largest thrust of all rotors with a full battery, divided by the weight."""
        return (self.full_speed_rad_s / self.hover_speed_rad_s) ** 2

    @property
    def hover_power_w(self) -> float:
        """Electrical power at hover out of ground effect [W]."""
        return self._power_w(self.hover_speed_rad_s)

    @property
    def allocation(self) -> Array:
        """(4, R) Map from squared rotor speeds [(rad/s)²] to thrust [N] and torques about x, y, z [N m]."""
        x, y = self.rotor_positions_m[:, 0], self.rotor_positions_m[:, 1]
        k, km = self.thrust_n_per_rad2_s2, self.torque_nm_per_rad2_s2
        return np.stack([np.full(self.rotor_count, k), k * y, -k * x, -km * self.rotor_directions])

    def _power_w(self, speed_rad_s: float) -> float:
        """Return the electrical power with all rotors at a speed [W]."""
        shafts = self.rotor_count * self.torque_nm_per_rad2_s2 * speed_rad_s**3
        return self.avionics_w + shafts / self.motor_efficiency

    def _reaches(self, speed_rad_s: float) -> bool:
        """Return whether a full battery drives all rotors at a speed [rad/s]."""
        voltage = self.battery.loaded_v(np.array(1.0), np.array(self._power_w(speed_rad_s)))
        return bool(speed_rad_s <= self.rotor_speed_per_v * voltage)

    def _check_balance(self) -> None:
        """Check that equal speeds do not turn the vehicle, and that others turn it about each axis.

        Raises:
            VehicleError: They do, or they do not.
        """
        places, spins = self.rotor_positions_m[:, :2], self.rotor_directions
        size, (x, y) = self.reach_m, places.mean(axis=0)
        if np.hypot(x, y) > _OFF_CENTRE * size or size == 0.0:
            found = f"the centre of the rotors is at x = {x:.3g} m, y = {y:.3g} m from the centre of mass"
            raise VehicleError("rotors", found, "0, 0: positions relative to the centre of mass, around it")
        if spins.sum() != 0.0:
            found = (
                f"{int((spins > 0).sum())} rotors turn anticlockwise (ccw) and {int((spins < 0).sum())} clockwise (cw)"
            )
            raise VehicleError("rotors", found, "as many of each, so that the vehicle does not turn at hover")
        scaled = np.stack([np.ones(len(spins)), *(places.T / size), spins])
        for axis, without in (("x (roll)", 2), ("y (pitch)", 1), ("z (yaw)", 3)):
            others = np.delete(scaled, without, axis=0)
            rest = scaled[without] - others.T @ np.linalg.lstsq(others.T, scaled[without], rcond=None)[0]
            if np.linalg.norm(rest) < 1e-3:
                found = f"no rotor speeds turn the vehicle about {axis} alone"
                raise VehicleError("rotors", found, "places and directions that can, such as those of quad-x")


RESEARCH = Quadrotor()
"""The research quadrotor of 1.5 kg."""

NANO = Quadrotor(
    # Bitcraze's Crazyflie 2.x weighs 27 g, to which 3 g are added for a camera.
    mass_kg=0.030,
    # Förster, "System identification of the Crazyflie 2.0 nano quadrocopter", ETH Zürich 2015: moments of inertia,
    # ratio of torque to thrust (5.96 mm), in-plane drag and inflow coefficients.
    inertia_kg_m2=(16.57e-6, 16.66e-6, 29.26e-6),
    torque_nm_per_rad2_s2=1.323e-10,
    drag_n_s2_per_rad_m=1.0251e-6,
    inflow_n_s2_per_rad_m=7.553e-7,
    # Bitcraze's drawing: motors 65 mm apart, discs above the board.
    arm_m=0.046,
    rotor_height_m=0.012,
    rotor_radius_m=0.0231,
    # Bitcraze's thrust stand ("PWM to thrust": 4485 to 23 882 rpm, 1.6 to 57.9 g, 4.0 to 3.3 V, up to 4.4 A): thrust
    # coefficient, speed per volt at full throttle, efficiency from hover on, idle power, resistance.
    thrust_n_per_rad2_s2=2.218e-8,
    rotor_speed_per_v=800.0,
    motor_efficiency=0.52,
    avionics_w=0.96,
    battery=Battery(cells=1, capacity_ah=0.25, resistance_ohm=0.16),
    rotor_speed_max_rad_s=2600.0,
    # Eschmann, Albani, Loianno, "Data-driven system identification of quadrotors subject to motor delays", 2024.
    rotor_time_constant_s=0.072,
    # Three fifths of that of a rod of 0.25 g and 46 mm; identified values are similar.
    rotor_inertia_kg_m2=2.7e-8,
    # A board of 30 mm, four motors of 7 × 16 mm and the camera, with the coefficient of a cube.
    drag_area_m2=(0.9e-3, 0.9e-3, 2.0e-3),
    mjcf_name="nano",
)
"""A nano quadrotor of 30 g."""

VEHICLES: dict[str, Quadrotor] = {"research": RESEARCH, "nano": NANO}
"""The vehicles by name."""


def vehicle_named(name: str) -> Quadrotor:
    """Return the vehicle with a given name.

    `dronevio.models.vehicles.vehicle_of` also reads vehicles of one's own.

    Raises:
        ConfigError: There is no vehicle with this name.
    """
    if name not in VEHICLES:
        raise unknown_name("vehicle", name, VEHICLES)
    return VEHICLES[name]
