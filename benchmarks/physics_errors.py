"""Errors of free flight as environments integrate it, and of MuJoCo's Euler integrator at several rates.

Vehicles rotate at 10 rad/s without forces for 1.4 s: the error is that of their kinetic energy. Others fly for 100 IMU
intervals of 5 ms, with another random wrench in each. MuJoCo's errors are proportional to its time step, so that those
of 4 and 8 kHz cancel in twice the latter less the former; this limit is the reference::

    .venv/bin/python benchmarks/physics_errors.py
"""

from dataclasses import dataclass

import numpy as np
import tyro

from dronevio.cli.terminal import print_table
from dronevio.models.arrays import Array
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import euroc_rig
from dronevio.sim.physics.contact_simulation import ContactSimulation
from dronevio.sim.physics.free_flight import FreeFlight
from dronevio.sim.physics.vehicle import physics_spec
from dronevio.sim.physics.vehicle_states import VehicleParameters

INTERVAL_S = 5e-3
"""Length of an IMU interval [s]."""
RATES_HZ = (400, 1000, 4000)
"""Rates of MuJoCo [Hz]."""
_LIMIT_HZ = (4000, 8000)
_HEIGHT_M = 1000.0


@dataclass(frozen=True)
class ErrorsCommand:
    """Measure the errors of free flight and of MuJoCo."""

    count: int = 64
    """Number of vehicles."""


def simulation(rate_hz: int | None, count: int) -> FreeFlight | ContactSimulation:
    """Return the simulation by MuJoCo at a rate [Hz], or free flight."""
    if rate_hz is None:
        return FreeFlight(INTERVAL_S)
    spec = physics_spec(RESEARCH, euroc_rig(), 1.0 / rate_hz)
    return ContactSimulation(spec, count, round(INTERVAL_S * rate_hz), nthread=1)


def flown(rate_hz: int | None, motion: Array, wrenches: Array) -> Array:
    """Return the motion (T, 13, n) after each interval, whose wrenches are (T, n, 6)."""
    count = motion.shape[1]
    made, vehicles, rows = simulation(rate_hz, count), VehicleParameters.of(RESEARCH, count), []
    for wrench in wrenches:
        motion = made.run(motion, wrench, vehicles).end
        rows.append(motion)
    return np.array(rows)


def initial(count: int, rate_rad_s: float) -> Array:
    """Return random motion (13, n) with an angular speed."""
    motion = np.random.default_rng(0).standard_normal((13, count))
    motion[2] += _HEIGHT_M
    motion[3:7] /= np.linalg.norm(motion[3:7], axis=0)
    motion[10:] *= rate_rad_s / np.linalg.norm(motion[10:], axis=0)
    return motion


def energy_error(rate_hz: int | None, count: int) -> float:
    """Return the root mean square relative error of the kinetic energy of rotation."""
    motion = initial(count, 10.0)
    after = flown(rate_hz, motion, np.zeros((280, count, 6)))[-1]
    before, now = (np.array(RESEARCH.inertia_kg_m2) @ each[10:] ** 2 for each in (motion, after))
    return float(np.sqrt(np.mean((now / before - 1.0) ** 2)))


def random_wrenches(count: int) -> Array:
    """Return wrenches (100, n, 6) about those of hovering [N, N m]."""
    spread, hover = [0.5, 0.5, 3.0, 0.05, 0.05, 0.01], [0.0, 0.0, 14.7, 0.0, 0.0, 0.0]
    return np.random.default_rng(1).standard_normal((100, count, 6)) * spread + hover


def measure(command: ErrorsCommand) -> None:
    """Measure all integrators and print the table."""
    motion, wrenches = initial(command.count, 2.0), random_wrenches(command.count)
    coarse, fine = (flown(rate_hz, motion, wrenches) for rate_hz in _LIMIT_HZ)
    limit = 2.0 * fine - coarse
    rows = []
    for rate_hz in (None, *RATES_HZ):
        errors = np.abs(flown(rate_hz, motion, wrenches) - limit).max(axis=(0, 2))
        groups = (errors[:3], errors[3:7] * 2.0, errors[7:10], errors[10:])
        rows.append(
            (
                "free flight, 200 Hz" if rate_hz is None else f"MuJoCo, {rate_hz} Hz",
                f"{100.0 * energy_error(rate_hz, command.count):.2g}",
                *(f"{group.max():.1g}" for group in groups),
            )
        )
    print_table(
        f"Energy after 1.4 s at 10 rad/s, and largest differences in 100 intervals, {command.count} vehicles",
        ("physics", "energy [%]", "position [m]", "attitude [rad]", "velocity [m/s]", "rate [rad/s]"),
        rows,
    )


if __name__ == "__main__":
    measure(tyro.cli(ErrorsCommand, description=__doc__))
