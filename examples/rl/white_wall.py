"""A policy that keeps its estimate good, beside policies that do not: flight to a goal before a white wall.

Policy and inner loops see the estimate of the visual-inertial odometry, which finds nothing to track on the white wall.
PPO first learns to fly to the goal on the true state, and goes on with the odometry in the loop: once for the goal alone,
and once with a penalty of the standard deviation of the estimated position (weight `uncertainty`)::

    python white_wall.py train --weight 1.0
    python white_wall.py train --weight 0.0
    python white_wall.py train --samples 0
    python white_wall.py draw white-wall.svg
"""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import gymnasium
import matplotlib
import numpy as np
import numpy.typing as npt
import torch
import tyro
from curves import HERE, print_table
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from trainings import EVALUATION_SEED

import dronevio as dv
from dronevio.envs import DroneVectorEnv, VioNavigate, policy_from_sb3
from dronevio.models.rotation import rotation_z
from dronevio.sim.envs.policies.environments import policy_arguments
from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv
from dronevio.sim.envs.tasks.task import PointGoals, distance_m
from dronevio.sim.physics.vehicle_states import VehicleStates

GOALS_M = np.array([[4.2, -2.5, 1.0], [4.6, 2.5, 1.8]])
"""Box of the goals, about a metre before the wall [m]."""
RATES: dict[str, Any] = {"action_rate_hz": 5.0, "imu_rate_hz": 100.0}
PREFIX = "white-wall"


@dataclass(frozen=True)
class WhiteWall(VioNavigate):
    """Take off, fly to a goal before the white wall, and be there at the end of the episode."""

    default_observations: ClassVar[tuple[str, ...]] = ("goals", "rotation", "body_velocity", "last_action")

    world: str = str(HERE / "white_wall.yaml")
    episode_s: float = 12.0
    tolerance_m: float = 0.3
    uncertainty: float = 0.0

    def begin(
        self, area: Any, quadrotor: Any, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, PointGoals]:
        """Draw goals, and return vehicles on the pad that head for them."""
        pad, goal = np.tile(area.pad, (count, 1)), rng.uniform(*GOALS_M, (count, 3))
        heading = rotation_z(np.arctan2(*(goal - pad)[:, 1::-1].T))
        return VehicleStates.at(pad, heading, rotors=quadrotor.rotor_count), PointGoals(goal)

    def success(self, goals: PointGoals, step: Any) -> npt.NDArray[np.bool_]:
        """Return which vehicles are at the goal in the last half second."""
        return (step.t_s > self.episode_s - 0.5) & (distance_m(step.after, goals.goal_m) < self.tolerance_m)


@dataclass(frozen=True)
class TrainCommand:
    """Train and evaluate policies."""

    weight: float = 1.0
    """Weight of the standard deviation of the estimated position in the reward [1/m]."""
    samples: int = 12_000
    """Number of steps with the odometry in the loop; 0 keeps the policy that was trained on the true state."""
    true_samples: int = 100_000
    """Number of steps on the true state."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of environments and agent."""
    episodes: int = 20
    """Number of episodes in which a policy is evaluated."""
    results: Path = HERE / "results"
    """Folder of the results."""


@dataclass(frozen=True)
class DrawCommand:
    """Draw the results of all policies, and print a table."""

    out: Annotated[Path, tyro.conf.Positional] = Path("white-wall.svg")
    """Picture to write."""
    results: Path = HERE / "results"
    """Folder of the results."""


def trained_on_truth(samples: int, seed: int) -> PPO:
    """Return a model that flies to the goal on the true state."""
    envs = DroneVectorEnv(16, WhiteWall(), autoreset_mode="SAME_STEP", flat=True, **RATES)
    model = PPO(
        "MlpPolicy", StableBaselinesVecEnv(envs), n_steps=120, batch_size=240, gamma=0.97, device="cpu", seed=seed
    )
    return model.learn(samples)


def trained_on_estimate(model: PPO, weight: float, samples: int, seed: int) -> tuple[PPO, Any]:
    """Return a model that has gone on to learn with the odometry in the loop, and its environment."""
    env = gymnasium.make(
        "dronevio.envs:dronevio/VioNavigate-v0", task=WhiteWall(uncertainty=weight), flat=True, **RATES
    )
    further = PPO("MlpPolicy", env, n_steps=600, batch_size=120, gamma=0.97, device="cpu", seed=seed, verbose=1)
    further.set_parameters(model.get_parameters())
    with torch.no_grad():
        further.policy.log_std.fill_(-0.7)  # explores again
    return (further.learn(samples) if samples else further), env


def flown(policy: dv.Policy, episodes: int) -> list[dict[str, Any]]:
    """Return what happens in episodes of 20 s on the estimate that no training has seen."""
    task, flights = replace(WhiteWall(), episode_s=20.0), []
    env = gymnasium.make("dronevio/VioNavigate-v0", task=task, **policy_arguments(policy, {}))
    for number in range(episodes):
        observation, _ = env.reset(seed=EVALUATION_SEED + number)
        rows, over = [], False
        while not over:
            action = policy.action({name: observation[name][None] for name in policy.names})[0]
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            quat = info["truth"]["quat_wxyz"]
            yaw = np.degrees(
                np.arctan2(2.0 * (quat[0] * quat[3] + quat[1] * quat[2]), 1.0 - 2.0 * (quat[2:] ** 2).sum())
            )
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(info["covariance"][3:6, 3:6])[-1]))
            place = info["truth"]["position_m"]
            rows.append((1e-9 * info["t_ns"], *place[:2], yaw, info["position_error_m"], sigma_m, info["landmarks"]))
        names = ("t_s", "x_m", "y_m", "yaw_deg", "error_m", "sigma_m", "landmarks")
        log = {
            name: " ".join(f"{value:.4g}" for value in column) for name, column in zip(names, zip(*rows), strict=True)
        }
        flights.append({"success": bool(info["success"]), "distance_m": float(info["distance_m"]), "log": log})
        print(f"episode {number}: distance {info['distance_m']:.2f} m, error {rows[-1][4]:.3f} m", flush=True)
    env.close()
    return flights


def train(command: TrainCommand) -> None:
    """Train and evaluate the policies of all seeds."""
    for seed in command.seeds:
        begun_s = time.process_time()
        model = trained_on_truth(command.true_samples, seed)
        further, env = trained_on_estimate(model, command.weight, command.samples, seed)
        policy = policy_from_sb3(further, env)
        cpu_s = time.process_time() - begun_s
        name = f"estimate-{command.weight:g}" if command.samples else "truth"
        document = {"name": name, "seed": seed, "cpu_s": round(cpu_s), "flights": flown(policy, command.episodes)}
        document["versions"] = policy.provenance.versions
        path = command.results / f"{PREFIX}-{name}-{seed}.json"
        path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def draw(command: DrawCommand) -> None:
    """Draw paths and errors of the policies, and print their results."""


def main(command: TrainCommand | DrawCommand) -> None:
    """Train or draw."""
    torch.set_num_threads(1)  # the networks are too small for more
    if isinstance(command, TrainCommand):
        train(command)
    else:
        draw(command)


if __name__ == "__main__":
    subcommands = {"train": TrainCommand, "draw": DrawCommand}
    main(tyro.extras.subcommand_cli_from_dict(subcommands, description=__doc__))
