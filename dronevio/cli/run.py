"""``dronevio run``: the whole mission, from physics to the report."""

import json
import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dronevio.cli.flight_options import FlightOptions, Flown, parse_flight
from dronevio.cli.terminal import Bars, print_json, print_table, progress_bars
from dronevio.estimator.config import VioConfig

if TYPE_CHECKING:
    from dronevio.driver import Watcher
    from dronevio.eval.rerun.surroundings import Surroundings
    from dronevio.models.protocols import Recording
    from dronevio.sim.scenario import Scenario


@dataclass(frozen=True)
class RunCommand:
    """Fly a scenario in simulation, estimate the motion from camera and IMU, score it, and report.

    Makes a folder with report.html, report.json, groundtruth.tum, estimate.tum, imu.csv, trajectory.png, run.rrd (open
    it with `dronevio view`) and configuration.json. The same scenario and seed give the same flight and estimate.

    Examples:
      dronevio run
      dronevio run --seed 3 --out runs/third
      dronevio run --scenario hover --keep-recording
      dronevio run --rig euroc-stereo
      dronevio run --estimator.smoother.max-keyframes 16
      dronevio run --live
      dronevio run --json > result.json
    """

    flight: Flown = field(default_factory=FlightOptions)
    """What to fly."""
    out: Path | None = None
    """Folder to make; runs/SCENARIO-SEED by default, with a number behind it where that is taken."""
    overwrite: bool = False
    """Replace an earlier run, once the new one is complete."""
    keep_recording: bool = False
    """Keep the frames too, as an EuRoC folder named recording."""
    live: bool = False
    """Show what the estimator sees and says while it runs, to this machine only: in a window where there is a display,
    else in your browser. It ends with the run; `dronevio view` shows more."""
    json: bool = False
    """Print one JSON document instead of a table."""
    estimator: VioConfig = field(default_factory=VioConfig)
    """Settings of the estimator."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse_flight(RunCommand, arguments, "run")

    from dronevio.cli.folders import atomic_folder, free_name
    from dronevio.sim.cameras.gl import require_gl

    chosen = command.flight.chosen()
    target = command.out or free_name(Path("runs") / f"{chosen.name}-{chosen.seed}")
    require_gl()
    with (
        atomic_folder(target, command.overwrite, mark="report.json") as folder,
        progress_bars(quiet=command.json) as bars,
    ):
        _carry_out(chosen, command, folder, target, _repeat(chosen, arguments), bars)
        if not command.keep_recording:
            shutil.rmtree(folder / "recording")
    report = json.loads((target / "report.json").read_text(encoding="utf-8"))
    if command.json:
        print_json({"run": str(target), **report})
        return 0
    print_report(f"Run {chosen.name}, seed {chosen.seed}", report)
    print(f"report:  {target}/report.html")
    print(f"look:    dronevio view {target}")
    return 0


def _carry_out(scenario: "Scenario", command: RunCommand, folder: Path, target: Path, repeat: str, bars: Bars) -> None:
    """Fly, estimate, score and log a scenario; everything that is left of it lies in ``folder``."""
    from dronevio import __version__
    from dronevio.driver import estimate_recording, require_poses
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.eval.metrics.scores import score_trajectory
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.report.run import write_report
    from dronevio.eval.rerun.log import run_file
    from dronevio.models.recordings.euroc import EurocRecording
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.serialization import to_plain
    from dronevio.recorder import record_flight
    from dronevio.sim.world import build_world
    from dronevio.surroundings import surroundings_of

    listeners = {name: bars.bar(name) for name in ("simulating", "rendering", "estimating")}
    record_flight(scenario, folder / "recording", listeners["simulating"], listeners["rendering"])
    name = f"{scenario.name}, seed {scenario.seed}"
    recording = replace(EurocRecording.open(folder / "recording"), name=name)
    surroundings = surroundings_of(build_world(scenario.world, scenario.seed))
    estimator = VisualInertialOdometry(recording.rig, command.estimator)
    truth = recording.ground_truth
    assert truth is not None
    with run_file(folder / "run.rrd", recording, surroundings=surroundings) as file:
        with _spectators(recording, surroundings, command.live) as spectators:
            run = estimate_recording(recording, estimator, listeners["estimating"], (file, *spectators))
        trajectory = require_poses(run, recording)
        scored = score_trajectory(truth, trajectory, recording.frame_times_ns)
        file.finish(run, scored)

    write_tum(folder / "groundtruth.tum", truth)
    write_tum(folder / "estimate.tum", trajectory)
    shutil.copyfile(folder / "recording" / "mav0" / "imu0" / "data.csv", folder / "imu.csv")
    configuration = {"dronevio": __version__, "scenario": to_plain(scenario), "estimator": to_plain(command.estimator)}
    (folder / "configuration.json").write_text(json.dumps(configuration, indent=2) + "\n", encoding="utf-8")
    info = RunInfo(
        title=f"{scenario.name}: {scenario.description}",
        command=repeat,
        open_command=f"dronevio view {target}",
        seed=scenario.seed,
        configuration=configuration,
    )
    write_report(folder, info, recording, run, scored, outline=surroundings.outline)


@contextmanager
def _spectators(recording: "Recording", surroundings: "Surroundings", live: bool) -> Iterator["Sequence[Watcher]"]:
    """Show a viewer that watches the estimator as long as the context lasts, if wanted."""
    if not live:
        yield ()
        return
    from dronevio.cli.view import viewer_beside
    from dronevio.eval.rerun.live import watched

    with viewer_beside() as address, watched(address, recording, surroundings) as spectator:
        yield (spectator,)


def _repeat(scenario: "Scenario", arguments: Sequence[str]) -> str:
    """Return the command that flies and estimates the same again, wherever its results go."""
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
    """Print what matters most of a ``report.json``; a dash where a number is not known."""
    scores, timing = report["scores"], report["timing"]
    rpe_m, rpe_deg = scores["rpe_m"] or {"rmse": None}, scores["rpe_deg"] or {"rmse": None}
    shown: list[tuple[str, float | None, str, str]] = [
        ("path", report["flight"]["path_m"], ".1f", "m"),
        ("ATE, yaw and position aligned", scores["ate_m"]["rmse"], ".3f", "m"),
        ("RPE over 1 s, translation", rpe_m["rmse"], ".3f", "m"),
        ("RPE over 1 s, rotation", rpe_deg["rmse"], ".2f", "°"),
        ("scale error", scores["scale_error_percent"], "+.2f", "%"),
        ("coverage", scores["coverage_percent"], ".1f", "%"),
        ("processor time a frame, mean", timing["cpu_ms_mean"], ".1f", "ms"),
        ("processor time a frame, 99th percentile", timing["cpu_ms_p99"], ".1f", "ms"),
        ("faster than real time", timing["real_time_factor"], ".1f", "×"),
    ]
    print_table(
        title,
        ("", "value", "unit"),
        [(label, "–" if value is None else format(value, form), unit) for label, value, form, unit in shown],
    )
