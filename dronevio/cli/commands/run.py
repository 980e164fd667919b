"""``dronevio run``: simulation, estimation, evaluation and report in one command."""

import json
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dronevio.cli.flight_options import COLLIDED, FlightOptions, ScenarioInput, parse_flight
from dronevio.cli.imported_settings import ImportedSettings
from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.progress import Bars
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.settings.option_tables import ESTIMATOR, MAP, options_from
from dronevio.cli.terminal import (
    command_line,
    innovation_rows,
    print_defects,
    print_json,
    print_run_warnings,
    print_values,
    progress_bars,
    with_scenario,
)
from dronevio.models.python_names import PREFIX
from dronevio.sim.closed_loop.settings import LoopSettings

if TYPE_CHECKING:
    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.eval.map_results import MapSummary
    from dronevio.eval.metrics.scores import Scores
    from dronevio.eval.report.model import RunReport
    from dronevio.sim.envs.policies.mission import PolicyMission
    from dronevio.sim.scenario import Scenario

SHOWN_SCORES = ("ate_m", "rpe_m", "rpe_deg", "scale_error_percent", "coverage_percent")
"""Scores of the estimate that are printed."""
SHOWN_MAP_SCORES = ("ate_m", "rpe_m", "scale_error_percent")
"""Scores of the trajectories that the map corrects that are printed."""


@dataclass(frozen=True)
class RunCommand:
    """Simulate a scenario, estimate the motion from its cameras and IMU, evaluate the estimate, and write a report.

    With --fly-on estimate, the estimator runs during the flight, and the controller receives its output in place of the
    true state. With --policy, a trained policy flies its task after the take-off.

    With --slam, the estimator builds a map and closes loops where it sees a place again. The estimate stays that of the
    odometry, on which the drone flies with --fly-on estimate. The folder then also holds estimate_map.tum, the poses as
    the map has corrected them at their frames, and map_final.tum, the poses by the map after the flight. The three are
    scored apart.

    The result is a folder with report.html, report.json, groundtruth.tum, estimate.tum, imu.csv, trajectory.png,
    run.rrd (for `dronevio view`) and configuration.json. The same settings and seed give the same recording and
    estimate.

    Examples:
      dronevio run
      dronevio run --seed 3 --out runs/third
      dronevio run hover --keep-recording
      dronevio run --rig euroc-stereo
      dronevio run --fly-on estimate
      dronevio run --policy examples/rl/policies/hover.safetensors --fly-on estimate
      dronevio run --scenario room-square --slam
      dronevio run --scenario room-square --slam --save-map room.map
      dronevio run --estimator.smoother.max-keyframes 16
      dronevio run --live
      dronevio run --json > result.json
    """

    flight: ScenarioInput = field(default_factory=FlightOptions)
    """The scenario to simulate."""
    out: Path | None = None
    """Folder to make. By default it is runs/SCENARIO-SEED, with a number appended if that exists or is
    being written."""
    fly_on: Literal["truth", "estimate"] = "truth"
    """State that the controller of the drone receives: the true state, or the output of the estimator at the IMU's
    rate. On the estimate, the drone waits on its pad until the estimator has a state."""
    policy: Path | None = None
    """File of a trained policy, see `dronevio policy`. It flies the task of its environment once, in the world and with
    the vehicle of its training unless others are chosen, after a take-off by the controller. The flight ends in the air
    when the task is accomplished or its time limit is reached."""
    slam: bool = False
    """Build a map, recognize places and correct the odometry; write and score the corrected trajectories, too."""
    save_map: Path | None = None
    """File in which the final map is saved, with --slam, for `dronevio estimate --slam --map`."""
    keep_recording: bool = False
    """Keep the recording with all images, as an EuRoC folder named recording."""
    live: bool = False
    """Show images, tracks and estimates in a rerun viewer while the estimator runs: in a window if there is a display,
    otherwise in a browser of this machine. The viewer ends with the run."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    estimator: "VioConfig" = field(
        default_factory=ImportedSettings("dronevio.estimator.config", "VioConfig"), metadata=options_from(ESTIMATOR)
    )
    """Settings of the estimator."""
    map: "SlamConfig" = field(
        default_factory=ImportedSettings("dronevio.estimator.slam.config", "SlamConfig"), metadata=options_from(MAP)
    )
    """Settings of the map, with --slam."""
    loop: LoopSettings = field(default_factory=LoopSettings)
    """Latencies of the control loop with --fly-on estimate."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    arguments = with_scenario(arguments)
    command = parse_flight(RunCommand, arguments, "run")

    from dronevio.cli.output_files import reserved_folder
    from dronevio.cli.reservations import reserved, reserved_free_name
    from dronevio.models.errors import ConfigError
    from dronevio.models.recordings.files import check_output_path
    from dronevio.sim.cameras.gl import require_gl

    if command.save_map is not None:
        if not command.slam:
            raise ConfigError("--save-map without --slam; expected both")
        check_output_path(command.save_map)  # before the flight
    chosen = command.flight.chosen()
    mission = _policy_mission(command, chosen)
    scenario = chosen if mission is None else mission.scenario
    wanted = Path("runs") / f"{scenario.name}-{scenario.seed}"
    require_gl()
    with (
        reserved_free_name(wanted) if command.out is None else reserved(command.out) as target,
        reserved_folder(target, command.output.overwrite, mark="report.json") as folder,
        progress_bars(quiet=command.output.json) as bars,
    ):
        repeat = repeating_command(command.flight.scenario, chosen, arguments)
        report = _run(scenario, command, mission, folder, target, repeat, bars)
        if not command.keep_recording:
            shutil.rmtree(folder / "recording")
    collision = None if report.control is None else report.control.collision
    code = 0 if collision is None else COLLIDED
    if command.output.json:
        print_json({"run": str(target), **report.values})
        return code
    print_report(f"Run {scenario.name}, seed {scenario.seed}", report)
    if report.policy is not None:
        result = "accomplished" if report.policy.success else "not accomplished"
        print(f"task:     {result} ({report.policy.environment}; end: {report.policy.end})")
    if collision is not None:
        print(f"the flight ended early: the drone {collision}")
    if command.save_map is not None:
        print(f"map:      {command.save_map}")
    print(f"report:   {target}/report.html")
    print(f"open it:  {command_line('view', target)}")
    return code


def _policy_mission(command: RunCommand, scenario: "Scenario") -> "PolicyMission | None":
    """Return the flight of the policy of a command in a scenario; None without a policy.

    Raises:
        ConfigError: The policy cannot be flown.
        InputError: The file of the policy is damaged.
    """
    if command.policy is None:
        return None
    from dronevio.models.policies.policy_file import load_policy
    from dronevio.sim.envs.policies.mission import policy_mission
    from dronevio.sim.envs.policies.pilot import PolicyPilot

    policy, options = load_policy(command.policy), command.flight
    mission = policy_mission(policy, scenario, own_world=options.world is None, own_vehicle=options.vehicle is None)
    PolicyPilot(mission)  # reports what the policy lacks before anything is rendered
    return mission


def _run(
    scenario: "Scenario",
    command: RunCommand,
    mission: "PolicyMission | None",
    folder: Path,
    target: Path,
    repeat: str,
    bars: Bars,
) -> "RunReport":
    """Simulate, estimate and evaluate a scenario, write all results into a folder, and return the figures.

    Args:
        scenario: The scenario.
        command: All other options.
        mission: Flight of a policy; None if the controller flies the scenario.
        folder: Folder to write to.
        target: Final name of the folder, for the report.
        repeat: Command that repeats the run, for the report.
        bars: Display of the progress.
    """
    from dronevio.cli.commands.run_flight import control_result, flown_and_estimated
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.report.run import write_report
    from dronevio.models.recordings.tum import write_tum
    from dronevio.recording.surroundings import surroundings_of

    surroundings = surroundings_of(scenario.world, scenario.seed_of_world, scenario.light_seed)
    estimated = flown_and_estimated(scenario, command, mission, folder, surroundings, bars)
    print_defects(estimated.run.defects)
    print_run_warnings(estimated.run)
    trajectory, truth = estimated.run.trajectory, estimated.recording.ground_truth
    assert truth is not None
    write_tum(folder / "groundtruth.tum", truth)
    write_tum(folder / "estimate.tum", trajectory)
    if estimated.map is not None:
        write_tum(folder / "estimate_map.tum", estimated.map.online)
        write_tum(folder / "map_final.tum", estimated.map.final)
    shutil.copyfile(folder / "recording" / "mav0" / "imu0" / "data.csv", folder / "imu.csv")
    configuration = _configuration(scenario, command, mission)
    (folder / "configuration.json").write_text(json.dumps(configuration, indent=2) + "\n", encoding="utf-8")
    info = RunInfo(
        title=f"{scenario.name}: {scenario.description}",
        command=repeat,
        open_command=command_line("view", target),
        seed=scenario.seed,
        configuration=configuration,
    )
    return write_report(
        folder,
        info,
        estimated.recording,
        estimated.run,
        estimated.scored,
        outline=surroundings.outline,
        control=control_result(command.fly_on, estimated),
        policy=estimated.outcome,
        map_results=estimated.map,
    )


def _configuration(scenario: "Scenario", command: RunCommand, mission: "PolicyMission | None") -> dict[str, Any]:
    """Return all settings of a run, for ``configuration.json`` and the report."""
    from dronevio import __version__
    from dronevio.models.policies.policy_file import description
    from dronevio.models.serialization import to_jsonable

    return {
        "dronevio": __version__,
        "scenario": to_jsonable(scenario.recorded),
        "estimator": to_jsonable(command.estimator),
        "slam": to_jsonable(command.map) if command.slam else None,
        "fly_on": command.fly_on,
        "loop": to_jsonable(command.loop),
        "policy": None if mission is None else json.loads(description(mission.policy)),
    }


def repeating_command(name: str, scenario: "Scenario", arguments: Sequence[str]) -> str:
    """Return the command that repeats a run, without the options that concern its output.

    Args:
        name: The scenario as it was named on the command line.
        scenario: The scenario of the run, whose name has a version.
        arguments: The words after ``dronevio run``.
    """
    words = [f"--scenario={name if name.startswith(PREFIX) else scenario.name}", f"--seed={scenario.seed}"]
    rest = iter(arguments)
    for word in rest:
        name, equals, _ = word.partition("=")
        if name in ("--scenario", "--seed", "--out", "--save-map"):
            if not equals:
                next(rest, None)
        elif name not in ("--json", "--overwrite", "--keep-recording", "--live"):
            words.append(word)
    return shlex.join(["dronevio", "run", *words])


def print_report(title: str, report: "RunReport") -> None:
    """Print the main figures of a run; a dash stands for a value that is not known."""
    timing = report.timing
    shown: list[tuple[str, float | str | None, str, str]] = [
        *innovation_rows(report.estimator.innovations),
        ("processor time per frame, mean", timing.cpu_ms_mean, ".1f", "ms"),
        ("processor time per frame, 99th percentile", timing.cpu_ms_p99, ".1f", "ms"),
        ("duration of the flight / processor time", timing.real_time_factor, ".1f", ""),
        *_control_rows(report),
    ]
    others = [(label, "–" if value is None else format(value, form), unit) for label, value, form, unit in shown]
    scores = _score_rows("", report.scores, SHOWN_SCORES)
    path = ("length of the path", f"{report.flight.path_m:.1f}", "m")
    print_values(title, [path, *scores, *_map_rows(report.map), *others])


def _score_rows(prefix: str, scores: "Scores | None", names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return labels, values and units of some scores of a trajectory; none without ground truth."""
    from dronevio.eval.metrics.scores import SCORE_METRICS

    if scores is None:
        return []
    metrics = [SCORE_METRICS[name] for name in names]
    return [(prefix + m.label(scores.rpe_interval), m.text(m.of(scores)), m.unit) for m in metrics]


def _map_rows(summary: "MapSummary | None") -> list[tuple[str, str, str]]:
    """Return labels, values and units of the figures of the map; none without a map."""
    if summary is None:
        return []
    return [
        *_score_rows("map, online: ", summary.online, SHOWN_MAP_SCORES),
        *_score_rows("map, final: ", summary.final, SHOWN_MAP_SCORES),
        ("loops", str(summary.loops), ""),
        ("rejected loops", str(summary.rejected_loops), ""),
        ("keyframes of the map", str(summary.keyframes), ""),
        ("bundle adjustment of the map", summary.adjustment or "–", ""),
    ]


def _control_rows(report: "RunReport") -> list[tuple[str, float | None, str, str]]:
    """Return names, values, formats and units of the figures of the control of a flight."""
    policy, control = report.policy, report.control
    if control is None:
        return []
    flown_on = f"flown on the {control.flown_on}"
    if policy is None:
        return [(f"distance from the reference, {flown_on}", control.reference_rmse_m, ".3f", "m")]
    return [
        ("time of the policy in command", policy.duration_s, ".2f", "s"),
        (f"distance from the goal at the end, {flown_on}", policy.distance_m, ".3f", "m"),
    ]
