"""``dronevio book sfm``: structure from motion."""

from dataclasses import dataclass
from pathlib import Path

from dronevio.cli.terminal import parse, print_json, print_table


@dataclass(frozen=True)
class BookSfm:
    """Structure from motion: five photographs of Villa Balbianello, bundle-adjusted.

    Every observation of a point in a photograph is a factor with a standard deviation of 1 px; the poses, the lenses
    and the points are found by Levenberg-Marquardt. Writes cloud.png, and cloud.rrd to walk around in.

    Examples:
      dronevio book sfm
      dronevio book sfm --out villa
      dronevio book sfm --json
    """

    out: Path = Path("runs/book-sfm")
    """Folder for the picture and the recording."""
    json: bool = False
    """Print one JSON document instead of the table."""


def main(arguments: list[str]) -> int:
    """Run the experiment, draw it and print its errors."""
    command = parse(BookSfm, arguments, "book sfm")

    from dronevio.book.plots import draw_sfm_cloud
    from dronevio.book.recording import record_sfm
    from dronevio.estimator.book.sfm import run_sfm_experiment

    experiment = run_sfm_experiment()
    command.out.mkdir(parents=True, exist_ok=True)
    draw_sfm_cloud(experiment, command.out / "cloud.png")
    record_sfm(experiment, command.out / "cloud.rrd")

    if command.json:
        print_json(
            {
                "cameras": len(experiment.photographs),
                "points": len(experiment.points),
                "observations": len(experiment.observed_px),
                "initial_error": experiment.initial_error,
                "final_error": experiment.final_error,
                "iterations": experiment.iterations,
                "reprojection_rms_px": experiment.reprojection_rms_px,
                "out": str(command.out),
            }
        )
        return 0
    print_table(
        "Villa Balbianello",
        ("", "value", "unit"),
        (
            ("cameras, points", f"{len(experiment.photographs)}, {len(experiment.points)}", ""),
            ("observations", f"{len(experiment.observed_px)}", ""),
            ("initial error", f"{experiment.initial_error:.1f}", ""),
            ("final error", f"{experiment.final_error:.1f}", ""),
            ("iterations", f"{experiment.iterations}", ""),
            ("reprojection, RMS", f"{experiment.reprojection_rms_px:.2f}", "px"),
        ),
    )
    print(f"picture: {command.out}/cloud.png    recording: rerun {command.out}/cloud.rrd")
    return 0
