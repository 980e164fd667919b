"""Columns of a row that are computed from an estimate and the ground truth."""

from typing import Any

from dronevio.eval.metrics.scores import Scores, score_trajectory
from dronevio.eval.metrics.start_errors import largest_step_error_m, start_errors
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory


def scored_columns(truth: Trajectory, estimate: Trajectory, frame_times_ns: Times) -> dict[str, Any]:
    """Return the columns that are computed from an estimate and the ground truth.

    Args:
        truth: Ground truth of the IMU.
        estimate: Estimated poses.
        frame_times_ns: (M,) Time stamps of all frames [ns].

    Raises:
        EvaluationError: Truth and estimate have fewer than three poses in common, or cannot be aligned.
    """
    scored = score_trajectory(truth, estimate, frame_times_ns)
    start = start_errors(truth, scored, int(frame_times_ns[0]))
    return {
        **score_columns(scored.scores),
        "step_error_m": largest_step_error_m(scored),
        "start_acceleration_m_s2": start.acceleration_m_s2,
        "start_velocity_error_m_s": start.velocity_m_s,
        "start_speed_m_s": start.speed_m_s,
        "start_scale_error_percent": start.scale_percent,
    }


def score_columns(scores: Scores) -> dict[str, Any]:
    """Return the columns that are computed from the scores of an estimate."""
    return {
        "coverage_percent": scores.coverage_percent,
        "first_pose_s": scores.first_pose_s,
        "path_m": scores.path_m,
        "ate_m": scores.ate_m.rmse,
        "max_error_m": scores.ate_m.max,
        "ate_deg": scores.ate_deg.rmse,
        "rpe_m": scores.rpe_m and scores.rpe_m.rmse,
        "rpe_deg": scores.rpe_deg and scores.rpe_deg.rmse,
        "scale_error_percent": scores.scale_error_percent,
        "drift_percent": scores.drift_percent,
        "nees_position": scores.nees_position,
        "nees_orientation": scores.nees_orientation,
        "nees_velocity": scores.nees_velocity,
        "position_beyond_3_sigma_percent": scores.position_beyond_3_sigma_percent,
        "velocity_m_s": scores.velocity_m_s and scores.velocity_m_s.rmse,
        "longest_gap_s": scores.longest_gap_s,
        "start_s": scores.initialization_s,
        "sub_trajectory_m": tuple(errors.length_m for errors in scores.lengths),
        "sub_trajectory_rpe_m": tuple(errors.translation_m.rmse for errors in scores.lengths),
        "sub_trajectory_rpe_deg": tuple(errors.rotation_deg.rmse for errors in scores.lengths),
    }
