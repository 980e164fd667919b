"""``dronevio book imu``: IMU factors, their solution and covariance, the drift, and the camera that stops it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, progress_bars
from dronevio.models.ranges import Range, Settings

_PLOTS = ("path.png", "graph.png", "graph.svg", "graph.dot", "drift.png", "camera.png")


@dataclass(frozen=True)
class ImuCommand(Settings):
    """Run the experiments of section 7.4.1: IMU factors, their drift, and the same factors with a camera.

    Experiment 1: The drone flies forward at 2 m/s and pitches up at 30 °/s, on a circle with a radius of 3.82 m. Its
    IMU has a rate of 10 Hz, and an IMU factor preintegrates 5 samples. Levenberg-Marquardt and iSAM2 estimate the
    states from inaccurate initial values, with their covariance.

    Experiment 2: Many flights of one minute on this circle, for each IMU of dronevio.models.imu_presets, measure how
    far dead reckoning drifts. The result is compared with the drift that theory predicts.

    Experiment 3: The same IMU factors are combined with the observations of a camera, and the drift stops.

    The command writes path.png, graph.png, graph.svg, graph.dot, drift.png and camera.png.

    Examples:
      dronevio book imu
      dronevio book imu --counting equal --seed 3 --out loop
      dronevio book imu --runs 20 --camera-runs 2 --json
    """

    out: Path = Path("runs/book-imu")
    """Folder for the plots."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the IMU errors, the initial values and the landmarks."""
    counting: Literal["book", "equal"] = "book"
    """Distribution of the 35 samples over the IMU factors of the first experiment. ``book``: as the loop in the book
    counts, six factors, of which the first has six samples; four samples remain unused. ``equal``: seven factors with
    five samples each."""
    runs: Annotated[int, Range(1, 100_000)] = 100
    """Number of flights for each IMU in the drift study."""
    camera_runs: Annotated[int, Range(1, 10_000)] = 10
    """Number of flights with a camera."""
    duration_s: Annotated[float, Range(5.0, 120.0)] = 60.0
    """Duration of the flights of the drift study and of those with a camera, 5 to 120 [s]."""
    imu: str = "euroc"
    """IMU of the flights with a camera, one of those of the drift study."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ImuCommand, arguments, "book imu")

    import numpy as np

    from dronevio.book.figures import save_figure
    from dronevio.book.imu_lesson import (
        experiment_json,
        print_camera,
        print_covariance,
        print_drift,
        print_flight,
        print_solution,
        studies_json,
    )
    from dronevio.book.imu_plots import draw_camera, draw_drift, draw_factor_graph, draw_imu_path
    from dronevio.estimator.book.drift import run_drift_study
    from dronevio.estimator.book.imu import run_imu_experiment
    from dronevio.estimator.book.loop import LoopFlight
    from dronevio.estimator.book.visual_inertial import run_camera_study
    from dronevio.models.imu_presets import IMUS, imu_named

    camera_imu = imu_named(command.imu)
    command.out.mkdir(parents=True, exist_ok=True)
    rng, *streams = map(np.random.default_rng, np.random.SeedSequence(command.seed).spawn(len(IMUS) + 2))
    experiment = run_imu_experiment(rng, LoopFlight(counting=command.counting))
    with progress_bars(quiet=command.printing.json) as bars:
        studies = {
            name: run_drift_study(
                imu, stream, runs=command.runs, duration_s=command.duration_s, progress=bars.bar(name)
            )
            for (name, imu), stream in zip(IMUS.items(), streams[1:], strict=True)
        }
        camera = run_camera_study(
            camera_imu,
            streams[0],
            runs=command.camera_runs,
            duration_s=command.duration_s,
            progress=bars.bar("with camera"),
        )

    save_figure(draw_imu_path(experiment), command.out / "path.png")
    graph = draw_factor_graph(experiment.factors)
    for name in ("graph.png", "graph.svg"):
        save_figure(graph, command.out / name)
    (command.out / "graph.dot").write_text(experiment.dot, encoding="utf-8")
    save_figure(draw_drift(studies), command.out / "drift.png")
    save_figure(draw_camera(camera, command.imu), command.out / "camera.png")

    if command.printing.json:
        print_json({**experiment_json(experiment), **studies_json(studies, camera), "out": str(command.out)})
        return 0
    print_flight(experiment.flight)
    print_solution(experiment)
    print_covariance(experiment)
    print_drift(studies)
    print_camera(camera, command.imu)
    print("\n".join(f"plot: {command.out / name}" for name in _PLOTS))
    return 0
