"""Output at the IMU's rate: the newest frame's state, dead-reckoned to every sample that has come since.

A controller cannot wait for the next frame. Between frames the IMU alone says where the drone is (Forster et al.,
"On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017, eq. 30-32), from the newest estimate and
with its biases; the next estimate, which speaks of the past by the time it comes, moves the ground under the samples
since. What was said before is not taken back: the output jumps by the correction that a frame makes, and by no more.
"""

from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.preintegration import PreintegrationConfig, preintegration_params
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.state import Estimate, NavState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Step:
    """The motion over one interval of the IMU."""

    start_ns: int
    end_ns: int
    gyro_rad_s: Array  # mean of the interval
    accel_m_s2: Array  # mean of the interval, in the frame at its start
    rate_rad_s: Array  # the gyroscope at its end


class ImuRatePropagator:
    """Answers every IMU sample with a state, from the newest estimate on.

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
        """Begin without a state.

        Args:
            imu: The IMU's noise, which the integration itself does not depend on.
            config: How the IMU is preintegrated.
        """
        self._params = preintegration_params(imu, config or PreintegrationConfig())
        self._steps: deque[_Step] = deque()  # those that end after the newest estimate
        self._last: tuple[int, Array, Array] | None = None  # the newest sample
        self._base: NavState | None = None
        self._nav: gtsam.NavState
        self._bias: gtsam.imuBias.ConstantBias
        self._integrated: gtsam.PreintegratedCombinedMeasurements

    def add_imu(self, samples: ImuSamples) -> list[NavState]:
        """Take samples, and return the state at each; none before there is an estimate to go on from.

        The angular velocity is the sample's, its bias removed; a sample that is a mean over an interval gives the mean.
        """
        found = []
        for step in self._new_steps(samples):
            self._steps.append(step)
            if self._base is not None:
                self._integrate(self._base, step)
                found.append(self._state(self._base, step))
        return found

    def correct(self, estimate: Estimate) -> None:
        """Take the estimate of a frame, however long ago that was, and go on from it; without a state, stop."""
        while self._steps and self._steps[0].end_ns <= estimate.t_ns:
            self._steps.popleft()
        self._base = base = estimate.state
        if base is None:
            return
        self._bias = gtsam.imuBias.ConstantBias(base.accel_bias_m_s2, base.gyro_bias_rad_s)
        self._nav = gtsam.NavState(gtsam.Pose3(base.T_world_imu), base.velocity_m_s)
        self._integrated = gtsam.PreintegratedCombinedMeasurements(self._params, self._bias)
        for step in self._steps:
            self._integrate(base, step)

    def _new_steps(self, samples: ImuSamples) -> list[_Step]:
        """Return the intervals that end at some samples; `ImuSamples.increments` tells how points become means."""
        steps = []
        for t_ns, gyro, accel in zip(samples.t_ns.tolist(), samples.gyro_rad_s, samples.accel_m_s2, strict=True):
            if self._last is not None:
                start_ns, gyro_before, accel_before = self._last
                if samples.sampling == "increment":
                    steps.append(_Step(start_ns, t_ns, gyro, accel, gyro))
                else:
                    mean = 0.5 * (gyro_before + gyro)
                    turn = gtsam.Rot3.Expmap(mean * ((t_ns - start_ns) * 1e-9)).matrix()
                    steps.append(_Step(start_ns, t_ns, mean, 0.5 * (accel_before + turn @ accel), gyro))
            self._last = t_ns, gyro, accel
        return steps

    def _integrate(self, base: NavState, step: _Step) -> None:
        """Go on over an interval, or over what of it is later than the estimate."""
        dt_s = (step.end_ns - max(step.start_ns, base.t_ns)) * 1e-9
        if dt_s > 0.0:
            self._integrated.integrateMeasurement(step.accel_m_s2, step.gyro_rad_s, dt_s)

    def _state(self, base: NavState, step: _Step) -> NavState:
        now = self._integrated.predict(self._nav, self._bias)
        return NavState(
            step.end_ns,
            now.pose().matrix(),
            now.velocity(),
            base.gyro_bias_rad_s,
            base.accel_bias_m_s2,
            angular_velocity_rad_s=step.rate_rad_s - base.gyro_bias_rad_s,
        )
