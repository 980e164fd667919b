"""An estimator in the loop of one environment: it receives the measurements, and its states replace the true ones."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.rotation import cross, inverse_pose, log_so3, quat_wxyz_from_matrix
from dronevio.models.state import Estimate, Health, NavState
from dronevio.sim.closed_loop.estimated_state import EstimatedState
from dronevio.sim.envs.sensing.delayed_frames import DelayedFrames
from dronevio.sim.envs.sensing.estimation import CameraSetup, Estimation, EstimatorFactory
from dronevio.sim.physics.vehicle_states import VehicleStates


@dataclass(frozen=True, eq=False)
class Perceived:
    """State of one vehicle, given that of its IMU."""

    T_world_vehicle: Array
    """(4, 4) Pose of the vehicle."""
    velocity_m_s: Array
    """(3,) Velocity of the centre of mass in the world frame [m/s]."""
    rate_rad_s: Array
    """(3,) Angular velocity in the vehicle frame [rad/s]."""
    bias: Array
    """(6,) Biases of gyroscope [rad/s] and accelerometer [m/s²]."""

    @classmethod
    def at_rest(cls, T_world_vehicle: Array) -> "Perceived":
        """Return a vehicle at rest at a pose (4, 4)."""
        return cls(T_world_vehicle, np.zeros(3), np.zeros(3), np.zeros(6))

    @classmethod
    def of(cls, state: NavState, T_vehicle_imu: Array) -> "Perceived":
        """Return the state of the vehicle that carries an IMU with a given mounting (4, 4) and state.

        Raises:
            ConfigError: The state has no angular velocity.
        """
        T = np.asarray(state.T_world_imu @ inverse_pose(T_vehicle_imu))
        if state.angular_velocity_rad_s is None:
            raise ConfigError("a state without angular velocity; expected one, since the inner control loops damp it")
        rate = T_vehicle_imu[:3, :3] @ state.angular_velocity_rad_s
        velocity = state.velocity_m_s - T[:3, :3] @ cross(rate, T_vehicle_imu[:3, 3])
        return cls(T, velocity, rate, np.concatenate([state.gyro_bias_rad_s, state.accel_bias_m_s2]))

    @property
    def is_finite(self) -> bool:
        """Whether all values are finite."""
        return all(bool(np.isfinite(value).all()) for value in vars(self).values())

    def states(self, truth: VehicleStates) -> VehicleStates:
        """Return the perceived state as one row, with the measured rotor speeds and battery of the true state."""
        T = self.T_world_vehicle[None]
        return replace(
            truth,
            position_m=T[:, :3, 3].copy(),
            R_world_vehicle=T[:, :3, :3].copy(),
            velocity_m_s=self.velocity_m_s[None].copy(),
            rate_rad_s=self.rate_rad_s[None].copy(),
        )


class EstimatorLoop:
    """The estimator of one vehicle with its cameras, during one episode."""

    def __init__(
        self,
        make: EstimatorFactory,
        rig: Rig,
        estimation: Estimation,
        cameras: CameraSetup,
        T_world_vehicle: Array,
        truth: VehicleStates,
    ) -> None:
        """Make estimator and cameras for the start of an episode.

        Args:
            make: Function that returns the estimator.
            rig: Calibrated cameras and IMU, as the estimator knows them.
            estimation: Latency, darkness and image sensors.
            cameras: The true cameras of the episode.
            T_world_vehicle: (4, 4) Planned pose of the standing vehicle.
            truth: True state of the vehicle, one row.
        """
        self._T_vehicle_imu = rig.T_vehicle_imu
        self._estimator = make(rig)
        self._state = EstimatedState(self._estimator, T_world_vehicle @ rig.T_vehicle_imu)
        self._frames = DelayedFrames(rig, estimation, estimation.cameras(cameras))
        self._truth, self._perceived = truth, Perceived.at_rest(T_world_vehicle)
        self._ready = False
        self._t_ns = self._start_ns = 0
        self._newest: Estimate | None = None
        self._published: NavState | None = None

    @property
    def ready(self) -> bool:
        """Whether the estimator has a state."""
        return self._ready

    @property
    def bias(self) -> Array:
        """(1, 6) Estimated biases of gyroscope [rad/s] and accelerometer [m/s²]."""
        return self._perceived.bias[None].copy()

    @property
    def position_sigma_m(self) -> Array:
        """(1,) Standard deviation of the estimated position along its least certain axis; 0 without a covariance."""
        variance = np.linalg.eigvalsh(self._covariance[3:6, 3:6])[-1:]
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def start(self) -> None:
        """Start the episode now, after the wait for the first state."""
        self._start_ns = self._t_ns
        self._frames.start(self._t_ns)

    def measure(self, t_ns: int, sample: Array, truth: VehicleStates) -> None:
        """Push an IMU sample, and all frames that have become available, into the estimator.

        Args:
            t_ns: Time of the sample [ns].
            sample: (6,) Measured angular velocity [rad/s] and specific force [m/s²].
            truth: True state of the vehicle, which the cameras see.
        """
        self._t_ns, self._truth = t_ns, truth
        self._frames.add_motion(t_ns, truth)
        self._estimator.add_imu(ImuSamples(np.array([t_ns]), sample[None, :3].copy(), sample[None, 3:].copy()))
        while (frame := self._frames.next_frame(t_ns)) is not None:
            self._newest = self._estimator.add_frame(frame)
            self._published = self._newest.state or self._published
        state = self._state.at(t_ns)
        perceived = None if state is None else Perceived.of(state, self._T_vehicle_imu)
        if perceived is not None and perceived.is_finite:
            self._perceived, self._ready = perceived, True

    def states(self) -> VehicleStates:
        """Return the perceived state as one row, with the measured rotor speeds and battery of the true state."""
        return self._perceived.states(self._truth)

    def info(self) -> dict[str, Any]:
        """Return values by name, arrays of one row; see `dronevio.sim.envs.sensing.estimation`."""
        truth, estimate, newest = self._truth, self.states(), self._newest
        report = None if newest is None else newest.health_report
        turn = truth.R_world_vehicle.mT @ estimate.R_world_vehicle
        propagated_ns = 0 if self._published is None else self._t_ns - self._published.t_ns
        return {
            "truth": _motion(truth),
            "estimate": _motion(estimate),
            "position_error_m": np.linalg.norm(estimate.position_m - truth.position_m, axis=1),
            "orientation_error_rad": np.linalg.norm(log_so3(turn), axis=1),
            "covariance": self._covariance[None].copy(),
            "landmarks": np.array([0 if report is None else report.landmarks]),
            "health": np.array([str(Health.INITIALIZING if newest is None else newest.health)]),
            "health_reason": np.array(["" if report is None else report.reason]),
            "propagated_s": np.array([propagated_ns * 1e-9]),
            "waited_s": np.array([self._start_ns * 1e-9]),
        }

    def close(self) -> None:
        """Release the resources of rendering."""
        self._frames.close()

    @property
    def _covariance(self) -> Array:
        """(15, 15) Covariance of the newest state of a frame; zeros without one."""
        if self._published is None or self._published.covariance is None:
            return np.zeros((15, 15))
        return self._published.covariance


def _motion(states: VehicleStates) -> dict[str, Array]:
    """Return the motion of one vehicle by name, arrays of one row."""
    return {
        "position_m": states.position_m.copy(),
        "quat_wxyz": quat_wxyz_from_matrix(states.R_world_vehicle),
        "velocity_m_s": states.velocity_m_s.copy(),
        "rate_rad_s": states.rate_rad_s.copy(),
    }
