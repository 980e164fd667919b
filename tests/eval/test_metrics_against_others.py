"""The same figures as other programs give: evo always, and published results where the data sets are at hand."""

import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.metrics import (
    AlignmentMode,
    Statistics,
    align,
    pairs_after_distance,
    relative_errors,
    rotation_errors_rad,
    score,
    translation_errors_m,
)
from dronevio.eval.metrics.association import interpolate, nearest_rows
from dronevio.models.recordings.timed_table import parse_decimal_seconds
from dronevio.models.recordings.tum import read_trajectory, read_tum
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, quat_wxyz_from_xyzw
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]
AGREEMENT = 1e-6


@dataclass(frozen=True)
class Poses:
    """Poses of a file; unlike a trajectory, they may repeat a time stamp, as two of the public files do."""

    t_ns: npt.NDArray[np.int64]
    t_s: Array
    p: Array
    quat_wxyz: Array

    def __getitem__(self, rows: Any) -> "Poses":
        return Poses(self.t_ns[rows], self.t_s[rows], self.p[rows], self.quat_wxyz[rows])


def load(path: Path) -> Poses:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    if path.suffix == ".csv":
        values = np.array([[float(x) for x in line.split(",")[1:8]] for line in lines])
        t_ns = np.array([int(line.split(",")[0]) for line in lines])
        return Poses(t_ns, t_ns / 1e9, values[:, :3], values[:, 3:7])
    values = np.array([[float(x) for x in line.split()] for line in lines])
    if values.shape[1] == 12:  # KITTI
        T = values.reshape(-1, 3, 4)
        return Poses(np.arange(len(T)), np.arange(len(T)) * 1e-9, T[:, :, 3], quat_wxyz_from_matrix(T[:, :, :3]))
    t_ns = np.array([parse_decimal_seconds(line.split()[0]) for line in lines])
    return Poses(t_ns, values[:, 0], values[:, 1:4], quat_wxyz_from_xyzw(values[:, 4:8]))


def synchronised(truth: Poses, estimate: Poses, max_gap_s: float) -> tuple[Poses, Poses]:
    """Pair the poses as evo does: by doubles, whose rounding decides who is nearest where two are equally near.

    Ours must be as many, and as near.
    """
    from evo.core.sync import matching_time_indices

    kept, rows = matching_time_indices(estimate.t_s, truth.t_s, max_gap_s)
    nearest = nearest_rows(truth.t_ns, estimate.t_ns)
    gap_ns = np.abs(truth.t_ns[nearest] - estimate.t_ns)
    np.testing.assert_array_equal(np.flatnonzero(gap_ns <= max_gap_s * 1e9), kept)
    np.testing.assert_allclose(gap_ns[kept], np.abs(truth.t_ns[rows] - estimate.t_ns[kept]), atol=500)
    return truth[rows], estimate[kept]


def assert_same(errors: Array, theirs: dict[str, Any], tolerance: float = 1e-9) -> None:
    ours = Statistics.of(errors)
    assert len(errors) == theirs["n"]
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, name) == pytest.approx(theirs[name], rel=AGREEMENT, abs=tolerance), name


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_agrees_with_evo(seed: int) -> None:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    rng, n = np.random.default_rng(seed), 120
    p, R = np.cumsum(rng.normal(size=(n, 3)), axis=0), exp_so3(np.cumsum(0.2 * rng.normal(size=(n, 3)), axis=0))
    turn, noise = exp_so3(rng.normal(size=3)), exp_so3(0.05 * rng.normal(size=(n, 3)))
    p_estimate = 0.9 * (p + 0.1 * rng.normal(size=(n, 3))) @ turn.T + 5.0
    q, q_estimate = quat_wxyz_from_matrix(R), quat_wxyz_from_matrix(turn @ R @ noise)

    def theirs(scale: bool, metric: Any) -> Any:
        reference = PoseTrajectory3D(p, q, np.arange(n) * 0.1)
        estimate = PoseTrajectory3D(p_estimate.copy(), q_estimate.copy(), np.arange(n) * 0.1)
        estimate.align(reference, correct_scale=scale)
        metric.process_data((reference, estimate))
        return metric.error

    relations = metrics.PoseRelation
    for mode, scale in (("se3", False), ("sim3", True)):
        motion = align(p, p_estimate, mode)  # type: ignore[arg-type]
        aligned = motion.positions(p_estimate), motion.orientations(q_estimate)
        ape = theirs(scale, metrics.APE(relations.translation_part))
        np.testing.assert_allclose(translation_errors_m(p, aligned[0]), ape, rtol=1e-7)
        ape = theirs(scale, metrics.APE(relations.rotation_angle_rad))
        np.testing.assert_allclose(rotation_errors_rad(q, aligned[1]), ape, atol=1e-7)
        pairs = np.arange(n - 10), np.arange(10, n)
        metres, radians = relative_errors(p, q, *aligned, pairs)
        by_ten = {"delta": 10, "delta_unit": metrics.Unit.frames, "all_pairs": True}
        np.testing.assert_allclose(metres, theirs(scale, metrics.RPE(relations.translation_part, **by_ten)), rtol=1e-7)
        rpe = theirs(scale, metrics.RPE(relations.rotation_angle_rad, **by_ten))
        np.testing.assert_allclose(radians, rpe, atol=1e-7)
        by_way = {"delta": 5.0, "delta_unit": metrics.Unit.meters, "all_pairs": True, "pairs_from_reference": True}
        metres, _ = relative_errors(p, q, *aligned, pairs_after_distance(p, 5.0))
        np.testing.assert_allclose(metres, theirs(scale, metrics.RPE(relations.translation_part, **by_way)), rtol=1e-7)


APE_COMMANDS: list[tuple[str, AlignmentMode]] = [
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt", "none"),
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a", "se3"),
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a -s", "sim3"),
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a -r angle_deg", "se3"),
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a --sync_method interpolation", "se3"),
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a --t_max_diff 0.005", "se3"),
    ("tum fr2_desk_groundtruth.txt fr2_desk_ORB_kf_mono.txt -a -s", "sim3"),
    ("tum freiburg1_xyz-groundtruth.txt freiburg1_xyz-rgbdslam.txt -a", "se3"),
    ("tum freiburg1_xyz-groundtruth.txt freiburg1_xyz-ORB_kf_mono.txt -a -s", "sim3"),
    ("euroc V102_groundtruth.csv V102.txt", "none"),
    ("euroc V102_groundtruth.csv V102.txt -a", "se3"),
    ("euroc V102_groundtruth.csv V102.txt -a -s", "sim3"),
    ("euroc V102_groundtruth.csv V102.txt -a -r angle_deg", "se3"),
    ("kitti KITTI_00_gt.txt KITTI_00_ORB.txt", "none"),
    ("kitti KITTI_00_gt.txt KITTI_00_ORB.txt -a", "se3"),
    ("kitti KITTI_00_gt.txt KITTI_00_ORB.txt -a -s", "sim3"),
    ("kitti KITTI_00_gt.txt KITTI_00_ORB.txt -a -r angle_deg", "se3"),
]
RPE_COMMANDS = [
    "tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -d 1 -u f",
    "tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -d 1 -u f -r angle_deg",
    "tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -d 30 -u f --all_pairs",
    "tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -d 1 -u m --all_pairs --pairs_from_reference",
    "tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -d 1 -u m --all_pairs --pairs_from_reference -r angle_deg",
    "tum freiburg1_xyz-groundtruth.txt freiburg1_xyz-rgbdslam.txt -d 1 -u f",
    "euroc V102_groundtruth.csv V102.txt -d 1 -u f",
    "euroc V102_groundtruth.csv V102.txt -d 10 -u f --all_pairs",
    "euroc V102_groundtruth.csv V102.txt -d 1 -u m --all_pairs --pairs_from_reference",
    "kitti KITTI_00_gt.txt KITTI_00_ORB.txt -d 1 -u f",
    "kitti KITTI_00_gt.txt KITTI_00_ORB.txt -d 1 -u f -r angle_deg",
    "kitti KITTI_00_gt.txt KITTI_00_ORB.txt -d 100 -u m --all_pairs --pairs_from_reference",
]


def published(data_folder: Path, command: str) -> tuple[dict[str, Any], Poses, Poses]:
    """Return evo's figures for a command, and the poses that it compared."""
    rows = json.loads((data_folder / "trajectories" / "evo_1.38.1_expected.json").read_text())
    theirs = next(row for row in rows if row["cmd"] == command)
    names = command.split()[2:4]
    truth, estimate = (load(data_folder / "trajectories" / "evo" / name) for name in names)
    if "kitti" in command:
        return theirs, truth, estimate
    if "interpolation" in command:
        first = np.flatnonzero(np.diff(truth.t_ns, prepend=truth.t_ns[0] - 1) > 0)
        truth = truth[first]
        _, estimate = synchronised(truth, estimate, 0.01)
        true, kept = interpolate(Trajectory(truth.t_ns, truth.p, truth.quat_wxyz), estimate.t_ns, max_gap_s=20.0)
        return theirs, Poses(true.t_ns, estimate.t_s[kept], true.p_world_imu, true.quat_wxyz), estimate[kept]
    return theirs, *synchronised(truth, estimate, 0.005 if "0.005" in command else 0.01)


@pytest.mark.parametrize(("command", "mode"), APE_COMMANDS)
def test_agrees_with_published_absolute_errors(data_folder: Path, command: str, mode: AlignmentMode) -> None:
    theirs, truth, estimate = published(data_folder, f"evo_ape {command}")
    motion = align(truth.p, estimate.p, mode)
    if "angle_deg" in command:
        assert_same(np.degrees(rotation_errors_rad(truth.quat_wxyz, motion.orientations(estimate.quat_wxyz))), theirs)
    else:
        assert_same(translation_errors_m(truth.p, motion.positions(estimate.p)), theirs)
    if theirs["sim3"] is not None and "kitti" not in command:
        T = np.array(theirs["sim3"])
        np.testing.assert_allclose(motion.scale * motion.R_truth_estimate, T[:3, :3], atol=AGREEMENT)
        np.testing.assert_allclose(motion.t_m, T[:3, 3], atol=1e-5)


@pytest.mark.parametrize("command", RPE_COMMANDS)
def test_agrees_with_published_relative_errors(data_folder: Path, command: str) -> None:
    theirs, truth, estimate = published(data_folder, f"evo_rpe {command}")
    delta = int(command.split("-d ")[1].split(maxsplit=1)[0])
    n = len(truth.t_ns)
    pairs = (np.arange(n - delta), np.arange(delta, n)) if "-u f" in command else pairs_after_distance(truth.p, delta)
    metres, radians = relative_errors(truth.p, truth.quat_wxyz, estimate.p, estimate.quat_wxyz, pairs)
    # KITTI's matrices have seven digits and are no rotations beyond them; evo takes them as they are, 100 m far.
    assert_same(np.degrees(radians) if "angle_deg" in command else metres, theirs, 1e-5 if "kitti" in command else 1e-9)


def test_agrees_with_the_toolbox_for_visual_inertial_odometry(data_folder: Path) -> None:
    """Yaw alignment too, which evo lacks."""
    rows = json.loads((data_folder / "trajectories" / "rpg_expected.json").read_text())
    modes: dict[str, AlignmentMode] = {"posyaw": "yaw", "se3": "se3", "sim3": "sim3", "none": "none"}
    compared = 0
    for theirs in (row for row in rows if row["n_align"] == -1):
        folder = data_folder / "trajectories" / "rpg"
        name = "stamped_ba_estimate" if theirs["alg"] == "vislam_ba" else "stamped_traj_estimate"
        truth = load(folder / "vislam_ba" / theirs["seq"] / "stamped_groundtruth.txt")
        estimate = load(folder / theirs["alg"] / theirs["seq"] / f"{name}{theirs['run']}.txt")
        truth, estimate = synchronised(truth, estimate, 0.02)
        motion = align(truth.p, estimate.p, modes[theirs["align"]])
        figures = theirs["abs_trans"] | {"n": theirs["n"]}
        assert_same(translation_errors_m(truth.p, motion.positions(estimate.p)), figures)
        compared += 1
    assert compared > 25


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("sequence", ["V1_02", "MH_04"])
@pytest.mark.parametrize("mode", ["yaw", "se3", "sim3"])
def test_agrees_with_an_independent_script(
    data_folder: Path, sequence: str, mode: Literal["yaw", "se3", "sim3"]
) -> None:
    script = data_folder.parent / "tools" / "score.py"
    if not script.exists():
        pytest.skip(f"{script} is not there")
    spec = importlib.util.spec_from_file_location("independent_score", script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    estimate = data_folder / "trajectories" / "rpg" / "vislam_rp" / sequence / "stamped_traj_estimate0.txt"
    truth = data_folder / "euroc" / sequence / "groundtruth.csv"
    theirs = module.evaluate(str(estimate), str(truth))
    ours = score(read_trajectory(truth), read_tum(estimate), alignment=mode)
    assert (ours.n_poses, ours.rpe_pairs) == (theirs["n"], theirs["rpe_n"])
    assert ours.ate_m.rmse == pytest.approx(theirs[f"ate_{mode}"], abs=AGREEMENT)
    assert ours.ate_m.max == pytest.approx(theirs[f"max_{mode}"], abs=AGREEMENT)
    assert (ours.first_s, ours.last_s) == pytest.approx((theirs["first_s"], theirs["last_s"]), abs=AGREEMENT)
    assert ours.path_m == pytest.approx(theirs["path_m"], abs=1e-5)
    assert ours.scale_error_percent is not None and ours.rpe_m is not None and ours.rpe_deg is not None
    assert 1.0 / (1.0 + ours.scale_error_percent / 100.0) == pytest.approx(theirs["scale"], abs=AGREEMENT)
    if mode != "sim3":
        assert ours.rpe_m.rmse == pytest.approx(theirs["rpe_m"], abs=AGREEMENT)
    assert ours.rpe_deg.rmse == pytest.approx(theirs["rpe_deg"], abs=1e-5)
    if mode == "se3":
        assert ours.ate_deg.rmse == pytest.approx(theirs["rot_deg_se3"], abs=1e-5)
