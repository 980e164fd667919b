"""``dronevio run``: simulation, estimation, evaluation and report in one command."""

import json
import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dronevio.cli.flight_options import FlightOptions, ScenarioInput, parse_flight
from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.terminal import Bars, print_json, print_values, progress_bars
from dronevio.estimator.config import VioConfig
from dronevio.sim.loop_settings import LoopSettings

if TYPE_CHECKING:
    from dronevio.driver import RunObserver
    from dronevio.eval.metrics.scores import ScoredTrajectory
    from dronevio.eval.report.model import ControlResult
    from dronevio.eval.rerun.surroundings import Surroundings
    from dronevio.eval.run import EstimatorRun
    from dronevio.models.policies.outcome import PolicyOutcome
    from dronevio.models.policies.policy import Policy
    from dronevio.models.protocols import Recording
    from dronevio.sim.envs.mission import PolicyMission
    from dronevio.sim.flight import Flight
    from dronevio.sim.scenario import Scenario


@dataclass(frozen=True)
class RunCommand:
    """Simulate a scenario, estimate the motion from its cameras and IMU, evaluate the estimate, and write a report.

    With --fly-on estimate, the estimator runs during the flight, and the controller receives its output in place of the
    true state. With --policy, a trained policy flies its task after the take-off.

    The result is a folder with report.html, report.json, groundtruth.tum, estimate.tum, imu.csv, trajectory.png,
    run.rrd (for `dronevio view`) and configuration.json. The same settings and seed give the same recording and
    estimate.

    Examples:
      dronevio run
      dronevio run --seed 3 --out runs/third
      dronevio run --scenario hover --keep-recording
      dronevio run --rig euroc-stereo
      dronevio run --fly-on estimate
      dronevio run --policy hover.safetensors --fly-on estimate
      dronevio run --estimator.smoother.max-keyframes 16
      dronevio run --live
      dronevio run --json > result.json
    """

    out: Path | None = None
    """Folder to make. By default it is runs/SCENARIO-SEED, with a number appended if that exists."""
    fly_on: Literal["truth", "estimate"] = "truth"
    """State that the controller of the drone receives: the true state, or the output of the estimator at the IMU's
    rate. On the estimate, the drone waits on its pad until the estimator has a state."""
    policy: Path | None = None
    """File of a trained policy, see `dronevio policy`. It flies the task of its environment once, in the world and with
    the vehicle of its training unless others are chosen, after a take-off by the controller. The flight ends in the air
    when the task is accomplished or its time limit is reached."""
    keep_recording: bool = False
    """Keep the recording with all images, as an EuRoC folder named recording."""
    live: bool = False
    """Show images, tracks and estimates in a rerun viewer while the estimator runs: in a window if there is a display,
    otherwise in a browser of this machine. The viewer ends with the run."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    flight: ScenarioInput = field(default_factory=FlightOptions)
    """The scenario to simulate."""
    estimator: VioConfig = field(default_factory=VioConfig)
    """Settings of the estimator."""
    loop: LoopSettings = field(default_factory=LoopSettings)
    """Latencies of the control loop with --fly-on estimate."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse_flight(RunCommand, arguments, "run")

    from dronevio.cli.output_files import atomic_folder, free_name
    from dronevio.sim.cameras.gl import require_gl

    chosen = command.flight.chosen()
    flown = _policy_flight(command, chosen)
    scenario = chosen if flown is None else flown.mission.scenario
    target = command.out or free_name(Path("runs") / f"{scenario.name}-{scenario.seed}")
    require_gl()
    with (
        atomic_folder(target, command.output.overwrite, mark="report.json") as folder,
        progress_bars(quiet=command.output.json) as bars,
    ):
        _run(scenario, command, flown, folder, target, repeating_command(chosen, arguments), bars)
        if not command.keep_recording:
            shutil.rmtree(folder / "recording")
    report = json.loads((target / "report.json").read_text(encoding="utf-8"))
    if command.output.json:
        print_json({"run": str(target), **report})
        return 0
    print_report(f"Run {scenario.name}, seed {scenario.seed}", report)
    if report["policy"] is not None:
        result = "accomplished" if report["policy"]["success"] else "not accomplished"
        print(f"task:     {result} ({report['policy']['environment']}; end: {report['policy']['end']})")
    if report["control"]["collision"] is not None:
        print(f"the flight ended early: the drone {report['control']['collision']}")
    print(f"report:   {target}/report.html")
    print(f"open it:  dronevio view {target}")
    return 0


@dataclass(frozen=True, eq=False)
class _PolicyFlight:
    """A policy and the flight of its task."""

    policy: "Policy"
    mission: "PolicyMission"


def _policy_flight(command: RunCommand, scenario: "Scenario") -> _PolicyFlight | None:
    """Return the flight of the policy of a command in a scenario; None without a policy.

    Raises:
        ConfigError: The policy cannot be flown.
        InputError: The file of the policy is damaged.
    """
    if command.policy is None:
        return None
    from dronevio.models.policies.policy_file import load_policy
    from dronevio.sim.envs.mission import policy_mission
    from dronevio.sim.envs.pilot import PolicyPilot

    policy, options = load_policy(command.policy), command.flight
    mission = policy_mission(policy, scenario, own_world=options.world is None, own_vehicle=options.vehicle is None)
    PolicyPilot(policy, mission)  # reports what the policy lacks before anything is rendered
    return _PolicyFlight(policy, mission)


def _run(
    scenario: "Scenario",
    command: RunCommand,
    flown: _PolicyFlight | None,
    folder: Path,
    target: Path,
    repeat: str,
    bars: Bars,
) -> None:
    """Simulate, estimate and evaluate a scenario, and write all results into a folder.

    Args:
        scenario: The scenario.
        command: All other options.
        flown: Policy that flies the scenario; None for the controller.
        folder: Folder to write to.
        target: Final name of the folder, for the report.
        repeat: Command that repeats the run, for the report.
        bars: Display of the progress.
    """
    from dronevio import __version__
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.report.run import write_report
    from dronevio.models.policies.policy_file import description
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.serialization import to_jsonable
    from dronevio.sim.world import build_world
    from dronevio.surroundings import surroundings_of

    surroundings = surroundings_of(build_world(scenario.world, scenario.seed))
    if command.fly_on == "estimate" or flown is not None:
        estimated = _flown_on_estimate(scenario, command, flown, folder, surroundings, bars)
    else:
        estimated = _flown_on_truth(scenario, command, folder, surroundings, bars)
    trajectory, truth = estimated.run.trajectory, estimated.recording.ground_truth
    assert truth is not None
    write_tum(folder / "groundtruth.tum", truth)
    write_tum(folder / "estimate.tum", trajectory)
    shutil.copyfile(folder / "recording" / "mav0" / "imu0" / "data.csv", folder / "imu.csv")
    configuration = {
        "dronevio": __version__,
        "scenario": to_jsonable(scenario),
        "estimator": to_jsonable(command.estimator),
        "fly_on": command.fly_on,
        "loop": to_jsonable(command.loop),
        "policy": None if flown is None else json.loads(description(flown.policy)),
    }
    (folder / "configuration.json").write_text(json.dumps(configuration, indent=2) + "\n", encoding="utf-8")
    info = RunInfo(
        title=f"{scenario.name}: {scenario.description}",
        command=repeat,
        open_command=f"dronevio view {target}",
        seed=scenario.seed,
        configuration=configuration,
    )
    write_report(
        folder,
        info,
        estimated.recording,
        estimated.run,
        estimated.scored,
        outline=surroundings.outline,
        control=_control(command, estimated),
        policy=estimated.outcome,
    )


@dataclass(frozen=True, eq=False)
class _Estimated:
    """A flight with its estimate."""

    flight: "Flight"
    recording: "Recording"
    run: "EstimatorRun"
    scored: "ScoredTrajectory"
    outcome: "PolicyOutcome | None" = None


def _flown_on_truth(
    scenario: "Scenario", command: RunCommand, folder: Path, surroundings: "Surroundings", bars: Bars
) -> _Estimated:
    """Fly on the true state, render, and run the estimator on the recording."""
    from dronevio.driver import estimate_recording
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.eval.rerun.files import run_file
    from dronevio.recorder import record_flight

    progress = {name: bars.bar(name) for name in ("simulating", "rendering", "estimating")}
    flight = record_flight(scenario, folder / "recording", progress["simulating"], progress["rendering"])
    recording = _recording(scenario, folder)
    estimator = VisualInertialOdometry(recording.rig, command.estimator)
    with run_file(folder / "run.rrd", recording, surroundings=surroundings) as file:
        with _viewers(recording, surroundings, command.live) as viewers:
            run = estimate_recording(recording, estimator, progress["estimating"], (file, *viewers))
        scored = _scored(recording, run)
        file.finish(run, scored)
    return _Estimated(flight, recording, run, scored)


def _flown_on_estimate(
    scenario: "Scenario",
    command: RunCommand,
    flown: _PolicyFlight | None,
    folder: Path,
    surroundings: "Surroundings",
    bars: Bars,
) -> _Estimated:
    """Fly on the output of the estimator, which runs during the flight, or a policy on either state.

    Raises:
        ConfigError: A live view is requested.
    """
    from dronevio.driver import TimedEstimator
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.eval.rerun.files import write_rrd
    from dronevio.models.errors import ConfigError
    from dronevio.recorder import record_on_estimate
    from dronevio.sim.envs.mission import policy_outcome
    from dronevio.sim.envs.pilot import PolicyPilot

    if command.live:
        other = "--fly-on estimate" if flown is None else "--policy"
        raise ConfigError(f"--live with {other}; expected one of them, since a live view shows a recording")
    progress = {name: bars.bar(name) for name in ("flying", "logging")}
    estimator = TimedEstimator(VisualInertialOdometry(scenario.rig, command.estimator))
    pilot = None if flown is None else PolicyPilot(flown.policy, flown.mission)
    flight = record_on_estimate(
        scenario,
        folder / "recording",
        estimator,
        command.loop,
        progress["flying"],
        pilot,
        true_state=command.fly_on == "truth",
    )
    recording, run = _recording(scenario, folder), estimator.run
    scored = _scored(recording, run)
    write_rrd(folder / "run.rrd", recording, run, scored, surroundings=surroundings, progress=progress["logging"])
    outcome = None
    if flown is not None and pilot is not None:
        outcome = policy_outcome(flown.policy, flown.mission, flight, pilot.began_ns)
    return _Estimated(flight, recording, run, scored, outcome)


def _recording(scenario: "Scenario", folder: Path) -> "Recording":
    """Return the recording of a run."""
    from dronevio.models.recordings.euroc import EurocRecording

    return replace(EurocRecording.open(folder / "recording"), name=f"{scenario.name}, seed {scenario.seed}")


def _scored(recording: "Recording", run: "EstimatorRun") -> "ScoredTrajectory":
    """Return the scores of a run.

    Raises:
        EvaluationError: The run has no pose.
    """
    from dronevio.driver import require_poses
    from dronevio.eval.metrics.scores import score_trajectory

    assert recording.ground_truth is not None
    return score_trajectory(recording.ground_truth, require_poses(run, recording), recording.frame_times_ns)


def _control(command: RunCommand, estimated: _Estimated) -> "ControlResult":
    """Return the accuracy of the control of a flight."""
    import numpy as np

    from dronevio.eval.report.model import ControlResult

    flight = estimated.flight
    distance_m = flight.reference_distance_m if estimated.outcome is None else np.zeros(0)
    return ControlResult(
        command.fly_on,
        float(np.sqrt(np.mean(distance_m**2))) if len(distance_m) else None,
        float(distance_m.max()) if len(distance_m) else None,
        None if flight.collision is None else str(flight.collision),
    )


@contextmanager
def _viewers(recording: "Recording", surroundings: "Surroundings", live: bool) -> Iterator["Sequence[RunObserver]"]:
    """Show a live viewer until the context ends, if one is asked for; yield the observers of the estimator."""
    if not live:
        yield ()
        return
    from dronevio.cli.view import viewer_process
    from dronevio.eval.rerun.live import viewer_log

    with viewer_process() as address, viewer_log(address, recording, surroundings) as viewer:
        yield (viewer,)


def repeating_command(scenario: "Scenario", arguments: Sequence[str]) -> str:
    """Return the command that repeats a run, without the options that concern its output.

    Args:
        scenario: The scenario of the run.
        arguments: The words after ``dronevio run``.
    """
    words = [f"--scenario={scenario.name}", f"--seed={scenario.seed}"]
    rest = iter(arguments)
    for word in rest:
        name, equals, _ = word.partition("=")
        if name in ("--scenario", "--seed", "--out"):
            if not equals:
                next(rest, None)
        elif name not in ("--json", "--overwrite", "--keep-recording", "--live"):
            words.append(word)
    return shlex.join(["dronevio", "run", *words])


def print_report(title: str, report: dict[str, Any]) -> None:
    """Print the main figures of a ``report.json``; a dash stands for a value that is not known."""
    scores, timing = report["scores"], report["timing"]
    rpe_m, rpe_deg = scores["rpe_m"] or {"rmse": None}, scores["rpe_deg"] or {"rmse": None}
    shown: list[tuple[str, float | None, str, str]] = [
        ("length of the path", report["flight"]["path_m"], ".1f", "m"),
        ("ATE, yaw and position aligned", scores["ate_m"]["rmse"], ".3f", "m"),
        ("RPE over 1 s, position", rpe_m["rmse"], ".3f", "m"),
        ("RPE over 1 s, orientation", rpe_deg["rmse"], ".2f", "°"),
        ("scale error", scores["scale_error_percent"], "+.2f", "%"),
        ("coverage", scores["coverage_percent"], ".1f", "%"),
        ("processor time per frame, mean", timing["cpu_ms_mean"], ".1f", "ms"),
        ("processor time per frame, 99th percentile", timing["cpu_ms_p99"], ".1f", "ms"),
        ("real-time factor", timing["real_time_factor"], ".1f", ""),
        *_control_rows(report),
    ]
    print_values(
        title,
        [(label, "–" if value is None else format(value, form), unit) for label, value, form, unit in shown],
    )


def _control_rows(report: dict[str, Any]) -> tuple[tuple[str, float | None, str, str], ...]:
    """Return names, values, formats and units of the figures of the control of a flight."""
    policy, flown_on = report["policy"], f"flown on the {report['control']['flown_on']}"
    if policy is None:
        return ((f"distance from the reference, {flown_on}", report["control"]["reference_rmse_m"], ".3f", "m"),)
    return (
        ("time of the policy in command", policy["duration_s"], ".2f", "s"),
        (f"distance from the goal at the end, {flown_on}", policy["distance_m"], ".3f", "m"),
    )
