"""Rows of a benchmark: each column holds the score of its name."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.eval.benchmark.metrics import score_columns
from dronevio.eval.benchmark.rows import read_results
from dronevio.eval.metrics import LengthErrors, Scores, Statistics, score
from dronevio.models.state import Trajectory
from tests.rows import changed, row_of


def statistics(rmse: float) -> Statistics:
    """Return statistics of distinct values, which also differ from those of other integer arguments."""
    return Statistics(rmse, rmse + 0.1, rmse + 0.2, rmse + 0.3, rmse + 0.4, rmse + 0.5, n=7)


def distinct_errors(first: float) -> LengthErrors:
    """Return distinct errors over a length, which is the first of seven consecutive numbers."""
    return LengthErrors(first, *(statistics(first + k) for k in range(1, 7)))


@pytest.fixture
def scores() -> Scores:
    """Return scores of distinct values."""
    p = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    square = Trajectory(10**9 * np.arange(4), p, np.tile([1.0, 0, 0, 0], (4, 1)))
    return replace(
        score(square, square),
        first_pose_s=1.0,
        last_pose_s=2.0,
        path_m=3.0,
        ate_m=statistics(4.0),
        ate_deg=statistics(5.0),
        rpe_m=statistics(6.0),
        rpe_deg=statistics(7.0),
        lengths=(distinct_errors(10.0), distinct_errors(20.0)),
        drift_percent=30.0,
        scale_error_percent=31.0,
        velocity_m_s=statistics(32.0),
        gyro_bias_rad_s=statistics(33.0),
        accel_bias_m_s2=statistics(34.0),
        coverage_percent=35.0,
        initialization_s=36.0,
        nees_position=37.0,
        nees_orientation=38.0,
        nees_velocity=43.0,
        longest_gap_s=44.0,
        nees_position_inside_percent=39.0,
        nees_orientation_inside_percent=40.0,
        position_beyond_3_sigma_percent=41.0,
        orientation_beyond_3_sigma_percent=42.0,
    )


def test_columns_hold_the_scores_of_their_names(scores: Scores) -> None:
    assert score_columns(scores) == {
        "coverage_percent": 35.0,
        "first_pose_s": 1.0,
        "path_m": 3.0,
        "ate_m": 4.0,
        "ate_deg": 5.0,
        "rpe_m": 6.0,
        "rpe_deg": 7.0,
        "scale_error_percent": 31.0,
        "drift_percent": 30.0,
        "nees_position": 37.0,
        "nees_orientation": 38.0,
        "nees_velocity": 43.0,
        "max_error_m": 4.3,
        "longest_gap_s": 44.0,
        "start_s": 36.0,
        "position_beyond_3_sigma_percent": 41.0,
        "velocity_m_s": 32.0,
        "gyro_bias_rad_s": 33.0,
        "accel_bias_m_s2": 34.0,
        "sub_trajectory_m": (10.0, 20.0),
        "sub_trajectory_rpe_m": (11.0, 21.0),
        "sub_trajectory_rpe_deg": (13.0, 23.0),
    }
    missing = score_columns(replace(scores, rpe_m=None, rpe_deg=None, velocity_m_s=None, lengths=()))
    assert {name for name, value in missing.items() if value is None} == {"rpe_m", "rpe_deg", "velocity_m_s"}
    assert missing["sub_trajectory_m"] == ()


def test_a_report_is_read_as_a_row(scores: Scores, tmp_path: Path) -> None:
    timing = {"cpu_ms_mean": 12.0, "cpu_ms_p99": 13.0, "real_time_factor": 14.0}
    report: dict[str, Any] = {
        "scores": asdict(replace(scores, rpe_deg=None)),
        "timing": timing,
        "configuration": {"scenario": {"name": "room-v0", "world": "room", "seed": 3}, "estimator": {}},
        "versions": {"dronevio": "1", "numpy": "2"},
        "flight": {"duration_s": 15.0},
    }
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    [row] = read_results(tmp_path)
    assert (row.identity, row.world, row.status) == (("room-v0", 3, "vio"), "room", "ok")
    assert row.versions == "dronevio 1, numpy 2"
    expected = {**score_columns(scores), **timing, "rpe_deg": None, "duration_s": 15.0}
    identifying = {"scenario", "world", "seed", "estimator", "config_hash", "versions", "status"}
    empty = row_of("", "", None, "").columns
    assert {name: value for name, value in row.columns.items() if name not in identifying} == {
        name: expected.get(name, value) for name, value in empty.items() if name not in identifying
    }
    del report["scores"]["nees_velocity"]  # of a version without this metric
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    [older] = read_results(tmp_path)
    assert older["nees_velocity"] is None and older["nees_position"] == 37.0


@pytest.mark.parametrize(
    ("values", "diverged"),
    [
        ({"ate_m": 0.2, "path_m": 20.0, "coverage_percent": 99.0}, False),  # 1 % of the path
        ({"ate_m": 0.21, "path_m": 20.0, "coverage_percent": 100.0}, True),
        ({"ate_m": 0.1, "path_m": 20.0, "coverage_percent": 98.9}, True),
        ({"ate_m": 0.01, "path_m": 0.0, "coverage_percent": 100.0}, False),  # at rest
        ({"ate_m": 9.0, "path_m": 20.0, "status": "failed"}, False),  # counts as failed already
    ],
)
def test_a_run_diverges_by_coverage_or_error(values: dict[str, Any], diverged: bool) -> None:
    row = changed(row_of("s", "", 0, "vio", "", "", "ok"), **values)
    assert row.diverged == diverged


def test_an_initialization_is_accurate_by_velocity() -> None:
    row = row_of("s", "", 0, "vio", "", "", "ok")
    assert not row.started_accurately
    fast = changed(row, start_velocity_error_m_s=0.1, start_speed_m_s=2.0)
    assert fast.started_accurately and not changed(fast, start_velocity_error_m_s=0.101).started_accurately
    slow = changed(row, start_velocity_error_m_s=0.03, start_speed_m_s=0.1)
    assert slow.started_accurately and not changed(slow, start_velocity_error_m_s=0.031).started_accurately
