"""Mutation testing: put known faults into the code, one at a time, and check that the tests named beside them fail.

A mutant is a fault that once passed all tests, or that would matter much if it did. Each is applied to a temporary copy
of the checkout, never to the working tree. Run all mutants, or some of them by name::

    .venv/bin/python scripts/mutants.py
    .venv/bin/python scripts/mutants.py covariance-sign-accel-bias-position
    .venv/bin/python scripts/mutants.py --list

The named tests are first run without any mutant, where they must pass. The exit status is 0 if every mutant is killed,
1 if one survives, and 2 if a mutant cannot be judged: it does not apply, or its tests fail without it.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 600.0
"""Time limit of a run of the tests [s]."""


@dataclass(frozen=True)
class Mutant:
    """A fault: a replacement of text in one file, and the tests that must notice it."""

    name: str
    """Short name, in lower case with hyphens."""
    description: str
    """What is wrong with the code once the fault is in, in one line."""
    file: str
    """File that is changed, relative to the checkout."""
    original: str
    """Text that is replaced. It occurs exactly once in the file."""
    mutated: str
    """Text that replaces it."""
    tests: tuple[str, ...]
    """Tests of which at least one must fail, as pytest takes them."""

    def apply(self, checkout: Path) -> None:
        """Change the file in a copy of the checkout.

        Raises:
            ValueError: The original text does not occur exactly once in the file, or the replacement changes nothing.
        """
        path = checkout / self.file
        text = path.read_text(encoding="utf-8")
        found = text.count(self.original)
        if found != 1 or self.original == self.mutated:
            raise ValueError(f"{self.name}: {found} occurrences in {self.file}; expected one, and a different text")
        path.write_text(text.replace(self.original, self.mutated), encoding="utf-8")


class Verdict(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    """A test failed, as it should."""
    SURVIVED = "survived"
    """All tests passed: they do not notice the fault."""
    INVALID = "invalid"
    """The tests could not be run with it, or took too long."""


ESTIMATOR = (
    Mutant(
        "covariance-sign-accel-bias-position",
        "Dead reckoning: sign of the Jacobian of the position by the accelerometer bias.",
        "estimator/imu/covariance.py",
        "-0.5 * t * t * R_world_imu",
        "0.5 * t * t * R_world_imu",
        ("tests/estimator/imu/test_jacobians.py::test_bias_columns_at_constant_rotation",),
    ),
    Mutant(
        "covariance-half-accel-bias-velocity",
        "Dead reckoning: the Jacobian of the velocity by the accelerometer bias is halved.",
        "estimator/imu/covariance.py",
        "-t * R_world_imu\n",
        "-0.5 * t * R_world_imu\n",
        ("tests/estimator/imu/test_jacobians.py::test_bias_columns_at_constant_rotation",),
    ),
    Mutant(
        "covariance-sign-gyro-bias-orientation",
        "Dead reckoning: sign of the Jacobian of the orientation by the gyroscope bias.",
        "estimator/imu/covariance.py",
        "dR.T, -t * eye",
        "dR.T, t * eye",
        ("tests/estimator/imu/test_jacobians.py::test_bias_columns_at_constant_rotation",),
    ),
    Mutant(
        "calibration-factor-sign-biases",
        "Calibration: sign of the Jacobian of the IMU factor by the biases.",
        "estimator/calibration/imu_factor.py",
        "J[:, 18:] = -self.J_bias",
        "J[:, 18:] = self.J_bias",
        ("tests/estimator/calibration/test_imu_factor.py::test_jacobian_is_the_derivative_of_the_residual",),
    ),
    Mutant(
        "calibration-factor-swapped-biases",
        "Calibration: the preintegration is asked at the biases of the wrong sensors.",
        "estimator/calibration/imu_factor.py",
        "ConstantBias(bias[3:], bias[:3])",
        "ConstantBias(bias[:3], bias[3:])",
        ("tests/estimator/calibration/test_imu_factor.py::test_measurement_agrees_with_direct_integration",),
    ),
    Mutant(
        "calibration-factor-half-biases",
        "Calibration: the Jacobian of the preintegration by the biases is halved.",
        "estimator/calibration/imu_factor.py",
        "dp_dv_step - dp_dv]) / _BIAS_STEP",
        "dp_dv_step - dp_dv]) / (2.0 * _BIAS_STEP)",
        ("tests/estimator/calibration/test_imu_factor.py::test_measurement_agrees_with_direct_integration",),
    ),
    Mutant(
        "fej-off-prior",
        "Smoother: the marginal prior has no linearization points of keyframes, so that current estimates are used.",
        "estimator/backend/marginal_prior.py",
        "        if k not in self.states:\n            return current\n",
        "        return current\n",
        ("tests/estimator/backend/test_observability.py::test_no_information_on_global_position_and_yaw",),
    ),
    Mutant(
        "fej-off-imu",
        "Smoother: IMU factors are linearized at the current estimates.",
        "estimator/backend/linear_system.py",
        "factor.linearize(values_first)",
        "factor.linearize(values)",
        ("tests/estimator/backend/test_observability.py::test_no_information_on_global_position_and_yaw",),
    ),
    Mutant(
        "fej-off-visual",
        "Smoother: observations are linearized at the current estimates.",
        "estimator/backend/window.py",
        "self._Ts_imu_cam, _visual_state(first, points), residual, weight",
        "self._Ts_imu_cam, current, residual, weight",
        ("tests/estimator/backend/test_observability.py::test_no_information_on_global_position_and_yaw",),
    ),
    Mutant(
        "fej-off-landmarks",
        "Smoother: observations of persistent landmarks are linearized at their current positions.",
        "estimator/backend/window.py",
        "self._Ts_imu_cam, _visual_state(first, points), residual, weight",
        "self._Ts_imu_cam, _visual_state(first, current.points), residual, weight",
        ("tests/estimator/backend/test_observability.py::test_no_information_on_global_position_and_yaw",),
    ),
    Mutant(
        "fej-moved-states",
        "Smoother: linearization points of keyframes move along with every marginalization.",
        "estimator/backend/marginal_prior.py",
        "first = {k: earlier.linearization_point(k, current) for k, current in states.items()}",
        "first = dict(states)",
        ("tests/estimator/backend/test_observability.py::test_no_information_on_global_position_and_yaw",),
    ),
    Mutant(
        "fej-moved-landmarks",
        "Smoother: linearization points of landmarks move along with every marginalization.",
        "estimator/backend/marginal_prior.py",
        "{i: earlier.points.get(i, current) for i, current in points.items()}",
        "points",
        ("tests/estimator/backend/test_observability.py::test_no_information_on_global_position_and_yaw",),
    ),
    Mutant(
        "variance-factor-one",
        "Smoother: observations that are noisier than assumed keep their weight.",
        "estimator/backend/weighting.py",
        "return max(1.0, float(np.median(squared)) / MEDIAN_CHI2_2DOF) if len(squared) > 0 else 1.0",
        "return 1.0",
        ("tests/estimator/backend/test_window.py::test_noisier_observations_weigh_less",),
    ),
    Mutant(
        "variance-factor-without-median",
        "Smoother: the median of squared residuals is not divided by that of the chi-squared distribution.",
        "estimator/backend/weighting.py",
        "float(np.median(squared)) / MEDIAN_CHI2_2DOF)",
        "float(np.median(squared)))",
        ("tests/estimator/backend/test_window.py::test_noisier_observations_weigh_less",),
    ),
    Mutant(
        "variance-factor-below-one",
        "Smoother: observations that happen to fit well weigh more than their noise lets them.",
        "estimator/backend/weighting.py",
        "max(1.0, float(np.median(squared)) / MEDIAN",
        "max(0.1, float(np.median(squared)) / MEDIAN",
        ("tests/estimator/backend/test_window.py::test_noisier_observations_weigh_less",),
    ),
    Mutant(
        "driver-waits-20-offsets",
        "Driver: a frame waits for twenty times the time offset.",
        "models/protocols.py",
        "max(rig.time_offset_s + 0.5",
        "max(20.0 * rig.time_offset_s + 0.5",
        ("tests/models/test_measurement_order.py",),
    ),
    Mutant(
        "driver-waits-10-readouts",
        "Driver: a frame waits for ten times the readout of a rolling shutter.",
        "models/protocols.py",
        "rig.time_offset_s + 0.5 * max(",
        "rig.time_offset_s + 5.0 * max(",
        ("tests/models/test_measurement_order.py",),
    ),
    Mutant(
        "driver-ignores-offset",
        "Driver: a frame does not wait for its exposure where the clocks differ.",
        "models/protocols.py",
        "max(rig.time_offset_s + 0.5",
        "max(0.5",
        ("tests/models/test_measurement_order.py",),
    ),
    Mutant(
        "driver-ignores-readout",
        "Driver: a frame does not wait for the last row of a rolling shutter.",
        "models/protocols.py",
        "max(rig.time_offset_s + 0.5 * max((camera.readout_s for camera in rig.cameras), default=0.0), 0.0)",
        "max(rig.time_offset_s, 0.0)",
        ("tests/models/test_measurement_order.py",),
    ),
)
"""Faults of the estimator and of the driver that feeds it."""

EVALUATION = (
    Mutant(
        "score-ate-in-radians",
        "Score: the absolute error of orientation is in radians.",
        "eval/metrics/scores.py",
        "ate_deg=Statistics.of(np.degrees(rotation_error_rad))",
        "ate_deg=Statistics.of(rotation_error_rad)",
        ("tests/eval/metrics/test_scores_by_hand.py::test_orientation_errors_are_in_degrees",),
    ),
    Mutant(
        "score-rpe-in-radians",
        "Score: the relative error of orientation is in radians.",
        "eval/metrics/scores.py",
        "rpe_deg=Statistics.of(np.degrees(rpe_rad))",
        "rpe_deg=Statistics.of(rpe_rad)",
        ("tests/eval/metrics/test_scores_by_hand.py::test_orientation_errors_are_in_degrees",),
    ),
    Mutant(
        "score-se3-for-yaw",
        "Score: the yaw alignment removes a tilt as well.",
        "eval/metrics/scores.py",
        "        alignment,\n        n=align_poses,",
        '        "se3" if alignment == "yaw" else alignment,\n        n=align_poses,',
        ("tests/eval/metrics/test_scores_by_hand.py::test_yaw_alignment_does_not_remove_a_tilt",),
    ),
    Mutant(
        "score-pairs-of-other-path",
        "Score: the pairs of relative errors are chosen on the other path.",
        "eval/metrics/scores.py",
        'poses[:2] if rpe.source == "truth" else poses[2:]',
        'poses[2:] if rpe.source == "truth" else poses[:2]',
        ("tests/eval/metrics/test_scores_by_hand.py::test_pairs_are_chosen_on_the_path_that_is_asked_for",),
    ),
    Mutant(
        "score-relative-errors-end",
        "Score: relative errors carry the time at which their pair ends.",
        "eval/metrics/scores.py",
        "true.t_ns[pairs[0]],",
        "true.t_ns[pairs[1]],",
        ("tests/eval/metrics/test_scores_by_hand.py::test_times_are_those_of_the_compared_poses",),
    ),
    Mutant(
        "score-first-pose-of-overlap",
        "Score: the first compared pose is always at zero seconds.",
        "eval/metrics/scores.py",
        "first_s=float(true.t_ns[0] - truth.t_ns[0])",
        "first_s=float(true.t_ns[0] - true.t_ns[0])",
        ("tests/eval/metrics/test_scores_by_hand.py::test_times_are_those_of_the_compared_poses",),
    ),
    Mutant(
        "score-last-pose-of-truth",
        "Score: the last compared pose is the last of the truth.",
        "eval/metrics/scores.py",
        "last_s=float(true.t_ns[-1] - truth.t_ns[0])",
        "last_s=float(truth.t_ns[-1] - truth.t_ns[0])",
        ("tests/eval/metrics/test_scores_by_hand.py::test_times_are_those_of_the_compared_poses",),
    ),
    Mutant(
        "score-coverage-of-compared",
        "Score: poses without a true one do not count as coverage.",
        "eval/metrics/scores.py",
        "coverage_percent(frame_times_ns, estimate.t_ns),",
        "coverage_percent(frame_times_ns, estimated.t_ns),",
        ("tests/eval/metrics/test_scores_by_hand.py::test_coverage_counts_poses_that_have_no_truth",),
    ),
    Mutant(
        "score-inside-of-position",
        "Score: the share of orientations within the bounds of the NEES is that of positions.",
        "eval/metrics/scores.py",
        "inside_percent(stated.orientation_nees)",
        "inside_percent(stated.position_nees)",
        ("tests/eval/metrics/test_scores_by_hand.py::test_consistency_by_hand",),
    ),
    Mutant(
        "score-beyond-of-position",
        "Score: the share of orientation errors beyond 3σ is that of position errors.",
        "eval/metrics/scores.py",
        "100.0 * stated.orientation_exceedance",
        "100.0 * stated.position_exceedance",
        ("tests/eval/metrics/test_scores_by_hand.py::test_consistency_by_hand",),
    ),
    Mutant(
        "score-beyond-no-percentage",
        "Score: the share of position errors beyond 3σ is not in per cent.",
        "eval/metrics/scores.py",
        "100.0 * stated.position_exceedance",
        "stated.position_exceedance",
        ("tests/eval/metrics/test_scores_by_hand.py::test_consistency_by_hand",),
    ),
    Mutant(
        "consistency-covariance-times-10",
        "Consistency: covariances are ten times too large.",
        "eval/metrics/consistency.py",
        "    R = anchor.R_truth_estimate\n",
        "    R = anchor.R_truth_estimate\n    covariance = 10.0 * covariance\n",
        ("tests/eval/metrics/test_scores_by_hand.py::test_a_covariance_too_large_by_a_factor_divides_the_nees",),
    ),
    Mutant(
        "consistency-sign-of-position",
        "Consistency: sign of the position errors.",
        "eval/metrics/consistency.py",
        "position = truth.p_world_imu - anchor.positions(estimate.p_world_imu)",
        "position = anchor.positions(estimate.p_world_imu) - truth.p_world_imu",
        ("tests/eval/metrics/test_scores_by_hand.py::test_consistency_by_hand",),
    ),
    Mutant(
        "consistency-sign-of-orientation",
        "Consistency: sign of the orientation errors.",
        "eval/metrics/consistency.py",
        "orientation = log_so3(",
        "orientation = -log_so3(",
        ("tests/eval/metrics/test_scores_by_hand.py::test_consistency_by_hand",),
    ),
    Mutant(
        "consistency-2-sigma",
        "Consistency: orientation errors are counted beyond 2σ.",
        "eval/metrics/consistency.py",
        "np.abs(self.orientation_error_rad) > 3.0",
        "np.abs(self.orientation_error_rad) > 2.0",
        ("tests/eval/metrics/test_scores_by_hand.py::test_consistency_by_hand",),
    ),
    Mutant(
        "errors-rpe-in-radians",
        "Relative errors of arrays: orientation in radians.",
        "eval/metrics/errors.py",
        "return Statistics.of(np.degrees(self.errors_rad))",
        "return Statistics.of(self.errors_rad)",
        ("tests/eval/metrics/test_scores_by_hand.py::test_relative_errors_of_arrays",),
    ),
    Mutant(
        "errors-pairs-of-truth",
        "Relative errors of arrays: pairs are always chosen on the truth.",
        "eval/metrics/errors.py",
        'chosen = (p_truth, quat_truth_wxyz) if source == "truth" else (p_estimate, quat_estimate_wxyz)',
        "chosen = (p_truth, quat_truth_wxyz)",
        ("tests/eval/metrics/test_scores_by_hand.py::test_relative_errors_of_arrays",),
    ),
    Mutant(
        "errors-frame-of-rotation",
        "Relative errors: the rotation of the error is not in the frame at the end of the step.",
        "eval/metrics/errors.py",
        "return product(conjugate(turns[0]), turns[1])",
        "return product(turns[1], conjugate(turns[0]))",
        ("tests/eval/metrics/test_scores_by_hand.py::test_yaw_and_tilt_errors_of_a_drone_that_pitches",),
    ),
    Mutant(
        "lengths-yaw-at-the-end",
        "Errors by length: the drift aligns the yaw at the end of a piece.",
        "eval/metrics/lengths.py",
        "components(quat_truth_wxyz[i]), conjugate(components(quat_estimate_wxyz[i]))",
        "components(quat_truth_wxyz[j]), conjugate(components(quat_estimate_wxyz[j]))",
        ("tests/eval/metrics/test_scores_by_hand.py::test_drift_aligns_the_yaw_at_the_beginning_of_a_piece",),
    ),
    Mutant(
        "pairs-tolerance-in-seconds",
        "Pairs: the tolerance of pairs by seconds is no share of their distance.",
        "eval/metrics/pairs.py",
        "None if self.tolerance is None else self.tolerance * self.delta",
        "self.tolerance",
        ("tests/eval/metrics/test_scores_by_hand.py::test_the_tolerance_of_pairs_is_a_share_of_their_distance",),
    ),
    Mutant(
        "compare-coverage-of-ok",
        "Comparison: failed runs drop out of the mean coverage.",
        "eval/compare.py",
        "return sum(known) / (len(known) + failed) if known else None",
        "return sum(known) / len(known) if known else None",
        ("tests/eval/test_compare_by_hand.py::test_a_failed_run_covers_nothing",),
    ),
    Mutant(
        "compare-gate-on-interval",
        "Comparison: a gate judges the lower end of the confidence interval.",
        "eval/compare.py",
        "if ratio.median > 1.0 + limit:",
        "if ratio.low > 1.0 + limit:",
        ("tests/eval/test_compare_by_hand.py::test_a_gate_judges_the_median_not_its_interval",),
    ),
    Mutant(
        "compare-chance-of-10-percent",
        "Comparison: differences with p below 0.1 are called clear.",
        "eval/compare.py",
        "_CHANCE = 0.05",
        "_CHANCE = 0.1",
        ("tests/eval/test_compare_by_hand.py::test_a_difference_is_clear_below_five_percent_only",),
    ),
    Mutant(
        "rows-mean-for-rmse",
        "Rows: the absolute error is the mean, not the root mean square.",
        "eval/benchmark/rows.py",
        '"ate_m": scores.ate_m.rmse',
        '"ate_m": scores.ate_m.mean',
        ("tests/eval/test_rows_by_hand.py::test_figures_come_from_the_scores_of_their_names",),
    ),
    Mutant(
        "rows-metres-for-degrees",
        "Rows: the relative error of orientation is that of position.",
        "eval/benchmark/rows.py",
        '"rpe_deg": scores.rpe_deg and scores.rpe_deg.rmse',
        '"rpe_deg": scores.rpe_m and scores.rpe_m.rmse',
        ("tests/eval/test_rows_by_hand.py::test_figures_come_from_the_scores_of_their_names",),
    ),
    Mutant(
        "rows-nees-of-position",
        "Rows: the NEES of orientation is that of position.",
        "eval/benchmark/rows.py",
        '"nees_orientation": scores.nees_orientation',
        '"nees_orientation": scores.nees_position',
        ("tests/eval/test_rows_by_hand.py::test_figures_come_from_the_scores_of_their_names",),
    ),
    Mutant(
        "rows-report-mean-for-rmse",
        "Rows: of a single run, errors are means.",
        "eval/benchmark/rows.py",
        'scores[name]["rmse"]',
        'scores[name]["mean"]',
        ("tests/eval/test_rows_by_hand.py::test_a_report_is_read_as_the_row_of_its_run",),
    ),
    Mutant(
        "summary-quartiles",
        "Summary: the spread is that of 10 % and 90 % of the runs.",
        "eval/benchmark/summary.py",
        "(0.25, 0.5, 0.75)",
        "(0.1, 0.5, 0.9)",
        ("tests/eval/test_benchmark_by_hand.py::test_a_spread_is_the_median_and_the_quartiles",),
    ),
    Mutant(
        "benchmark-retries-everything",
        "Benchmark: a retry repeats the runs that ended well.",
        "eval/benchmark/runner.py",
        '(retry and row.status != "ok")',
        "retry",
        ("tests/eval/test_benchmark_by_hand.py::test_a_retry_repeats_failed_runs_only",),
    ),
    Mutant(
        "sizing-minutes-for-hours",
        "Sizing: processor time is in minutes.",
        "eval/benchmark/sizing.py",
        "cost.cpu_s / 3600.0 * flights, cost.cpu_s / 3600.0 * flights / cores",
        "cost.cpu_s / 60.0 * flights, cost.cpu_s / 60.0 * flights / cores",
        ("tests/eval/test_benchmark_by_hand.py::test_many_flights_take_as_many_times_as_much",),
    ),
    Mutant(
        "sizing-on-one-core",
        "Sizing: the hours on some cores are those on one.",
        "eval/benchmark/sizing.py",
        "cost.cpu_s / 3600.0 * flights / cores",
        "cost.cpu_s / 3600.0 * flights",
        ("tests/eval/test_benchmark_by_hand.py::test_many_flights_take_as_many_times_as_much",),
    ),
    Mutant(
        "jobs-cost-swapped",
        "Jobs: processor time and elapsed time of a recording are swapped.",
        "eval/benchmark/jobs.py",
        "Cost(outcome.cpu_s, outcome.wall_s, disk_mb)",
        "Cost(outcome.wall_s, outcome.cpu_s, disk_mb)",
        ("tests/eval/test_benchmark_by_hand.py::test_a_job_notes_what_its_recording_and_its_runs_took",),
    ),
    Mutant(
        "jobs-size-in-kilobytes",
        "Jobs: the size of a recording is in kilobytes.",
        "eval/benchmark/jobs.py",
        "if file.is_file()) * 1e-6",
        "if file.is_file()) * 1e-3",
        ("tests/eval/test_benchmark_by_hand.py::test_a_job_notes_what_its_recording_and_its_runs_took",),
    ),
    Mutant(
        "jobs-wall-of-processor",
        "Jobs: the time of a run is its processor time.",
        "eval/benchmark/jobs.py",
        "wall_s=outcome.wall_s,\n            peak",
        "wall_s=outcome.cpu_s,\n            peak",
        ("tests/eval/test_benchmark_by_hand.py::test_a_job_notes_what_its_recording_and_its_runs_took",),
    ),
    Mutant(
        "run-resets-count-losses",
        "Run: losses are counted as resets.",
        "eval/run.py",
        "~since_first[:-1] & since_first[1:]",
        "since_first[:-1] & ~since_first[1:]",
        ("tests/eval/test_run_by_hand.py::test_losses_and_resets",),
    ),
    Mutant(
        "run-percentile-of-latency",
        "Run: the 99th percentile of the latency is the 95th.",
        "eval/run.py",
        "[50.0, 95.0, 99.0]",
        "[50.0, 95.0, 95.0]",
        ("tests/eval/test_run_by_hand.py::test_percentiles_of_latencies",),
    ),
    Mutant(
        "jobs-drop-what-is-kept",
        "Jobs: recordings that are to be kept are dropped, the others stay.",
        "eval/benchmark/jobs.py",
        "if not self.keep and",
        "if self.keep and",
        ("tests/eval/test_benchmark_by_hand.py::test_a_recording_is_dropped_unless_it_is_to_be_kept",),
    ),
    Mutant(
        "kitti-rpe-in-radians",
        "KITTI: the relative error of orientation is in radians.",
        "eval/metrics/kitti.py",
        "float(np.degrees(step_rad.mean()))",
        "float(step_rad.mean())",
        ("tests/eval/metrics/test_kitti_by_hand.py::test_kitti_rotation_errors_are_in_degrees",),
    ),
    Mutant(
        "kitti-first-true-frame",
        "KITTI: the first frame of the truth is aligned, not that of the estimate.",
        "eval/metrics/kitti.py",
        "seen = np.linalg.inv(truth[frames[0]]) @ truth[frames]",
        "seen = np.linalg.inv(truth[0]) @ truth[frames]",
        ("tests/eval/metrics/test_kitti_by_hand.py::test_kitti_aligns_the_first_estimated_frame",),
    ),
    Mutant(
        "association-bridges-long-gaps",
        "Association: gaps of the truth of 5 s are interpolated.",
        "eval/metrics/association.py",
        '"interpolate": 0.5',
        '"interpolate": 5.0',
        ("tests/eval/metrics/test_association_by_hand.py::test_default_gaps_of_the_associations",),
    ),
    Mutant(
        "association-loses-covariances",
        "Association: estimates paired with the nearest true pose lose their covariances.",
        "eval/metrics/association.py",
        "pick(trajectory.covariance)",
        "None",
        ("tests/eval/metrics/test_association_by_hand.py::test_associations_keep_all_that_an_estimate_holds",),
    ),
)
"""Faults of the evaluation."""

MUTANTS = (*ESTIMATOR, *EVALUATION)


def copy_checkout(target: Path) -> None:
    """Copy the files of the checkout that git tracks, or would track, to a new folder. Links stay links."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        source, copy = CHECKOUT / name, target / name
        if source.is_symlink() or source.exists():  # a file may be deleted and not yet committed
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy, follow_symlinks=False)


def run_tests(checkout: Path, tests: Sequence[str]) -> Verdict:
    """Run some tests in a copy of the checkout, on one process, up to the first failure."""
    options = ["-x", "-q", "-p", "no:cacheprovider", "-n", "0", "--no-header", "--tb=line"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        finished = subprocess.run(
            command, cwd=checkout, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Verdict.INVALID
    if finished.returncode not in (0, 1):  # pytest: 0 all passed, 1 a test failed, else no test could be run
        print(finished.stdout, finished.stderr, file=sys.stderr)
    return {0: Verdict.SURVIVED, 1: Verdict.KILLED}.get(finished.returncode, Verdict.INVALID)


def judge(mutant: Mutant) -> Verdict:
    """Apply a mutant to a copy of the checkout and run its tests there."""
    with tempfile.TemporaryDirectory(prefix="dronevio-mutant-") as folder:
        copy_checkout(Path(folder))
        try:
            mutant.apply(Path(folder))
        except (OSError, ValueError) as error:
            print(error, file=sys.stderr)
            return Verdict.INVALID
        return run_tests(Path(folder), mutant.tests)


def selected(names: Sequence[str]) -> list[Mutant]:
    """Return the mutants of some names, all of them where no name is given.

    Raises:
        SystemExit: There is none of a name.
    """
    unknown = sorted(set(names) - {mutant.name for mutant in MUTANTS})
    if unknown:
        sys.exit(f"mutants: no mutant is called {', '.join(unknown)}; see --list")
    return [mutant for mutant in MUTANTS if not names or mutant.name in names]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(description="Put known faults into a copy of the code and run the tests on it.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="Mutants to run; by default, all.")
    parser.add_argument("--list", action="store_true", help="List the mutants and run nothing.")
    options = parser.parse_args(arguments)
    mutants = selected(options.names)
    width = max(len(mutant.name) for mutant in mutants)
    if options.list:
        for mutant in mutants:
            print(f"{mutant.name:{width}}  {mutant.description}")
        return 0
    with tempfile.TemporaryDirectory(prefix="dronevio-mutant-") as folder:
        copy_checkout(Path(folder))
        tests = sorted({test for mutant in mutants for test in mutant.tests})
        if run_tests(Path(folder), tests) is not Verdict.SURVIVED:
            print("mutants: the tests do not pass without a mutant", file=sys.stderr)
            return 2
    verdicts = []
    print(f"{'mutant':{width}}  {'verdict':8}  {'time [s]':>8}")
    for mutant in mutants:
        start = time.perf_counter()
        verdicts.append(judge(mutant))
        print(f"{mutant.name:{width}}  {verdicts[-1]:8}  {time.perf_counter() - start:8.1f}", flush=True)
    print(f"{verdicts.count(Verdict.KILLED)} of {len(verdicts)} killed")
    if Verdict.INVALID in verdicts:
        return 2
    return 1 if Verdict.SURVIVED in verdicts else 0


if __name__ == "__main__":
    sys.exit(main())
