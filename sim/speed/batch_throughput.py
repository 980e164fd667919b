"""Speed of many vehicles at once: figures with their bounds, measured as processor time of this process."""

import time
from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.errors import ConfigError
from dronevio.models.performance import PerformanceFigure
from dronevio.models.progress import Progress, silent
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.sim.envs.episodes.distributions import Constant, Uniform
from dronevio.sim.envs.episodes.randomization import Randomization
from dronevio.sim.envs.vector import DroneVectorEnv
from dronevio.sim.inertial.batch_imu import BatchImuErrors
from dronevio.sim.physics.batch_plant import BatchPlant
from dronevio.sim.physics.vehicle import physics_model
from dronevio.sim.physics.vehicle_states import VehicleParameters, VehicleStates
from dronevio.sim.physics.wind import Wind, Winds

ACTIONS_PER_S = 50.0
"""Rate of the actions [Hz]."""
STEP_S = 1e-3
"""Time step of the bare physics [s]."""
_EPISODE = 500  # actions between two resets of a vehicle
_HEIGHT_M = 50.0
_STATE = ("position", "orientation", "velocity", "rotors")  # observations of the environments
_WIND = Wind((3.0, 1.0, 0.0), gusts=1.0)


@dataclass(frozen=True)
class BatchTiming:
    """Processor times of one run of each variant, for the same simulated time."""

    bare_s: float
    """Time of the bare physics in `mujoco.batch` [s]."""
    plant_s: float
    """Time of the plant with rotors, air, battery and resets, and of IMUs with errors [s]."""
    plant_without_imu_s: float
    """Time of the plant with rotors, air, battery and resets, without IMUs [s]."""
    environment_s: float
    """Time of the vector environment ``Hover-v0`` with IMUs, random masses and gusts [s]."""
    environment_without_imu_s: float
    """Time of the same vector environment without observations of the IMUs, which are then not simulated [s]."""


def batch_figures(count: int, actions: int, runs: int, progress: Progress = silent) -> list[PerformanceFigure]:
    """Measure the speed of many vehicles in one thread, relative to the bare physics and to real time.

    The variants run in turn. The bare physics are those of the same vehicles from the same states, airborne under a
    constant thrust, with one call for all time steps of an action.

    Args:
        count: Number of vehicles.
        actions: Number of actions in each run.
        runs: Number of runs, of which the medians are taken.
        progress: Callback that receives the number of completed runs and their total.

    Raises:
        ConfigError: There is no vehicle or no run.
    """
    if runs < 1:
        raise ConfigError(f"{runs} runs; expected 1 or more")
    variants = (
        _bare(count),
        _flying(count, imu=True),
        _flying(count, imu=False),
        _environment(count, imu=True),
        _environment(count, imu=False),
    )
    timings = []
    for run in range(runs):
        progress(run, runs)
        timings.append(BatchTiming(*(_spent_s(step, actions) for step in variants)))
    progress(runs, runs)
    return figures_of(timings, count, actions)


def environment_speed(count: int, actions: int, runs: int, rate_hz: float, imu: bool) -> float:
    """Return the simulated seconds of a vector environment per second of processor time, the median of some runs.

    Args:
        count: Number of vehicles.
        actions: Number of actions in each run.
        runs: Number of runs.
        rate_hz: Rate of the actions [Hz]; the rate of the IMU is 200 Hz, or that of the actions if it is higher.
        imu: Whether the IMU is observed.
    """
    step = _environment(count, imu, rate_hz)
    return count * actions / rate_hz / float(np.median([_spent_s(step, actions) for _ in range(runs)]))


def figures_of(timings: list[BatchTiming], count: int, actions: int) -> list[PerformanceFigure]:
    """Return the figures of the timings of some runs, each with ``count`` vehicles and a number of actions."""
    simulated_s = count * actions / ACTIONS_PER_S
    bare, *variants = np.array([astuple(timing) for timing in timings]).T
    plant, plant_without_imu, environment, environment_without_imu = (float(np.median(bare / v)) for v in variants)
    speeds = [float(simulated_s / np.median(variant)) for variant in (bare, *variants)]
    method = (
        f"{count} vehicles in the air, bare physics at {1.0 / STEP_S:.0f} Hz, actions at {ACTIONS_PER_S:.0f} Hz, "
        f"200 Hz IMU, random masses, gusts, episodes of {_EPISODE / ACTIONS_PER_S:.0f} s; median of {len(timings)} runs"
    )
    per_s = "simulated s per CPU s"
    named = "Hover-v0 with random masses, gusts and the episodes that result from constant actions"
    rows = [
        ("plant with IMU, by bare physics", plant, "", 3.0, f"{method}; bare: {speeds[0]:.0f} {per_s}"),
        ("plant without IMU, by bare physics", plant_without_imu, "", 3.5, f"as above; {speeds[2]:.0f} {per_s}"),
        (
            "vector environment without IMU, by bare physics",
            environment_without_imu,
            "",
            2.5,
            f"{named}, without observations of the IMU; {speeds[4]:.0f} {per_s}",
        ),
        ("plant with IMU", speeds[1], per_s, 900.0, "the plant of the first row"),
        ("vector environment with IMU", speeds[3], per_s, 600.0, f"{named}; {environment:.2f} of the bare physics"),
    ]
    return [PerformanceFigure(name, value, unit, bound, "at least", how) for name, value, unit, bound, how in rows]


def _initial(count: int) -> tuple[VehicleStates, VehicleParameters]:
    """Return random airborne states and masses."""
    rng = np.random.default_rng(0)
    states = VehicleStates.at(
        np.tile([0.0, 0.0, _HEIGHT_M], (count, 1)),
        exp_so3(0.2 * rng.standard_normal((count, 3))),
        rng.standard_normal((count, 3)),
        0.5 * rng.standard_normal((count, 3)),
        RESEARCH.hover_speed_rad_s,
    )
    nominal = VehicleParameters.of(RESEARCH, count)
    mass = nominal.mass_kg * rng.uniform(0.8, 1.2, count)
    inertia = nominal.inertia_kg_m2 * rng.uniform(0.8, 1.2, (count, 1))
    scales = nominal.rotor_time_constant_s, nominal.thrust_scale, nominal.drag_scale
    return states, VehicleParameters(mass, inertia, *scales)


def _bare(count: int) -> Callable[[int], None]:
    """Return a function that runs the bare physics for one action, given its number."""
    states, parameters = _initial(count)
    model = physics_model(RESEARCH, euroc_rig(), STEP_S)
    batch, body = Batch(model, count, 1), model.body("quadrotor").id
    batch.expand("body_mass")[:, body] = parameters.mass_kg
    batch.expand("body_inertia")[:, body] = parameters.inertia_kg_m2
    batch.set_const()
    batch.bind("ctrl")[:, 2] = model.body_mass[body] * -model.opt.gravity[2]
    steps = round(1.0 / (ACTIONS_PER_S * STEP_S))

    def start() -> None:
        batch.bind("qpos")[:] = np.hstack([states.position_m, quat_wxyz_from_matrix(states.R_world_vehicle)])
        batch.bind("qvel")[:] = np.hstack([states.velocity_m_s, states.rate_rad_s])

    def step(action: int) -> None:
        if action == 0:
            start()
        batch.step(nstep=steps)

    return step


def _flying(count: int, imu: bool) -> Callable[[int], None]:
    """Return a function that runs plant and IMUs for one action, given its number."""
    rig, rng = euroc_rig(), np.random.default_rng(0)
    plant = BatchPlant(count, rig, imu=imu, rng=rng, nthread=1)
    states, parameters = _initial(count)
    winds = Winds.of(_WIND, count)
    errors = BatchImuErrors(rig.imu, count, rng)
    commands = np.full((count, 4), RESEARCH.hover_speed_rad_s)
    intervals = round(1.0 / (ACTIONS_PER_S * plant.interval_s))

    def reset(mask: npt.NDArray[np.bool_]) -> None:
        plant.reset(mask, states, parameters, winds)
        if imu:
            errors.reset(mask)
            rows, samples = np.flatnonzero(mask), plant.now.samples
            perfect = np.hstack([samples.gyro_rad_s, samples.accel_m_s2])
            errors.first(perfect[rows], rows, plant.now.rotors.speed_rad_s[rows])

    def step(action: int) -> None:
        reset(np.arange(count) % _EPISODE == action % _EPISODE if action else np.ones(count, dtype=bool))
        for _ in range(intervals):
            samples = plant.advance(commands)
            if imu:
                errors.add_to(np.hstack([samples.gyro_rad_s, samples.accel_m_s2]), plant.now.rotors.speed_rad_s)
        assert len(plant.states) == count

    return step


def _environment(count: int, imu: bool, rate_hz: float = ACTIONS_PER_S) -> Callable[[int], None]:
    """Return a function that steps the vector environment once, given the number of the action."""
    mass = Uniform(0.8, 1.2)
    random = Randomization(mass=mass, inertia=mass, gusts=Constant(_WIND.gusts), wind_m_s=Constant(_WIND.speed_m_s))
    observations = (*_STATE, "imu") if imu else _STATE
    envs = DroneVectorEnv(
        count,
        "hover",
        flat=True,
        action="rotors",
        observations=observations,
        randomization=random,
        action_rate_hz=rate_hz,
        imu_rate_hz=max(rate_hz, euroc_rig().imu.rate_hz),
    )
    envs.reset(seed=0)
    actions = np.zeros((count, 4), dtype=np.float32)

    def step(action: int) -> None:
        envs.step(actions)

    return step


def _spent_s(step: Callable[[int], None], actions: int) -> float:
    """Return the processor time of a number of actions after the first, which resets all vehicles [s]."""
    step(0)
    start_s = time.process_time()
    for action in range(1, actions + 1):
        step(action)
    return time.process_time() - start_s
