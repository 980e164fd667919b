"""A policy that keeps its estimate good, beside policies that do not: flight to a goal before a white wall.

Policy and inner loops see the estimate of the visual-inertial odometry, which finds nothing to track on the white wall.
PPO first learns to fly to the goal on the true state, and goes on with the odometry in the loop, with and without a
penalty of the uncertainty: the logarithm of the standard deviation σ of the estimated position::

    python white_wall.py train
    python white_wall.py train --weight 0.0
    python white_wall.py train --samples 0
    python white_wall.py draw white-wall.svg
"""

import json
import time
from dataclasses import dataclass
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
from dronevio.envs import ActionLimits, DroneVectorEnv, VioNavigate, policy_from_sb3
from dronevio.models.rotation import matrix_from_quat_wxyz, rotation_z, yaw_rad_from_matrix
from dronevio.sim.envs.policies.environments import policy_arguments
from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv
from dronevio.sim.envs.tasks.task import PointGoals, distance_m
from dronevio.sim.physics.vehicle_states import VehicleStates

GOALS_M = np.array([[4.2, -2.5, 1.0], [4.6, 2.5, 1.8]])
"""Box of the goals, about a metre before the wall [m]."""
FLIGHT: dict[str, Any] = {"action_rate_hz": 5.0, "action_limits": ActionLimits(velocity_m_s=1.0, yaw_rate_rad_s=1.0)}
"""Calm flight, in which nothing but the wall makes the estimate worse."""
PREFIX = "white-wall"
TITLES = {"truth": "true state", "estimate-0": "estimate", "estimate-0.1": "estimate, σ in the reward"}
"""What each policy has learned on."""


@dataclass(frozen=True)
class WhiteWall(VioNavigate):
    """Take off, fly to a goal before the white wall, and be there at the end of the episode."""

    default_observations: ClassVar[tuple[str, ...]] = ("goals", "rotation", "body_velocity", "last_action")

    world: str = str(HERE / "white_wall.yaml")
    episode_s: float = 15.0
    tolerance_m: float = 0.3
    uncertainty: float = 0.0
    rate: float = 0.1  # a turn must be worth it
    spread_rad: float = np.pi
    """Largest angle between the first heading and the goal [rad]; of any, a training sees what it is worth."""

    def begin(
        self, area: Any, quadrotor: Any, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, PointGoals]:
        """Draw goals and headings, and return vehicles on the pad."""
        pad, goal = np.tile(area.pad, (count, 1)), rng.uniform(*GOALS_M, (count, 3))
        heading = np.arctan2(*(goal - pad)[:, 1::-1].T) + rng.uniform(-self.spread_rad, self.spread_rad, count)
        return VehicleStates.at(pad, rotation_z(heading), rotors=quadrotor.rotor_count), PointGoals(goal)

    def reward_terms(self, before: PointGoals, goals: PointGoals, step: Any) -> dict[str, npt.NDArray[np.float64]]:
        """Return the terms of the reward, with the logarithm of σ, whose changes do not depend on its size."""
        sigma_cm = np.maximum(100.0 * step.position_sigma_m, 1.0)  # also where there is no estimator
        uncertainty = np.broadcast_to(-self.uncertainty * np.log(sigma_cm), step.t_s.shape)
        return {**super().reward_terms(before, goals, step), "uncertainty": uncertainty}

    def success(self, goals: PointGoals, step: Any) -> npt.NDArray[np.bool_]:
        """Return which vehicles are at the goal in the last half second."""
        return (step.t_s > self.episode_s - 0.5) & (distance_m(step.after, goals.goal_m) < self.tolerance_m)


@dataclass(frozen=True)
class TrainCommand:
    """Train and evaluate policies."""

    weight: float = 0.1
    """Weight of ln(σ / 1 cm) in the reward, with the standard deviation σ of the estimated position."""
    samples: int = 15_000
    """Number of steps with the odometry in the loop; 0 keeps the policy that was trained on the true state."""
    true_samples: int = 100_000
    """Number of steps on the true state."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of environments and agent."""
    episodes: int = 20
    """Number of episodes in which a policy is evaluated."""
    out: Path = Path("runs")
    """Folder for the policies and their results."""


@dataclass(frozen=True)
class DrawCommand:
    """Draw the results of all policies, and print a table."""

    out: Annotated[Path, tyro.conf.Positional] = Path("white-wall.svg")
    """Picture to write."""
    results: Path = HERE / "results"
    """Folder of the results."""


def trained_on_truth(samples: int, seed: int) -> PPO:
    """Return a model that flies to the goal on the true state."""
    envs = DroneVectorEnv(16, WhiteWall(), autoreset_mode="SAME_STEP", flat=True, **FLIGHT)
    model = PPO(
        "MlpPolicy", StableBaselinesVecEnv(envs), n_steps=120, batch_size=240, gamma=0.97, device="cpu", seed=seed
    )
    return model.learn(samples)


def trained_on_estimate(model: PPO, weight: float, samples: int, seed: int) -> tuple[PPO, Any]:
    """Return a model that has gone on to learn with the odometry in the loop, and its environment."""
    env = gymnasium.make(
        "dronevio.envs:dronevio/VioNavigate-v0", task=WhiteWall(uncertainty=weight), flat=True, **FLIGHT
    )
    # Few samples, which cost much: large steps, which become smaller
    rates: dict[str, Any] = {"n_steps": 300, "batch_size": 100, "learning_rate": lambda left: 1e-3 * left}
    further = PPO("MlpPolicy", env, gamma=0.985, device="cpu", seed=seed, verbose=1, **rates)
    further.policy.load_state_dict(model.policy.state_dict())
    with torch.no_grad():
        further.policy.log_std[:] = torch.tensor([-2.0, -2.0, -2.0, -0.5])  # explores the heading
    return (further.learn(samples) if samples else further), env


def flown(policy: dv.Policy, episodes: int) -> list[dict[str, Any]]:
    """Return what happens in episodes of 20 s on the estimate that no training has seen."""
    task, flights = WhiteWall(episode_s=20.0, spread_rad=0.0), []  # heading for the goal, as any drone would
    env = gymnasium.make("dronevio/VioNavigate-v0", task=task, **policy_arguments(policy, {}))
    for number in range(episodes):
        observation, _ = env.reset(seed=EVALUATION_SEED + number)
        rows, over = [], False
        while not over:
            action = policy.action({name: observation[name][None] for name in policy.names})[0]
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            yaw_deg = np.degrees(yaw_rad_from_matrix(matrix_from_quat_wxyz(info["truth"]["quat_wxyz"])))
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(info["covariance"][3:6, 3:6])[-1]))
            place = info["truth"]["position_m"]
            rows.append(
                (1e-9 * info["t_ns"], *place[:2], yaw_deg, info["position_error_m"], sigma_m, info["landmarks"])
            )
        names = ("t_s", "x_m", "y_m", "yaw_deg", "error_m", "sigma_m", "landmarks")
        columns = zip(names, np.array(rows).T, strict=True)
        log = {name: " ".join(f"{value:.4g}" for value in column) for name, column in columns}
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
        command.out.mkdir(parents=True, exist_ok=True)
        path = command.out / f"{PREFIX}-{name}-{seed}.json"
        path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        dv.save_policy(path.with_suffix(".safetensors"), policy)


def draw(command: DrawCommand) -> None:
    """Draw paths and errors of the policies, and print their results."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    above, errors = figure.subplots(1, 2, width_ratios=(1.0, 1.3))
    above.plot([5.45, 5.45], [-3.9, 3.9], color="0.6", linewidth=4)
    rows = []
    for colour, (name, title) in enumerate(TITLES.items()):
        for path in sorted(command.results.glob(f"{PREFIX}-{name}-[0-9]*.json")):
            result = json.loads(path.read_text(encoding="utf-8"))
            flights = [
                {key: np.array(text.split(), float) for key, text in one["log"].items()} for one in result["flights"]
            ]
            final_m = np.array([one["error_m"][-1] for one in flights])
            goal_m = np.array([one["distance_m"] for one in result["flights"]])
            success = np.mean([one["success"] for one in result["flights"]])
            figures = [f"{value:.2f}" for value in (*np.percentile(final_m, (50, 100)), np.median(goal_m))]
            rows.append((title, str(result["seed"]), f"{success:.0%}", *figures, f"{result['cpu_s'] / 60.0:.0f}"))
            if result["seed"] == 0:
                _draw_flights(above, errors, flights, f"C{colour}", title)
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="path and view of one flight")
    errors.set(xlabel="time [s]", ylabel="error of the position [m]", yscale="log", title="error of the estimate")
    errors.grid(alpha=0.3)
    errors.legend(loc="upper left")
    matplotlib.rcParams["svg.hashsalt"] = "dronevio"  # the same picture has the same bytes
    figure.savefig(command.out, metadata={"Date": None})
    columns = ("at the goal", "median error [m]", "largest error [m]", "median distance [m]", "processor time [min]")
    print_table(columns, rows)


def _draw_flights(above: Any, errors: Any, flights: list[dict[str, Any]], colour: str, title: str) -> None:
    """Draw path and views of a flight, and the errors of all flights."""
    one = flights[1]
    every = slice(4, None, 5)  # each second
    yaw = np.radians(one["yaw_deg"][every])
    above.plot(one["x_m"], one["y_m"], color=colour, linewidth=1.2)
    above.quiver(one["x_m"][every], one["y_m"][every], np.cos(yaw), np.sin(yaw), color=colour, width=0.006, scale=14.0)
    for number, flight in enumerate(flights):
        errors.plot(
            flight["t_s"],
            flight["error_m"],
            color=colour,
            linewidth=0.6,
            alpha=0.7,
            label=title if number == 0 else None,
        )


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
