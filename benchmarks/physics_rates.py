"""Errors of the physics at different rates, relative to 4 kHz.

Quadrotors fly for 10 s along random paths of sinusoids under the controller of the scenarios, and for 1 s under
recorded commands without a controller. The time step of the physics is the only difference between the flights, whose
wrench changes with every IMU sample. Errors are root mean squares over vehicles and times, of the whole flight for the
controller and at the end of the flight without one::

    .venv/bin/python benchmarks/physics_rates.py
    .venv/bin/python benchmarks/physics_rates.py --count 8 --duration-s 2
"""

from dataclasses import dataclass

import numpy as np
import tyro

from dronevio.cli.terminal import print_table
from dronevio.models.arrays import Array
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import log_so3
from dronevio.sim.physics.batch_plant import BatchPlant
from dronevio.sim.physics.cascade import Body, Cascade, attitude_along
from dronevio.sim.physics.gains import Gains
from dronevio.sim.physics.vehicle_states import VehicleStates

RATES_HZ = (400, 600, 1000, 2000)
"""Rates of the physics [Hz]."""
REFERENCE_HZ = 4000
"""Rate of the flights with which the others are compared [Hz]."""
HEIGHT_M = 20.0
"""Height of the centre of the paths [m]."""


@dataclass(frozen=True)
class RatesCommand:
    """Measure the errors of the physics at different rates."""

    count: int = 64
    """Number of vehicles."""
    duration_s: float = 10.0
    """Duration of the flights with the controller [s]."""


@dataclass(frozen=True, eq=False)
class Flights:
    """States and samples of n vehicles at T times."""

    position_m: Array
    """(T, n, 3) Positions in the world [m]."""
    R_world_vehicle: Array
    """(T, n, 3, 3) Rotations from the vehicle frames to the world."""
    imu: Array
    """(T, n, 6) Noise-free angular velocities [rad/s] and specific forces [m/s²]."""
    commands: Array
    """(T, n, 4) Commands of rotor speeds [rad/s]."""


@dataclass(frozen=True, eq=False)
class Paths:
    """Random sinusoids."""

    amplitude_m: Array
    """(n, 3) Amplitudes along each axis [m]."""
    rate_rad_s: Array
    """(n, 3) Angular frequencies [rad/s]."""

    def at(self, t_s: float) -> tuple[Array, Array, Array]:
        """Return positions [m], velocities [m/s] and accelerations [m/s²] (n, 3) at a time [s]."""
        phase, rate = self.rate_rad_s * t_s, self.rate_rad_s
        position = self.amplitude_m * np.sin(phase)
        return position + [0.0, 0.0, HEIGHT_M], self.amplitude_m * rate * np.cos(phase), -(rate**2) * position


def random_paths(count: int) -> Paths:
    """Return paths with speeds of up to 4 m/s and accelerations of up to 10 m/s² on each axis."""
    rng = np.random.default_rng(0)
    return Paths(rng.uniform(0.5, 1.5, (count, 3)), rng.uniform(0.5, 2.5, (count, 3)))


def start(rate_hz: int, paths: Paths) -> BatchPlant:
    """Return a plant with the vehicles level at the start of their paths."""
    position, velocity, _ = paths.at(0.0)
    plant = BatchPlant(len(position), euroc_rig(), step_s=1.0 / rate_hz)
    speeds = RESEARCH.hover_speed_rad_s
    states = VehicleStates.at(position, velocity_m_s=velocity, rotor_speed_rad_s=speeds)
    plant.reset(np.ones(len(position), dtype=bool), states)
    return plant


def fly_controlled(rate_hz: int, paths: Paths, duration_s: float) -> Flights:
    """Return flights along paths under the controller."""
    plant = start(rate_hz, paths)
    cascade = Cascade(RESEARCH, Gains(), plant.interval_s)
    first = plant.states
    state = cascade.at(first.rotor_speed_rad_s, first.velocity_m_s, first.rate_rad_s)
    rows = []
    for step in range(round(duration_s / plant.interval_s)):
        now = plant.states
        body = Body(now.position_m, now.R_world_vehicle, now.velocity_m_s, now.rate_rad_s)
        loads = cascade.loads(state, body)
        state = cascade.observe(state, body, loads)
        force = cascade.specific_force(state, body, *paths.at(step * plant.interval_s))
        R_desired = attitude_along(force, np.zeros(plant.count))
        thrust_n = RESEARCH.mass_kg * np.vecdot(force, body.R_world_vehicle[..., 2]) / loads.lift
        turning = cascade.angular_acceleration(state, body, R_desired)
        commands, state = cascade.commands(state, loads, thrust_n, turning)
        rows.append(advanced(plant, commands))
    return Flights(*(np.array(column) for column in zip(*rows, strict=True)))


def fly_open(rate_hz: int, paths: Paths, commands: Array) -> Flights:
    """Return flights under commands (T, n, 4) [rad/s]."""
    plant = start(rate_hz, paths)
    rows = [advanced(plant, command) for command in commands]
    return Flights(*(np.array(column) for column in zip(*rows, strict=True)))


def advanced(plant: BatchPlant, commands: Array) -> tuple[Array, Array, Array, Array]:
    """Advance a plant and return positions, rotations, IMU samples and the commands."""
    samples = plant.advance(commands)
    states = plant.states
    imu = np.concatenate([samples.gyro_rad_s, samples.accel_m_s2], axis=1)
    return states.position_m, states.R_world_vehicle, imu, commands


def errors(flights: Flights, reference: Flights) -> tuple[float, float, float, float]:
    """Return the errors of positions [m], attitudes [rad], gyroscopes [rad/s] and accelerometers [m/s²]."""
    turn = log_so3(np.swapaxes(reference.R_world_vehicle, -1, -2) @ flights.R_world_vehicle)
    imu = flights.imu - reference.imu
    return tuple(  # type: ignore[return-value]
        float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))
        for difference in (flights.position_m - reference.position_m, turn, imu[..., :3], imu[..., 3:])
    )


def last(flights: Flights) -> Flights:
    """Return the last time of flights."""
    return Flights(flights.position_m[-1:], flights.R_world_vehicle[-1:], flights.imu[-1:], flights.commands[-1:])


def measure(command: RatesCommand) -> None:
    """Measure all rates and print the table."""
    paths = random_paths(command.count)
    reference = fly_controlled(REFERENCE_HZ, paths, command.duration_s)
    second = reference.commands[: round(1.0 / 5e-3)]
    open_reference = fly_open(REFERENCE_HZ, paths, second)
    rows = []
    for rate_hz in RATES_HZ:
        flown = errors(fly_controlled(rate_hz, paths, command.duration_s), reference)
        opened = errors(last(fly_open(rate_hz, paths, second)), last(open_reference))
        rows.append(
            (
                f"{rate_hz} Hz",
                *(f"{value:.2g}" for value in (1e3 * flown[0], 1e3 * flown[1], 1e3 * flown[2], flown[3])),
                *(f"{value:.2g}" for value in (1e3 * opened[0], 1e3 * opened[1])),
            )
        )
    print_table(
        f"Root mean square differences from {REFERENCE_HZ} Hz, {command.count} vehicles, {command.duration_s:g} s",
        ("physics", "position [mm]", "attitude [mrad]", "gyro [mrad/s]", "accel [m/s²]", "1 s open: [mm]", "[mrad]"),
        rows,
    )


if __name__ == "__main__":
    measure(tyro.cli(RatesCommand, description=__doc__))
