"""``dronevio evaluate``: how far an estimate is from the truth."""

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dronevio.cli.plain import parse_plain, print_plain_table

if TYPE_CHECKING:
    from dronevio.eval.metrics import ScoredTrajectory, Scores, Statistics
    from dronevio.eval.metrics.kitti import KittiScores
    from dronevio.models.imu import Times
    from dronevio.models.state import Trajectory


@dataclass(frozen=True)
class EvaluateCommand:
    """Score an estimated trajectory against the true one.

    Either may be a TUM file (rows of t x y z qx qy qz qw, seconds), a KITTI file (rows of twelve numbers), an EuRoC
    ground truth (CSV), or a recording: an EuRoC folder or a ROS 2 bag. The truth is interpolated at the estimate's time
    stamps, never extrapolated. Where it is a recording with images, the coverage tells how many frames have a pose.

    For example:
      dronevio evaluate runs/room/groundtruth.tum runs/room/estimate.tum
      dronevio evaluate V1_02_medium estimate.tum --alignment se3
      dronevio evaluate truth.tum estimate.tum --rpe-delta 10 --rpe-unit m
      dronevio evaluate 00_gt.txt 00_mine.txt --kitti
      dronevio evaluate truth.csv estimate.tum --json
    """

    truth: Path
    """The true motion: TUM, KITTI or EuRoC file, EuRoC folder or bag."""
    estimate: Path
    """The estimated motion: TUM, KITTI or EuRoC file."""
    alignment: Literal["yaw", "se3", "sim3", "first", "scale", "none"] = "yaw"
    """What an estimator may choose at will: yaw and position (visual-inertial), the whole pose (se3), also the scale
    (sim3), the first pose, that and the scale (as KITTI's tools do), or nothing (none)."""
    align_poses: int | None = None
    """Align over so many poses only, from the first on; one means by its orientation."""
    association: Literal["interpolate", "nearest", "evo"] = "interpolate"
    """Interpolate the truth at the estimate's time stamps, take the true pose nearest in time, or pair as evo does."""
    max_gap_s: float | None = None
    """The longest gap of the truth to interpolate, or the farthest nearest pose [s]; by default 0.5 s and 0.01 s."""
    repeated: Literal["first", "last", "keep", "refuse"] = "first"
    """Which rows of a TUM file count that repeat the time stamp above."""
    times: Path | None = None
    """The times.txt of KITTI files, seconds; without it their frames are 0.1 s apart."""
    time_offset_s: float = 0.0
    """Add this to the estimate's time stamps [s]."""
    estimate_time_offset: bool = False
    """Say which time offset would make the error smallest; it is not applied."""
    rpe_delta: float = 1.0
    """How far apart the two poses of a relative error are."""
    rpe_unit: Literal["s", "m", "deg", "frames"] = "s"
    """In seconds, metres of path, degrees of turning or frames."""
    rpe_pairs: Literal["all", "consecutive"] = "all"
    """Pairs from every pose on, or one behind the other."""
    rpe_source: Literal["truth", "estimate"] = "truth"
    """On whose path pairs are chosen."""
    rpe_tolerance: float | None = None
    """By what share of the distance all pairs may miss it; by default 0.1 of metres and degrees, 0.03 of seconds."""
    lengths_m: tuple[float, ...] = ()
    """Lengths of sub-trajectories [m]; 10 % to 50 % of the true path by default."""
    kitti: bool = False
    """Also the figures of the KITTI odometry benchmark, in its own arithmetic."""
    plot: Path | None = None
    """Draw path and errors into this PNG file."""
    json: bool = False
    """Print one JSON document instead of tables."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse_plain(EvaluateCommand, arguments, "evaluate")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # starting threads would cost more than they could save

    from dronevio.eval.metrics import PairRule, score_trajectory
    from dronevio.eval.metrics.time_offset import estimate_time_offset_s

    truth, estimate = _trajectory(command, command.truth), _trajectory(command, command.estimate)
    scored = score_trajectory(
        truth,
        estimate,
        _frame_times_ns(command.truth),
        command.alignment,
        align_poses=command.align_poses,
        rpe=PairRule(command.rpe_delta, command.rpe_unit, command.rpe_pairs, command.rpe_source, command.rpe_tolerance),
        lengths_m=command.lengths_m or None,
        association=command.association,
        max_gap_s=command.max_gap_s,
        time_offset_s=command.time_offset_s,
    )
    kitti = _kitti(command, scored) if command.kitti else None
    offset_s = estimate_time_offset_s(truth, estimate) if command.estimate_time_offset else None
    if command.plot is not None:
        _plot(command.plot, scored)
    if command.json:
        named = {"truth": str(command.truth), "estimate": str(command.estimate), **asdict(scored.scores)}
        asked = {"kitti": kitti and asdict(kitti), "best_time_offset_s": offset_s}
        json.dump(named | asked, sys.stdout, indent=2, allow_nan=False)
        print()
        return 0
    print_scores(f"{command.estimate} against {command.truth}", scored.scores)
    if kitti is not None:
        print_kitti(kitti)
    if offset_s is not None:
        print(f"adding {offset_s:+.6f} s to the estimate's time stamps would make the error smallest (not applied)")
    return 0


def print_scores(title: str, scores: "Scores") -> None:
    """Print scores as tables with units."""
    over = f"over {scores.rpe_over}"
    errors: list[tuple[str, Statistics | None, int, str]] = [
        (f"ATE, position ({scores.alignment} aligned)", scores.ate_m, 4, "m"),
        ("ATE, orientation", scores.ate_deg, 3, "°"),
        (f"RPE, position, {over}", scores.rpe_m, 4, "m"),
        (f"RPE, orientation, {over}", scores.rpe_deg, 3, "°"),
    ]
    known = (
        ("velocity", scores.velocity_m_s, 4, "m/s"),
        ("gyroscope bias", scores.gyro_bias_rad_s, 5, "rad/s"),
        ("accelerometer bias", scores.accel_bias_m_s2, 4, "m/s²"),
    )
    errors += [row for row in known if row[1] is not None]
    print_plain_table(
        title,
        ("error", "rmse", "mean", "median", "max", "unit"),
        [(name, *_figures(statistics, decimals), unit) for name, statistics, decimals, unit in errors],
    )
    if scores.lengths:
        print_plain_table(
            "mean errors by length of sub-trajectories",
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
    print_plain_table("", ("", "value", "unit"), _facts(scores, over))


def print_kitti(kitti: "KittiScores") -> None:
    """Print the figures of the KITTI benchmark."""
    rows = [(f"{length:g} m", _figure(percent, 4), _figure(deg, 4)) for length, percent, deg in kitti.by_length]
    whole = (f"all {kitti.pieces} pieces", *(_figure(x, 4) for x in _kitti_means(kitti)))
    print_plain_table("KITTI benchmark", ("length", "position, %", "orientation, °/100 m"), [*rows, whole])
    print(f"ATE {kitti.ate_m:.4f} m; from frame to frame, mean: {kitti.rpe_m:.5f} m, {kitti.rpe_deg:.5f} °")


def _kitti_means(kitti: "KittiScores") -> tuple[float | None, float | None]:
    return kitti.translation_percent, kitti.rotation_deg_per_100_m


def _facts(scores: "Scores", over: str) -> list[tuple[str, str, str]]:
    """Return what else is known, as rows of a table."""
    consistency = [
        ("NEES, position (3 expected)", _figure(scores.nees_position, 2), ""),
        ("NEES, orientation (3 expected)", _figure(scores.nees_orientation, 2), ""),
        ("positions beyond 3 σ", _figure(scores.position_beyond_3_sigma_percent, 2), "%"),
    ]
    return [
        ("scale error", _figure(scores.scale_error_percent, 2), "%"),
        ("drift, position and yaw aligned", _figure(scores.drift_percent, 3), "%"),
        ("coverage after 3 s", _figure(scores.coverage_percent, 2), "%"),
        ("poses compared", f"{scores.n_poses} of {scores.n_estimated}", ""),
        ("longest gap between them", _figure(scores.longest_gap_s, 3), "s"),
        (f"pairs {over}", f"{scores.rpe_pairs}", ""),
        ("path", _figure(scores.path_m, 2), "m"),
        ("first pose, after the truth's first", _figure(scores.first_s, 3), "s"),
        ("first pose, after the first frame", _figure(scores.initialized_s, 3), "s"),
        ("last pose", _figure(scores.last_s, 3), "s"),
        *(consistency if scores.nees_position is not None else ()),
    ]


def _trajectory(command: EvaluateCommand, path: Path) -> "Trajectory":
    """Return the trajectory of a file or folder, in a world whose z axis is up."""
    if _is_recording(path):
        from dronevio.models.recordings.open import read_trajectory as read_truth

        return read_truth(path)
    import numpy as np

    from dronevio.eval.metrics import Alignment
    from dronevio.models.recordings.kitti import R_UP_KITTI, is_kitti
    from dronevio.models.recordings.tum import read_trajectory

    trajectory = read_trajectory(path, command.repeated, command.times, _warn)
    return Alignment(R_UP_KITTI, np.zeros(3)).apply(trajectory) if is_kitti(path) else trajectory


def _frame_times_ns(truth: Path) -> "Times | None":
    """Return the time stamps of all frames [ns] if the truth is a recording with images, else None."""
    if not _is_recording(truth):
        return None
    from dronevio.models.recordings.open import frame_times_ns

    return frame_times_ns(truth)


def _is_recording(path: Path) -> bool:
    """Say whether a path may be a recording: those who read none shall not wait for their readers."""
    return path.is_dir() or path.suffix in (".mcap", ".db3")


def _kitti(command: EvaluateCommand, scored: "ScoredTrajectory") -> "KittiScores":
    """Return the figures of the KITTI benchmark; where both files are KITTI's, from their matrices as they stand."""
    import numpy as np

    from dronevio.eval.metrics.kitti import KittiAlignment, kitti_scores
    from dronevio.models.recordings.kitti import is_kitti, read_kitti_poses

    modes: dict[str, KittiAlignment] = {"se3": "se3", "sim3": "sim3", "scale": "scale"}
    mode = modes.get(command.alignment, "first")
    if not (is_kitti(command.truth) and is_kitti(command.estimate)):
        return kitti_scores(scored.truth.Ts_world_imu, scored.estimate.Ts_world_imu, alignment=mode)
    truth, estimate = read_kitti_poses(command.truth), read_kitti_poses(command.estimate)
    known = np.isin(estimate.frames, truth.frames)
    rows = np.searchsorted(truth.frames, estimate.frames[known])
    return kitti_scores(truth.Ts_world_cam, estimate.Ts_world_cam[known], rows, mode)


def _plot(path: Path, scored: "ScoredTrajectory") -> None:
    """Draw path and errors over time."""
    from dronevio.eval.report.plots import write_score_plot

    write_score_plot(path, scored)


def _warn(notice: str) -> None:
    """Say on standard error what a reader mended."""
    print(f"dronevio: {notice}", file=sys.stderr)


def _figure(value: float | None, decimals: int) -> str:
    """Return a number for a table; a dash where it is not known."""
    return "–" if value is None else f"{value:.{decimals}f}"


def _figures(statistics: "Statistics | None", decimals: int) -> tuple[str, str, str, str]:
    """Return rmse, mean, median and max for a table; dashes where they are not known."""
    if statistics is None:
        return ("–", "–", "–", "–")
    rmse, mean, median, largest = statistics.rmse, statistics.mean, statistics.median, statistics.max
    return (
        _figure(rmse, decimals),
        _figure(mean, decimals),
        _figure(median, decimals),
        _figure(largest, decimals),
    )
