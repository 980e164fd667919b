"""Flight through forests by depth images of 64 × 64 pixels, learned from a privileged expert by DAgger.

The expert of `expert.py` knows the solids of each forest; the learner sees depth, goal, rotation and velocity. A round
flies the learner, and the expert in a part of the episodes that halves from round to round. The learner imitates what
the expert would do in all states of all rounds (Ross et al., "A Reduction of Imitation Learning and Structured
Prediction to No-Regret Online Learning", arXiv:1011.0686). A blind learner has all but the image::

    python dagger.py --seeds 0 1 2
    python dagger.py --blind --seeds 0 1 2
    python dagger.py --draw navigate.svg
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib
import numpy as np
import torch
import torch._dynamo  # before the first image: with Triton, in builds for CUDA, it crashes after Mesa's OpenGL
import tyro
from curves import HERE, print_table
from expert import Expert
from matplotlib.figure import Figure
from torch import nn
from trainings import EVALUATION_SEED

import dronevio as dv
from dronevio.envs import OwnObservation, Randomization, policy_from_torch
from dronevio.models.policies import Scaling
from dronevio.models.rotation import rotation_z
from dronevio.sim.envs import provenance_of

NAMES = ("depth", "goals", "rotation", "body_velocity", "last_action")
"""What the learner observes."""
PLACE = OwnObservation("place", (3,), -100.0, 100.0, lambda state: state.states.position_m)
"""Position in the world [m], which the expert alone receives."""
TRAINING_WORLDS, UNSEEN_WORLDS = range(32), range(10_000, 10_200)
"""Seeds of the forests."""
RATE_HZ = 10.0
"""Rate of actions and images."""
FAR_M, LIMIT = 6.0, 3.0
"""Depth beyond which all is equally far, and the largest scaled observation."""
PREFIX = "navigate"


@dataclass(frozen=True)
class DaggerCommand:
    """Train policies of the task Navigate, or draw the learning curves of those that have been trained."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of environments and learner."""
    blind: bool = False
    """Whether the learner has no image."""
    rounds: int = 12
    """Number of rounds."""
    steps: int = 150
    """Number of steps of each environment in a round."""
    envs: int = 32
    """Number of environments."""
    updates: int = 600
    """Number of steps of the optimizer after a round; five times as many after the last one."""
    worlds: int = len(UNSEEN_WORLDS)
    """Number of unseen worlds in which the policies are evaluated."""
    out: Path = Path("runs")
    """Folder for the policies and their results."""
    results: Path = HERE / "results"
    """Folder with the results that are drawn."""
    draw: Path | None = None
    """Picture of the learning curves of all results, which is drawn instead of a training."""


class Learner(nn.Module):
    """A network from a scaled depth image, unless it is blind, and other scaled observations to actions."""

    def __init__(self, others: int, blind: bool) -> None:
        super().__init__()
        sizes = [(1, 16, 8, 4), (16, 32, 4, 2), (32, 32, 3, 1)]  # channels, kernel and stride
        modules = [module for one in sizes for module in (nn.Conv2d(*one), nn.ReLU())]
        self.convolutions = None if blind else nn.Sequential(*modules, nn.Flatten())
        features = 0 if blind else 32 * 4 * 4
        self.layers = nn.Sequential(
            *(nn.Linear(features + others, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 4)),
            nn.Tanh(),
        )

    def forward(self, depth: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """Return actions (n, 4) for scaled depths (n, 64, 64) and other scaled observations (n, N)."""
        if self.convolutions is not None:
            others = torch.cat([self.convolutions(depth[:, None]), others], dim=1)
        return self.layers(others)


def scaled_depth(depth_m: Any) -> Any:
    """Return depths from 0 to `FAR_M` as numbers from −`LIMIT` to `LIMIT`."""
    return ((2.0 * depth_m / FAR_M - 1.0) * LIMIT).clip(-LIMIT, LIMIT)


def scaled_others(observation: Any) -> Any:
    """Return all observations but the depth (n, N), goals in units of 4 m."""
    goals, count = observation["goals"] / 4.0, len(observation["goals"])
    parts = (goals.clip(-LIMIT, LIMIT), *(observation[name] for name in NAMES[2:]))
    return np.concatenate([part.reshape(count, -1) for part in parts], axis=1)


def policy_scaling(blind: bool) -> Scaling:
    """Return the scaling of `scaled_depth` and `scaled_others` for a policy file."""
    mean = np.zeros(3 + 9 + 3 + 4, np.float32)
    scale = np.concatenate([np.full(3, 4.0), np.ones(16)]).astype(np.float32)
    if not blind:
        image = np.ones(64 * 64, np.float32)
        mean, scale = np.append(image * FAR_M / 2.0, mean), np.append(image * FAR_M / 2.0 / LIMIT, scale)
    return Scaling(mean.astype(np.float32), scale.astype(np.float32), LIMIT)


class Samples:
    """All states that have been visited, with the actions of the expert there."""

    def __init__(self, most: int) -> None:
        self.count = 0
        self._depth, self._others = np.zeros((most, 64, 64), np.uint8), np.zeros((most, 19), np.float32)
        self._actions = np.zeros((most, 4), np.float32)

    def add(self, observation: Any, actions: Any) -> None:
        """Add the observations of n environments, and the actions (n, 4) of the expert."""
        rows = slice(self.count, self.count + len(actions))
        if "depth" in observation:
            self._depth[rows] = np.rint(255.0 / FAR_M * observation["depth"][..., 0].clip(0.0, FAR_M))
        self._others[rows], self._actions[rows] = scaled_others(observation), actions
        self.count += len(actions)

    def drawn(self, count: int, rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
        """Return random samples, scaled, of which half are mirrored, and all turned about the vertical."""
        rows = rng.integers(0, self.count, count)
        depth, others, actions = self._depth[rows] * (FAR_M / 255.0), self._others[rows], self._actions[rows]
        R = others[:, 3:12].reshape(-1, 3, 3)
        if rng.random() < 0.5:
            side = np.array([1.0, -1.0, 1.0])  # left becomes right
            depth, R = depth[:, :, ::-1], side[:, None] * R * side
            others = others * np.concatenate([side, np.ones(9), side, [1.0, -1.0, 1.0, -1.0]])
            actions = actions * [1.0, -1.0, 1.0, -1.0]
        others[:, 3:12] = (rotation_z(rng.uniform(0.0, 2.0 * np.pi, count)) @ R).reshape(-1, 9)
        arrays = scaled_depth(depth), others, actions
        return tuple(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays)


class Flights:
    """Environments in forests, the expert, and which episodes it flies."""

    def __init__(self, command: DaggerCommand, seed: int) -> None:
        self.envs: Any = gymnasium.make_vec(
            "dronevio.envs:dronevio/Navigate-v0",
            command.envs,
            autoreset_mode="SAME_STEP",
            observations=NAMES[command.blind :],
            privileged=(PLACE,),
            action_rate_hz=RATE_HZ,
            randomization=Randomization(world_seeds=tuple(TRAINING_WORLDS)),
        )
        settings = self.envs.unwrapped.settings
        self._expert = Expert("forest", TRAINING_WORLDS, command.envs, settings.action_limits)
        self._rng = np.random.default_rng(seed)
        self._observation, infos = self.envs.reset(seed=seed)
        self._taught = np.ones(command.envs, np.bool_)
        self._begin(np.arange(command.envs), infos)

    def fly(self, learner: Learner, steps: int, share: float, samples: Samples) -> float:
        """Fly, add the samples, and return the share of successful episodes of the learner; NaN without any.

        Args:
            learner: The learner.
            steps: Number of steps.
            share: Share of the episodes that begin now and that the expert flies.
            samples: Where the states are added.
        """
        successes: list[bool] = []
        for _ in range(steps):
            seen = self._observation["policy"]
            state = (self._observation["critic"]["place"], seen["rotation"])
            wanted = self._expert.action(*(part.astype(np.float64) for part in state))
            samples.add(seen, wanted)
            depth = seen["depth"][..., 0] if "depth" in seen else np.zeros((len(wanted), 0))
            inputs = (torch.from_numpy(part.astype(np.float32)) for part in (scaled_depth(depth), scaled_others(seen)))
            with torch.no_grad():
                own = learner(*inputs).numpy()
            actions = np.where(self._taught[:, None], wanted, own)
            self._observation, _, terminated, truncated, infos = self.envs.step(actions)
            ended = np.flatnonzero(terminated | truncated)
            if ended.size:
                own_flights = ended[~self._taught[ended]]
                successes += infos["final_info"]["success"][own_flights].tolist()
                self._taught[ended] = self._rng.random(ended.size) < share
                self._begin(ended, infos)
        return float(np.mean(successes)) if successes else float("nan")

    def _begin(self, rows: Any, infos: Any) -> None:
        """Tell the expert the worlds and the goals of new episodes."""
        seen, place = self._observation["policy"], self._observation["critic"]["place"]
        goals = place + np.matvec(seen["rotation"], seen["goals"][:, 0])
        self._expert.begin(rows, infos["randomization"]["world_seed"][rows], goals[rows].astype(np.float64))


def improve(learner: Learner, optimizer: torch.optim.Optimizer, samples: Samples, updates: int, seed: Any) -> float:
    """Imitate the expert in random samples, and return the mean squared error of the actions."""
    rng, errors = np.random.default_rng(seed), []
    for _ in range(updates):
        depth, others, actions = samples.drawn(256, rng)
        error = ((learner(depth, others) - actions) ** 2).mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    return float(np.mean(errors))


def train(command: DaggerCommand, seed: int) -> tuple[dv.Policy, dict[str, Any]]:
    """Return the policy of a seed, and its learning curve."""
    torch.manual_seed(seed)
    begun_s = time.process_time()
    learner = Learner(19, command.blind)
    optimizer = torch.optim.Adam(learner.parameters(), 1e-3)
    flights, samples = Flights(command, seed), Samples(command.rounds * command.steps * command.envs)
    curve: dict[str, list[float]] = {"samples": [], "success_rate": [], "cpu_s": []}
    for number in range(command.rounds):
        success = flights.fly(learner, command.steps, 0.5**number, samples)
        updates = command.updates * (5 if number == command.rounds - 1 else 1)
        error = improve(learner, optimizer, samples, updates, (seed, number))
        for name, value in zip(curve, (samples.count, success, time.process_time() - begun_s), strict=True):
            curve[name].append(value)
        print(
            f"{samples.count:8,} samples  success {success:4.0%}  error {error:.4f}  {curve['cpu_s'][-1]:5.0f} s",
            flush=True,
        )
    origin = provenance_of("DAgger", samples.count, seed)
    policy = policy_from_torch(
        learner.layers, flights.envs, origin, convolutions=learner.convolutions, scaling=policy_scaling(command.blind)
    )
    flights.envs.close()
    return policy, {name: " ".join(f"{value:.4g}" for value in values) for name, values in curve.items()}


def name_of(blind: bool) -> str:
    """Return the name of a training."""
    return f"{PREFIX}-blind" if blind else f"{PREFIX}-depth"


def draw(folder: Path, out: Path) -> None:
    """Draw the learning curves of all seeds, and print the results in unseen worlds."""
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes, rows = figure.subplots(), []
    for blind, style in ((False, "-"), (True, ":")):
        for path in sorted(folder.glob(f"{name_of(blind)}-*.json")):
            result = json.loads(path.read_text(encoding="utf-8"))
            samples, success = (np.array(result["curve"][name].split(), float) for name in ("samples", "success_rate"))
            label = f"{'blind' if blind else 'depth'}, seed {result['seed']}"
            axes.plot(samples / 1e3, 100.0 * success, style, color=f"C{result['seed']}", label=label, linewidth=1.2)
            counts = result["evaluation"]
            share = f"{counts.get('success', 0) / sum(counts.values()):.1%}"
            ends = ", ".join(f"{count} {name}" for name, count in counts.items())
            rows.append((name_of(blind), str(result["seed"]), share, ends, f"{result['cpu_s'] / 60.0:.0f}"))
    axes.set(xlabel="samples [thousands]", ylabel="successful episodes [%]", ylim=(0.0, 102.0))
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", ncols=2)
    matplotlib.rcParams["svg.hashsalt"] = "dronevio"  # the same picture has the same bytes
    figure.savefig(out, metadata={"Date": None})
    print_table(("success in unseen worlds", "ends", "processor time [min]"), rows)


def main(command: DaggerCommand) -> None:
    """Train all seeds and evaluate them in unseen worlds, or draw."""
    if command.draw is not None:
        draw(command.results, command.draw)
        return
    torch.set_num_threads(1)  # the networks are too small for more
    for seed in command.seeds:
        policy, curve = train(command, seed)
        result = dv.evaluate_policy(
            policy, command.worlds, EVALUATION_SEED, world_seeds=UNSEEN_WORLDS[: command.worlds], world="forest"
        )
        document = {
            "training": name_of(command.blind),
            "seed": seed,
            "cpu_s": float(curve["cpu_s"].split()[-1]),
            "versions": policy.provenance.versions,
            "evaluation": result.counts(),
            "curve": curve,
        }
        command.out.mkdir(parents=True, exist_ok=True)
        path = command.out / f"{name_of(command.blind)}-{seed}.json"
        path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        dv.save_policy(path.with_suffix(".safetensors"), policy)
        print(f"seed {seed}: {result.counts()}")


if __name__ == "__main__":
    main(tyro.cli(DaggerCommand, description=__doc__))
