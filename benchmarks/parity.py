"""Compare the metrics with those of other programs: evo, the rpg toolbox, a KITTI evaluation and TUM's scripts.

The script needs a folder of public trajectories with the figures of these programs, which DRONEVIO_DATA or the command
line names::

    python benchmarks/parity.py                  # one line per row of figures
    python benchmarks/parity.py --brief FOLDER   # only sums, and rows that differ
"""

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dronevio.eval.metrics import (
    Alignment,
    AlignmentMode,
    PairRule,
    Statistics,
    align,
    associate,
    errors_by_length,
    interpolate,
    relative_errors,
    rotation_errors_rad,
    translation_errors_m,
    umeyama,
)
from dronevio.eval.metrics.errors import distance_errors_percent
from dronevio.eval.metrics.kitti import KittiAlignment, kitti_scores
from dronevio.models.arrays import Array
from dronevio.models.recordings.kitti import read_kitti_poses
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.state import Trajectory

AGREEMENT = 1e-6
"""Largest relative difference of two figures that are equal."""
_STATISTICS = ("rmse", "mean", "median", "max", "min", "std")


@dataclass(frozen=True)
class Comparison:
    """Comparison of one row of published figures with ours."""

    tool: str
    """Name of the other program."""
    what: str
    """Options of the other program."""
    pairs: tuple[int | None, int | None]
    """Numbers of errors from which their and our figures are computed; None if a number is not known."""
    figures: int
    """Number of compared figures."""
    worst: float
    """Largest relative difference."""
    reason: str = ""
    """Reason why there is no comparison; empty if there is one."""

    @property
    def verdict(self) -> str:
        """Result: ``same``, ``differs`` or ``not expressible``."""
        if self.reason:
            return "not expressible"
        return "same" if self.worst <= AGREEMENT and self.pairs[0] in (None, self.pairs[1]) else "differs"


@cache
def read_once(path: Path) -> Trajectory:
    """Return a trajectory with all its rows."""
    return read_trajectory_file(path, "keep")


def difference(ours: float, theirs: float) -> float:
    """Return the relative difference of two figures, with 1e-6 as the smallest denominator."""
    return abs(ours - theirs) / max(abs(theirs), 1e-6)


def compared(ours: Statistics, theirs: dict[str, Any]) -> tuple[int, float]:
    """Return the number of statistics that both have, and their largest relative difference."""
    statistics = {name: getattr(ours, name) for name in _STATISTICS} | {"sse": ours.n * ours.rmse**2}
    found = [difference(statistics[name], theirs[name]) for name in statistics if name in theirs]
    return len(found), max(found)


def evo_rows(folder: Path) -> Iterator[Comparison]:
    """Compare every row of evo's figures."""
    for row in json.loads((folder / "evo_1.38.1_expected.json").read_text(encoding="utf-8")):
        words = row["cmd"].split()
        tool, what = words[0], " ".join(words[2:])
        missing = [name for name in words[2:4] if not (folder / "evo" / name).exists()]
        if missing:
            yield Comparison(tool, what, (row["n"], None), 0, 0.0, f"{missing[0]} is not in the folder")
        elif "full" in words:
            yield Comparison(tool, what, (row["n"], None), 0, 0.0, "the sum of metres and radians is not computed")
        else:
            errors, motion = _evo_errors(folder / "evo", tool, words[2:4], words[4:])
            count, worst = compared(Statistics.of(errors), row)
            if row["sim3"] is not None:
                count, worst = count + 1, max(worst, _transform_difference(motion, np.array(row["sim3"])))
            yield Comparison(tool, what, (row["n"], len(errors)), count, worst)


def _evo_errors(folder: Path, tool: str, names: list[str], flags: list[str]) -> tuple[Array, Alignment]:
    """Return the errors that a command of evo computes, and the alignment."""

    def value(flag: str, default: str) -> str:
        return flags[flags.index(flag) + 1] if flag in flags else default

    true, estimated = _evo_pairs(folder, names, value)
    orientations = true.quat_wxyz, estimated.quat_wxyz
    if names[0].startswith("KITTI"):  # evo uses the matrices without orthonormalization
        orientations = tuple(read_kitti_poses(folder / name).Ts_world_cam[:, :, :3] for name in names)  # type: ignore[assignment]
    motion = _evo_alignment(true, estimated, flags, int(value("--n_to_align", "-1")))
    aligned = motion.apply(estimated)
    degrees = value("-r", "") == "angle_deg"
    if tool == "evo_ape":
        if degrees:
            return np.degrees(rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz)), motion
        return translation_errors_m(true.p_world_imu, aligned.p_world_imu), motion
    rule = PairRule(
        float(value("-d", "1")),
        {"f": "frames", "m": "m", "d": "deg"}[value("-u", "f")],  # type: ignore[arg-type]
        "all" if "--all_pairs" in flags else "consecutive",
        "truth" if "--pairs_from_reference" in flags else "estimate",
    )
    chosen = true if rule.source == "truth" else aligned
    pairs = rule.select(chosen.t_ns, chosen.p_world_imu, chosen.quat_wxyz)
    if value("-r", "") == "point_distance_error_ratio":
        return distance_errors_percent(true.p_world_imu, aligned.p_world_imu, pairs), motion
    p_scaled = motion.scale * estimated.p_world_imu
    metres, radians = relative_errors(true.p_world_imu, orientations[0], p_scaled, orientations[1], pairs)
    return np.degrees(radians) if degrees else metres, motion


def _evo_pairs(folder: Path, names: list[str], value: Callable[[str, str], str]) -> tuple[Trajectory, Trajectory]:
    """Return the poses that a command of evo compares."""
    truth, estimate = (read_once(folder / name) for name in names)
    shift_ns = round(float(value("--t_offset", "0")) * 1e9)
    shifted = replace(estimate, t_ns=estimate.t_ns + shift_ns)
    true, estimated = associate(truth, shifted, "evo", float(value("--t_max_diff", "0.01")))
    if value("--sync_method", "") == "interpolation":
        truth, estimated = _stamped_in_doubles(truth), _stamped_in_doubles(estimated)
        true, rows = interpolate(truth, estimated.t_ns, max_gap_s=1e9)
        estimated = estimated[rows]
    return true, estimated


def _stamped_in_doubles(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory with time stamps rounded to doubles of seconds, which is 0.24 µs for present dates."""
    whole = trajectory.t_ns // 10**9
    rounded = (whole + (trajectory.t_ns - whole * 10**9) / 1e9) - whole
    t_ns, count = whole * 10**9 + np.rint(rounded * 1e9).astype(np.int64), np.arange(len(trajectory))
    return replace(trajectory, t_ns=np.maximum.accumulate(t_ns - count) + count)  # repeated ones a nanosecond later


def _evo_alignment(true: Trajectory, estimated: Trajectory, flags: list[str], n: int) -> Alignment:
    """Return the alignment that options of evo select.

    Args:
        true: N true poses.
        estimated: N estimated poses.
        flags: Options of evo.
        n: Number of poses to align; negative for all.
    """
    a, b = true.p_world_imu, estimated.p_world_imu
    if "-s" in flags and "-a" not in flags:  # the scale of the best similarity about the origin of the estimate
        return Alignment(np.eye(3), np.zeros(3), umeyama(a, b, with_scale=True).scale)
    mode: AlignmentMode = "none"
    if "--align_origin" in flags:
        mode = "first"
    elif "-a" in flags:
        mode = "sim3" if "-s" in flags else "se3"
    orientations = {"quat_truth_wxyz": true.quat_wxyz, "quat_estimate_wxyz": estimated.quat_wxyz}
    return align(a, b, mode, n=None if n < 0 else n, **orientations)


def _transform_difference(ours: Alignment, theirs: Array) -> float:
    """Return the largest difference of two similarities, relative to their rotation and translation.

    If only the scale is applied, evo prints the whole similarity nevertheless.
    """
    if not ours.t_m.any() and ours.scale != 1.0:
        return difference(ours.scale, float(np.cbrt(np.linalg.det(theirs[:3, :3]))))
    rotation = np.abs(ours.scale * ours.R_truth_estimate - theirs[:3, :3]).max() / np.abs(theirs[:3, :3]).max()
    return float(max(rotation, np.abs(ours.t_m - theirs[:3, 3]).max() / max(1.0, np.abs(theirs[:3, 3]).max())))


def rpg_rows(folder: Path) -> Iterator[Comparison]:
    """Compare every row of the rpg toolbox's figures."""
    modes: dict[str, AlignmentMode] = {"posyaw": "yaw", "se3": "se3", "sim3": "sim3", "none": "none"}
    for row in json.loads((folder / "rpg_expected.json").read_text(encoding="utf-8")):
        what = f"{row['alg']} {row['seq']} run {row['run']} {row['align']}({row['n_align']})"
        name = {"vislam_ba": "stamped_ba_estimate", "vislam_rp": "stamped_traj_estimate"}[row["alg"]]
        truth = read_once(folder / "rpg" / "vislam_ba" / row["seq"] / "stamped_groundtruth.txt")
        estimate = read_trajectory_file(folder / "rpg" / row["alg"] / row["seq"] / f"{name}{row['run']}.txt")
        true, estimated = associate(truth, estimate, "nearest", 0.02)
        motion = align(
            true.p_world_imu,
            estimated.p_world_imu,
            modes[row["align"]],
            n=None if row["n_align"] < 0 else row["n_align"],
            quat_truth_wxyz=true.quat_wxyz,
            quat_estimate_wxyz=estimated.quat_wxyz,
        )
        aligned = motion.apply(estimated)
        metres = Statistics.of(translation_errors_m(true.p_world_imu, aligned.p_world_imu))
        degrees = Statistics.of(np.degrees(rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz)))
        found = [compared(metres, row["abs_trans"]), compared(degrees, row["abs_rot_deg"])]
        found.append((1, difference(truth.length_m, row["traj_length"])))
        found.append((1, difference(motion.scale, row["scale"])))
        lengths = tuple(float(length) for length in row["rel"])
        segments = errors_by_length(
            true.p_world_imu,
            true.quat_wxyz,
            motion.scale * estimated.p_world_imu,
            estimated.quat_wxyz,  # the toolbox decomposes the error in the world frame of the estimate
            lengths,
        )
        same = metres.n == row["n"]
        for ours, theirs in zip(segments, row["rel"].values(), strict=True):
            per_metre = {name: value * ours.length_m for name, value in theirs["rel_rot_deg_per_m"].items()}
            for statistics, published in (
                (ours.translation_m, theirs["rel_trans"]),
                (ours.translation_percent, theirs["rel_trans_perc"]),
                (ours.yaw_deg, theirs["rel_yaw"]),
                (ours.tilt_deg, theirs["rel_gravity"]),
                (ours.rotation_deg, theirs["rel_rot"]),
                (ours.rotation_deg, per_metre),
            ):
                same &= statistics.n == theirs["rel_trans"]["num_samples"]
                found.append(compared(statistics, published))
        worst = max(each for _, each in found) if same else float("inf")
        yield Comparison("rpg toolbox", what, (row["n"], metres.n), sum(count for count, _ in found), worst)


def kitti_rows(folder: Path) -> Iterator[Comparison]:
    """Compare every row of the KITTI evaluation's figures."""
    modes: dict[str | None, KittiAlignment] = {None: "first", "6dof": "se3", "7dof": "sim3", "scale": "scale"}
    for row in json.loads((folder / "kitti_expected.json").read_text(encoding="utf-8")):
        sequence = f"{int(row['seq']):02d}"
        what = f"{row['result']} {sequence} {row['align'] or 'none'}"
        if row["result"] in ("orb", "spt"):
            name = {"orb": "ORB", "spt": "SPTAM"}[row["result"]]
            paths = folder / "evo" / f"KITTI_{sequence}_gt.txt", folder / "evo" / f"KITTI_{sequence}_{name}.txt"
        else:
            number = row["result"].removeprefix("ex")
            paths = folder / "kitti" / f"gt_{sequence}.txt", folder / "kitti" / f"example_{number}_{sequence}.txt"
        if not paths[1].exists():
            yield Comparison("kitti-odom-eval", what, (None, None), 0, 0.0, f"{paths[1].name} is not in the folder")
            continue
        truth, estimate = (read_kitti_poses(path) for path in paths)
        ours = kitti_scores(truth.Ts_world_cam, estimate.Ts_world_cam, estimate.frames, modes[row["align"]])
        found = {
            "t_err_pct": ours.translation_percent,
            "r_err_deg_per_100m": ours.rotation_deg_per_100_m,
            "ate_m": ours.ate_m,
            "rpe_m": ours.rpe_m,
            "rpe_deg": ours.rpe_deg,
        }
        worst = max(difference(float(value or 0.0), row[name]) for name, value in found.items())
        yield Comparison("kitti-odom-eval", what, (None, ours.segments), len(found), worst)


def tum_rows(folder: Path) -> Iterator[Comparison]:
    """Compare the figures of TUM's scripts, which have six decimals."""
    names = "freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"
    truth, estimate = (read_trajectory_file(folder / "evo" / name) for name in names)
    true, estimated = associate(truth, estimate, "nearest", 0.02)
    motion = align(true.p_world_imu, estimated.p_world_imu, "se3")
    ate = Statistics.of(translation_errors_m(true.p_world_imu, motion.positions(estimated.p_world_imu)))
    yield Comparison("TUM evaluate_ate", "six decimals", (786, ate.n), 1, _printed(ate.rmse, 0.013473))
    # Pairs are chosen on the whole estimate, those that end with its last pose are left out, and the motion is that
    # from the second pose back to the first.
    pairs = PairRule(1.0, "s", "all", "estimate", 0.9).select(estimate.t_ns, estimate.p_world_imu, estimate.quat_wxyz)
    rows = np.searchsorted(estimated.t_ns, estimate.t_ns)
    known = np.isin(estimate.t_ns, estimated.t_ns)
    kept = (pairs[1] < len(estimate) - 1) & known[pairs[0]] & known[pairs[1]]
    poses = true.p_world_imu, true.quat_wxyz, estimated.p_world_imu, estimated.quat_wxyz
    metres, radians = relative_errors(*poses, (rows[pairs[1][kept]], rows[pairs[0][kept]]))
    rpe_m, rpe_deg = Statistics.of(metres), Statistics.of(np.degrees(radians))
    worst = max(_printed(rpe_m.rmse, 0.021217), _printed(rpe_deg.rmse, 0.934480))
    yield Comparison("TUM evaluate_rpe", "--fixed_delta --delta 1, six decimals", (753, rpe_m.n), 2, worst)


def _printed(ours: float, theirs: float) -> float:
    """Return the relative difference of two figures; zero if they agree to six decimals."""
    return 0.0 if abs(round(ours, 6) - theirs) < 1e-9 else difference(ours, theirs)


def all_rows(folder: Path) -> list[Comparison]:
    """Compare all rows of all programs in a folder."""
    return [*evo_rows(folder), *rpg_rows(folder), *kitti_rows(folder), *tum_rows(folder)]


def main(arguments: list[str]) -> int:
    """Print the table, and return 1 if a row differs and 2 without a folder."""
    brief = "--brief" in arguments
    folders = [word for word in arguments if word != "--brief"]
    data = os.environ.get("DRONEVIO_DATA")
    if not folders and not data:
        print("no folder; expected an argument, or DRONEVIO_DATA", file=sys.stderr)
        return 2
    rows = all_rows(Path(folders[0]) if folders else Path(str(data)) / "trajectories")
    for row in rows:
        if brief and row.verdict == "same":
            continue
        pairs = "/".join("–" if count is None else str(count) for count in row.pairs)
        print(f"{row.verdict:15} {row.worst:8.1e} {pairs:>12} {row.tool:17} {row.what}  {row.reason}")
    for tool in dict.fromkeys(row.tool for row in rows):
        of_tool = [row for row in rows if row.tool == tool]
        counts = Counter(row.verdict for row in of_tool)
        figures = sum(row.figures for row in of_tool if row.verdict == "same")
        sums = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
        print(f"{tool}: {len(of_tool)} rows: {sums}; {figures} figures agree to {AGREEMENT:g}")
    return int(any(row.verdict == "differs" for row in rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
