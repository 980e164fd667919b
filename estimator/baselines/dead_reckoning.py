"""Dead reckoning: the IMU alone, from a start at rest. What a camera has to beat."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.estimator.initialization.static import InitialSigmas, initialize_static
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, nearest_rotations, pose_matrix
from dronevio.models.state import CameraFrame, Estimate, Health, HealthReport, NavState

Array = npt.NDArray[np.float64]

_GRAVITY_WORLD = np.array([0.0, 0.0, -GRAVITY_M_S2])


@dataclass(frozen=True)
class DeadReckoningConfig:
    """Settings of the dead reckoning."""

    rest_s: float = 0.8
    """How long the drone must stand still for the start [s]."""
    max_gyro_spread_rad_s: float = 0.05
    """Largest standard deviation of the angular velocity at rest, any axis [rad/s]; EuRoC's noise is 0.0024."""
    max_accel_spread_m_s2: float = 0.5
    """Largest standard deviation of the specific force at rest, any axis [m/s²]; EuRoC's noise is 0.03."""
    max_gyro_rad_s: float = 0.2
    """Largest mean angular velocity at rest [rad/s], bias included."""
    max_accel_error_m_s2: float = 1.0
    """Largest difference of the mean specific force from gravity's magnitude at rest [m/s²], bias included."""
    sigmas: InitialSigmas = field(default_factory=InitialSigmas)
    """How sure the start is."""


class DeadReckoning:
    """Integrates the IMU from the first rest on; of the frames it takes nothing but their time stamps.

    Gravity gives roll and pitch, the gyroscope's mean at rest is taken for its bias, the accelerometer's bias for zero.
    The position error grows with the square of time and faster: metres within ten seconds, with a sensor like EuRoC's.
    """

    def __init__(self, rig: Rig, config: DeadReckoningConfig | None = None) -> None:
        self._config = config or DeadReckoningConfig()
        self._imu = rig.imu
        self._buffer = ImuBuffer()
        self._recent: deque[Increments] = deque()
        self._recent_s = 0.0
        self._state: NavState | None = None
        self._start_ns = 0  # when that began

    def add_imu(self, samples: ImuSamples) -> None:
        """Take the IMU samples since the last call."""
        self._buffer.add(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Take a frame's time stamp and say where the IMU is."""
        increments = self._buffer.take_until(frame.t_ns)
        events: tuple[str, ...] = ()
        if self._state is not None:
            self._state = self._moved(self._state, frame.t_ns, increments)
        elif self._stands_still(increments):
            start = initialize_static(frame.t_ns, self._recent)
            covariance = self._config.sigmas.covariance(start.T_world_imu[:3, :3])
            self._state = NavState(
                frame.t_ns,
                start.T_world_imu,
                start.velocity_m_s,
                start.gyro_bias_rad_s,
                start.accel_bias_m_s2,
                covariance,
            )
            self._start_ns = frame.t_ns
            events = ("initialized",)
        if self._state is None:
            waiting = HealthReport(Health.INITIALIZING, f"no rest of {self._config.rest_s:g} s yet")
            return Estimate(frame.t_ns, Health.INITIALIZING, None, health_report=waiting)
        alone = HealthReport(Health.INERTIAL_ONLY, "the IMU alone", blind_s=(frame.t_ns - self._start_ns) * 1e-9)
        return Estimate(frame.t_ns, Health.INERTIAL_ONLY, self._state, events=events, health_report=alone)

    def _stands_still(self, increments: Increments) -> bool:
        """Take increments, and say whether the IMU has been at rest for long enough."""
        c = self._config
        self._recent.append(increments)
        self._recent_s += float(increments.dt_s.sum())
        while self._recent and self._recent_s - float(self._recent[0].dt_s.sum()) >= c.rest_s:
            self._recent_s -= float(self._recent.popleft().dt_s.sum())
        if self._recent_s < c.rest_s:
            return False
        gyro = np.concatenate([part.gyro_rad_s for part in self._recent])
        accel = np.concatenate([part.accel_m_s2 for part in self._recent])
        return bool(
            gyro.std(axis=0).max() < c.max_gyro_spread_rad_s
            and accel.std(axis=0).max() < c.max_accel_spread_m_s2
            and np.linalg.norm(gyro.mean(axis=0)) < c.max_gyro_rad_s
            and abs(np.linalg.norm(accel.mean(axis=0)) - GRAVITY_M_S2) < c.max_accel_error_m_s2
        )

    def _moved(self, start: NavState, t_ns: int, increments: Increments) -> NavState:
        """Return the state at a later time, the increments since then integrated."""
        dR, dv, dp = preintegrated(increments, start.gyro_bias_rad_s, start.accel_bias_m_s2)
        R, p, t = start.T_world_imu[:3, :3], start.T_world_imu[:3, 3], float(increments.dt_s.sum())
        assert start.covariance is not None
        covariance = propagate_covariance(start.covariance, R, dR=dR, dp=dp, dv=dv, dt_s=t, imu=self._imu)
        return NavState(
            t_ns,
            pose_matrix(nearest_rotations(R @ dR), p + start.velocity_m_s * t + 0.5 * _GRAVITY_WORLD * t * t + R @ dp),
            start.velocity_m_s + _GRAVITY_WORLD * t + R @ dv,
            start.gyro_bias_rad_s,
            start.accel_bias_m_s2,
            covariance,
        )


def preintegrated(increments: Increments, gyro_bias_rad_s: Array, accel_bias_m_s2: Array) -> tuple[Array, Array, Array]:
    """Return what increments add up to in the frame at their start, gravity left out (Forster et al. 2017, eq. 35-37).

    Args:
        increments: N of them.
        gyro_bias_rad_s: (3,) Gyroscope bias [rad/s].
        accel_bias_m_s2: (3,) Accelerometer bias [m/s²].

    Returns:
        Rotation (3, 3), velocity (3,) [m/s] and position (3,) [m].
    """
    dt = increments.dt_s[:, None]
    steps = exp_so3((increments.gyro_rad_s - gyro_bias_rad_s) * dt)
    R = np.empty((len(steps) + 1, 3, 3))
    R[0] = np.eye(3)
    for i, step in enumerate(steps):  # some ten a frame
        R[i + 1] = R[i] @ step
    dv = np.einsum("nij,nj->ni", R[:-1], increments.accel_m_s2 - accel_bias_m_s2) * dt
    before = np.cumsum(dv, axis=0) - dv
    return R[-1], dv.sum(axis=0), ((before + 0.5 * dv) * dt).sum(axis=0)
