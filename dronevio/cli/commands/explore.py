"""``dronevio explore``: a flight to a goal through an unknown world on the drone's own estimate."""

import json
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.flight_options import COLLIDED
from dronevio.cli.imported_settings import ImportedSettings
from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.settings.option_tables import EXPLORE, options_from
from dronevio.cli.terminal import (
    command_line,
    parse,
    print_defects,
    print_json,
    print_run_warnings,
    print_table,
    print_values,
    progress_bars,
    with_scenario,
)
from dronevio.models.ranges import Range, Settings
from dronevio.sim.faults import Faults
from dronevio.sim.physics.wind import Wind

if TYPE_CHECKING:
    from dronevio.autonomy.exploration import Exploration
    from dronevio.autonomy.pilot.explorer import Explorer, FlightListener
    from dronevio.autonomy.settings import ExploreSettings
    from dronevio.cli.progress import Bars
    from dronevio.eval.exploration import ExploredFlight
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.rerun.exploration import ExplorationLog
    from dronevio.models.depth import DepthImage
    from dronevio.models.state import Estimate
    from dronevio.sim.scenario import Scenario


@dataclass(frozen=True)
class ExploreCommand(Settings):
    """Fly through an unknown world on the drone's own estimate: it sees, maps, plans and flies without truth.

    The drone takes off, looks around, and flies through space that it has seen to be free: to a goal or, with --task
    cover, to where it will see most of what is unknown. The truth draws the goal and scores the flight. Loops correct
    the map, and with it goal and route, unless --no-slam is given. The flight ends when the goal is reached or nothing
    is left to see, when there is no way to the goal (the drone returns home first), when the estimate or the depth is
    lost (it lands), in a collision, or after --time-s. The exit code is 3 after a collision, and 0 after all others.

    The result is a folder with report.html, report.json, groundtruth.tum, estimate.tum, occupancy.npz (what is free,
    occupied and unknown), configuration.json, and run.rrd, in which the map grows (for `dronevio view`). The same
    settings and seed give the same flight.

    Examples:
      dronevio explore
      dronevio explore forest --seed 3
      dronevio explore --goal 2 -5.5 1.2
      dronevio explore --task cover --time-s 60
      dronevio explore --scenario room-medium --state truth --out runs/upper-bound
      dronevio explore --no-images
      dronevio explore --pilot.limits.speed-m-s 1.2
      dronevio explore --live
      dronevio explore --json > result.json
    """

    scenario: str = "office"
    """World, or a scenario whose world, vehicle, wind and faults are taken; `dronevio worlds` and `dronevio scenarios`
    list them. A world of your own is a file, such as yard.yaml or yard.xml (MJCF), or
    python:package.module:NAME."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the world, the goal and the errors of the sensors."""
    task: Literal["reach", "cover"] = "reach"
    """What the flight is for: to reach the goal, or to see all that can be reached."""
    goal: Annotated[tuple[float, ...], Range(-10_000.0, 10_000.0), tyro.conf.arg(metavar="X Y Z")] = ()
    """Position of the goal in the frame of the world, three numbers [m]; by default one behind obstacles, drawn by the
    seed."""
    time_s: Annotated[float, Range(1.0, 3600.0)] = 120.0
    """Time after which the flight ends [s]."""
    rig: str = "euroc-stereo"
    """Sensors: a name such as euroc-stereo, a Kalibr camchain.yaml, or a recording with its calibration."""
    slam: bool = True
    """Correct map, goal and route by loops, where a place is seen again."""
    state: Literal["estimate", "truth"] = "estimate"
    """State that pilot, map and controller receive: the estimate, or the true state, which is an upper bound."""
    images: bool = True
    """Render images and estimate from them. Without images, depth comes from rays with the errors of stereo, and the
    estimate is the true motion with drift, which takes a tenth of the time."""
    out: Path | None = None
    """Folder to make. By default it is runs/explore-SCENARIO-SEED, with a number appended if that exists or is being
    written."""
    live: bool = False
    """Show the map in a rerun viewer while it grows: in a window if there is a display, otherwise in a browser of this
    machine. The viewer ends with the command."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    pilot: "ExploreSettings" = field(
        default_factory=ImportedSettings("dronevio.autonomy.settings", "ExploreSettings"),
        metadata=options_from(EXPLORE),
    )
    """Settings of mapping, planning and flight."""
    wind: Wind = field(default_factory=Wind)
    """Settings of the wind; by default that of the scenario."""
    faults: Faults = field(default_factory=Faults)
    """Settings of faults of vehicle and sensors; by default those of the scenario."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    arguments = with_scenario(arguments)
    command = parse(ExploreCommand, arguments, "explore")

    from dronevio.autonomy.explored_flight import document
    from dronevio.cli.output_files import require_free, reserved_folder
    from dronevio.cli.reservations import reserved, reserved_free_name
    from dronevio.models.errors import ConfigError
    from dronevio.sim.worlds.own.names import file_stem

    if command.goal and command.task == "cover":
        raise ConfigError("--goal with --task cover; expected one of them")
    if len(command.goal) not in (0, 3):
        raise ConfigError(f"--goal {' '.join(map(str, command.goal))}; expected three numbers, x, y and z")
    scenario = _scenario(command)
    if command.out is not None:
        require_free(command.out, command.output.overwrite)  # before the flight
    wanted = Path("runs") / f"explore-{file_stem(command.scenario)}-{scenario.seed}"
    with (
        reserved_free_name(wanted) if command.out is None else reserved(command.out) as target,
        reserved_folder(target, command.output.overwrite, mark="report.json") as folder,
        progress_bars(quiet=command.output.json) as bars,
    ):
        exploration, flight = _flown(command, scenario, folder, bars)
        values = document(exploration, flight)
        info = _provenance(command, arguments, exploration, target)
        _write(folder, info, exploration, flight, values)
    if command.output.json:
        print_json({"run": str(target), **values})
    else:
        _print(f"Explore {flight.name}", flight, target)
    return COLLIDED if exploration.scores.collided else 0


def _scenario(command: ExploreCommand) -> "Scenario":
    """Return the scenario to fly.

    Raises:
        ConfigError: A name is unknown.
        InputError: The file of the rig cannot be read.
        GraphicsError: There is no off-screen OpenGL.
    """
    from dronevio.autonomy.exploration import exploration_scenario
    from dronevio.recording.recorder import rig_of

    scenario = replace(exploration_scenario(command.scenario, command.seed), rig=rig_of(command.rig))
    if command.wind != Wind():
        scenario = replace(scenario, wind=command.wind)
    if command.faults != Faults():
        scenario = replace(scenario, faults=command.faults)
    if command.images:
        from dronevio.sim.cameras.gl import require_gl

        require_gl()
    return scenario


def _flown(
    command: ExploreCommand, scenario: "Scenario", folder: Path, bars: "Bars"
) -> "tuple[Exploration, ExploredFlight]":
    """Fly, and write the rerun file; return the flight, also as reports show it."""
    from dronevio.autonomy.exploration import explore, goal_in
    from dronevio.autonomy.explored_flight import explored_flight
    from dronevio.autonomy.ray_sensing import RaySensing
    from dronevio.cli.commands.view import viewer_process
    from dronevio.eval.rerun.exploration import exploration_file, exploration_viewer
    from dronevio.recording.surroundings import surroundings_of
    from dronevio.sim.world import flight_area

    goal_m = None if command.task == "cover" else goal_in(scenario, command.goal or None)
    pad_m = flight_area(scenario.world, scenario.seed_of_world).pad
    surroundings = surroundings_of(scenario.world, scenario.seed_of_world, scenario.light_seed)
    name = f"{scenario.name}, seed {scenario.seed}"
    with ExitStack() as stack:
        has_images = command.images
        logs = [stack.enter_context(exploration_file(folder / "run.rrd", name, pad_m, goal_m, has_images=has_images))]
        if command.live:
            address = stack.enter_context(viewer_process())
            logs.append(stack.enter_context(exploration_viewer(address, name, pad_m, goal_m, has_images=has_images)))
        exploration = explore(
            scenario,
            None if goal_m is None else goal_m.tolist(),
            task=command.task,
            longest_s=command.time_s,
            settings=command.pilot,
            slam=command.slam,
            true_pose=command.state == "truth",
            without_images=None if command.images else RaySensing(),
            listeners=[_listener(log) for log in logs],
            progress=bars.bar("flying"),
        )
        flight = explored_flight(exploration)
        for log in logs:
            log.finish(flight, exploration.submaps, surroundings)
    print_defects(exploration.run.defects)
    print_run_warnings(exploration.run)
    return exploration, flight


def _listener(log: "ExplorationLog") -> "FlightListener":
    """Return what passes depth images, plans and decisions to a log."""
    from dronevio.eval.exploration import TimedDecision
    from dronevio.models.rotation import inverse_pose

    def listener(depth: "DepthImage", estimate: "Estimate", pilot: "Explorer") -> None:
        log.depth(depth, estimate, lambda: pilot.mapper.submaps)
        if pilot.plans and pilot.T_world_odom is not None:
            waited_ns = depth.t_ns - pilot.now_ns
            decisions = [TimedDecision(d.t_ns + waited_ns, d.what, d.position_m) for d in pilot.decisions]
            plan = pilot.plans[-1]
            T_map_world = inverse_pose(pilot.T_world_odom)
            log.under_way(depth.t_ns, T_map_world, plan.positions_m, plan.route_m, decisions)

    return listener


def _provenance(
    command: ExploreCommand, arguments: Sequence[str], exploration: "Exploration", target: Path
) -> "RunInfo":
    """Return the provenance of a flight, with all its settings."""
    from dronevio import __version__
    from dronevio.eval.provenance import RunInfo
    from dronevio.models.serialization import to_jsonable

    scenario = exploration.scenario
    configuration = {
        "dronevio": __version__,
        "scenario": to_jsonable(scenario.recorded),
        "task": command.task,
        "goal_m": to_jsonable(exploration.goal_m),
        "time_s": command.time_s,
        "slam": command.slam,
        "state": command.state,
        "images": command.images,
        "pilot": to_jsonable(exploration.settings),
        "wind": to_jsonable(scenario.wind),
        "faults": to_jsonable(scenario.faults),
    }
    return RunInfo(
        title=f"{scenario.name}: {scenario.description}",
        command=repeating_command(arguments),
        open_command=command_line("view", target),
        seed=scenario.seed,
        configuration=configuration,
    )


def repeating_command(arguments: Sequence[str]) -> str:
    """Return the command that repeats a flight, without the options that concern its output.

    Args:
        arguments: The words after ``dronevio explore``.
    """
    words, rest = ["dronevio", "explore"], iter(arguments)
    for word in rest:
        name, equals, _ = word.partition("=")
        if name == "--out":
            if not equals:
                next(rest, None)
        elif name not in ("--json", "--overwrite", "--live"):
            words.append(word)
    return shlex.join(words)


def _write(
    folder: Path,
    info: "RunInfo",
    exploration: "Exploration",
    flight: "ExploredFlight",
    values: dict[str, object],
) -> None:
    """Write the files of a flight besides the rerun file."""
    from dronevio.eval.report.exploration import write_exploration_report
    from dronevio.models.occupancy_maps import write_occupancy
    from dronevio.models.recordings.tum import write_tum

    write_tum(folder / "groundtruth.tum", exploration.flight.truth)
    write_tum(folder / "estimate.tum", exploration.run.trajectory)
    if exploration.run.map is not None:
        write_tum(folder / "estimate_map.tum", exploration.run.map_trajectory)
    if exploration.occupancy is not None:
        write_occupancy(folder / "occupancy.npz", exploration.occupancy)
    (folder / "configuration.json").write_text(json.dumps(info.configuration, indent=2) + "\n", encoding="utf-8")
    write_exploration_report(folder, info, flight, values)


def _print(title: str, flight: "ExploredFlight", target: Path) -> None:
    """Print the figures of a flight, and where its report is."""
    from dronevio.eval.report.exploration import COST_COLUMNS, cost_note, cost_rows, score_rows

    print_values(title, [("outcome", flight.outcome, ""), *score_rows(flight.scores)])
    print_table("Processor times beside the latencies of the flight", COST_COLUMNS, cost_rows(flight))
    print(cost_note(flight))
    if flight.collision is not None:
        print(f"the flight ended early: the drone {flight.collision}")
    print(f"report:   {target}/report.html")
    print(f"open it:  {command_line('view', target)}")
