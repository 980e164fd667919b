"""``dronevio book sfm``: structure from motion."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_values


@dataclass(frozen=True)
class SfmCommand:
    """Reconstruct Villa Balbianello from five photographs by bundle adjustment.

    Each observation of a point in a photograph is a factor with a standard deviation of 1 px. Levenberg-Marquardt
    estimates the poses and intrinsics of the cameras and the points. The command writes cloud.png and cloud.rrd, a
    rerun file.

    Examples:
      dronevio book sfm
      dronevio book sfm --out villa
      dronevio book sfm --json
    """

    out: Path = Path("runs/book-sfm")
    """Folder for the plot and the rerun file."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(SfmCommand, arguments, "book sfm")

    from dronevio.book.plots import draw_sfm_cloud
    from dronevio.book.rerun_file import write_sfm_rerun
    from dronevio.estimator.book.sfm import run_sfm_experiment

    experiment = run_sfm_experiment()
    command.out.mkdir(parents=True, exist_ok=True)
    draw_sfm_cloud(experiment, command.out / "cloud.png")
    write_sfm_rerun(experiment, command.out / "cloud.rrd")

    if command.printing.json:
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
    print_values(
        "Villa Balbianello",
        (
            ("cameras, points", f"{len(experiment.photographs)}, {len(experiment.points)}", ""),
            ("observations", f"{len(experiment.observed_px)}", ""),
            ("initial error", f"{experiment.initial_error:.1f}", ""),
            ("final error", f"{experiment.final_error:.1f}", ""),
            ("iterations", f"{experiment.iterations}", ""),
            ("reprojection, RMS", f"{experiment.reprojection_rms_px:.2f}", "px"),
        ),
    )
    print(f"plot:     {command.out}/cloud.png")
    print(f"open it:  dronevio view {command.out}/cloud.rrd")
    return 0
