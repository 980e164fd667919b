"""Errors of the time stamps of frames, recognized by a regular clock and by the motion in the images.

Cameras without a hardware trigger stamp frames when they arrive, which errs by milliseconds from frame to frame, while
the frames are exposed at a constant rate. A line through the stamps averages their errors (Olson, "A passive solution
to the sensor synchronization problem", IROS 2010). Stamps that are regular are taken as exact. Irregular ones are
replaced by those of the line, unless the images contradict it, as with a camera whose exposures are irregular and whose
stamps are exact.

What the images show: if a frame is exposed a time δ after the time that is assumed, the innovation of a landmark is its
velocity in the image times δ, besides the errors of the prediction and of the image. δ is fitted to the innovation of a
frame by weighted least squares, with the position and the orientation of the prediction as further unknowns and their
covariance as prior. From differences of δ between successive frames, errors of the prediction vanish that change
slowly, such as those of a wrong calibration: the assumption with the smaller differences is the right one.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.estimator.monitoring.innovation import Innovation
from dronevio.estimator.optimization.linear_fit import median
from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import cross
from dronevio.models.state import NavState

MEDIAN_CHI2_1DOF = 0.4549
"""Median of the χ² distribution with one degree of freedom."""
FORGETTING = 0.999
"""Weight of a stamp in the clock of the frames, relative to that of the next one."""
PERIOD_WEIGHT = 1000.0
"""Weight of the nominal period in that clock, in squared ticks: a thousandth of the period, relative to an error of the
stamps of a thirtieth."""
MAX_PERIOD_ERROR = 0.2
"""Largest relative difference of the period of the stamps from the nominal one."""
MAX_LATE_TICKS = 0.75
"""Largest error of a stamp in ticks; beyond it, the frame belongs to another tick than the next."""
MIN_INTERVAL_S = 0.001
"""Shortest time between the exposures of successive frames [s]."""
MIN_FRAMES = 8
"""Smallest number of frames from which the error of the stamps is estimated and over which the images are compared."""
MAX_SIGMA_S = 0.003
"""Largest standard deviation of the time of exposure by the image of a frame that is used [s]. While a vehicle hovers,
the image does not show when it was exposed."""
MAX_GAP_S = 2.0
"""Time without frames after which their clock begins anew [s]."""
PREFERENCE = 2.0
"""Ratio of mean squares by which the stamps must agree better with the images than the clock before they are used."""


@dataclass(frozen=True)
class StampConfig(Settings):
    """Settings of the detection of errors of time stamps."""

    correct: bool = True
    """Whether irregular time stamps of frames are replaced by those of a regular clock."""
    min_error_s: Annotated[float, Range(low=0.0, high=1.0)] = 0.0003
    """Standard deviation of stamps about a regular clock up to which they are taken as exact [s]."""
    memory: Annotated[int, Range(8, 1000)] = 30
    """Number of frames from which it is estimated and over which the images are compared."""
    min_landmarks: Annotated[int, Range(4, 1000)] = 8
    """Smallest number of landmarks of a frame that is compared."""


class FrameClock:
    """The regular clock by which frames are exposed: a line through their time stamps."""

    def __init__(self, period_s: float, first_ns: int) -> None:
        """Begin at the first stamp [ns] with the nominal period [s]."""
        self._first_ns, self._prior = first_ns, np.array([0.0, period_s])
        self._line = self._prior  # time of tick 0 since the first stamp, and period [s]
        self._H, self._b = np.zeros((2, 2)), np.zeros(2)
        self._tick = -1

    def add(self, t_ns: int) -> float:
        """Add a stamp [ns] and return how much later than it the clock ticks [s]."""
        t_s = (t_ns - self._first_ns) * 1e-9
        elapsed = (t_s - self._line[0]) / self._line[1]
        # A frame is rather late than another one lost.
        self._tick = self._tick + 1 if abs(elapsed - self._tick - 1) < MAX_LATE_TICKS else round(elapsed)
        x = np.array([1.0, self._tick])
        self._H, self._b = FORGETTING * self._H + np.outer(x, x), FORGETTING * self._b + x * t_s
        information = np.diag([0.0, PERIOD_WEIGHT])
        self._line = np.linalg.solve(self._H + information, self._b + information @ self._prior)
        return float(x @ self._line) - t_s


class StampCorrection:
    """Decides for each frame how much later than its time stamp it was exposed."""

    def __init__(self, rate_hz: float, config: StampConfig) -> None:
        """Begin before the first frame.

        Args:
            rate_hz: Nominal frame rate [Hz].
            config: Settings.
        """
        self._config, self._period_s = config, 1.0 / rate_hz
        self._stamps_ns: tuple[int, ...] = ()
        self._clock: FrameClock | None = None
        self._exposed_ns: int | None = None  # the newest frame
        self._is_irregular = False
        self._uses_clock = True  # where stamps are irregular
        self._clock_delay_s = self._applied_s = 0.0  # of the newest frame, by the clock and as applied
        self._last: tuple[float, float] | None = (
            None  # exposure after the stamp, and after the clock, by the last image
        )
        self._squares: tuple[tuple[float, float], ...] = ()  # squared differences of both between successive images

    def add_stamp(self, t_ns: int) -> float:
        """Add the time stamp of the next frame [ns] and return how much later it was exposed [s].

        A stamp that is not later than the last one is ignored.
        """
        c = self._config
        if not c.correct or (self._stamps_ns and t_ns <= self._stamps_ns[-1]):
            return 0.0
        if self._clock is None or t_ns - self._stamps_ns[-1] > MAX_GAP_S * 1e9:
            self._stamps_ns, self._clock = (), FrameClock(self._period_s, t_ns)
        self._stamps_ns = (*self._stamps_ns, t_ns)[-c.memory - 1 :]
        self._clock_delay_s = self._clock.add(t_ns)
        if len(self._stamps_ns) > MIN_FRAMES:
            stamps_ns = np.array(self._stamps_ns, dtype=np.int64)
            intervals_s = np.asarray((stamps_ns[1:] - stamps_ns[:-1]) * 1e-9)
            self._is_irregular = is_irregular(intervals_s, self._period_s, c.min_error_s)
        self._applied_s = self._clock_delay_s if self._is_irregular and self._uses_clock else 0.0
        if self._exposed_ns is not None:
            earliest_s = (self._exposed_ns - t_ns) * 1e-9 + MIN_INTERVAL_S
            self._applied_s = max(self._applied_s, earliest_s) if self._applied_s or earliest_s > 0.0 else 0.0
        self._exposed_ns = t_ns + round(self._applied_s * 1e9)
        return self._applied_s

    def compare(self, innovation: Innovation, predicted: NavState, angular_velocity_rad_s: Array) -> None:
        """Compare the clock and the stamps with the image of the newest frame.

        Args:
            innovation: The innovation of the frame at the time that is applied.
            predicted: The state that the IMU predicts for that time.
            angular_velocity_rad_s: (3,) Angular velocity of the IMU at the frame, bias removed [rad/s].
        """
        c, last = self._config, self._last
        self._last = None
        if len(innovation) < c.min_landmarks:
            return
        error_s, sigma_s = exposure_error(innovation, predicted, angular_velocity_rad_s)
        if sigma_s > MAX_SIGMA_S:
            return
        self._last = after_stamp, after_clock = (
            error_s + self._applied_s,
            error_s + self._applied_s - self._clock_delay_s,
        )
        if last is None:
            return
        self._squares = (*self._squares, ((after_stamp - last[0]) ** 2, (after_clock - last[1]) ** 2))[-c.memory :]
        if len(self._squares) >= MIN_FRAMES:
            of_stamps, of_clock = (median(squares) for squares in np.array(self._squares).T)
            self._uses_clock = of_clock < (PREFERENCE if self._uses_clock else 1.0 / PREFERENCE) * of_stamps

    @property
    def is_irregular(self) -> bool:
        """Whether the time stamps are irregular."""
        return self._is_irregular


def is_irregular(intervals_s: Array, period_s: float, min_error_s: float) -> bool:
    """Return whether time stamps err from a regular clock, some of whose ticks may be missing.

    Stamps of another period than the nominal one are taken as regular.

    Args:
        intervals_s: (N,) Intervals between successive stamps [s].
        period_s: Nominal period [s].
        min_error_s: Standard deviation up to which stamps are regular [s].
    """
    ticks = np.maximum(np.rint(intervals_s / period_s), 1.0)
    found_s = median(intervals_s / ticks)
    if abs(found_s - period_s) > MAX_PERIOD_ERROR * period_s:
        return False
    error_s = intervals_s - ticks * found_s
    return 0.5 * median(error_s**2) / MEDIAN_CHI2_1DOF > min_error_s**2


def exposure_error(innovation: Innovation, predicted: NavState, angular_velocity_rad_s: Array) -> tuple[float, float]:
    """Return by how much a frame was exposed later than assumed, according to its innovation.

    Args:
        innovation: The innovation of the frame.
        predicted: The state that the IMU predicts for the assumed time.
        angular_velocity_rad_s: (3,) Angular velocity of the IMU at the frame, bias removed [rad/s].

    Returns:
        The time and its standard deviation [s].
    """
    R, J = innovation.R_world_imu, innovation.J_imu
    velocity = -cross(angular_velocity_rad_s, innovation.in_imu) - predicted.velocity_m_s @ R
    flow = J[..., 0] * velocity[:, :1] + J[..., 1] * velocity[:, 1:2] + J[..., 2] * velocity[:, 2:]
    found = innovation.fit(innovation.uncertainty.rotation_variance, flow[..., None])
    return float(found.solution[6]), float(np.sqrt(found.covariance[6, 6]))
