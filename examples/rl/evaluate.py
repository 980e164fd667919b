"""Evaluate a policy in episodes that it has not been trained on.

```console
python evaluate.py hover policies/hover.safetensors
python evaluate.py race policies/race.safetensors --episodes 1000
```
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tyro
from trainings import TRAININGS, UNSEEN, Training, evaluation_envs

import dronevio as dv

Act = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]
"""Function from flat observations (n, N) to actions (n, 4)."""


@dataclass(frozen=True)
class Evaluation:
    """Results of a policy, averaged over episodes."""

    episodes: int
    """Number of episodes."""
    success_rate: float
    """Share of the episodes that end with success."""
    crash_rate: float
    """Share of the episodes that end by a failure, such as a collision."""
    error_m: float
    """Mean distance from the current goal at the end of an episode [m]."""
    duration_s: float | None
    """Mean duration of the episodes that end with success [s]; None without one."""
    ends: dict[str, int]
    """Numbers of episodes by the reason of their end."""


def evaluate(act: Act, envs: Any, seed: int = UNSEEN) -> Evaluation:
    """Return the results of a policy in one episode of each environment.

    Args:
        act: The policy.
        envs: Vector of environments.
        seed: Seed of the environments.
    """
    observations, _ = envs.reset(seed=seed)
    n = envs.num_envs
    running, success = np.ones(n, np.bool_), np.zeros(n, np.bool_)
    error_m, steps, ends = np.zeros(n), np.zeros(n), np.full(n, "", object)
    while running.any():
        observations, _, terminated, truncated, infos = envs.step(act(observations))
        steps += running
        last = running & (terminated | truncated)
        success[last], error_m[last] = infos["success"][last], infos["distance_m"][last]
        ends[last] = np.where(terminated, infos["termination"], "time limit")[last]
        running &= ~last
    crashed = ~np.isin(ends, ["success", "time limit"])
    duration_s = steps[success] / envs.metadata["render_fps"]
    return Evaluation(
        episodes=n,
        success_rate=float(success.mean()),
        crash_rate=float(crashed.mean()),
        error_m=float(error_m.mean()),
        duration_s=float(duration_s.mean()) if success.any() else None,
        ends=dict(Counter(ends.tolist())),
    )


def evaluated(act: Act, training: Training, episodes: int) -> Evaluation:
    """Return the results of a policy in unseen episodes of the environment of a training."""
    envs = evaluation_envs(training, episodes)
    try:
        return evaluate(act, envs)
    finally:
        envs.close()


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate a policy in episodes that it has not been trained on."""

    training: tyro.conf.Positional[str]
    """Name of the training, which determines the environment: hover, hover-imu, waypoints or race."""
    policy: tyro.conf.Positional[Path]
    """File of the policy."""
    episodes: int = 100
    """Number of episodes."""


def main(command: EvaluateCommand) -> None:
    """Print the results."""
    policy = dv.load_policy(command.policy)
    result = evaluated(policy.action, TRAININGS[command.training], command.episodes)
    for one in fields(result):
        print(f"{one.name:13} {getattr(result, one.name)}")


if __name__ == "__main__":
    main(tyro.cli(EvaluateCommand, description=__doc__))
