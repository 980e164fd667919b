"""Columns of a row that are computed from an estimate and the ground truth."""

import math
from typing import Any

from dronevio.eval.metrics.loops import FlightRevisits, loop_quality, rmse_after_revisit_m
from dronevio.eval.metrics.scores import ScoredTrajectory, Scores, score_trajectory
from dronevio.eval.metrics.start_errors import largest_step_error_m, start_errors
from dronevio.eval.run import EstimatorRun
from dronevio.models.imu import Times
from dronevio.models.rig import RigCamera
from dronevio.models.state import Trajectory


def scored_columns(truth: Trajectory, scored: ScoredTrajectory, frame_times_ns: Times) -> dict[str, Any]:
    """Return the columns that are computed from an estimate and the ground truth.

    Args:
        truth: Ground truth of the IMU.
        scored: Estimated poses with their errors.
        frame_times_ns: (M,) Time stamps of all frames [ns].
    """
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


def revisit_columns(scored: ScoredTrajectory, revisits: FlightRevisits, first_frame_ns: int) -> dict[str, Any]:
    """Return the columns about the first revisit of a flight in a known world.

    Args:
        scored: Estimated poses with their errors.
        revisits: The revisits of the flight.
        first_frame_ns: Time of the first frame [ns].
    """
    first_ns = revisits.first_ns
    return {
        "first_revisit_s": None if first_ns is None else 1e-9 * (first_ns - first_frame_ns),
        "rmse_after_revisit_m": rmse_after_revisit_m(scored, first_ns),
    }


def map_columns(
    truth: Trajectory,
    run: EstimatorRun,
    frame_times_ns: Times,
    revisits: FlightRevisits | None,
    camera: RigCamera,
) -> dict[str, Any]:
    """Return the columns of an estimator with a map: its odometry, its final path, and its loops.

    Args:
        truth: Ground truth of the IMU.
        run: The run with the final map; without one there are no columns.
        frame_times_ns: (M,) Time stamps of all frames [ns].
        revisits: The revisits of the flight, with the true views of the keyframes of the map; None if the world is not
            known.
        camera: The first camera with its mounting.

    Raises:
        EvaluationError: Truth and poses have fewer than three poses in common, or cannot be aligned.
    """
    if run.map is None:
        return {}
    final = score_trajectory(truth, run.final_trajectory, frame_times_ns)
    columns = {"final_ate_m": final.scores.ate_m.rmse, "loops": len(run.map.closed)}
    if revisits is None:
        return columns
    quality = loop_quality(run.map, revisits, camera)
    odometry = score_trajectory(truth, run.trajectory, frame_times_ns)
    return {
        **columns,
        "wrong_loops": quality.wrong,
        "recall_percent": None if math.isnan(quality.recall) else 100.0 * quality.recall,
        "odometry_after_revisit_m": rmse_after_revisit_m(odometry, revisits.first_ns),
        "final_after_revisit_m": rmse_after_revisit_m(final, revisits.first_ns),
    }
