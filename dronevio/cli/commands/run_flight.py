"""The flights of ``dronevio run``, with their estimates: on the true state, on the estimate, or by a policy."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from dronevio.cli.commands.run import RunCommand
    from dronevio.cli.progress import Bars
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimator.slam.visual_slam import VisualSlam
    from dronevio.estimators.driver import RunObserver
    from dronevio.eval.map_results import MapResults
    from dronevio.eval.metrics.scores import ScoredTrajectory
    from dronevio.eval.report.model import ControlResult
    from dronevio.eval.rerun.surroundings import Surroundings
    from dronevio.eval.run import EstimatorRun
    from dronevio.models.policies.outcome import PolicyOutcome
    from dronevio.models.protocols import Recording
    from dronevio.models.rig import Rig
    from dronevio.sim.envs.policies.mission import PolicyMission
    from dronevio.sim.flight import Flight
    from dronevio.sim.scenario import Scenario


@dataclass(frozen=True, eq=False)
class EstimatedFlight:
    """A flight with its estimate."""

    flight: "Flight"
    """The flight without its images."""
    recording: "Recording"
    """The recording of the flight."""
    run: "EstimatorRun"
    """The estimates of all frames, and their cost."""
    scored: "ScoredTrajectory"
    """The estimated trajectory with its errors."""
    outcome: "PolicyOutcome | None" = None
    """Outcome of the flight of a policy; None for other flights."""
    map: "MapResults | None" = None
    """The map with the corrected trajectories; None without --slam."""


def flown_and_estimated(
    scenario: "Scenario",
    command: "RunCommand",
    mission: "PolicyMission | None",
    folder: Path,
    surroundings: "Surroundings",
    bars: "Bars",
) -> EstimatedFlight:
    """Fly a scenario, estimate the motion, and write the recording and the rerun file.

    Args:
        scenario: The scenario.
        command: All other options.
        mission: Flight of a policy; None if the controller flies the scenario.
        folder: Folder to write to.
        surroundings: The world, for the rerun file.
        bars: Display of the progress.

    Raises:
        ConfigError: A live view of a flight on the estimate or of a policy is requested.
        EvaluationError: The estimator has no pose.
    """
    if command.fly_on == "estimate" or mission is not None:
        return _flown_live(scenario, command, mission, folder, surroundings, bars)
    return _flown_on_truth(scenario, command, folder, surroundings, bars)


def _flown_on_truth(
    scenario: "Scenario", command: "RunCommand", folder: Path, surroundings: "Surroundings", bars: "Bars"
) -> EstimatedFlight:
    """Fly on the true state, render, and run the estimator on the recording."""
    from dronevio.estimators.driver import estimate_recording
    from dronevio.eval.map_results import map_results
    from dronevio.eval.rerun.files import run_file
    from dronevio.recording.recorder import record_flight

    progress = {name: bars.bar(name) for name in ("simulating", "rendering", "estimating")}
    flight = record_flight(scenario, folder / "recording", progress["simulating"], progress["rendering"])
    recording = _recording(scenario, folder)
    estimator = _estimator(command, recording.rig)
    with run_file(folder / "run.rrd", recording, surroundings=surroundings, has_map=command.slam) as file:
        with _viewers(recording, surroundings, command) as viewers:
            run = estimate_recording(recording, estimator, progress["estimating"], (file, *viewers))
        run = _with_map(run, estimator, command)
        scored, mapped = _scored(recording, run), map_results(run, recording)
        file.finish(run, scored, mapped)
    return EstimatedFlight(flight, recording, run, scored, map=mapped)


def _flown_live(
    scenario: "Scenario",
    command: "RunCommand",
    mission: "PolicyMission | None",
    folder: Path,
    surroundings: "Surroundings",
    bars: "Bars",
) -> EstimatedFlight:
    """Fly on the output of the estimator, which runs during the flight, or a policy on either state.

    Raises:
        ConfigError: A live view is requested.
    """
    from dronevio.estimators.driver import TimedEstimator
    from dronevio.eval.map_results import map_results
    from dronevio.eval.rerun.files import write_rrd
    from dronevio.models.defects import defects_of
    from dronevio.models.errors import ConfigError
    from dronevio.recording.recorder import record_closed_loop
    from dronevio.sim.envs.policies.mission import policy_outcome
    from dronevio.sim.envs.policies.pilot import PolicyPilot

    if command.live:
        other = "--fly-on estimate" if mission is None else "--policy"
        raise ConfigError(f"--live with {other}; expected one of them, since a live view shows a recording")
    progress = {name: bars.bar(name) for name in ("flying", "logging")}
    own = _estimator(command, scenario.rig)
    estimator = TimedEstimator(own)
    pilot = None if mission is None else PolicyPilot(mission)
    flight = record_closed_loop(
        scenario,
        folder / "recording",
        estimator,
        command.loop,
        progress["flying"],
        pilot,
        true_state=command.fly_on == "truth",
    )
    recording = _recording(scenario, folder)
    run = _with_map(replace(estimator.run, defects=defects_of(recording)), own, command)
    scored, mapped = _scored(recording, run), map_results(run, recording)
    write_rrd(
        folder / "run.rrd",
        recording,
        run,
        scored,
        mapped=mapped,
        surroundings=surroundings,
        progress=progress["logging"],
    )
    outcome = None
    if mission is not None and pilot is not None:
        outcome = policy_outcome(mission, flight, pilot.began_ns, pilot.end)
    return EstimatedFlight(flight, recording, run, scored, outcome, mapped)


def _estimator(command: "RunCommand", rig: "Rig") -> "VisualInertialOdometry | VisualSlam":
    """Return the estimator of a command before its first measurement: the odometry, or with --slam that with a map."""
    if command.slam:
        from dronevio.estimator.slam.visual_slam import VisualSlam

        return VisualSlam(rig, command.estimator, command.map)
    from dronevio.estimator.odometry import VisualInertialOdometry

    return VisualInertialOdometry(rig, command.estimator)


def _with_map(
    run: "EstimatorRun", estimator: "VisualInertialOdometry | VisualSlam", command: "RunCommand"
) -> "EstimatorRun":
    """Return a finished run with the final map, if its estimator has one, and save the map with --save-map.

    Raises:
        ConfigError: The map is too small to be saved.
    """
    from dronevio.estimator.slam.visual_slam import VisualSlam

    if not isinstance(estimator, VisualSlam):
        return run
    if command.save_map is not None:
        estimator.save_map(command.save_map)
    return replace(run, map=estimator.final_map())


def _recording(scenario: "Scenario", folder: Path) -> "Recording":
    """Return the recording of a run."""
    from dronevio.models.recordings.euroc import EurocRecording

    opened = EurocRecording.open(folder / "recording", repair=True)
    return replace(opened, name=f"{scenario.name}, seed {scenario.seed}")


def _scored(recording: "Recording", run: "EstimatorRun") -> "ScoredTrajectory":
    """Return the scores of a run.

    Raises:
        EvaluationError: The run has no pose.
    """
    from dronevio.estimators.driver import require_poses
    from dronevio.eval.metrics.scores import score_trajectory

    assert recording.ground_truth is not None
    return score_trajectory(recording.ground_truth, require_poses(run, recording), recording.frame_times_ns)


def control_result(flown_on: Literal["truth", "estimate"], estimated: EstimatedFlight) -> "ControlResult":
    """Return the accuracy of the control of a flight.

    Args:
        flown_on: State that the controller or the policy received.
        estimated: The flight.
    """
    import numpy as np

    from dronevio.eval.report.model import ControlResult

    flight = estimated.flight
    distance_m = flight.reference_distance_m if estimated.outcome is None else np.zeros(0)
    return ControlResult(
        flown_on,
        float(np.sqrt(np.mean(distance_m**2))) if len(distance_m) else None,
        float(distance_m.max()) if len(distance_m) else None,
        None if flight.collision is None else str(flight.collision),
    )


@contextmanager
def _viewers(
    recording: "Recording", surroundings: "Surroundings", command: "RunCommand"
) -> Iterator["Sequence[RunObserver]"]:
    """Show a live viewer until the context ends, if one is asked for; yield the observers of the estimator."""
    if not command.live:
        yield ()
        return
    from dronevio.cli.commands.view import viewer_process
    from dronevio.eval.rerun.live import viewer_log

    with viewer_process() as address, viewer_log(address, recording, surroundings, has_map=command.slam) as viewer:
        yield (viewer,)
