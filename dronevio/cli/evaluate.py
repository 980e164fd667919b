"""``dronevio evaluate``: how far an estimate is from the truth."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.terminal import parse, print_json, print_table

if TYPE_CHECKING:
    from dronevio.eval.metrics import Scores, Statistics


@dataclass(frozen=True)
class EvaluateCommand:
    """Score an estimated trajectory against the true one.

    Either may be a TUM file (rows of t x y z qx qy qz qw, seconds), an EuRoC ground truth (CSV), an EuRoC folder or a
    ROS 2 bag. The truth is interpolated at the estimate's time stamps, never extrapolated. Where the truth is a
    recording with images, the coverage tells how many frames have a pose.

    For example:
      dronevio evaluate runs/room/groundtruth.tum runs/room/estimate.tum
      dronevio evaluate V1_02_medium estimate.tum --alignment se3
      dronevio evaluate truth.csv estimate.tum --json
    """

    truth: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TRUTH")]
    """The true motion: TUM file, EuRoC CSV, EuRoC folder or bag."""
    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """The estimated motion: TUM file or EuRoC CSV."""
    alignment: Literal["yaw", "se3", "sim3", "none"] = "yaw"
    """What an estimator may choose at will: yaw and position (visual-inertial), the whole pose (se3), also the scale
    (sim3), or nothing (none)."""
    association: Literal["interpolate", "nearest"] = "interpolate"
    """Interpolate the truth at the estimate's time stamps, or take the true pose nearest in time (within 10 ms)."""
    rpe_delta_s: float = 1.0
    """Time between the two poses of a relative error [s]."""
    json: bool = False
    """Print one JSON document instead of tables."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(EvaluateCommand, arguments, "evaluate")

    from dronevio.eval.metrics import PairRule, score
    from dronevio.models.recordings.open import frame_times_ns, read_trajectory

    scores = score(
        read_trajectory(command.truth),
        read_trajectory(command.estimate),
        frame_times_ns(command.truth),
        command.alignment,
        rpe=PairRule(command.rpe_delta_s),
        association=command.association,
    )
    if command.json:
        print_json({"truth": str(command.truth), "estimate": str(command.estimate), **asdict(scores)})
        return 0
    print_scores(f"{command.estimate} against {command.truth}", scores)
    return 0


def print_scores(title: str, scores: "Scores") -> None:
    """Print scores as tables with units."""
    delta = f"over {scores.rpe_delta_s:g} s"
    print_table(
        title,
        ("error", "rmse", "mean", "median", "max", "unit"),
        (
            (f"ATE, position ({scores.alignment} aligned)", *_figures(scores.ate_m, 4), "m"),
            ("ATE, orientation", *_figures(scores.ate_deg, 3), "°"),
            (f"RPE, position, {delta}", *_figures(scores.rpe_m, 4), "m"),
            (f"RPE, orientation, {delta}", *_figures(scores.rpe_deg, 3), "°"),
        ),
    )
    print_table(
        "",
        ("", "value", "unit"),
        (
            ("scale error", _figure(scores.scale_error_percent, 2), "%"),
            ("coverage after 3 s", _figure(scores.coverage_percent, 2), "%"),
            ("poses compared", f"{scores.n_poses} of {scores.n_estimated}", ""),
            (f"pairs {delta}", f"{scores.rpe_pairs}", ""),
            ("path", _figure(scores.path_m, 2), "m"),
            ("first pose, after the truth's first", _figure(scores.first_s, 3), "s"),
            ("last pose", _figure(scores.last_s, 3), "s"),
        ),
    )


def _figure(value: float | None, decimals: int) -> str:
    """Return a number for a table; a dash where it is not known."""
    return "–" if value is None else f"{value:.{decimals}f}"


def _figures(statistics: "Statistics | None", decimals: int) -> tuple[str, str, str, str]:
    """Return rmse, mean, median and max for a table; dashes where they are not known."""
    if statistics is None:
        return ("–", "–", "–", "–")
    return (
        _figure(statistics.rmse, decimals),
        _figure(statistics.mean, decimals),
        _figure(statistics.median, decimals),
        _figure(statistics.max, decimals),
    )
