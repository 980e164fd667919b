"""Evaluation of trajectories in memory and in files."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dronevio as dv

RATE_HZ = 200


@pytest.fixture
def truth() -> dv.Trajectory:
    """Four seconds on a circle of 1 m, at 200 Hz."""
    t = np.arange(4 * RATE_HZ) / RATE_HZ
    positions = np.column_stack([np.cos(t), np.sin(t), np.zeros_like(t)])
    return dv.Trajectory(
        1_000_000_000 + np.arange(len(t)) * 5_000_000, positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    )


@pytest.fixture
def estimate(truth: dv.Trajectory) -> dv.Trajectory:
    """Every tenth pose of the truth, moved by 3 m, and alternately 0.1 m too high and too low."""
    rows = np.arange(0, len(truth), 10)
    height = np.where(np.arange(len(rows)) % 2, 0.1, -0.1)
    error = np.column_stack([np.full(len(rows), 3.0), np.zeros(len(rows)), height])
    return dv.Trajectory(truth.t_ns[rows], truth.p_world_imu[rows] + error, truth.quat_wxyz[rows])


def test_ate_of_trajectories_with_other_time_stamps(truth: dv.Trajectory, estimate: dv.Trajectory) -> None:
    assert dv.ate(truth, estimate).rmse == pytest.approx(0.1, rel=1e-3)
    assert dv.ate(truth, estimate, "none").rmse == pytest.approx(np.hypot(3.0, 0.1), rel=1e-6)
    scores = dv.evaluate(truth, estimate).scores
    assert dv.ate(truth, estimate) == scores.ate_m
    assert dv.ate(truth, estimate, "se3") == dv.evaluate(truth, estimate, "se3").scores.ate_m


def test_files_are_evaluated_in_one_line(truth: dv.Trajectory, estimate: dv.Trajectory, tmp_path: Path) -> None:
    dv.write_tum(tmp_path / "gt.tum", truth)
    dv.write_tum(tmp_path / "est.tum", estimate)
    code = (
        "import sys, dronevio as dv; print(dv.evaluate('gt.tum', 'est.tum').scores.ate_m.rmse);"
        "print(dv.ate('gt.tum', 'est.tum').rmse); print({'mujoco', 'gtsam', 'cv2', 'matplotlib'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code]
    root = str(Path(dv.__file__).parents[1])
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env={"PYTHONPATH": root}, check=False)
    evaluated, ate, heavy = ended.stdout.splitlines()
    assert float(evaluated) == float(ate) == pytest.approx(0.1, rel=1e-3)
    assert heavy == "set()"


def test_trajectories_without_common_time_are_refused(truth: dv.Trajectory, estimate: dv.Trajectory) -> None:
    later = dv.Trajectory(estimate.t_ns + 10**12, estimate.p_world_imu, estimate.quat_wxyz)
    with pytest.raises(dv.DronevioError, match=r"overlap|in common"):
        dv.ate(truth, later)
