"""Dead reckoning: integration of the IMU alone after a static initialization, the lower bound for any odometry."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.estimator.initialization.static import InitialSigmas, initialize_static
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.measurement_checks import check_imu
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, nearest_rotations, pose_matrix
from dronevio.models.state import CameraFrame, Estimate, Health, HealthReport, NavState

_GRAVITY_WORLD = np.array([0.0, 0.0, -GRAVITY_M_S2])


@dataclass(frozen=True)
class DeadReckoningConfig(Settings):
    """Settings of the dead reckoning."""

    min_stationary_s: Annotated[float, Range(0.05, 60.0)] = 0.8
    """Time for which the drone has to be stationary before the initialization [s]."""
    max_gyro_std_rad_s: Annotated[float, Range(above=0.0)] = 0.05
    """Largest standard deviation of the angular velocity of a stationary drone, on any axis [rad/s]; the noise of
    EuRoC's gyroscope is 0.0024 rad/s."""
    max_accel_std_m_s2: Annotated[float, Range(above=0.0)] = 0.5
    """Largest standard deviation of the specific force of a stationary drone, on any axis [m/s²]; the noise of EuRoC's
    accelerometer is 0.03 m/s²."""
    max_gyro_rad_s: Annotated[float, Range(above=0.0)] = 0.2
    """Largest mean angular velocity of a stationary drone, bias included [rad/s]."""
    max_accel_error_m_s2: Annotated[float, Range(above=0.0)] = 1.0
    """Largest difference between the mean specific force of a stationary drone and gravity, bias included [m/s²]."""
    sigmas: InitialSigmas = field(default_factory=InitialSigmas)
    """Standard deviations of the initial state."""


@dataclass(frozen=True, eq=False)
class _Initializing:
    """The drone has not been stationary for long enough."""

    recent: tuple[Increments, ...] = ()
    """Increments between the last frames."""
    duration_s: float = 0.0
    """Sum of their intervals [s]."""

    def with_next(self, increments: Increments, min_s: float) -> "_Initializing":
        """Return the phase with new increments and without the oldest, as long as ``min_s`` seconds remain."""
        recent = deque((*self.recent, increments))
        duration_s = self.duration_s + float(increments.dt_s.sum())
        while recent and duration_s - float(recent[0].dt_s.sum()) >= min_s:
            duration_s -= float(recent.popleft().dt_s.sum())
        return _Initializing(tuple(recent), duration_s)


@dataclass(frozen=True, eq=False)
class _Integrating:
    """The IMU is integrated from an initial state on."""

    state: NavState
    """State at the newest frame."""
    start_ns: int
    """Time of the initialization [ns]."""


class DeadReckoning:
    """Integrates the IMU once the drone has been stationary; uses only the time stamps of the frames.

    Gravity determines roll and pitch, the mean of the gyroscope its bias, and the accelerometer bias is taken as zero.
    The position error grows faster than the square of time: metres within ten seconds for an IMU like EuRoC's.
    """

    def __init__(self, rig: Rig, config: DeadReckoningConfig | None = None) -> None:
        self._config = config or DeadReckoningConfig()
        self._imu = rig.imu
        self._buffer = ImuBuffer()
        self._phase: _Initializing | _Integrating = _Initializing()
        self._imu_rate = ImuRatePropagator(rig.imu)

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call.

        Raises:
            ConfigError: A sample is not finite, or not later than the last one.
        """
        check_imu(samples)
        self._buffer.add(samples)
        self._imu_rate.push(samples)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU to its last sample not after a time; see `Estimator`."""
        return self._imu_rate.state_at(t_ns)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate at the time stamp of a frame."""
        estimate = self._at_frame(frame)
        if estimate.state is not None:
            self._imu_rate.correct(estimate)
        return estimate

    def _at_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate at the time stamp of a frame, from the one before."""
        increments = self._buffer.take_until(frame.t_ns)
        if isinstance(self._phase, _Integrating):
            state = self._propagated(self._phase.state, frame.t_ns, increments)
            self._phase = _Integrating(state, self._phase.start_ns)
            return self._estimate(self._phase)
        self._phase = self._phase.with_next(increments, self._config.min_stationary_s)
        if not self._is_stationary(self._phase):
            reason = f"the drone has not been stationary for {self._config.min_stationary_s:g} s"
            report = HealthReport(Health.INITIALIZING, reason)
            return Estimate(frame.t_ns, Health.INITIALIZING, None, health_report=report)
        self._phase = _Integrating(self._initial_state(frame.t_ns, self._phase.recent), frame.t_ns)
        return self._estimate(self._phase, ("initialized",))

    @staticmethod
    def _estimate(phase: _Integrating, events: tuple[str, ...] = ()) -> Estimate:
        t_ns, health = phase.state.t_ns, Health.INERTIAL_ONLY
        report = HealthReport(health, "the IMU alone", inertial_only_s=(t_ns - phase.start_ns) * 1e-9)
        return Estimate(t_ns, health, phase.state, events=events, health_report=report)

    def _initial_state(self, t_ns: int, recent: Sequence[Increments]) -> NavState:
        state = initialize_static(t_ns, recent)
        return NavState(
            t_ns,
            state.T_world_imu,
            state.velocity_m_s,
            state.gyro_bias_rad_s,
            state.accel_bias_m_s2,
            self._config.sigmas.covariance(state.T_world_imu[:3, :3]),
        )

    def _is_stationary(self, phase: _Initializing) -> bool:
        """Return whether the recent increments are long enough and those of a stationary IMU."""
        c = self._config
        if phase.duration_s < c.min_stationary_s:
            return False
        gyro = np.concatenate([part.gyro_rad_s for part in phase.recent])
        accel = np.concatenate([part.accel_m_s2 for part in phase.recent])
        return bool(
            gyro.std(axis=0).max() < c.max_gyro_std_rad_s
            and accel.std(axis=0).max() < c.max_accel_std_m_s2
            and np.linalg.norm(gyro.mean(axis=0)) < c.max_gyro_rad_s
            and abs(np.linalg.norm(accel.mean(axis=0)) - GRAVITY_M_S2) < c.max_accel_error_m_s2
        )

    def _propagated(self, state: NavState, t_ns: int, increments: Increments) -> NavState:
        """Return the state at ``t_ns``, after the increments since the given state."""
        dR, dv, dp = preintegrate(increments, state.gyro_bias_rad_s, state.accel_bias_m_s2)
        R, p, t = state.T_world_imu[:3, :3], state.T_world_imu[:3, 3], float(increments.dt_s.sum())
        assert state.covariance is not None
        covariance = propagate_covariance(state.covariance, R, dR=dR, dp=dp, dv=dv, dt_s=t, imu=self._imu)
        return NavState(
            t_ns,
            pose_matrix(nearest_rotations(R @ dR), p + state.velocity_m_s * t + 0.5 * _GRAVITY_WORLD * t * t + R @ dp),
            state.velocity_m_s + _GRAVITY_WORLD * t + R @ dv,
            state.gyro_bias_rad_s,
            state.accel_bias_m_s2,
            covariance,
        )


def preintegrate(increments: Increments, gyro_bias_rad_s: Array, accel_bias_m_s2: Array) -> tuple[Array, Array, Array]:
    """Return the preintegrated motion in the frame at the start, without gravity (Forster et al. 2017, eq. 35-37).

    Args:
        increments: N increments of the IMU.
        gyro_bias_rad_s: (3,) Gyroscope bias [rad/s].
        accel_bias_m_s2: (3,) Accelerometer bias [m/s²].

    Returns:
        Rotation (3, 3), velocity (3,) [m/s] and position (3,) [m].
    """
    dt = increments.dt_s[:, None]
    steps = exp_so3((increments.gyro_rad_s - gyro_bias_rad_s) * dt)
    R = np.empty((len(steps) + 1, 3, 3))
    R[0] = np.eye(3)
    for i, step in enumerate(steps):  # about ten per frame
        R[i + 1] = R[i] @ step
    dv = np.einsum("nij,nj->ni", R[:-1], increments.accel_m_s2 - accel_bias_m_s2) * dt
    before = np.cumsum(dv, axis=0) - dv
    return R[-1], dv.sum(axis=0), ((before + 0.5 * dv) * dt).sum(axis=0)
