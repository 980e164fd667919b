"""Rotor and aerodynamic model: response of the rotors, and force and torque of rotors and air on the body.

All functions broadcast over leading axes, for one simulation or many. The model is evaluated once per control step, and
its wrench is constant over the steps of the physics.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import exp
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.quadrotor import AIR_DENSITY_KG_M3, Quadrotor
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import skew
from dronevio.models.rotors import MOST_ROTORS
from dronevio.sim.physics.ground_effect import GroundEffect
from dronevio.sim.physics.vehicle_states import Table, VehicleParameters


@dataclass(frozen=True)
class MotorFailure(Settings):
    """Loss of power of a rotor, which is then decelerated by its drag only."""

    rotor: Annotated[int, Range(0, MOST_ROTORS - 1)]
    """Index of the rotor in the order of motor commands."""
    t_s: Annotated[float, Range(low=0.0, infinite=True)]
    """Time of the failure since the start of the flight [s]."""


@dataclass(frozen=True, eq=False)
class RotorState(Table):
    """State of rotors and battery of one simulation or many."""

    speed_rad_s: Array
    """(…, R) Speeds of the rotors [rad/s]."""
    acceleration_rad_s2: Array
    """(…, R) Accelerations of the rotors over the last control step [rad/s²]."""
    charge: Array
    """(…) State of charge of the battery, from 1 (full) to 0 (empty)."""
    voltage_v: Array
    """(…) Voltage of the battery under the steady load of these speeds [V]; accelerations, shorter than the time
    constants of the cell chemistry, are not included."""


@dataclass(frozen=True, eq=False)
class Airflow:
    """Motion of a vehicle relative to the air and the ground."""

    velocity_m_s: Array
    """(…, 3) Velocity of the centre of mass relative to the air, in the vehicle frame [m/s]."""
    rate_rad_s: Array
    """(…, 3) Angular velocity in the vehicle frame [rad/s]."""
    up: Array
    """(…, 3) The world's z axis in the vehicle frame."""
    height_m: Array
    """(…) Height of the centre of mass above the ground [m]."""


class Rotors:
    """Rotor and aerodynamic model of one vehicle type, or of n vehicles whose parameters differ.

    A rotor at speed ω, whose hub moves through the air at (u, v, w) in the vehicle frame, exerts along its axis the
    thrust g k ω² − k_i ω w (g the ground effect), in its disc the drag −k_d ω (u, v), and about its axis the torque −s
    (k_m ω² + J ω̇), the sum of drag and reaction (s = ±1 the direction of rotation). All rotors together have the
    angular momentum H = J Σ s ω along z, whose rotation with the body requires the torque −Ω × H. The body has the drag
    −½ ρ A_i |V| V_i along each axis.

    Sources: Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE RAM 2012 (thrust, torque, gyroscopic torque);
    Martin and Salaün 2010 (rotor drag); Smeur, Chu, de Croon, "Adaptive incremental nonlinear dynamic inversion", JGCD
    2016 (reaction torque). Aerodynamic interaction with surfaces other than the floor is not modelled.
    """

    def __init__(self, quadrotor: Quadrotor, parameters: VehicleParameters | None = None) -> None:
        """Define the vehicles.

        Args:
            quadrotor: Parameters of the vehicle type.
            parameters: Differing parameters of n vehicles, for states with n rows; those of the type by default.
        """
        self._quadrotor = quadrotor
        self._hubs, self._hub_twists, self._spins = _geometry(quadrotor)
        self._ground = GroundEffect(quadrotor)
        self._body_drag = 0.5 * AIR_DENSITY_KG_M3 * np.array(quadrotor.drag_area_m2)
        across, along = quadrotor.drag_n_s2_per_rad_m, quadrotor.inflow_n_s2_per_rad_m
        self._rotor_drag = np.array([[across], [across], [along]])
        self._time_constant_s: Array | float = quadrotor.rotor_time_constant_s
        self._thrust: Array | float = quadrotor.thrust_n_per_rad2_s2
        self._torque: Array | float = quadrotor.torque_nm_per_rad2_s2
        if parameters is not None:
            self._body_drag = parameters.drag_scale[:, None] * self._body_drag
            self._rotor_drag = parameters.drag_scale[:, None, None] * self._rotor_drag
            self._time_constant_s = parameters.rotor_time_constant_s[:, None]
            self._thrust = parameters.thrust_scale[:, None] * self._thrust
            self._torque = parameters.thrust_scale[:, None] * self._torque
        self._coasting = self._torque / quadrotor.rotor_inertia_kg_m2

    def steady_state(self, speeds_rad_s: Array, charge: Array | float = 1.0) -> RotorState:
        """Return the steady state of rotors at speeds (…, R) [rad/s] with a charge (…), a full battery by default."""
        speeds = np.array(speeds_rad_s, dtype=np.float64)
        steady = np.zeros_like(speeds)
        charges = charge * np.ones(speeds.shape[:-1])
        voltage = self._quadrotor.battery.loaded_v(charges, self._power_w(speeds, 0.0))
        return RotorState(speeds, steady, charges, voltage)

    def step(
        self, state: RotorState, commands_rad_s: Array, dt_s: float, powered: npt.NDArray[np.bool_] | None = None
    ) -> RotorState:
        """Return the state after ``dt_s`` under constant commands (…, R) of rotor speeds [rad/s].

        A speed follows its command as a first-order system, integrated exactly, up to the speed that the voltage of the
        battery allows. A rotor without power is decelerated by its drag, J ω̇ = −k_m ω², integrated exactly, too.

        Args:
            state: State at the start of the step.
            commands_rad_s: (…, R) Commands, clipped to [0, largest speed].
            dt_s: Length of the step [s].
            powered: (…, R) Mask of the rotors with power; all by default.
        """
        drone, before = self._quadrotor, state.speed_rad_s
        fastest = np.minimum(drone.rotor_speed_max_rad_s, drone.rotor_speed_per_v * state.voltage_v)[..., None]
        target = np.minimum(np.maximum(commands_rad_s, 0.0), fastest)
        driven = target + (before - target) * _exp(-dt_s / self._time_constant_s)
        speeds = driven
        if powered is not None:
            speeds = np.where(powered, driven, before / (1.0 + before * (self._coasting * dt_s)))
        change = (speeds - before) / dt_s
        voltage = drone.battery.loaded_v(state.charge, self._power_w(speeds, 0.0))
        charge = drone.battery.charge_after(state.charge, self._power_w(speeds, change) / voltage, dt_s)
        return RotorState(speeds, change, charge, voltage)

    def wrench(self, state: RotorState, air: Airflow) -> Array:
        """Return force [N] and torque [N m] (…, 6) at the centre of mass, in the vehicle frame."""
        drone, speeds, velocity, rate = self._quadrotor, state.speed_rad_s, air.velocity_m_s, air.rate_rad_s
        batch, square = speeds.shape[:-1], speeds * speeds
        hubs = (np.concatenate([velocity, rate], axis=-1) @ self._hub_twists.T).reshape(*batch, 3, -1)
        force = hubs * (-self._rotor_drag * speeds[..., None, :])
        force[..., 2, :] += self._lift(air) * square
        wrench = force.reshape(*batch, -1) @ self._hub_twists
        wrench[..., :3] -= self._body_drag * velocity * np.sqrt((velocity * velocity).sum(axis=-1, keepdims=True))
        turning = self._torque * square + drone.rotor_inertia_kg_m2 * state.acceleration_rad_s2
        momentum = drone.rotor_inertia_kg_m2 * (speeds @ self._spins)
        wrench[..., 3] -= rate[..., 1] * momentum
        wrench[..., 4] += rate[..., 0] * momentum
        wrench[..., 5] -= turning @ self._spins
        return np.asarray(wrench)

    def _lift(self, air: Airflow) -> Array:
        """Return the thrust of each rotor per squared speed (…, R), with ground effect.

        Each rotor has its own height, so that the ground effect levels a tilted drone; there is none upside down.
        """
        gain = self._ground.ratio(air.height_m[..., None] + air.up @ self._hubs.T) - 1.0
        return np.asarray(self._thrust * (1.0 + np.maximum(air.up[..., 2:], 0.0) * gain))

    def power_w(self, state: RotorState) -> Array:
        """Return the electrical power (…) drawn from the battery [W]."""
        return self._power_w(state.speed_rad_s, state.acceleration_rad_s2)

    def _power_w(self, speeds: Array, change: Array | float) -> Array:
        """Return the power (…) of avionics and motors [W]; decelerating rotors do not recuperate."""
        drone = self._quadrotor
        torque = self._torque * speeds * speeds + drone.rotor_inertia_kg_m2 * change
        shaft = np.maximum(torque * speeds, 0.0)
        shafts = shaft[..., 0]
        for k in range(1, shaft.shape[-1]):  # ten times as fast as a reduction
            shafts = shafts + shaft[..., k]
        return np.asarray(drone.avionics_w + shafts / drone.motor_efficiency)


@lru_cache(maxsize=16)
def _geometry(quadrotor: Quadrotor) -> tuple[Array, Array, Array]:
    """Return the positions (R, 3) of the hubs [m], the map (3 R, 6) to their velocities, and their directions.

    The hubs move with v + Ω × r; forces f there sum up to Σ f and Σ r × f: the same matrix, transposed.
    """
    hubs = quadrotor.rotor_positions_m
    levers = np.swapaxes(skew(hubs), 1, 2)
    hub_twists = np.concatenate([np.tile(np.eye(3), (len(hubs), 1, 1)), levers], axis=2)
    arrays = hubs, np.ascontiguousarray(hub_twists.transpose(1, 0, 2).reshape(-1, 6)), quadrotor.rotor_directions
    for array in arrays:
        array.flags.writeable = False  # shared between all models of the vehicle type
    return arrays


def _exp(x: Array | float) -> Array | float:
    """Return the exponential of a number, for which `math.exp` is faster, or of an array."""
    return exp(x) if isinstance(x, float) else np.exp(x)
