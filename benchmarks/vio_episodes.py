"""Episodes that are flown on visual-inertial odometry by the built-in policy, one per seed.

The script prints a table and the number of crashes; with ``--json`` it also writes the results, after every episode,
and continues with the missing seeds if the file exists. It fails if an episode ends by a failure::

    .venv/bin/python benchmarks/vio_episodes.py --seeds 0-49 --workers 2 --json vio_hover.json
    .venv/bin/python benchmarks/vio_episodes.py --environment VioHover --dark-from-s 10 --dark-for-s 1
    .venv/bin/python benchmarks/vio_episodes.py --environment VioNavigate --world room --seeds 0-9
"""

import json
import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import tyro
from measuring import in_processes, numbers, print_rows

import dronevio.envs  # noqa: F401 registers
from dronevio.sim.envs.policies.goal_flight import fly_to_goal
from dronevio.sim.envs.sensing.estimation import Estimation
from dronevio.sim.envs.tasks import VioHover, VioNavigate

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")
"""Variables that limit the threads of a process of numpy and of the software renderer."""


@dataclass(frozen=True)
class EpisodesCommand:
    """Fly episodes on visual-inertial odometry."""

    environment: Literal["VioHover", "VioNavigate"] = "VioHover"
    """Name of the environment."""
    seeds: str = "0-4"
    """Seeds of the episodes, such as 0-4 or 0,2,5."""
    workers: int = 1
    """Number of processes."""
    hover_s: float = 60.0
    """Duration of the hover of VioHover [s]."""
    world: str = ""
    """Name of the world; that of the task by default."""
    latency_s: float = Estimation.latency_s
    """Time from the middle of an exposure until the estimate of the frame is available [s]."""
    dark_from_s: float = 0.0
    """Time from the start of the episode at which the images become dark [s]."""
    dark_for_s: float = 0.0
    """Duration of the darkness [s]."""
    json: Path | None = None
    """File for the results."""


@dataclass(frozen=True)
class Episode:
    """Result of one episode."""

    seed: int
    """Seed of the environment."""
    end: str
    """Reason of the termination; ``time limit`` if the episode was truncated."""
    success: bool
    """Whether the vehicle did what the task demands."""
    duration_s: float
    """Simulated time, without the wait for the first state [s]."""
    waited_s: float
    """Simulated time until the estimator had a state [s]."""
    final_path_error_m: float
    """True distance from the place at which the flight should end: horizontally from the pad, or from the goal [m]."""
    final_estimate_error_m: float
    """Distance between estimated and true position at the end [m]."""
    worst_estimate_error_m: float
    """Largest distance between estimated and true position [m]."""
    worst_orientation_error_rad: float
    """Largest angle between estimated and true orientation [rad]."""
    lost_s: float
    """Time with the health ``lost`` [s]."""
    cpu_s: float
    """Processor time of the episode with its reset [s]."""

    @property
    def crashed(self) -> bool:
        """Whether the episode ended by a failure."""
        return self.end not in ("success", "time limit")


def flown(command: EpisodesCommand, seed: int) -> Episode:
    """Return the result of the episode of a seed."""
    start_s = time.process_time()
    hovering = VioHover(hover_s=command.hover_s, episode_s=20.0 + command.hover_s)
    task = hovering if command.environment == "VioHover" else VioNavigate()
    estimation = Estimation(latency_s=command.latency_s, dark_from_s=command.dark_from_s, dark_for_s=command.dark_for_s)
    env = gymnasium.make(
        f"dronevio/{command.environment}-v0",
        task=task,
        world=command.world,
        estimation=estimation,
        observations=("goals", "rotation"),
    )
    observation, info = env.reset(seed=seed)
    pad = info["truth"]["position_m"]
    waited_s = info["waited_s"]
    infos: list[dict[str, Any]] = []
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(fly_to_goal(observation))
        infos.append(info)
        over = terminated or truncated
    env.close()
    away = info["truth"]["position_m"] - pad
    errors_m = [one["position_error_m"] for one in infos]
    return Episode(
        seed,
        info["termination"].text or "time limit",
        bool(info["success"]),
        info["t_ns"] * 1e-9,
        waited_s,
        float(np.linalg.norm(away[:2])) if isinstance(task, VioHover) else info["distance_m"],
        errors_m[-1],
        max(errors_m),
        max(one["orientation_error_rad"] for one in infos),
        sum(one["health"] == "lost" for one in infos) / 50.0,
        time.process_time() - start_s,
    )


def summary(results: list[Episode]) -> dict[str, Any]:
    """Return the figures of several episodes by name."""
    path, final, worst = (
        [getattr(one, name) for one in results]
        for name in ("final_path_error_m", "final_estimate_error_m", "worst_estimate_error_m")
    )
    return {
        "episodes": len(results),
        "crashes": sum(one.crashed for one in results),
        "successes": sum(one.success for one in results),
        "final path error, mean [m]": float(np.mean(path)),
        "final path error, largest [m]": max(path),
        "final estimate error, mean [m]": float(np.mean(final)),
        "final estimate error, largest [m]": max(final),
        "estimate error, largest [m]": max(worst),
        "simulated seconds per second of processor time": sum(one.duration_s + one.waited_s for one in results)
        / sum(one.cpu_s for one in results),
    }


def read(path: Path | None) -> list[Episode]:
    """Return the results in a file; none if it does not exist."""
    if path is None or not path.exists():
        return []
    return [Episode(**one) for one in json.loads(path.read_text(encoding="utf-8"))["episodes"]]


def write(path: Path | None, command: EpisodesCommand, results: list[Episode]) -> None:
    """Write the results to a file."""
    if path is not None:
        settings = {name: value for name, value in asdict(command).items() if name not in ("json", "workers", "seeds")}
        content = {"settings": settings, "summary": summary(results), "episodes": [asdict(one) for one in results]}
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main(command: EpisodesCommand) -> int:
    """Fly the episodes and print the results; return 1 if one of them ends by a failure."""
    for name in THREADS:
        os.environ.setdefault(name, "1")
    results = read(command.json)
    known = {one.seed for one in results}
    missing = [(command, seed) for seed in numbers(command.seeds) if seed not in known]
    for one in in_processes(flown, missing, command.workers):
        results = sorted([*results, one], key=lambda episode: episode.seed)
        write(command.json, command, results)
        print(
            f"seed {one.seed}: {one.end}, {one.duration_s:.1f} s, final error {one.final_path_error_m:.3f} m",
            flush=True,
        )
    rows = [
        {
            "seed": str(one.seed),
            "end": one.end,
            "s": f"{one.duration_s:.1f}",
            "final path m": f"{one.final_path_error_m:.3f}",
            "final estimate m": f"{one.final_estimate_error_m:.3f}",
            "worst estimate m": f"{one.worst_estimate_error_m:.3f}",
            "worst °": f"{np.degrees(one.worst_orientation_error_rad):.1f}",
            "lost s": f"{one.lost_s:.2f}",
        }
        for one in results
    ]
    print_rows(f"Episodes of {command.environment}", rows, left=("end",))
    print_rows("", [{"figure": name, "value": f"{value:.4g}"} for name, value in summary(results).items()])
    return int(any(one.crashed for one in results))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(EpisodesCommand, description=__doc__)))
