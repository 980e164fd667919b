"""Learning curves of Stable-Baselines3's PPO with its default settings, in environments with their default arguments.

The policy is evaluated without noise in 200 episodes that no training has seen, at equal intervals. A training ends
with the samples, or early when as many evaluations as `--enough` in a row have succeeded in 95 % or more::

    python default_ppo.py hover
    python default_ppo.py hover --envs 1 --enough 2
    python default_ppo.py waypoints --samples 2000000
    python default_ppo.py --draw default-ppo.svg
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import matplotlib
import numpy as np
import torch
import tyro
from curves import HERE, print_table
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from trainings import EVALUATION_SEED

import dronevio as dv
from dronevio.envs import policy_from_sb3
from dronevio.sim.envs.policies.conversion import provenance_of
from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv

EPISODES = 200
"""Number of episodes of an evaluation."""
GOOD = 0.95
"""Share of successful episodes that ends a training early."""
PREFIX = "default-ppo"


@dataclass(frozen=True)
class DefaultCommand:
    """Train policies with default settings, or draw the learning curves of those that have been trained."""

    environment: Annotated[Literal["hover", "waypoints"], tyro.conf.Positional] = "hover"
    """Name of the environment."""
    envs: int = 16
    """Number of environments of the native vector; 1 for a single environment."""
    samples: int = 500_000
    """Number of steps of environments, all together."""
    every: int = 50_000
    """Number of steps between two evaluations."""
    enough: int | None = None
    """Number of good evaluations in a row that end a training; none by default."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of environments and agent."""
    results: Path = HERE / "results"
    """Folder of the learning curves."""
    draw: Path | None = None
    """Picture of all learning curves in the folder, which is drawn instead of a training."""


class Evaluations(BaseCallback):
    """Share of successful episodes as a function of the samples."""

    def __init__(self, envs: Any, command: DefaultCommand) -> None:
        super().__init__()
        self._envs, self._command, self._start_s = envs, command, time.process_time()
        self.samples: list[int] = []
        self.success: list[float] = []
        self.cpu_s: list[float] = []

    def evaluate(self) -> None:
        """Add an evaluation."""
        training_s = time.process_time() - self._start_s
        result = dv.evaluate_policy(policy_from_sb3(self.model, self._envs), EPISODES, EVALUATION_SEED)
        self._start_s += time.process_time() - self._start_s - training_s  # evaluations are not counted
        self.samples.append(self.num_timesteps)
        self.success.append(float(result.success.mean()))
        self.cpu_s.append(training_s)
        print(f"{self.samples[-1]:10,} samples  success {self.success[-1]:4.0%}  {training_s:6.0f} s", flush=True)

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= (self.samples[-1] if self.samples else 0) + self._command.every:
            self.evaluate()

    @property
    def is_enough(self) -> bool:
        """Whether enough evaluations in a row have been good."""
        enough = self._command.enough
        return enough is not None and len(self.success) >= enough and min(self.success[-enough:]) >= GOOD

    def _on_step(self) -> bool:
        return not self.is_enough


def train(command: DefaultCommand, seed: int) -> dict[str, Any]:
    """Return the learning curve of a seed."""
    name = f"dronevio.envs:dronevio/{command.environment.capitalize()}-v0"
    if command.envs == 1:
        envs = made = gymnasium.make(name, flat=True)
    else:
        envs = gymnasium.make_vec(name, command.envs, autoreset_mode="SAME_STEP", flat=True)
        made = StableBaselinesVecEnv(envs)
    curve = Evaluations(envs, command)
    PPO("MlpPolicy", made, device="cpu", seed=seed).learn(command.samples, callback=curve)
    if not curve.is_enough:
        curve.evaluate()
    return {
        "environment": command.environment,
        "envs": command.envs,
        "seed": seed,
        "episodes": EPISODES,
        "cpu_s": round(curve.cpu_s[-1], 1),
        "versions": provenance_of("PPO", curve.samples[-1], seed).versions,
        "curve": {
            "samples": " ".join(map(str, curve.samples)),
            "success_rate": " ".join(f"{rate:.3f}" for rate in curve.success),
        },
    }


def draw(folder: Path, out: Path) -> None:
    """Draw all learning curves of a folder, and print the samples after which the policies succeed."""
    found = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(f"{PREFIX}-*.json"))]
    groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for each in found:
        groups.setdefault((each["environment"], each["envs"]), []).append(each)
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    rows = []
    for axes, ((name, envs), results) in zip(
        figure.subplots(1, len(groups), squeeze=False)[0], sorted(groups.items()), strict=True
    ):
        title = f"{name.capitalize()}, {f'vector of {envs}' if envs > 1 else 'one environment'}"
        for each in results:
            samples, success = (np.array(each["curve"][key].split(), float) for key in ("samples", "success_rate"))
            axes.plot(samples / 1e6, 100.0 * success, label=f"seed {each['seed']}", linewidth=1.2)
            good = success >= GOOD
            first = f"{samples[np.argmax(good)] / 1e3:.0f} 000" if good.any() else "–"
            speed = f"{1e3 * each['cpu_s'] / samples[-1]:.2f}"
            rows.append(((title, str(each["seed"])), first, f"{success.max():.1%}", f"{success[-1]:.1%}", speed))
        axes.set(title=title, xlabel="samples [millions]", ylabel="successful episodes [%]", ylim=(0.0, 102.0))
        axes.set_xlim(left=0.0)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="lower right")
    matplotlib.rcParams["svg.hashsalt"] = "dronevio"  # the same picture has the same bytes
    figure.savefig(out, metadata={"Date": None})
    columns = ("samples until 95 %", "best", "at the end", "processor time [ms per sample]")
    print_table(columns, [(*first, *values) for first, *values in rows])


def main(command: DefaultCommand) -> None:
    """Train all seeds, or draw."""
    if command.draw is not None:
        draw(command.results, command.draw)
        return
    torch.set_num_threads(1)  # the networks are too small for more
    for seed in command.seeds:
        result = train(command, seed)
        path = command.results / f"{PREFIX}-{command.environment}-{command.envs}-{seed}.json"
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(DefaultCommand, description=__doc__))
