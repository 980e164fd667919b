"""``dronevio evaluate``: the errors of an estimated trajectory."""

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import command_line, parse, print_json, print_table, print_values, print_warning
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.eval.metrics import ScoredTrajectory, ScoreOptions, Scores
    from dronevio.eval.metrics.kitti import KittiScores
    from dronevio.models.imu import Times
    from dronevio.models.state import Trajectory

SPARSE_TRUTH_S = 0.1
"""Interval of the ground truth from which its interpolation is worth a warning [s]: at 2 m/s² it errs by 2.5 mm."""


@dataclass(frozen=True)
class EvaluateCommand(Settings):
    """Compute the errors of an estimated trajectory with respect to the ground truth.

    Each of the two is a TUM file (rows of t x y z qx qy qz qw, in seconds and metres), a KITTI file (rows of twelve
    numbers), an EuRoC ground truth file (CSV), or a recording: the folder of a data set or a bag. The ground truth is
    interpolated at the time stamps of the estimate and never extrapolated. If it is a recording with images, the
    coverage is the share of the frames after 3 s that have a pose.

    Examples:
      dronevio evaluate runs/room-v0-0/groundtruth.tum runs/room-v0-0/estimate.tum
      dronevio evaluate V1_02_medium estimate.tum --alignment se3
      dronevio evaluate truth.tum estimate.tum --rpe-delta 10 --rpe-unit m
      dronevio evaluate 00_gt.txt 00_mine.txt --kitti
      dronevio evaluate truth.csv estimate.tum --json
      dronevio evaluate truth.tum estimate.tum --metrics python:my_metrics:FINAL_ERROR
    """

    truth: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TRUTH")]
    """Ground truth: TUM, KITTI or EuRoC file, or recording."""
    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """Estimated trajectory: TUM, KITTI or EuRoC file."""
    alignment: Literal["yaw", "se3", "sim3", "first", "scale", "none"] = "yaw"
    """Transformation of the estimate that minimizes the errors before they are computed: yaw and position (yaw, for
    visual-inertial odometry), rotation and position (se3), also the scale (sim3), the transformation that makes the
    first poses equal (first), that and the scale (scale, as in KITTI's tools), or the identity (none)."""
    align_poses: Annotated[int | None, Range(low=1)] = None
    """Number of poses over which the estimate is aligned, from the first on. All poses are used by default; with 1, the
    first orientations are made equal."""
    association: Literal["interpolate", "nearest", "evo"] = "interpolate"
    """How poses are associated: interpolate the ground truth at the time stamps of the estimate, take the true pose
    that is nearest in time, or associate as evo does."""
    max_gap_s: Annotated[float | None, Range(above=0.0)] = None
    """Largest gap of the ground truth that is interpolated (0.5 s by default), or largest difference between the time
    stamps of associated poses (0.01 s by default) [s]."""
    repeated: Literal["first", "last", "keep", "refuse"] = "first"
    """Which row of a TUM file counts when several have the same time stamp. With refuse, such a file is an error."""
    times: Path | None = None
    """The times.txt that belongs to KITTI files, in seconds. Without it, frames are 0.1 s apart."""
    time_offset_s: Annotated[float, Range()] = 0.0
    """Offset that is added to the time stamps of the estimate [s]."""
    estimate_time_offset: bool = False
    """Print the time offset for which the error is smallest. It is not applied."""
    rpe_delta: Annotated[float, Range(above=0.0)] = 1.0
    """Distance between the two poses of a relative pose error, in the unit of --rpe-unit."""
    rpe_unit: Literal["s", "m", "deg", "frames"] = "s"
    """Unit of --rpe-delta: seconds, metres along the path, degrees of rotation, or frames."""
    rpe_pairs: Literal["all", "consecutive"] = "all"
    """Pairs of poses for relative errors: overlapping ones from every pose on, or consecutive ones."""
    rpe_source: Literal["truth", "estimate"] = "truth"
    """Trajectory on which the distances between the poses of a pair are measured."""
    rpe_tolerance: Annotated[float | None, Range(low=0.0)] = None
    """Largest relative deviation of a pair from --rpe-delta. The default is 0.1 for metres and degrees and 0.03 for
    seconds."""
    lengths_m: Annotated[tuple[float, ...] | None, Range(above=0.0)] = None
    """Lengths of the sub-trajectories for errors by length [m]. The default is 10, 20, 30, 40 and 50 % of the path."""
    kitti: bool = False
    """Also compute the metrics of the KITTI odometry benchmark, with its definitions."""
    metrics: tuple[str, ...] | None = None
    """Metrics of your own that are also printed: python:package.module:NAME, a `dronevio.eval.metrics.Metric` whose
    function is given the `ScoredTrajectory`."""
    plot: Path | None = None
    """PNG file for a plot of the paths and the errors."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(EvaluateCommand, arguments, "evaluate")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # starting threads would cost more than they could save

    from dronevio.benchmark.own_metrics import PythonMetric
    from dronevio.eval.metrics import score_trajectory
    from dronevio.eval.metrics.time_offset import estimate_time_offset_s
    from dronevio.models.errors import InputError

    if _is_recording(command.estimate) and not _is_recording(command.truth):
        expected = f"the truth first: {command_line('evaluate', command.estimate, command.truth)}"
        raise InputError(command.estimate, "it is a recording, which holds the truth", expected)
    own = {text: PythonMetric.parse(text).load() for text in command.metrics or ()}
    estimate = _trajectory(command, command.estimate)
    truth = _trajectory(command, command.truth, estimate.t_ns)
    if command.association == "interpolate":
        _warn_of_sparse_truth(truth)
    scored = score_trajectory(
        truth,
        estimate,
        _frame_times_ns(command.truth, estimate.t_ns),
        _options(command),
    )
    kitti = _kitti(command, scored) if command.kitti else None
    offset_s = estimate_time_offset_s(truth, estimate) if command.estimate_time_offset else None
    own_values = {text: PythonMetric.parse(text).value(scored) for text in own}
    if command.plot is not None:
        _plot(command.plot, scored)
    if command.printing.json:
        files = {"truth": str(command.truth), "estimate": str(command.estimate)}
        optional = {"kitti": kitti and asdict(kitti), "best_time_offset_s": offset_s, "own": own_values}
        print_json(files | asdict(scored.scores) | optional)
        return 0
    print_scores(f"{command.estimate} against {command.truth}", scored.scores)
    if own:
        rows = [(metric.label(""), metric.text(own_values[text]), metric.unit) for text, metric in own.items()]
        print_values("Own metrics", rows)
    if kitti is not None:
        print_kitti(kitti)
    if offset_s is not None:
        print(f"time offset of the estimate for which the error is smallest: {offset_s:+.6f} s (not applied)")
    return 0


def print_scores(title: str, scores: "Scores") -> None:
    """Print scores as tables with units, without those that are not known."""
    from dronevio.eval.metrics.scores import ERROR_COLUMNS

    print_table(f"{title}, alignment {scores.alignment}", ERROR_COLUMNS, scores.error_rows(), left=("unit",))
    if scores.lengths:
        print_table(
            "Mean errors by length of the sub-trajectories",
            ("length", "pairs", "position", "drift", "orientation", "yaw", "tilt"),
            [
                (
                    f"{of.length_m:.2f} m",
                    f"{of.translation_m.n}",
                    f"{of.translation_percent.mean:.3f} %",
                    f"{of.drift_percent.mean:.3f} %",
                    f"{of.rotation_deg.mean:.3f} °",
                    f"{of.yaw_deg.mean:.3f} °",
                    f"{of.tilt_deg.mean:.3f} °",
                )
                for of in scores.lengths
            ],
        )
    print_values("", scores.value_rows())


def print_kitti(kitti: "KittiScores") -> None:
    """Print the metrics of the KITTI odometry benchmark."""
    by_length = [*kitti.by_length, (None, kitti.translation_percent, kitti.rotation_deg_per_100_m)]
    print_table(
        "KITTI benchmark",
        ("length", "position, %", "orientation, °/100 m"),
        [
            (f"all {kitti.segments} segments" if length is None else f"{length:g} m", _text(percent), _text(deg))
            for length, percent, deg in by_length
        ],
    )
    print(f"ATE {kitti.ate_m:.4f} m; mean RPE between frames {kitti.rpe_m:.5f} m, {kitti.rpe_deg:.5f} °")


def _options(command: EvaluateCommand) -> "ScoreOptions":
    """Return how a command compares the two trajectories."""
    from dronevio.eval.metrics import PairRule, ScoreOptions

    pairs = command.rpe_delta, command.rpe_unit, command.rpe_pairs, command.rpe_source, command.rpe_tolerance
    return ScoreOptions(
        command.alignment,
        command.align_poses,
        PairRule(*pairs),
        command.lengths_m or None,
        command.association,
        command.max_gap_s,
        command.time_offset_s,
    )


def _trajectory(command: EvaluateCommand, path: Path, poses_ns: "Times | None" = None) -> "Trajectory":
    """Return the trajectory of a file or folder in a world frame whose z axis points up.

    Where the clock of a bag steps, it is the part of its ground truth with the most of some poses (N,) [ns].
    """
    if _is_recording(path):
        from dronevio.models.recordings.open import read_trajectory

        return read_trajectory(path, poses_ns)
    import numpy as np

    from dronevio.eval.metrics import Alignment
    from dronevio.models.recordings.kitti import R_UP_KITTI, is_kitti
    from dronevio.models.recordings.trajectory_file import read_trajectory_file

    trajectory = read_trajectory_file(path, command.repeated, command.times, _warn)
    return Alignment(R_UP_KITTI, np.zeros(3)).apply(trajectory) if is_kitti(path) else trajectory


def _frame_times_ns(truth: Path, poses_ns: "Times") -> "Times | None":
    """Return the (M,) time stamps of all frames [ns] if the truth is a recording with images, else None.

    Where the clock of the recording steps, they are those of the segment with the most of the poses (N,) [ns].
    """
    if not _is_recording(truth):
        return None
    from dronevio.models.recordings.open import read_frame_times

    return read_frame_times(truth, poses_ns)


def _is_recording(path: Path) -> bool:
    """Return whether a path may be a recording, whose readers take long to import."""
    return path.is_dir() or path.suffix in (".mcap", ".db3")


def _kitti(command: EvaluateCommand, scored: "ScoredTrajectory") -> "KittiScores":
    """Return the metrics of the KITTI benchmark, for two KITTI files from their matrices without conversion."""
    import numpy as np

    from dronevio.eval.metrics.kitti import KittiAlignment, kitti_scores
    from dronevio.models.recordings.kitti import is_kitti, read_kitti_poses

    modes: dict[str, KittiAlignment] = {"se3": "se3", "sim3": "sim3", "scale": "scale"}
    mode = modes.get(command.alignment, "first")
    if not (is_kitti(command.truth) and is_kitti(command.estimate)):
        return kitti_scores(scored.truth.Ts_world_imu, scored.estimate.Ts_world_imu, alignment=mode)
    truth, estimate = read_kitti_poses(command.truth), read_kitti_poses(command.estimate)
    common = np.isin(estimate.frames, truth.frames)
    rows = np.searchsorted(truth.frames, estimate.frames[common])
    return kitti_scores(truth.Ts_world_cam, estimate.Ts_world_cam[common], rows, mode)


def _plot(path: Path, scored: "ScoredTrajectory") -> None:
    """Plot the paths and the errors over time."""
    from dronevio.eval.report.plots import write_score_plot

    write_score_plot(path, scored)


def _warn_of_sparse_truth(truth: "Trajectory") -> None:
    """Print a warning if the poses of the ground truth are so far apart that interpolation errs."""
    import numpy as np

    interval_s = float(np.median(np.diff(truth.t_ns))) * 1e-9 if len(truth.t_ns) > 1 else 0.0
    if interval_s > SPARSE_TRUTH_S:
        print_warning(
            f"the ground truth has a pose every {interval_s:.2f} s, between which a straight flight is assumed;"
            " with --association nearest, only the estimates at these poses count"
        )


def _warn(warning: str) -> None:
    """Print the warning of a reader on standard error."""
    print(f"dronevio: {warning}", file=sys.stderr)


def _text(value: float | None) -> str:
    """Return a number as text for a table, or a dash if it is not known."""
    return "–" if value is None else f"{value:.4f}"
