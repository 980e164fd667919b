"""The metrics of a benchmark: those of `Scores`, and those that need more than the trajectory, each declared once.

To add a metric, add a field to `Scores`, or here an entry with its computation: it is then a column of the rows, and in
tables and reports.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dronevio.eval.metrics.loops import FlightRevisits, LoopQuality, loop_quality, rmse_after_revisit_m
from dronevio.eval.metrics.metric import Metric
from dronevio.eval.metrics.scores import SCORE_METRICS, ScoredTrajectory, Scores, score_trajectory
from dronevio.eval.metrics.start_errors import StartErrors, largest_step_error_m, start_errors
from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import longest_loss_s, tracking_sigmas
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.rig import RigCamera


@dataclass(frozen=True)
class RunCost:
    """What an estimator's run cost; None where it is not known."""

    cpu_ms_mean: float | None = None
    """Mean processor time of all threads per frame [ms]."""
    cpu_ms_p99: float | None = None
    """99th percentile of the processor time per frame [ms]."""
    real_time_factor: float | None = None
    """Seconds of flight that are estimated in one second of processor time."""
    peak_mb: float | None = None
    """Peak memory of the process, or of the largest process of an external program [MB]."""
    worker_cpu_ms: float | None = None
    """Mean processor time per frame of the process that builds the map [ms]."""
    map_results: int | None = None
    """Number of results of that process."""
    map_waits: int | None = None
    """Number of results for which a frame had to wait."""


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """An estimator's run on a recording with ground truth, from which the metrics of a row are computed."""

    scored: ScoredTrajectory
    """The estimated trajectory with its errors and the time stamps of all frames."""
    cost: RunCost
    """What the run cost."""
    camera: RigCamera
    """The first camera with its mounting."""
    run: EstimatorRun | None = None
    """The estimates of all frames, with the final map; None for an external program."""
    revisits: FlightRevisits | None = None
    """The revisits of the flight, with the true views of the keyframes of the map; None if the world is not known."""

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of all frames [ns]."""
        times_ns = self.scored.given.frame_times_ns
        assert times_ns is not None
        return times_ns

    @cached_property
    def start(self) -> StartErrors:
        """Errors of the initialization."""
        return start_errors(self.scored.given.truth, self.scored, int(self.frame_times_ns[0]))

    @cached_property
    def final(self) -> ScoredTrajectory | None:
        """The path corrected by the final map; None without a map."""
        if self.run is None or self.run.map is None:
            return None
        return score_trajectory(self.scored.given.truth, self.run.final_trajectory, self.frame_times_ns)

    @cached_property
    def odometry(self) -> ScoredTrajectory | None:
        """The path of the odometry of an estimator with a map; None without a map."""
        if self.run is None or self.run.map is None:
            return None
        return score_trajectory(self.scored.given.truth, self.run.trajectory, self.frame_times_ns)

    @cached_property
    def loops(self) -> LoopQuality | None:
        """How well places are recognized; None without a map, or if the world is not known."""
        if self.run is None or self.run.map is None or self.revisits is None:
            return None
        return loop_quality(self.run.map, self.revisits, self.camera)

    @property
    def first_revisit_s(self) -> float | None:
        """Time from the first frame to the first revisit [s]; None without one."""
        first_ns = None if self.revisits is None else self.revisits.first_ns
        return None if first_ns is None else 1e-9 * (first_ns - int(self.frame_times_ns[0]))

    def rmse_after_revisit_m(self, path: ScoredTrajectory | None) -> float | None:
        """Return the position error of a path after the first revisit [m]; None if one of the two is not known."""
        if path is None or self.revisits is None:
            return None
        return rmse_after_revisit_m(path, self.revisits.first_ns)


def _recall_percent(run: EvaluatedRun) -> float | None:
    return None if run.loops is None or math.isnan(run.loops.recall) else 100.0 * run.loops.recall


def _ate_percent(columns: Mapping[str, float]) -> float | None:
    ate_m, path_m = columns.get("ate_m"), columns.get("path_m")
    return 100.0 * ate_m / path_m if ate_m is not None and path_m else None


RUN_METRICS = (
    # Largest error of a step from one pose to the next: jumps of the estimate
    Metric(
        "Largest error of a step between poses", "m", 4, name="step_error_m",
        of=lambda run: largest_step_error_m(run.scored),
    ),
    # Error of the velocity two seconds after the first pose; None if the estimate has no velocities
    Metric(
        "Velocity error 2 s after the first pose", "m/s", 3, name="start_velocity_error_m_s",
        of=lambda run: run.start.velocity_m_s,
    ),
    # True speed two seconds after the first pose
    Metric("Speed 2 s after the first pose", "m/s", 2, None, "start_speed_m_s", of=lambda run: run.start.speed_m_s),
    # Root mean square of the true acceleration in the first two seconds
    Metric(
        "Acceleration in the first 2 s", "m/s²", 2, None, "start_acceleration_m_s2",
        of=lambda run: run.start.acceleration_m_s2,
    ),
    # Relative error of the scale in the two seconds after the first pose, positive if it is too large; None at rest
    Metric(
        "Scale error in the first 2 s", "%", 1, None, "start_scale_error_percent",
        of=lambda run: run.start.scale_percent,
        signed=True,
    ),
    # Longest time without tracking after the first frame that is tracked; None if none is, or for an external program
    Metric(
        "Longest time without tracking", "s", 2, name="longest_loss_s",
        of=lambda run: run.run and longest_loss_s(run.run),
    ),
    # Largest error of position while the estimator reports that it tracks, in standard deviations along the least
    # certain axis; None if it never does, without covariances, or for an external program
    Metric(
        "Largest position error while tracking", "σ", 1, name="tracking_sigmas",
        of=lambda run: run.run and tracking_sigmas(run.run, run.scored.given.truth),
    ),
    # Position error over the frames later than 2 s after the first revisit, or over all frames without revisits, root
    # mean square, after the alignment of `ate_m`; None if the simulated world is not known
    Metric(
        "RMSE after the first revisit", "m", 4, name="rmse_after_revisit_m",
        of=lambda run: run.rmse_after_revisit_m(run.scored),
    ),
    # The same of the path corrected by the final map, aligned by itself; None without a map
    Metric(
        "RMSE after the first revisit, final map", "m", 4, name="final_after_revisit_m",
        of=lambda run: run.rmse_after_revisit_m(run.final),
    ),
    # The same of the odometry of an estimator with a map, aligned by itself; None without a map
    Metric(
        "RMSE after the first revisit, odometry", "m", 4, None, "odometry_after_revisit_m",
        of=lambda run: run.rmse_after_revisit_m(run.odometry),
    ),
    # Absolute position error of the path corrected by the final map, root mean square; None without a map
    Metric(
        "ATE, position, final map", "m", 4, name="final_ate_m",
        of=lambda run: run.final and run.final.scores.ate_m.rmse,
    ),
    # Share of the revisiting keyframes with a right loop within 1 s; None without revisits
    Metric("Recall of revisits", "%", 1, "high", "recall_percent", of=_recall_percent),
    # Time from the first frame to the first revisit of a place by the true motion; None without revisits, or if the
    # simulated world is not known
    Metric("Time of the first revisit", "s", 1, None, "first_revisit_s", of=lambda run: run.first_revisit_s),
    # Number of loops that the final map accepts; None without a map
    Metric(
        "Loops", "", 0, None, "loops",
        of=lambda run: None if run.run is None or run.run.map is None else len(run.run.map.closed),
    ),
    # Number of them whose relative pose is wrong; None if the simulated world is not known
    Metric("Wrong loops", "", 0, None, "wrong_loops", of=lambda run: run.loops and run.loops.wrong),
    # Mean processor time of all threads per frame
    Metric(
        "Mean processor time per frame", "ms", 1, name="cpu_ms_mean",
        of=lambda run: run.cost.cpu_ms_mean,
        counts_failed=False,
    ),
    # 99th percentile of the processor time per frame; None for an external program
    Metric(
        "99th percentile of the processor time per frame", "ms", 1, name="cpu_ms_p99",
        of=lambda run: run.cost.cpu_ms_p99,
        counts_failed=False,
    ),
    # Mean processor time per frame of the process that builds the map, a part of `cpu_ms_mean`; None without a map
    Metric(
        "Mean processor time of the map process per frame", "ms", 1, name="worker_cpu_ms",
        of=lambda run: run.cost.worker_cpu_ms,
        counts_failed=False,
    ),
    # Mean processor time per frame in the last quarter of the flight, relative to the second quarter; None for an
    # external program
    Metric(
        "Processor time, last / second quarter", "×", 2, name="cpu_growth",
        of=lambda run: run.run and run.run.cpu_growth,
        counts_failed=False,
    ),
    # Seconds of flight that are estimated in one second of processor time
    Metric(
        "Flight / processor time", "×", 1, "high", "real_time_factor",
        of=lambda run: run.cost.real_time_factor,
        counts_failed=False,
    ),
    # Peak memory of the process, or of the largest process of an external program
    Metric("Peak memory", "MB", 1, name="peak_mb", of=lambda run: run.cost.peak_mb, counts_failed=False),
    # Elapsed time of the run's process
    Metric(
        "Elapsed time of the run", "s", 1, "any", "wall_s",
        of=lambda run: None,  # it ends after this; see `Job.row`
        counts_failed=False,
    ),
    # Number of results of the process that builds the map; None without a map
    Metric("Results of the map process", "", 0, None, "map_results", of=lambda run: run.cost.map_results),
    # Number of results for which a frame had to wait; None without a map
    Metric("Waits for the map process", "", 0, None, "map_waits", of=lambda run: run.cost.map_waits),
    # Time from the first frame to the last
    Metric(
        "Duration of the flight", "s", 1, None, "duration_s",
        of=lambda run: float(run.frame_times_ns[-1] - run.frame_times_ns[0]) * 1e-9,
    ),
)  # fmt: skip
"""The metrics that are no scores of a trajectory."""
STORED_METRICS = (*SCORE_METRICS.values(), *RUN_METRICS)
"""The metrics that are columns of the files of a benchmark, in this order."""
DERIVED_METRICS = (Metric("ATE, position", "% of the path length", 3, name="ate_percent", of=_ate_percent),)
"""The metrics that are computed from columns, and are not stored."""
METRICS = {metric.name: metric for metric in (*STORED_METRICS, *DERIVED_METRICS)}
"""All metrics of a run by name."""


@dataclass(frozen=True)
class OwnMetric(Metric):
    """A metric of the user without its function, as it is stored with the values: tables do not need its module."""

    code_hash: str = ""
    """Hash of the sources of its module; values of other sources are computed again."""


def metric_named(name: str, own: Iterable[OwnMetric] = ()) -> Metric:
    """Return the metric by which estimators are compared that has a name.

    Args:
        name: The name.
        own: Metrics of the user.

    Raises:
        ConfigError: There is no such metric.
    """
    compared = {metric.name: metric for metric in (*METRICS.values(), *own) if metric.best is not None}
    if name not in compared:
        raise ConfigError(f"unknown measure {name!r}; expected some of {', '.join(compared)}")
    return compared[name]


def score_columns(scores: Scores) -> dict[str, Any]:
    """Return the columns of a row that are computed from the scores of an estimate."""
    return {
        **{name: metric.of(scores) for name, metric in SCORE_METRICS.items()},
        "sub_trajectory_m": tuple(errors.length_m for errors in scores.lengths),
        "sub_trajectory_rpe_m": tuple(errors.translation_m.rmse for errors in scores.lengths),
        "sub_trajectory_rpe_deg": tuple(errors.rotation_deg.rmse for errors in scores.lengths),
    }


def run_columns(run: EvaluatedRun) -> dict[str, Any]:
    """Return the columns of a row that are computed from a run.

    Raises:
        EvaluationError: Truth and poses of a map have fewer than three poses in common, or cannot be aligned.
    """
    others = {metric.name: metric.of(run) for metric in RUN_METRICS}
    return {**score_columns(run.scored.scores), **others}
