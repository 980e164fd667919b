"""Output at the IMU rate: the newest estimate, dead-reckoned to every IMU sample since then.

A controller cannot wait for the next frame. Between frames, the IMU propagates the newest estimate with its biases
(Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017, eq. 30-32). An estimate
arrives after its time stamp; the samples since then are propagated again from it. States that were returned before are
not revised, so that the output jumps by the correction of the frame.
"""

from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.state import Estimate, NavState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _ImuInterval:
    """The mean motion over the interval between two IMU samples."""

    start_ns: int
    end_ns: int
    gyro_rad_s: Array  # (3,) mean angular velocity
    accel_m_s2: Array  # (3,) mean specific force in the IMU frame at the start
    end_rate_rad_s: Array  # (3,) gyroscope reading at the end


class _Propagation:
    """Dead reckoning from one estimate."""

    def __init__(self, start: NavState, params: PreintegrationParams) -> None:
        self._start = start
        self._nav = gtsam.NavState(gtsam.Pose3(start.T_world_imu), start.velocity_m_s)
        self._bias = gtsam.imuBias.ConstantBias(start.accel_bias_m_s2, start.gyro_bias_rad_s)
        self._preintegration = Preintegration(params, self._bias)

    def integrate(self, interval: _ImuInterval) -> None:
        """Add an interval, or the part of it after the estimate."""
        dt_s = (interval.end_ns - max(interval.start_ns, self._start.t_ns)) * 1e-9
        if dt_s > 0.0:
            gyro, accel = interval.gyro_rad_s[None], interval.accel_m_s2[None]
            self._preintegration.integrate(Increments(np.array([dt_s]), gyro, accel))

    def state(self, interval: _ImuInterval) -> NavState:
        """Return the state at the end of an interval, the last that was added."""
        predicted = self._preintegration.measurements.predict(self._nav, self._bias)
        return NavState(
            interval.end_ns,
            predicted.pose().matrix(),
            predicted.velocity(),
            self._start.gyro_bias_rad_s,
            self._start.accel_bias_m_s2,
            angular_velocity_rad_s=interval.end_rate_rad_s - self._start.gyro_bias_rad_s,
        )


class ImuRatePropagator:
    """Returns a state for every IMU sample, propagated from the newest estimate.

    Example:
        >>> propagator = ImuRatePropagator(rig.imu)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         vio.add_imu(measurement)
        ...         states = propagator.add_imu(measurement)
        ...     else:
        ...         propagator.correct(vio.add_frame(measurement))
    """

    def __init__(self, imu: ImuModel, config: PreintegrationConfig | None = None) -> None:
        """Create a propagator without an estimate.

        Args:
            imu: Noise of the IMU; states do not depend on it.
            config: Settings of the preintegration.
        """
        self._params = PreintegrationParams.of(imu, config or PreintegrationConfig())
        self._intervals: deque[_ImuInterval] = deque()  # those that end after the newest estimate
        self._last: tuple[int, Array, Array] | None = None  # time stamp, gyroscope and accelerometer of the last sample
        self._propagation: _Propagation | None = None

    def add_imu(self, samples: ImuSamples) -> list[NavState]:
        """Add samples and return the state at each of them; without an estimate, return none.

        The states have no covariance. Their angular velocity is the reading of the sample minus the bias, which is a
        mean over the interval if the samples are increments.

        Args:
            samples: Samples later than those before.
        """
        states = []
        for interval in self._new_intervals(samples):
            self._intervals.append(interval)
            if self._propagation is not None:
                self._propagation.integrate(interval)
                states.append(self._propagation.state(interval))
        return states

    def correct(self, estimate: Estimate) -> None:
        """Propagate from a new estimate, of any earlier time; if it has no state, stop until the next one has."""
        while self._intervals and self._intervals[0].end_ns <= estimate.t_ns:
            self._intervals.popleft()
        if estimate.state is None:
            self._propagation = None
            return
        self._propagation = _Propagation(estimate.state, self._params)
        for interval in self._intervals:
            self._propagation.integrate(interval)

    def _new_intervals(self, samples: ImuSamples) -> list[_ImuInterval]:
        """Return the intervals that end at some samples; `ImuSamples.increments` describes the mean of two points."""
        intervals = []
        for t_ns, gyro, accel in zip(samples.t_ns.tolist(), samples.gyro_rad_s, samples.accel_m_s2, strict=True):
            if self._last is not None:
                start_ns, last_gyro, last_accel = self._last
                if samples.sampling == "increment":
                    intervals.append(_ImuInterval(start_ns, t_ns, gyro, accel, gyro))
                else:
                    mean = 0.5 * (last_gyro + gyro)
                    rotation = gtsam.Rot3.Expmap(mean * ((t_ns - start_ns) * 1e-9)).matrix()
                    intervals.append(_ImuInterval(start_ns, t_ns, mean, 0.5 * (last_accel + rotation @ accel), gyro))
            self._last = t_ns, gyro, accel
        return intervals
