"""How an estimator reports its own state, compared with the truth: losses of tracking, and errors while it tracks."""

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import errors_and_sigmas_m
from dronevio.eval.run import EstimatorRun
from dronevio.models.state import Health, Trajectory


def is_tracking(run: EstimatorRun, trajectory: Trajectory) -> npt.NDArray[np.bool_]:
    """Return at which poses (N,) of a run it reports that it tracks."""
    times_ns = [each.t_ns for each in run.estimates if each.health is Health.TRACKING]
    return np.isin(trajectory.t_ns, times_ns)


def tracking_errors(run: EstimatorRun, truth: Trajectory) -> npt.NDArray[np.float64] | None:
    """Return the errors (N,) of position while a run reports that it tracks, in standard deviations.

    Position and yaw of the first pose are taken from the ground truth. The standard deviation is that along the least
    certain axis.

    Args:
        run: A run with at least one pose.
        truth: Ground truth of the IMU, or another run's trajectory to compare with.

    Returns:
        The ratios, at the poses within the time of the truth; None if the run has no covariances, or no such pose.
    """
    true, rows = interpolate(truth, run.trajectory.t_ns)
    estimate = run.trajectory[rows]
    if estimate.covariance is None or not len(estimate):
        return None
    error_m, sigma_m = errors_and_sigmas_m(true, estimate)
    tracking = is_tracking(run, estimate)
    return np.asarray(error_m[tracking] / sigma_m[tracking])


def tracking_sigmas(run: EstimatorRun, truth: Trajectory) -> float | None:
    """Return the largest of `tracking_errors`; None if the run never tracks, or if it has no covariances."""
    errors = tracking_errors(run, truth)
    return None if errors is None or not len(errors) else float(errors.max())


def longest_loss_s(run: EstimatorRun) -> float | None:
    """Return the longest time without tracking after the first frame that is tracked [s].

    A loss lasts from the last frame that is tracked to the next one, or to the end of the recording. Frames that the
    recording lacks are no loss: between two consecutive frames that are tracked, there is none.

    Returns:
        The time, 0 if all frames are tracked from the first one on; None if no frame is tracked.
    """
    tracked = np.flatnonzero([each.health is Health.TRACKING for each in run.estimates])
    if not len(tracked):
        return None
    last = len(run.estimates) - 1
    ends = np.append(tracked, last) if tracked[-1] < last else tracked
    gaps_s = np.diff(run.t_ns[ends]) * 1e-9
    lost = np.diff(ends) > 1
    if tracked[-1] < last:
        lost[-1] = True  # the recording ends without tracking
    return float(gaps_s[lost].max(initial=0.0))
