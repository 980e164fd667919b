"""The time offset between estimate and truth, for who asks for it.

An estimator whose time stamps are late by 10 ms is 1 cm wrong at 1 m/s, and a reader of its score should know whether
that is so. It is never taken out silently: a wrong time stamp is an error like any other.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import AlignmentMode, align
from dronevio.eval.metrics.errors import translation_errors_m
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

_MOST = 2_000  # poses that are looked at: the offset is one number
_FEWEST = 10
_STEP_S = 0.02  # of the first search; a path is smooth over longer than that
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_NARROW_S = 1e-6


def estimate_time_offset_s(
    truth: Trajectory, estimate: Trajectory, mode: AlignmentMode = "yaw", search_s: float = 1.0
) -> float:
    """Return what must be added to the estimate's time stamps [s] to make its absolute error smallest.

    Args:
        truth: The true motion.
        estimate: The estimated one.
        mode: What is taken out besides: ``yaw``, ``se3`` or ``sim3``, or ``none``.
        search_s: The offset lies within this much of zero [s].

    Raises:
        ConfigError: There is nothing to search, or an alignment that looks at one pose only.
        EvaluationError: The two share too little time, or the path tells nothing of the offset.
    """
    if not 0.0 < search_s < 1e4 or mode in ("first", "scale"):
        raise ConfigError(f"a time offset within {search_s:g} s, aligned by {mode}; expected above 0 s, by yaw")
    error = _error_by_offset(truth, estimate, mode)
    count = int(np.ceil(search_s / _STEP_S))
    offsets = np.linspace(-search_s, search_s, 2 * count + 1)
    errors = np.array([error(offset) for offset in offsets])
    if not np.isfinite(errors).any():
        raise EvaluationError("truth and estimate share too little time to find an offset; expected half of the poses")
    best = int(np.argmin(errors))
    around = errors[np.isfinite(errors)]
    if np.ptp(around) <= 1e-9 * (1.0 + around.max()):
        raise EvaluationError("a path that says nothing of a time offset, such as one at rest; expected motion")
    step_s = search_s / count
    return _minimum(error, offsets[best] - step_s, offsets[best] + step_s)


def _error_by_offset(truth: Trajectory, estimate: Trajectory, mode: AlignmentMode) -> Callable[[float], float]:
    """Return a function that gives the root mean square error [m] for an offset [s], infinite where little is left."""
    if len(truth) < 2 or len(estimate) < _FEWEST:
        raise EvaluationError(f"{len(truth)} true and {len(estimate)} estimated poses; expected {_FEWEST} or more")
    start_ns = truth.t_ns[0]
    t_truth = (truth.t_ns - start_ns) * 1e-9
    some = estimate[:: 1 + (len(estimate) - 1) // _MOST]
    t_some = (some.t_ns - start_ns) * 1e-9

    def error(offset_s: float) -> float:
        t = t_some + offset_s
        inside = (t >= t_truth[0]) & (t <= t_truth[-1])
        if inside.sum() < max(_FEWEST, len(some) // 2):
            return float("inf")
        p = np.stack([np.interp(t[inside], t_truth, truth.p_world_imu[:, k]) for k in range(3)], axis=1)
        p_some = some.p_world_imu[inside]
        apart = translation_errors_m(p, align(p, p_some, mode).positions(p_some))
        return float(np.sqrt(np.mean(apart * apart)))

    return error


def _minimum(f: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function of one valley is smallest between two arguments (golden section)."""
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f_a, f_b = f(a), f(b)
    while high - low > _NARROW_S:
        if f_a < f_b:
            high, b, f_b = b, a, f_a
            a = high - _GOLDEN * (high - low)
            f_a = f(a)
        else:
            low, a, f_a = a, b, f_b
            b = low + _GOLDEN * (high - low)
            f_b = f(b)
    return 0.5 * (low + high)
