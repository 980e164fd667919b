"""The time offset between estimate and truth.

Time stamps that are 10 ms late cause an error of 1 cm at 1 m/s. Scores never remove this error silently; the offset is
estimated only on request.
"""

from collections.abc import Callable

import numpy as np

from dronevio.eval.metrics.alignment import AlignmentMode, align
from dronevio.eval.metrics.errors import translation_errors_m
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.state import Trajectory

_MAX_POSES = 2_000  # enough for a single number
_MIN_POSES = 10
_COARSE_STEP_S = 0.02  # of the first search; the error is smooth over longer times
_GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)
_RESOLUTION_S = 1e-6


def estimate_time_offset_s(
    truth: Trajectory, estimate: Trajectory, mode: AlignmentMode = "yaw", search_s: float = 1.0
) -> float:
    """Return the offset to add to the estimate's time stamps that minimizes the absolute error [s].

    Args:
        truth: The true trajectory.
        estimate: The estimated trajectory.
        mode: Alignment at each offset: ``yaw``, ``se3``, ``sim3`` or ``none``.
        search_s: Largest magnitude of the offset [s].

    Raises:
        ConfigError: The range is empty, or the alignment uses the first pose only.
        EvaluationError: The trajectories overlap too little in time, or the path does not determine the offset.
    """
    if not 0.0 < search_s < 1e4 or mode in ("first", "scale"):
        raise ConfigError(f"a time offset within {search_s:g} s, aligned by {mode}; expected above 0 s, by yaw")
    error = _error_of_offset(truth, estimate, mode)
    count = int(np.ceil(search_s / _COARSE_STEP_S))
    offsets = np.linspace(-search_s, search_s, 2 * count + 1)
    errors = np.array([error(offset) for offset in offsets])
    if not np.isfinite(errors).any():
        raise EvaluationError("truth and estimate overlap too little in time; expected half of the estimated poses")
    best = int(np.argmin(errors))
    finite = errors[np.isfinite(errors)]
    if np.ptp(finite) <= 1e-9 * (1.0 + finite.max()):
        raise EvaluationError("a path that does not determine a time offset, such as one at rest; expected motion")
    step_s = search_s / count
    return _minimum(error, offsets[best] - step_s, offsets[best] + step_s)


def _error_of_offset(truth: Trajectory, estimate: Trajectory, mode: AlignmentMode) -> Callable[[float], float]:
    """Return a function from an offset [s] to the root mean square error [m], infinite if too few poses overlap."""
    if len(truth) < 2 or len(estimate) < _MIN_POSES:
        raise EvaluationError(f"{len(truth)} true and {len(estimate)} estimated poses; expected {_MIN_POSES} or more")
    start_ns = truth.t_ns[0]
    t_truth = (truth.t_ns - start_ns) * 1e-9
    sampled = estimate[:: 1 + (len(estimate) - 1) // _MAX_POSES]
    t_sampled = (sampled.t_ns - start_ns) * 1e-9

    def error(offset_s: float) -> float:
        t = t_sampled + offset_s
        inside = (t >= t_truth[0]) & (t <= t_truth[-1])
        if inside.sum() < max(_MIN_POSES, len(sampled) // 2):
            return float("inf")
        p = np.stack([np.interp(t[inside], t_truth, truth.p_world_imu[:, k]) for k in range(3)], axis=1)
        p_sampled = sampled.p_world_imu[inside]
        distances_m = translation_errors_m(p, align(p, p_sampled, mode).positions(p_sampled))
        return float(np.sqrt(np.mean(distances_m * distances_m)))

    return error


def _minimum(f: Callable[[float], float], low: float, high: float) -> float:
    """Return the minimum of a unimodal function in an interval (golden-section search)."""
    a, b = high - _GOLDEN_RATIO * (high - low), low + _GOLDEN_RATIO * (high - low)
    f_a, f_b = f(a), f(b)
    while high - low > _RESOLUTION_S:
        if f_a < f_b:
            high, b, f_b = b, a, f_a
            a = high - _GOLDEN_RATIO * (high - low)
            f_a = f(a)
        else:
            low, a, f_a = a, b, f_b
            b = low + _GOLDEN_RATIO * (high - low)
            f_b = f(b)
    return 0.5 * (low + high)
