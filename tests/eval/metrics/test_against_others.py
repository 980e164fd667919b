"""Agreement with other programs: evo always, and published results if the data sets are present."""

import importlib.util
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.cli import main
from dronevio.eval.metrics import (
    AlignmentMode,
    PairRule,
    ScoreOptions,
    align,
    pairs_after_distance,
    relative_errors,
    rotation_errors_rad,
    score,
    translation_errors_m,
)
from dronevio.eval.metrics.association import evo_pairs
from dronevio.eval.metrics.pairs import Unit
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix

AGREEMENT = 1e-6
"""Largest difference from the results of other programs."""
UNITS: tuple[Unit, ...] = ("frames", "m", "deg")
CHECKOUT = Path(__file__).resolve().parents[3]


def module_at(path: Path) -> Any:
    """Return a module that belongs to no package."""
    if not path.exists():
        pytest.skip(f"{path} does not exist")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look up their module there
    spec.loader.exec_module(module)
    return module


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_absolute_and_relative_errors_agree_with_evo(seed: int) -> None:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    rng, n = np.random.default_rng(seed), 120
    p, R = np.cumsum(rng.normal(size=(n, 3)), axis=0), exp_so3(np.cumsum(0.2 * rng.normal(size=(n, 3)), axis=0))
    R_estimate_world, noise = exp_so3(rng.normal(size=3)), exp_so3(0.05 * rng.normal(size=(n, 3)))
    p_estimate = 0.9 * (p + 0.1 * rng.normal(size=(n, 3))) @ R_estimate_world.T + 5.0
    q, q_estimate = quat_wxyz_from_matrix(R), quat_wxyz_from_matrix(R_estimate_world @ R @ noise)

    def evo_errors(scale: bool, metric: Any) -> Any:
        reference = PoseTrajectory3D(p, q, np.arange(n) * 0.1)
        estimate = PoseTrajectory3D(p_estimate.copy(), q_estimate.copy(), np.arange(n) * 0.1)
        estimate.align(reference, correct_scale=scale)
        metric.process_data((reference, estimate))
        return metric.error

    relations = metrics.PoseRelation
    modes: list[tuple[AlignmentMode, bool]] = [("se3", False), ("sim3", True)]
    for mode, scale in modes:
        motion = align(p, p_estimate, mode)
        aligned = motion.positions(p_estimate), motion.orientations(q_estimate)
        ape = evo_errors(scale, metrics.APE(relations.translation_part))
        np.testing.assert_allclose(translation_errors_m(p, aligned[0]), ape, rtol=1e-7)
        ape = evo_errors(scale, metrics.APE(relations.rotation_angle_rad))
        np.testing.assert_allclose(rotation_errors_rad(q, aligned[1]), ape, atol=1e-7)
        pairs = np.arange(n - 10), np.arange(10, n)
        metres, radians = relative_errors(p, q, *aligned, pairs)
        ten_frames = {"delta": 10, "delta_unit": metrics.Unit.frames, "all_pairs": True}
        rpe = evo_errors(scale, metrics.RPE(relations.translation_part, **ten_frames))
        np.testing.assert_allclose(metres, rpe, rtol=1e-7)
        rpe = evo_errors(scale, metrics.RPE(relations.rotation_angle_rad, **ten_frames))
        np.testing.assert_allclose(radians, rpe, atol=1e-7)
        five_m = {"delta": 5.0, "delta_unit": metrics.Unit.meters, "all_pairs": True, "pairs_from_reference": True}
        metres, _ = relative_errors(p, q, *aligned, pairs_after_distance(p, 5.0))
        rpe = evo_errors(scale, metrics.RPE(relations.translation_part, **five_m))
        np.testing.assert_allclose(metres, rpe, rtol=1e-7)


def test_published_results_are_reproduced(data_folder: Path) -> None:
    """All statistics of evo, the rpg toolbox, a KITTI evaluation and TUM's scripts agree, with equal counts."""
    parity = module_at(CHECKOUT / "benchmarks" / "parity.py")
    rows = parity.all_rows(data_folder / "trajectories")
    assert [row for row in rows if row.verdict == "differs"] == []
    reasons = Counter(row.reason.removeprefix("KITTI_00_SPTAM.txt ") for row in rows if row.reason)
    assert reasons.pop("is not in the folder", 0) in (0, 6)  # KITTI_00_SPTAM.txt is optional
    assert reasons == {"the sum of metres and radians is not computed": 1}
    same = Counter(row.tool for row in rows if row.verdict == "same")
    assert same["evo_ape"] >= 28 and same["evo_rpe"] == 25
    assert same["rpg toolbox"] == 42 and same["kitti-odom-eval"] >= 20
    assert same["TUM evaluate_ate"] == same["TUM evaluate_rpe"] == 1
    assert sum(row.figures for row in rows) > 5_700


COMMANDS = [
    ("evo_ape euroc V102_groundtruth.csv V102.txt", "--alignment none", "ate_m"),
    ("evo_ape euroc V102_groundtruth.csv V102.txt -a", "--alignment se3", "ate_m"),
    ("evo_ape euroc V102_groundtruth.csv V102.txt -a -s", "--alignment sim3", "ate_m"),
    ("evo_ape euroc V102_groundtruth.csv V102.txt -a -r angle_deg", "--alignment se3", "ate_deg"),
    ("evo_ape euroc V102_groundtruth.csv V102.txt --align_origin", "--alignment first", "ate_m"),
    ("evo_rpe euroc V102_groundtruth.csv V102.txt -d 1 -u m", "--rpe-pairs consecutive --rpe-source estimate", "rpe_m"),
    ("evo_rpe euroc V102_groundtruth.csv V102.txt -d 1 -u m --all_pairs --pairs_from_reference", "", "rpe_m"),
    (
        "evo_ape tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a --n_to_align 500",
        "--alignment se3 --align-poses 500",
        "ate_m",
    ),
    (
        "evo_ape tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a --t_offset 0.05",
        "--alignment se3 --time-offset-s 0.05",
        "ate_m",
    ),
    (
        "evo_ape tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -a --t_max_diff 0.005",
        "--alignment se3 --max-gap-s 0.005",
        "ate_m",
    ),
    (
        "evo_rpe tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -d 10 -u d --all_pairs --pairs_from_reference"
        " -r angle_deg",
        "--rpe-delta 10 --rpe-unit deg",
        "rpe_deg",
    ),
    ("evo_ape kitti KITTI_00_gt.txt KITTI_00_ORB.txt -a", "--alignment se3", "ate_m"),
    ("evo_rpe kitti KITTI_00_gt.txt KITTI_00_ORB.txt -d 1 -u f", "--rpe-unit frames", "rpe_m"),
]


@pytest.mark.parametrize(("command", "options", "figure"), COMMANDS)
def test_the_command_reproduces_results_of_evo(
    data_folder: Path, command: str, options: str, figure: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = data_folder / "trajectories"
    rows = json.loads((folder / "evo_1.38.1_expected.json").read_text())
    expected = next(row for row in rows if row["cmd"] == command)
    files = [str(folder / "evo" / name) for name in command.split()[2:4]]
    common = ["--association", "evo", "--repeated", "keep", "--json"]
    unit = ["--rpe-unit", "m"] if "--rpe-unit" not in options else []
    assert main(["evaluate", *files, *options.split(), *common, *unit]) == 0
    found = json.loads(capsys.readouterr().out)[figure]
    assert found["n"] == expected["n"]
    assert found["rmse"] == pytest.approx(expected["rmse"], rel=AGREEMENT)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 60), st.sampled_from(UNITS), st.booleans())
def test_pairs_agree_with_evo(seed: int, n: int, unit: Unit, all_pairs: bool) -> None:
    from evo.core import filters, metrics

    rng = np.random.default_rng(seed)
    p = np.cumsum(rng.normal(size=(n, 3)) * (rng.random((n, 1)) < 0.8), axis=0)  # some steps are zero
    R = exp_so3(np.cumsum(0.1 * rng.normal(size=(n, 3)), axis=0))
    poses = [np.block([[R[i], p[i][:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) for i in range(n)]
    delta = int(rng.integers(1, 8)) if unit == "frames" else float(rng.uniform(1.0, 20.0))
    units = {"frames": metrics.Unit.frames, "m": metrics.Unit.meters, "deg": metrics.Unit.degrees}
    try:
        expected = metrics.id_pairs_from_delta(poses, delta, units[unit], 0.1, all_pairs)
    except filters.FilterException:
        expected = []
    rule = PairRule(delta, unit, "all" if all_pairs else "consecutive")
    found = rule.select(np.arange(n), p, quat_wxyz_from_matrix(R))
    assert list(zip(*(rows.tolist() for rows in found), strict=True)) == expected


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 62_500_000]))
def test_the_association_evo_agrees_with_evo(seed: int, grid_ns: int) -> None:
    """Random stamps, and stamps on a grid that is exact in floating point, where many repeat or are equally near."""
    from evo.core import sync
    from evo.core.trajectory import PoseTrajectory3D

    rng, span = np.random.default_rng(seed), max(40, 10**9 // grid_ns)
    start_ns = 1403715273262142976 if grid_ns == 1 else 0
    stamps = [np.sort(start_ns + grid_ns * rng.integers(0, span, rng.integers(3, 40))) for _ in range(2)]
    max_gap_s = 0.03 if grid_ns == 1 else 0.2
    trajectories = [
        PoseTrajectory3D(np.zeros((len(t), 3)), np.tile([1.0, 0, 0, 0], (len(t), 1)), t / 1e9) for t in stamps
    ]
    for trajectory in trajectories:
        trajectory.positions_xyz[:, 0] = np.arange(len(trajectory.timestamps))
    found = evo_pairs(stamps[0], stamps[1], max_gap_s)
    try:
        expected = sync.associate_trajectories(*trajectories, max_diff=max_gap_s)
    except sync.SyncException:
        assert len(found[0]) == 0
        return
    for rows, trajectory in zip(found, expected, strict=True):
        np.testing.assert_array_equal(rows, trajectory.positions_xyz[:, 0])


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("sequence", ["V1_02", "MH_04"])
@pytest.mark.parametrize("mode", ["yaw", "se3", "sim3"])
def test_scores_agree_with_an_independent_script(data_folder: Path, sequence: str, mode: AlignmentMode) -> None:
    module = module_at(data_folder.parent / "tools" / "score.py")
    estimate = data_folder / "trajectories" / "rpg" / "vislam_rp" / sequence / "stamped_traj_estimate0.txt"
    truth = data_folder / "euroc" / sequence / "groundtruth.csv"
    expected = module.evaluate(str(estimate), str(truth))
    found = score(read_trajectory_file(truth), read_tum(estimate), options=ScoreOptions(mode))
    assert (found.n_poses, found.rpe_pairs) == (expected["n"], expected["rpe_n"])
    assert found.ate_m.rmse == pytest.approx(expected[f"ate_{mode}"], abs=AGREEMENT)
    assert found.ate_m.max == pytest.approx(expected[f"max_{mode}"], abs=AGREEMENT)
    assert (found.first_pose_s, found.last_pose_s) == pytest.approx(
        (expected["first_s"], expected["last_s"]), abs=AGREEMENT
    )
    assert found.path_m == pytest.approx(expected["path_m"], abs=1e-5)
    assert found.scale_error_percent is not None and found.rpe_m is not None and found.rpe_deg is not None
    assert 1.0 / (1.0 + found.scale_error_percent / 100.0) == pytest.approx(expected["scale"], abs=AGREEMENT)
    if mode != "sim3":
        assert found.rpe_m.rmse == pytest.approx(expected["rpe_m"], abs=AGREEMENT)
    assert found.rpe_deg.rmse == pytest.approx(expected["rpe_deg"], abs=1e-5)
    if mode == "se3":
        assert found.ate_deg.rmse == pytest.approx(expected["rot_deg_se3"], abs=1e-5)
