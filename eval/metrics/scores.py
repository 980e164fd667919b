"""Scores of an estimated trajectory: all metrics, each declared with how it is computed from the errors at every pose.

To add a metric, add a field to `Scores`: it is then in the JSON documents, tables, benchmarks and reports.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Self

import numpy as np

from dronevio.eval.metrics.alignment import AlignmentMode, umeyama
from dronevio.eval.metrics.association import Association, nearest_rows
from dronevio.eval.metrics.consistency import inside_percent
from dronevio.eval.metrics.errors import Statistics, translation_errors_m
from dronevio.eval.metrics.lengths import LengthErrors
from dronevio.eval.metrics.metric import Metric, computed, computed_values, declared, metrics_of
from dronevio.eval.metrics.trajectory_errors import Compared, ScoreOptions, TrajectoryErrors
from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory
from dronevio.models.summary import Row, Summarized, html_table

START_UP_S = 3.0
"""Time after the first frame before which frames do not count for the coverage [s]."""
ERROR_COLUMNS = ("error", "rmse", "mean", "median", "max", "unit")
"""Headings of a table of errors."""
_FRAME_TOLERANCE_NS = 1_000_000  # between the time stamps of a frame and of its pose, which may be rounded
_DEFAULTS = ScoreOptions()


@dataclass(frozen=True)
class Scores:
    """Scores of an estimated trajectory. Angles are in degrees, other quantities in SI units."""

    alignment: AlignmentMode = computed(lambda e: e.given.options.alignment)
    """Alignment before errors were computed."""
    align_poses: int | None = computed(lambda e: e.given.options.align_poses)
    """Number of aligned poses, from the first on; None for all."""
    association: Association = computed(lambda e: e.given.options.association)
    """How the true pose of an estimated pose was found."""
    time_offset_s: float = computed(lambda e: e.given.options.time_offset_s)
    """Offset that was added to the estimate's time stamps [s]."""
    n_poses: int = computed(lambda e: len(e.truth))
    """Number of estimated poses that were compared with the truth."""
    n_estimated: int = computed(lambda e: len(e.given.estimate))
    """Number of poses of the estimate."""
    path_m: float = computed(lambda e: e.truth.length_m, Metric("Length of the path", "m", 2, best=None))
    """Length of the true path over the compared poses [m]."""
    ate_m: Statistics = computed(
        lambda e: Statistics.of(e.translation_error_m),
        Metric("ATE, position", "m", 4),
        Metric("Largest position error", "m", 4, name="max_error_m", of=lambda ate_m: ate_m.max),
    )
    """Absolute position error after alignment [m]."""
    ate_deg: Statistics = computed(
        lambda e: Statistics.of(np.degrees(e.rotation_error_rad)), Metric("ATE, orientation", "°", 3)
    )
    """Absolute orientation error after alignment [°]."""
    rpe_interval: str = computed(lambda e: e.given.options.rpe.label)
    """Distance between the two poses of a relative error, such as ``1 s`` or ``100 m``."""
    rpe_delta_s: float | None = computed(lambda e: e.given.options.rpe.delta_s)
    """The same distance [s]; None if its unit is not the second."""
    rpe_pairs: int = computed(lambda e: len(e.rpe_m))
    """Number of pairs of poses at that distance."""
    rpe_m: Statistics | None = computed(lambda e: _statistics(e.rpe_m), Metric("RPE over {interval}, position", "m", 4))
    """Relative position error [m]; None without such pairs."""
    rpe_deg: Statistics | None = computed(
        lambda e: _statistics(np.degrees(e.rpe_rad)), Metric("RPE over {interval}, orientation", "°", 3)
    )
    """Relative orientation error [°]; None without such pairs."""
    lengths: tuple[LengthErrors, ...] = computed(lambda e: e.lengths)
    """Errors by sub-trajectory length."""
    drift_percent: float | None = computed(
        lambda e: mean_drift_percent(e.lengths), Metric("Drift", "% of the path length", 3)
    )
    """Mean drift over all sub-trajectories, relative to their lengths [%]; None without sub-trajectories."""
    scale_error_percent: float | None = computed(
        lambda e: scale_error_percent(e.truth.p_world_imu, e.unaligned.p_world_imu),
        Metric("Scale error", "%", 2, signed=True),
    )
    """Relative error of the scale, positive if the estimated path is too large [%]; None for a straight path."""
    velocity_m_s: Statistics | None = computed(
        lambda e: _differences(e.truth.velocity_m_s, e.estimate.velocity_m_s), Metric("Velocity error", "m/s", 4)
    )
    """Velocity error after alignment [m/s]; None if truth or estimate has no velocities."""
    gyro_bias_rad_s: Statistics | None = computed(
        lambda e: _differences(e.truth.gyro_bias_rad_s, e.estimate.gyro_bias_rad_s),
        Metric("Gyroscope bias", "rad/s", 5),
    )
    """Error of the gyroscope bias [rad/s]; None if truth or estimate has no biases."""
    accel_bias_m_s2: Statistics | None = computed(
        lambda e: _differences(e.truth.accel_bias_m_s2, e.estimate.accel_bias_m_s2),
        Metric("Accelerometer bias", "m/s²", 4),
    )
    """Error of the accelerometer bias [m/s²]; None if truth or estimate has no biases."""
    coverage_percent: float | None = computed(
        lambda e: _of_frames(coverage_percent, e), Metric("Coverage", "% of frames after 3 s", 1, best="high")
    )
    """Share of the frames later than 3 s after the first that have a pose [%]; None without frame times."""
    initialization_s: float | None = computed(
        lambda e: _of_frames(initialization_s, e),
        Metric("First pose after the first frame", "s", 3, best=None, name="start_s"),
    )
    """Time from the first frame to the first estimated pose [s]; None without frame times."""
    first_pose_s: float = computed(
        lambda e: float(e.truth.t_ns[0] - e.given.truth.t_ns[0]) * 1e-9, Metric("Time of the first pose", "s", 3)
    )
    """Time of the first compared pose after the first true pose [s]."""
    last_pose_s: float = computed(lambda e: float(e.truth.t_ns[-1] - e.given.truth.t_ns[0]) * 1e-9)
    """Time of the last compared pose after the first true pose [s]."""
    nees_position: float | None = computed(
        lambda e: e.consistency and float(e.consistency.position_nees.mean()),
        Metric("NEES of the position, 3 expected", "", 2, best="three"),
    )
    """Mean NEES of the position, 3 expected; larger values are overconfident; None without covariances."""
    nees_orientation: float | None = computed(
        lambda e: e.consistency and float(e.consistency.orientation_nees.mean()),
        Metric("NEES of the orientation, 3 expected", "", 2, best="three"),
    )
    """Mean NEES of the orientation, 3 expected; larger values are overconfident; None without covariances."""
    nees_velocity: float | None = computed(
        lambda e: _mean(e.consistency and e.consistency.velocity_nees),
        Metric("NEES of the velocity, 3 expected", "", 2, best="three"),
    )
    """Mean NEES of the velocity, 3 expected; larger values are overconfident; None without covariances or
    velocities."""
    nees_position_inside_percent: float | None = computed(
        lambda e: e.consistency and inside_percent(e.consistency.position_nees)
    )
    """Share of poses whose NEES of the position is within its two-sided 95 % bounds [%]; None without covariances."""
    nees_orientation_inside_percent: float | None = computed(
        lambda e: e.consistency and inside_percent(e.consistency.orientation_nees)
    )
    """Share of poses whose NEES of the orientation is within these bounds [%]; None without covariances."""
    position_beyond_3_sigma_percent: float | None = computed(
        lambda e: e.consistency and 100.0 * e.consistency.position_exceedance,
        Metric("Position errors beyond 3σ, 0.27 expected", "%", 2),
    )
    """Share of position errors beyond 3σ [%]; 0.27 expected; None without covariances."""
    orientation_beyond_3_sigma_percent: float | None = computed(
        lambda e: e.consistency and 100.0 * e.consistency.orientation_exceedance
    )
    """Share of orientation errors beyond 3σ [%]; 0.27 expected; None without covariances."""
    longest_gap_s: float = computed(
        lambda e: float(np.diff(e.truth.t_ns).max()) * 1e-9, Metric("Longest time between two poses", "s", 3)
    )
    """Longest time between two successive compared poses [s]."""

    def error_rows(self) -> list[Row]:
        """Return the errors that are known as text: name, the statistics of `ERROR_COLUMNS`, and unit."""
        rows: list[Row] = []
        for name, metric in declared(type(self)):
            of = getattr(self, name)
            if isinstance(of, Statistics) and not metric.name:  # one with a name is a part of another, which has a row
                shown = map(metric.text, (of.rmse, of.mean, of.median, of.max))
                rows.append((metric.label(self.rpe_interval), *shown, metric.unit))
        return rows

    def value_rows(self) -> list[tuple[str, str, str]]:
        """Return the other scores that are known as text: name, value and unit."""
        known = ((getattr(self, name), metric) for name, metric in declared(type(self)))
        return [
            *(
                (metric.label(self.rpe_interval), metric.text(value), metric.unit)
                for value, metric in known
                if value is not None and not isinstance(value, Statistics)
            ),
            ("poses compared", f"{self.n_poses} of {self.n_estimated}", ""),
            ("last pose after the first true pose", f"{self.last_pose_s:.3f}", "s"),
            (f"pairs over {self.rpe_interval}", f"{self.rpe_pairs}", ""),
        ]

    def _repr_html_(self) -> str:
        """Return the scores as HTML, by which notebooks show them."""
        errors = html_table(f"Errors, alignment {self.alignment}", self.error_rows(), ERROR_COLUMNS)
        values = [(label, f"{value} {unit}".strip()) for label, value, unit in self.value_rows()]
        return f"<div>{errors}{html_table('Scores', values)}</div>"

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return the scores of a JSON document that `dataclasses.asdict` made; what it lacks is None.

        Raises:
            TypeError: The document has other fields.
        """
        lengths = tuple(LengthErrors(**_restored(errors)) for errors in values.get("lengths", ()))
        known = _restored({each.name: values.get(each.name) for each in fields(cls)})
        return cls(**known | {"lengths": lengths})


SCORE_METRICS = metrics_of(Scores)
"""The metrics of a trajectory by name."""


@dataclass(frozen=True, eq=False, repr=False)
class ScoredTrajectory(Summarized, TrajectoryErrors):
    """An estimated trajectory with its errors at every pose, and its scores."""

    @cached_property
    def scores(self) -> Scores:
        """Scores computed from these errors."""
        return Scores(**computed_values(Scores, self))

    def _summary(self) -> list[tuple[str, str]]:
        scores = self.scores
        return [
            ("ATE", f"{scores.ate_m.rmse:.4f} m, {scores.ate_deg.rmse:.3f} °"),
            ("alignment", scores.alignment),
            ("poses", f"{scores.n_poses} of {scores.n_estimated}"),
            ("length of the path", f"{scores.path_m:.2f} m"),
        ]

    def _repr_html_(self) -> str:
        """Return the scores as HTML, by which notebooks show them."""
        return self.scores._repr_html_()


def score(
    truth: Trajectory,
    estimate: Trajectory,
    frame_times_ns: Times | None = None,
    options: ScoreOptions = _DEFAULTS,
) -> Scores:
    """Return the scores of an estimate; see `score_trajectory`, which also returns the errors at every pose."""
    return score_trajectory(truth, estimate, frame_times_ns, options).scores


def score_trajectory(
    truth: Trajectory,
    estimate: Trajectory,
    frame_times_ns: Times | None = None,
    options: ScoreOptions = _DEFAULTS,
) -> ScoredTrajectory:
    """Return the scores of an estimate, and its errors at every pose.

    Args:
        truth: The true trajectory of the IMU.
        estimate: The estimated trajectory, in any world frame whose z axis is up.
        frame_times_ns: (M,) Time stamps of all frames [ns], from which the coverage is computed.
        options: How the two are compared.

    Raises:
        ConfigError: An option does not exist or is out of range.
        EvaluationError: Truth and estimate have fewer than three poses in common, or cannot be aligned.
    """
    scored = ScoredTrajectory.of(Compared(truth, estimate, frame_times_ns, options))
    _ = scored.scores  # whose errors are raised here
    return scored


def mean_drift_percent(lengths: tuple[LengthErrors, ...]) -> float | None:
    """Return the mean drift over all sub-trajectories of all lengths [%]; None if there are none."""
    count = sum(errors.drift_percent.n for errors in lengths)
    return sum(errors.drift_percent.mean * errors.drift_percent.n for errors in lengths) / count if count else None


def initialization_s(frame_times_ns: Times, t_estimate_ns: Times) -> float | None:
    """Return the time from the first frame to the first estimated pose [s]; None without frames or poses."""
    if len(frame_times_ns) == 0 or len(t_estimate_ns) == 0:
        return None
    return float(t_estimate_ns[0] - frame_times_ns[0]) * 1e-9


def scale_error_percent(p_truth: Array, p_estimate: Array) -> float | None:
    """Return the relative error of the scale of an estimated path (N, 3), positive if it is too large [%].

    The scale is that of the least-squares similarity; None if the path is a point or a straight line.
    """
    try:
        scale = umeyama(p_truth, p_estimate, with_scale=True).scale
    except EvaluationError:
        return None
    return 100.0 * (1.0 / scale - 1.0) if scale > 0.0 else None


def coverage_percent(frame_times_ns: Times, t_estimate_ns: Times, start_up_s: float = START_UP_S) -> float | None:
    """Return the share [%] of the frames later than ``start_up_s`` after the first that have a pose.

    It belongs beside every error: an estimator that loses track and stops publishing poses must not look accurate. None
    if there is no such frame.
    """
    if len(frame_times_ns) == 0:
        return None
    counted = frame_times_ns[frame_times_ns > frame_times_ns[0] + round(start_up_s * 1e9)]
    if len(counted) == 0:
        return None
    if len(t_estimate_ns) == 0:
        return 0.0
    gap_ns = np.abs(t_estimate_ns[nearest_rows(t_estimate_ns, counted)] - counted)
    return 100.0 * float(np.mean(gap_ns <= _FRAME_TOLERANCE_NS))


def _differences(truth: Array | None, estimate: Array | None) -> Statistics | None:
    """Return the statistics of the norms of differences of vectors (N, 3); None if one of the two is missing."""
    if truth is None or estimate is None:
        return None
    return Statistics.of(translation_errors_m(truth, estimate))


def _statistics(errors: Array) -> Statistics | None:
    """Return the statistics of errors (N,); None without any."""
    return Statistics.of(errors) if len(errors) else None


def _mean(values: Array | None) -> float | None:
    return None if values is None else float(values.mean())


def _of_frames(metric: Callable[[Times, Times], float | None], errors: TrajectoryErrors) -> float | None:
    """Return a metric of the time stamps of frames and estimated poses; None if the former are not known."""
    frame_times_ns = errors.given.frame_times_ns
    return None if frame_times_ns is None else metric(frame_times_ns, errors.given.estimate.t_ns)


def _restored(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a JSON object, with the objects among them as statistics."""
    return {name: Statistics(**value) if isinstance(value, dict) else value for name, value in values.items()}
