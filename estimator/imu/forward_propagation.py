"""Output at the IMU rate: the newest estimate, dead-reckoned to every IMU sample since then.

A controller cannot wait for the next frame. Between frames, the IMU propagates the newest estimate with its biases
(Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017, eq. 30-32). An estimate
arrives after its time stamp; the samples since then are propagated again from it. States that were returned before are
not revised, so that the output jumps by the correction of the frame.
"""

from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.outliers import OutlierFilter
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
from dronevio.models.state import Estimate, NavState

TESTED_TOGETHER = 64
"""Number of samples from which on outliers are removed before a state is requested. It takes less time for many."""


@dataclass(frozen=True, eq=False)
class _ImuInterval:
    """The mean motion over the interval between two IMU samples."""

    start_ns: int
    end_ns: int
    gyro_rad_s: Array  # (3,) mean angular velocity
    accel_m_s2: Array  # (3,) mean specific force in the IMU frame at the start
    end_rate_rad_s: Array  # (3,) gyroscope reading at the end


class _Propagation:
    """Dead reckoning from one estimate, ``start``."""

    def __init__(self, start: NavState, params: PreintegrationParams) -> None:
        self.start, self._params = start, params

    @cached_property
    def _bias(self) -> gtsam.imuBias.ConstantBias:
        """The biases of the estimate."""
        return gtsam.imuBias.ConstantBias(self.start.accel_bias_m_s2, self.start.gyro_bias_rad_s)

    @cached_property
    def _preintegration(self) -> Preintegration:
        """The preintegration since the estimate. It begins with the first interval, which most estimates do not get."""
        return Preintegration(self._params, self._bias)

    def integrate(self, interval: _ImuInterval) -> None:
        """Add an interval, or the part of it after the estimate."""
        dt_s = (interval.end_ns - max(interval.start_ns, self.start.t_ns)) * 1e-9
        if dt_s > 0.0:
            gyro, accel = interval.gyro_rad_s[None], interval.accel_m_s2[None]
            self._preintegration.integrate(Increments(np.array([dt_s]), gyro, accel))

    def state(self, interval: _ImuInterval) -> NavState:
        """Return the state at the end of an interval, the last that was added."""
        nav = gtsam.NavState(gtsam.Pose3(self.start.T_world_imu), self.start.velocity_m_s)
        predicted = self._preintegration.measurements.predict(nav, self._bias)
        return NavState(
            interval.end_ns,
            predicted.pose().matrix(),
            predicted.velocity(),
            self.start.gyro_bias_rad_s,
            self.start.accel_bias_m_s2,
            angular_velocity_rad_s=interval.end_rate_rad_s - self.start.gyro_bias_rad_s,
        )


class ImuRatePropagator:
    """Returns a state for every IMU sample, propagated from the newest estimate.

    Samples are integrated when a state is requested, so that an estimator whose states between frames are not used pays
    for their storage only.

    Example:
        >>> propagator = ImuRatePropagator(rig.imu)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         vio.add_imu(measurement)
        ...         states = propagator.add_imu(measurement)
        ...     else:
        ...         propagator.correct(vio.add_frame(measurement))
    """

    def __init__(
        self,
        imu: ImuModel,
        config: PreintegrationConfig | None = None,
        gravity_m_s2: float = GRAVITY_M_S2,
        outliers: OutlierFilter | None = None,
    ) -> None:
        """Create a propagator without an estimate.

        Args:
            imu: Noise of the IMU; states do not depend on it.
            config: Settings of the preintegration.
            gravity_m_s2: Magnitude of gravity [m/s²].
            outliers: Removes the outliers of the samples; by default none are removed.
        """
        self._params = PreintegrationParams.of(imu, config or PreintegrationConfig(), gravity_m_s2)
        self._outliers = outliers
        self._untested: list[ImuSamples] = []  # samples whose outliers have not been removed
        self._received: deque[ImuSamples] = deque()  # samples that are not divided into intervals yet
        self._last: tuple[int, Array, Array] | None = None  # time stamp, gyroscope and accelerometer before them
        self._ahead: deque[_ImuInterval] = deque()  # intervals that are not integrated yet
        self._integrated: deque[_ImuInterval] = deque()  # those since the newest estimate
        self._propagation: _Propagation | None = None

    def add_imu(self, samples: ImuSamples) -> list[NavState]:
        """Add samples and return the state at each of them; without an estimate, return none.

        The states have no covariance. Their angular velocity is the reading of the sample minus the bias, which is a
        mean over the interval if the samples are increments.

        Args:
            samples: Samples later than those before.
        """
        self.push(samples)
        times = samples.t_ns.tolist()
        states = [self.state_at(t_ns) for t_ns in times]
        return [state for state, t_ns in zip(states, times, strict=True) if state and state.t_ns == t_ns]

    def push(self, samples: ImuSamples) -> None:
        """Add samples later than those before, without integration."""
        if len(samples):
            (self._received if self._outliers is None else self._untested).append(samples)
        if sum(map(len, self._untested)) >= TESTED_TOGETHER:
            self._remove_outliers()

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the state at the last sample not after a time, propagated from the newest estimate.

        Args:
            t_ns: Time [ns], not before that of the last call.

        Returns:
            The state as `add_imu` returns it; the newest estimate if no sample follows it; None without an estimate.
        """
        propagation = self._propagation
        if propagation is None:
            return None
        self._divide()
        while self._ahead and self._ahead[0].end_ns <= propagation.start.t_ns:
            self._ahead.popleft()
        while self._ahead and self._ahead[0].end_ns <= t_ns:
            self._integrated.append(self._ahead.popleft())
            propagation.integrate(self._integrated[-1])
        if self._integrated:
            return propagation.state(self._integrated[-1])
        return self._at_estimate(propagation.start)

    def set_gravity(self, gravity_m_s2: float) -> None:
        """Propagate from the next estimate on with another magnitude of gravity [m/s²]."""
        self._params = replace(self._params, gravity_m_s2=gravity_m_s2)

    def correct(self, estimate: Estimate) -> None:
        """Propagate from a new estimate, of any earlier time; if it has no state, stop until the next one has."""
        self._drop_until(estimate.t_ns)
        self._ahead.extendleft(reversed(self._integrated))
        self._integrated.clear()
        self._propagation = None if estimate.state is None else _Propagation(estimate.state, self._params)

    def skip(self, t_ns: int) -> None:
        """Go on from the last estimate beyond a frame without a state; later estimates are of later times.

        Args:
            t_ns: Time of the frame [ns].
        """
        if self._propagation is None:
            self._drop_until(t_ns)
            return
        self.state_at(t_ns)
        while len(self._integrated) > 1 and self._integrated[0].end_ns <= t_ns:
            self._integrated.popleft()

    def _at_estimate(self, start: NavState) -> NavState:
        """Return the state of an estimate without later samples, with the angular velocity of the nearest sample."""
        if self._last is None:
            return start
        gyro = self._ahead[0].gyro_rad_s if self._ahead else self._last[1]
        return replace(start, covariance=None, angular_velocity_rad_s=gyro - start.gyro_bias_rad_s)

    def _drop_until(self, t_ns: int) -> None:
        """Discard received samples before a time, except the last of them."""
        while len(self._received) > 1 and self._received[1].t_ns[0] <= t_ns:
            dropped = self._received.popleft()
            self._last = int(dropped.t_ns[-1]), dropped.gyro_rad_s[-1], dropped.accel_m_s2[-1]

    def _remove_outliers(self) -> None:
        """Remove the outliers of the samples since the last call."""
        if self._outliers is None or not self._untested:
            return
        samples, self._untested = self._outliers.add(ImuSamples.concatenated(self._untested)), []
        if len(samples):
            self._received.append(samples)

    def _divide(self) -> None:
        """Divide the received samples into intervals; `ImuSamples.increments` describes the mean of two points."""
        self._remove_outliers()
        while self._received:
            samples = self._received.popleft()
            for t_ns, gyro, accel in zip(samples.t_ns.tolist(), samples.gyro_rad_s, samples.accel_m_s2, strict=True):
                if self._last is not None:
                    start_ns, last_gyro, last_accel = self._last
                    if samples.sampling == "increment":
                        self._ahead.append(_ImuInterval(start_ns, t_ns, gyro, accel, gyro))
                    else:
                        mean = 0.5 * (last_gyro + gyro)
                        rotation = gtsam.Rot3.Expmap(mean * ((t_ns - start_ns) * 1e-9)).matrix()
                        accel_start = 0.5 * (last_accel + rotation @ accel)
                        self._ahead.append(_ImuInterval(start_ns, t_ns, mean, accel_start, gyro))
                self._last = t_ns, gyro, accel
