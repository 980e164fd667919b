"""``dronevio book sfm``: structure from motion."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from dronevio.book.lesson import print_lesson, print_paragraph
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import command_line, parse, print_json
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.estimator.book.sfm import SfmExperiment


@dataclass(frozen=True)
class BookSfmCommand(Settings):
    """Reconstruct Villa Balbianello from five photographs by bundle adjustment.

    Each observation of a point in a photograph is a factor with a standard deviation of 1 px. The reconstruction that
    comes with the photographs is optimal except for details, so cameras and points are perturbed first; the
    Levenberg-Marquardt method then estimates poses and intrinsics of the cameras and the points. The command writes
    cloud.png, which shows both states, sfm.html, a page on which they are rotated, and cloud.rrd, a rerun file. With a
    perturbation of 0 the adjustment starts near the solution, as in the book; with 5 it starts too far away, and most
    seeds do not reach it.

    Examples:
      dronevio book sfm
      dronevio book sfm --perturbation 0
      dronevio book sfm --perturbation 5 --seed 1
      dronevio book sfm --out villa --json
    """

    out: Path = Path("runs/book-sfm")
    """Folder for the plot, the page and the rerun file."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the perturbation."""
    perturbation: Annotated[float, Range(0.0, 100.0)] = 1.0
    """Factor on the perturbation, whose standard deviations are 0.02 rad and 0.05 units for cameras, 2 % for focal
    lengths and 0.05 units for points. The villa is 1.5 units away from the cameras."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(BookSfmCommand, arguments, "book sfm")

    import numpy as np

    from dronevio.book.figures import save_figure
    from dronevio.book.rerun_file import write_sfm_rerun
    from dronevio.book.sfm_page import sfm_page
    from dronevio.book.sfm_plots import draw_sfm_cloud
    from dronevio.estimator.book.sfm import run_sfm_experiment

    experiment = run_sfm_experiment(np.random.default_rng(command.seed), command.perturbation)
    command.out.mkdir(parents=True, exist_ok=True)
    save_figure(draw_sfm_cloud(experiment), command.out / "cloud.png")
    (command.out / "sfm.html").write_text(sfm_page(experiment), encoding="utf-8")
    write_sfm_rerun(experiment, command.out / "cloud.rrd")

    if command.printing.json:
        print_json(
            {
                "cameras": len(experiment.photographs),
                "points": len(experiment.points),
                "observations": len(experiment.observed_px),
                "bundler_error": experiment.bundler_error,
                "initial_error": experiment.initial_error,
                "final_error": experiment.final_error,
                "iterations": experiment.iterations,
                "initial_reprojection_rms_px": experiment.initial_reprojection_rms_px,
                "reprojection_rms_px": experiment.reprojection_rms_px,
                "initial_distance": experiment.initial_distance,
                "final_distance": experiment.final_distance,
                "out": str(command.out),
            }
        )
        return 0
    _print_lesson(experiment)
    print(f"plot:     {command.out}/cloud.png")
    print(f"open it:  {command_line('view', command.out / 'sfm.html')}")
    print(f"rerun:    {command_line('view', command.out / 'cloud.rrd')}")
    return 0


def _print_lesson(experiment: "SfmExperiment") -> None:
    unknowns = 9 * len(experiment.photographs) + 3 * len(experiment.points)
    print_lesson(
        "Villa Balbianello",
        "7.4.2",
        "dronevio.estimator.book.sfm",
        (
            (
                "cameras, points",
                f"{len(experiment.photographs)}, {len(experiment.points)}",
                "1",
                f"{unknowns} unknowns",
            ),
            ("observations", f"{len(experiment.observed_px)}", "1", "of a point in a photograph: two residuals each"),
            (
                "error of Bundler",
                f"{experiment.bundler_error:.1f}",
                "1",
                "½ Σ (residual/1 px)² of the reconstruction in the file",
            ),
            ("error before", f"{experiment.initial_error:.1f}", "1", "the same after the perturbation: the start"),
            ("error after", f"{experiment.final_error:.1f}", "1", "the same at the solution; the book has 125.5"),
            ("iterations", f"{experiment.iterations}", "1", "of Levenberg-Marquardt"),
            (
                "reprojection before",
                f"{experiment.initial_reprojection_rms_px:.2f}",
                "px",
                "RMS distance of observed and projected points",
            ),
            ("reprojection after", f"{experiment.reprojection_rms_px:.2f}", "px", "the same at the solution"),
            (
                "distance before",
                f"{experiment.initial_distance:.4f}",
                "units",
                "median distance of the points from Bundler's",
            ),
            ("distance after", f"{experiment.final_distance:.4f}", "units", "the same at the solution"),
        ),
    )
    print_paragraph(
        """The unit is unknown: photographs determine no scale. Two priors, on the first camera and the first point, fix
        position, orientation and scale, and are not perturbed. An error of 125.5 with 1 px per observation means that
        the points are observed to 0.3 px in each coordinate, better than the noise model assumes."""
    )
