"""``dronevio book imu``: dead reckoning as a factor graph."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_values


@dataclass(frozen=True)
class ImuCommand:
    """Estimate dead reckoning on a loop as a factor graph.

    The drone flies forward at 2 m/s and pitches up at 30 °/s. Its IMU has a rate of 10 Hz, and each IMU factor
    preintegrates 5 samples. From inaccurate initial states, Levenberg-Marquardt converges to states without any error.
    The command writes path.png, graph.png and graph.dot.

    Examples:
      dronevio book imu
      dronevio book imu --seed 3 --out loop
      dronevio book imu --json
    """

    out: Path = Path("runs/book-imu")
    """Folder for the plots."""
    seed: int = 0
    """Seed of the IMU noise and of the initial states."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ImuCommand, arguments, "book imu")

    import numpy as np

    from dronevio.book.plots import draw_factor_graph, draw_imu_path
    from dronevio.estimator.book.imu import run_imu_experiment

    experiment = run_imu_experiment(np.random.default_rng(command.seed))
    command.out.mkdir(parents=True, exist_ok=True)
    draw_imu_path(experiment, command.out / "path.png")
    draw_factor_graph(experiment.factors, command.out / "graph.png")
    (command.out / "graph.dot").write_text(experiment.dot, encoding="utf-8")

    if command.printing.json:
        print_json(
            {
                "states": len(experiment.t_s),
                "factors": len(experiment.factors),
                "initial_error": experiment.initial_error,
                "final_error": experiment.final_error,
                "iterations": experiment.iterations,
                "radius_m": experiment.flight.radius_m,
                "drift_m": experiment.drift_m,
                "out": str(command.out),
            }
        )
        return 0
    print_values(
        "Dead reckoning on a loop",
        (
            ("states, factors", f"{len(experiment.t_s)}, {len(experiment.factors)}", ""),
            ("initial error", f"{experiment.initial_error:.4g}", ""),
            ("final error", f"{experiment.final_error:.1e}", ""),
            ("iterations", f"{experiment.iterations}", ""),
            ("radius of the loop", f"{experiment.flight.radius_m:.3f}", "m"),
            (f"drift after {experiment.flight.duration_s:g} s", f"{experiment.drift_m:.3f}", "m"),
        ),
    )
    print(f"plots: {command.out}/path.png {command.out}/graph.png")
    return 0
