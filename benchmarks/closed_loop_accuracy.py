"""Flights on the estimate of one camera and the IMU, beside the same flights on the true state.

Each scenario is flown with each seed in three ways: on the true state, on the output of the odometry, and on the output
of the odometry with a camera that is dark for one second in the middle of the flight. The table shows collisions, the
absolute trajectory error (ATE) of the estimate, and the largest distance of the vehicle from its reference. Results are
kept in a file of one line per flight, so that an interrupted measurement continues::

    .venv/bin/python benchmarks/closed_loop_accuracy.py --work build/closed-loop
    .venv/bin/python benchmarks/closed_loop_accuracy.py --work build/closed-loop --scenarios room-medium-v0 --seeds 2
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported
os.environ.setdefault("LP_NUM_THREADS", "0")  # the software renderer computes in the thread that calls it

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Literal

import numpy as np
import tyro
from measuring import ChangedRecording, computed, kept_results, odometry, print_rows

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import TimedEstimator
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.state import CameraFrame, Trajectory
from dronevio.sim.closed_loop.flight import fly_closed_loop
from dronevio.sim.flight import Flight, fly
from dronevio.sim.rendering.live_cameras import LiveCameras
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named

Way = Literal["truth", "estimate", "dark"]
WAYS: tuple[Way, ...] = ("truth", "estimate", "dark")
"""The three ways in which each scenario is flown."""
SCENARIOS = ("room-medium-v0", "hall-medium-v0", "corridor-medium-v0")
DARK_S = 1.0
"""Duration of the darkness [s]."""


@dataclass(frozen=True)
class ClosedLoopAccuracyCommand:
    """Fly scenarios on the true state and on the estimate, and compare collisions and errors."""

    work: Path
    """Folder of the results; flights that it already contains are not repeated."""
    scenarios: tuple[str, ...] = SCENARIOS
    """Scenarios to fly."""
    ways: tuple[Way, ...] = WAYS
    """Ways in which each is flown: on the truth, on the estimate, and on the estimate with one second of darkness."""
    seeds: int = 10
    """Number of seeds of each scenario, from 0 on."""
    workers: int = 2
    """Number of processes."""


@dataclass(frozen=True)
class FlightResult:
    """Result of one flight."""

    scenario: str
    """Name of the scenario."""
    seed: int
    """Seed of the flight."""
    way: Way
    """Way in which it was flown."""
    collision: str | None
    """Collision that ended the flight."""
    ate_m: float | None
    """Root mean square error of the estimated position after alignment of yaw and position; None without a pose [m]."""
    reference_rmse_m: float
    """Root mean square distance of the vehicle from its reference [m]."""
    reference_max_m: float
    """Largest distance of the vehicle from its reference [m]."""


def rendered(flight: Flight, cameras: LiveCameras) -> ChangedRecording:
    """Return the recording of a finished flight, whose frames are rendered when they are read, in order."""
    schedule, scenario = flight.schedule, flight.scenario

    def frame(index: int) -> CameraFrame:
        times_ns = int(schedule.stamps_ns[index]), int(schedule.exposed_ns[index])
        return cameras.frame(*times_ns, bool(schedule.lit[index]), flight.truth)

    return ChangedRecording(scenario.name, scenario.rig, flight.imu, flight.frame_times_ns, frame, flight.truth)


def flown(name: str, seed: int, way: Way) -> FlightResult:
    """Fly a scenario in one way, and return the result."""
    scenario = scenario_named(name, seed)
    if way == "dark":
        middle_s = 0.5 * fly(scenario).truth.t_s[-1]
        scenario = replace(scenario, faults=replace(scenario.faults, dark_from_s=middle_s, dark_for_s=DARK_S))
    flight, estimate = _on_truth(scenario) if way == "truth" else _on_estimate(scenario)
    ate_m = None
    if len(estimate) > 1:
        ate_m = score_trajectory(flight.truth, estimate, flight.frame_times_ns).scores.ate_m.rmse
    distance_m = flight.reference_distance_m
    collision = None if flight.collision is None else str(flight.collision)
    rmse_m, max_m = float(np.sqrt(np.mean(distance_m**2))), float(distance_m.max())
    return FlightResult(name, seed, way, collision, ate_m, rmse_m, max_m)


def _cameras(scenario: Scenario) -> LiveCameras:
    return LiveCameras(scenario.true_rig, scenario.world, scenario.seed, scenario.imaging)


def _on_truth(scenario: Scenario) -> tuple[Flight, Trajectory]:
    """Return a flight on the true state, and the estimate of its recording."""
    flight = fly(scenario)
    with closing(_cameras(scenario)) as cameras:
        return flight, odometry(rendered(flight, cameras)).trajectory


def _on_estimate(scenario: Scenario) -> tuple[Flight, Trajectory]:
    """Return a flight on the estimate, and that estimate."""
    estimator = TimedEstimator(VisualInertialOdometry(scenario.rig))
    with closing(_cameras(scenario)) as cameras:
        flight = fly_closed_loop(scenario, estimator, cameras)
    return flight, estimator.run.trajectory


def rows_of(results: list[FlightResult], scenarios: tuple[str, ...]) -> Iterator[dict[str, str]]:
    """Yield the rows of the table: one for each scenario and way."""
    for scenario, way in product(scenarios, WAYS):
        found = [r for r in results if r.scenario == scenario and r.way == way]
        on_truth = {r.seed: r for r in results if r.scenario == scenario and r.way == "truth"}
        if not found:
            continue
        ates_m = [np.inf if r.ate_m is None else r.ate_m for r in found]
        pairs = [(r.ate_m, on_truth[r.seed].ate_m) for r in found if r.seed in on_truth]
        ratio = fmean(a or np.inf for a, _ in pairs) / fmean(b or np.inf for _, b in pairs) if pairs else np.nan
        excess_m = max(r.reference_max_m - ate for r, ate in zip(found, ates_m, strict=True))
        yield {
            "scenario": scenario,
            "flown on": way,
            "flights": str(len(found)),
            "collisions": str(sum(r.collision is not None for r in found)),
            "ATE, mean [m]": f"{fmean(ates_m):.4f}",
            "ATE, worst [m]": f"{max(ates_m):.4f}",
            "ratio to truth": f"{ratio:.2f}",
            "from reference, r.m.s. [m]": f"{fmean(r.reference_rmse_m for r in found):.3f}",
            "largest [m]": f"{max(r.reference_max_m for r in found):.3f}",
            "largest minus ATE [m]": f"{excess_m:.3f}",
        }


def main(arguments: list[str] | None = None) -> int:
    """Fly what is missing, print the table, and return 0 if no flight ended in a collision, otherwise 1."""
    command = tyro.cli(ClosedLoopAccuracyCommand, args=arguments)
    command.work.mkdir(parents=True, exist_ok=True)
    file = command.work / "flights.jsonl"
    kept = kept_results(file, FlightResult)
    done = {(r.scenario, r.seed, r.way) for r in kept}
    wanted = [(name, seed, way) for seed in range(command.seeds) for name in command.scenarios for way in command.ways]
    missing = [flight for flight in wanted if flight not in done]
    results = computed(file, kept, flown, missing, command.workers)
    chosen = [r for r in results if (r.scenario, r.seed, r.way) in set(wanted)]
    print_rows("Flights on the truth and on the estimate", list(rows_of(chosen, command.scenarios)))
    return int(any(r.collision is not None for r in chosen))


if __name__ == "__main__":
    raise SystemExit(main())
