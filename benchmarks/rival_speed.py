"""Speed of another simulator of quadrotors, measured in an environment of its own that has only that simulator.

The script needs numpy and the simulator. It prints one JSON document per measurement: the simulator, its version, the
settings, and the simulated seconds per second of processor time::

    rivals/bin/python benchmarks/rival_speed.py rotorpy
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.metadata import version
from typing import Any

import numpy as np

BATCH = 1024
"""Number of vehicles where a simulator has vector environments."""
RUNS = 3
"""Number of runs, of which the median counts."""


def pyflyt() -> Iterator[tuple[str, float]]:
    """Yield settings and speed of PyFlyt's hover environment, one vehicle in Bullet."""
    import_module("PyFlyt.gym_envs")
    env = import_module("gymnasium").make("PyFlyt/QuadX-Hover-v4", agent_hz=40)
    env.reset(seed=0)
    action = np.array([0.0, 0.0, 0.0, 0.35])

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    yield "1 vehicle, physics 240 Hz, actions 40 Hz", speed(step, 200, 1.0 / 40.0)


def rotorpy() -> Iterator[tuple[str, float]]:
    """Yield settings and speed of RotorPy's vector environment at two rates."""
    torch = import_module("torch")
    torch.set_num_threads(1)
    environments = import_module("rotorpy.learning.quadrotor_environments")
    for rate_hz in (500, 100):
        zeros = torch.zeros(BATCH, 3).double()
        states = {
            "x": zeros,
            "v": zeros.clone(),
            "q": torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(BATCH, 1).double(),
            "w": zeros.clone(),
            "wind": zeros.clone(),
            "rotor_speeds": torch.full((BATCH, 4), 1788.53).double(),
        }
        env = environments.QuadrotorEnv(BATCH, states, control_mode="cmd_motor_speeds", sim_rate=rate_hz)
        env.reset()
        action = np.zeros((BATCH, 4))
        settings = f"{BATCH} vehicles, physics and actions {rate_hz} Hz"
        yield settings, speed(partial(env.step, action), 20, BATCH / rate_hz)


def crazyflow() -> Iterator[tuple[str, float]]:
    """Yield settings and speed of crazyflow's vector environment with its default dynamics, at two action rates."""
    environments = import_module("crazyflow.envs.reach_pos_env")
    for rate_hz in (500, 50):
        env = environments.ReachPosEnv(num_envs=BATCH, freq=rate_hz)
        env.reset(seed=0)
        action = 0.5 * (env.action_space.low + env.action_space.high)
        settings = f"{BATCH} vehicles, simplified dynamics 500 Hz, actions {rate_hz} Hz"
        yield settings, speed(partial(_completed_step, env, action), 100, BATCH / rate_hz)


def _completed_step(env: Any, action: Any) -> None:
    """Step an environment in JAX, and wait for the result."""
    observation, *_ = env.step(action)
    observation["pos"].block_until_ready()


RIVALS: dict[str, Callable[[], Iterator[tuple[str, float]]]] = {
    "pyflyt": pyflyt,
    "rotorpy": rotorpy,
    "crazyflow": crazyflow,
}
"""Measurements by the name of the simulator."""


def speed(step: Callable[[], Any], steps: int, simulated_s: float) -> float:
    """Return the simulated seconds per second of processor time, the median of some runs.

    Args:
        step: Function that simulates one step of all vehicles.
        steps: Number of steps in a run.
        simulated_s: Simulated time of a step, the sum over all vehicles [s].
    """
    for _ in range(5):  # compilation and caches
        step()
    spent = []
    for _ in range(RUNS):
        start_s = time.process_time()
        for _ in range(steps):
            step()
        spent.append(time.process_time() - start_s)
    return steps * simulated_s / float(np.median(spent))


def main(name: str) -> None:
    """Measure a simulator and print one JSON document per setting."""
    for settings, value in RIVALS[name]():
        print(json.dumps({"name": name, "version": version(name), "settings": settings, "speed": value}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
