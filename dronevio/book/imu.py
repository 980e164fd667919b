"""``dronevio book imu``: dead reckoning as a factor graph."""

from dataclasses import dataclass
from pathlib import Path

from dronevio.cli.terminal import parse, print_json, print_table


@dataclass(frozen=True)
class BookImu:
    """Dead reckoning on a loop, as a factor graph.

    The drone flies 2 m/s forward and pitches up 30 °/s, its IMU samples at 10 Hz, an IMU factor sums up every 5
    samples. From states that are far off, Levenberg-Marquardt finds those without any error. Writes path.png,
    graph.png and graph.dot.

    Examples:
      dronevio book imu
      dronevio book imu --seed 3 --out loop
      dronevio book imu --json
    """

    out: Path = Path("runs/book-imu")
    """Folder for the pictures."""
    seed: int = 0
    """Of the IMU's noise and of the first guess."""
    json: bool = False
    """Print one JSON document instead of the table."""


def main(arguments: list[str]) -> int:
    """Run the experiment, draw it and print its errors."""
    command = parse(BookImu, arguments, "book imu")

    import numpy as np

    from dronevio.book.plots import draw_factor_graph, draw_imu_path
    from dronevio.estimator.book.imu import run_imu_experiment

    experiment = run_imu_experiment(np.random.default_rng(command.seed))
    command.out.mkdir(parents=True, exist_ok=True)
    draw_imu_path(experiment, command.out / "path.png")
    draw_factor_graph(experiment.factors, command.out / "graph.png")
    (command.out / "graph.dot").write_text(experiment.dot, encoding="utf-8")

    if command.json:
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
    print_table(
        "Dead reckoning on a loop",
        ("", "value", "unit"),
        (
            ("states, factors", f"{len(experiment.t_s)}, {len(experiment.factors)}", ""),
            ("initial error", f"{experiment.initial_error:.4g}", ""),
            ("final error", f"{experiment.final_error:.1e}", ""),
            ("iterations", f"{experiment.iterations}", ""),
            ("radius of the loop", f"{experiment.flight.radius_m:.3f}", "m"),
            (f"drift after {experiment.flight.duration_s:g} s", f"{experiment.drift_m:.3f}", "m"),
        ),
    )
    print(f"pictures: {command.out}/path.png {command.out}/graph.png")
    return 0
