"""Flights of policies on the true state and on the estimate of the odometry, with the same seeds.

Each policy flies its task after a take-off, in the world of its training, with one camera and an IMU that have errors.
The odometry runs during all flights. The table shows how many flights accomplish the task on the true path, the
distance from the goal at the end, the time that the policy needs, and the absolute trajectory error (ATE) of the
estimate. Results are kept in a file of one line per flight, so that an interrupted measurement continues::

    .venv/bin/python benchmarks/policy_flights.py --work build/policy-flights examples/rl/policies/*.safetensors
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported
os.environ.setdefault("LP_NUM_THREADS", "0")  # the software renderer computes in the thread that calls it

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Annotated, Literal

import tyro
from measuring import computed, kept_results, print_rows

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import TimedEstimator
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.policies.policy_file import load_policy
from dronevio.sim.closed_loop.flight import fly_closed_loop
from dronevio.sim.envs import PolicyPilot, policy_mission, policy_outcome
from dronevio.sim.rendering.live_cameras import LiveCameras
from dronevio.sim.scenarios import scenario_named

State = Literal["truth", "estimate"]
STATES: tuple[State, ...] = ("truth", "estimate")
"""States that a policy receives."""


@dataclass(frozen=True)
class PolicyFlightsCommand:
    """Fly policies on the true state and on the estimate, and compare outcomes and errors."""

    policies: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")]
    """Files of the policies."""
    work: Path
    """Folder of the results; flights that it already contains are not repeated."""
    seeds: int = 10
    """Number of seeds of each policy, from 0 on."""
    workers: int = 2
    """Number of processes."""


@dataclass(frozen=True)
class FlightResult:
    """Result of one flight."""

    policy: str
    """Name of the file of the policy, without its suffix."""
    state: State
    """State that the policy received."""
    seed: int
    """Seed of goals and sensors."""
    success: bool
    """Whether the task was accomplished on the true path."""
    end: str
    """Reason of the end."""
    duration_s: float
    """Time that the policy was in command [s]."""
    distance_m: float | None
    """True distance from the current goal at the end [m]."""
    ate_m: float | None
    """Root mean square error of the estimated position after alignment of yaw and position; None without a pose [m]."""


def flown(path: Path, state: State, seed: int) -> FlightResult:
    """Fly a policy once, and return the result."""
    mission = policy_mission(load_policy(path), scenario_named("room", seed))
    scenario, pilot = mission.scenario, PolicyPilot(mission)
    estimator = TimedEstimator(VisualInertialOdometry(scenario.rig))
    with closing(LiveCameras(scenario.true_rig, scenario.world, scenario.seed, scenario.imaging)) as cameras:
        flight = fly_closed_loop(scenario, estimator, cameras, pilot=pilot, true_state=state == "truth")
    outcome = policy_outcome(mission, flight, pilot.began_ns, pilot.end)
    trajectory, ate_m = estimator.run.trajectory, None
    if len(trajectory) > 1:
        ate_m = score_trajectory(flight.truth, trajectory, flight.frame_times_ns).scores.ate_m.rmse
    return FlightResult(
        path.stem, state, seed, outcome.success, outcome.end, outcome.duration_s, outcome.distance_m, ate_m
    )


def rows_of(results: list[FlightResult]) -> Iterator[dict[str, str]]:
    """Yield the rows of the table: one for each policy and state."""
    for policy, state in product(dict.fromkeys(r.policy for r in results), STATES):
        found = [r for r in results if (r.policy, r.state) == (policy, state)]
        if not found:
            continue
        yield {
            "policy": policy,
            "state": state,
            "flights": str(len(found)),
            "successful": str(sum(r.success for r in found)),
            "distance [m]": _mean([r.distance_m for r in found]),
            "time [s]": _mean([r.duration_s for r in found if r.success], ".2f"),
            "ATE [m]": _mean([r.ate_m for r in found]),
            "ends": ", ".join(f"{count} {end}" for end, count in Counter(r.end for r in found).most_common()),
        }


def _mean(values: list[float | None], form: str = ".3f") -> str:
    """Return the mean of the known values as text, a dash without any."""
    known = [value for value in values if value is not None]
    return format(fmean(known), form) if known else "–"


def main(arguments: list[str] | None = None) -> int:
    """Fly what is missing, and print the table."""
    command = tyro.cli(PolicyFlightsCommand, args=arguments)
    command.work.mkdir(parents=True, exist_ok=True)
    file = command.work / "flights.jsonl"
    kept = kept_results(file, FlightResult)
    done = {(r.policy, r.state, r.seed) for r in kept}
    wanted = product(range(command.seeds), command.policies, STATES)
    missing = [(path, state, seed) for seed, path, state in wanted if (path.stem, state, seed) not in done]
    results = list(computed(file, kept, flown, missing, command.workers))
    order = {(path.stem, seed): k for k, (path, seed) in enumerate(product(command.policies, range(command.seeds)))}
    chosen = sorted((r for r in results if (r.policy, r.seed) in order), key=lambda r: order[r.policy, r.seed])
    print_rows("Flights of policies on the truth and on the estimate", list(rows_of(chosen)), left=("state", "ends"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
