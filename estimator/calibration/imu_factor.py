"""The IMU factors between consecutive keyframes in the adjustment of a calibration, all at once.

Unlike GTSAM's combined factor, they depend on one gyroscope bias and one accelerometer bias of the whole window.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, log_so3, skew

_BIAS_STEP = 1e-3
"""Step of the forward differences by the biases [rad/s and m/s²]."""


@dataclass(frozen=True, eq=False)
class CalibrationImuFactors:
    """F preintegrated measurements of rotation, position and velocity, linear in a correction of the biases.

    Factor i is between the keyframes i and i + 1. The biases (6,) are those of the gyroscope [rad/s] and then of the
    accelerometer [m/s²]. See Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", T-RO
    2017, eq. 45.
    """

    dt_s: Array
    """(F,) Lengths of the intervals [s]."""
    rotation: Array
    """(F, 3, 3) Preintegrated rotations, `R_start_end`."""
    position_velocity: Array
    """(F, 6) Preintegrated positions [m] and velocities [m/s], in the IMU frame at the start and without gravity."""
    J_bias: Array
    """(F, 9, 6) Jacobians of rotation, position and velocity by the biases."""
    information: Array
    """(F, 9, 9) Information matrices of rotation, position and velocity."""

    def __len__(self) -> int:
        return len(self.dt_s)

    @classmethod
    def from_preintegrated(
        cls,
        preintegrated: Sequence[gtsam.PreintegratedCombinedMeasurements],
        bias: Array,
        gravity_m_s2: Sequence[float],
    ) -> "CalibrationImuFactors":
        """Return the factors of GTSAM's preintegrated measurements, linearized at some biases (6,).

        Args:
            preintegrated: F preintegrated measurements.
            bias: (6,) Biases of the gyroscope [rad/s] and the accelerometer [m/s²].
            gravity_m_s2: Magnitude of gravity of each of the preintegrated measurements [m/s²].
        """
        F = len(preintegrated)
        dt_s = np.array([measured.deltaTij() for measured in preintegrated])
        biases = bias + np.concatenate([np.zeros((1, 6)), _BIAS_STEP * np.eye(6)])  # the last six for the differences
        gtsam_biases = [gtsam.imuBias.ConstantBias(each[3:], each[:3]) for each in biases]
        rest, R, position, velocity = gtsam.NavState(), np.empty((F, 7, 3, 3)), np.empty((F, 7, 3)), np.empty((F, 7, 3))
        for i, measured in enumerate(preintegrated):
            for j, gtsam_bias in enumerate(gtsam_biases):
                end = measured.predict(rest, gtsam_bias)
                R[i, j], position[i, j], velocity[i, j] = end.attitude().matrix(), end.position(), end.velocity()
        gravity_dt = -np.reshape(gravity_m_s2, -1) * dt_s
        position[..., 2] -= (0.5 * gravity_dt * dt_s)[:, None]
        velocity[..., 2] -= gravity_dt[:, None]
        position_velocity = np.concatenate([position, velocity], axis=-1)
        rotated = log_so3(np.swapaxes(R[:, :1], -1, -2) @ R[:, 1:])
        moved = position_velocity[:, 1:] - position_velocity[:, :1]
        J_bias = np.swapaxes(np.concatenate([rotated, moved], axis=-1), 1, 2) / _BIAS_STEP
        covariance = np.array([measured.preintMeasCov()[:9, :9] for measured in preintegrated]).reshape(F, 9, 9)
        return cls(dt_s, R[:, 0], position_velocity[:, 0], J_bias, np.linalg.inv(covariance))

    def residuals(
        self, R: Array, p: Array, v: Array, bias: Array, gravity_m_s2: float, gyro_scale: float
    ) -> tuple[Array, Array]:
        """Return the residuals (F, 9) between consecutive keyframes, and their Jacobians (F, 9, 26).

        Args:
            R: (F + 1, 3, 3) Orientations of the keyframes, `R_world_imu`.
            p: (F + 1, 3) Positions in the world frame [m].
            v: (F + 1, 3) Velocities in the world frame [m/s].
            bias: (6,) Correction of the biases at which the factors were linearized.
            gravity_m_s2: Magnitude of gravity [m/s²].
            gyro_scale: Relative correction of the gyroscope's scale.

        Returns:
            The residuals of rotation, position and velocity, and their Jacobians by δθ (right), δp, δv of the first
            keyframe, the same of the second, the biases, the magnitude of gravity, and the gyroscope's scale.
        """
        dt, R_start, R_end = self.dt_s[:, None], np.swapaxes(R[:-1], 1, 2), R[1:]
        gravity = np.array([0.0, 0.0, -gravity_m_s2])
        turned = log_so3(self.rotation)
        dR = self.rotation @ exp_so3(self.J_bias[:, :3] @ bias + gyro_scale * turned)
        r_rotation = log_so3(np.swapaxes(dR, 1, 2) @ R_start @ R_end)
        dp = _rotated(R_start, np.diff(p, axis=0) - v[:-1] * dt - 0.5 * gravity * dt**2)
        dv = _rotated(R_start, np.diff(v, axis=0) - gravity * dt)
        moved = np.concatenate([dp, dv], axis=1) - self.position_velocity - self.J_bias[:, 3:] @ bias
        J, dt = np.zeros((len(self), 9, 26)), dt[..., None]
        J[:, 0:3, 0:3], J[:, 0:3, 9:12] = -np.swapaxes(R_end, 1, 2) @ R[:-1], np.eye(3)
        J[:, 3:6, 0:3], J[:, 3:6, 3:6], J[:, 3:6, 6:9], J[:, 3:6, 12:15] = skew(dp), -R_start, -dt * R_start, R_start
        J[:, 6:9, 0:3], J[:, 6:9, 6:9], J[:, 6:9, 15:18] = skew(dv), -R_start, R_start
        J[:, :, 18:24] = -self.J_bias
        J[:, 3:6, 24:25], J[:, 6:9, 24:25] = 0.5 * dt**2 * R_start[..., 2:], dt * R_start[..., 2:]
        J[:, 0:3, 25] = -turned
        return np.concatenate([r_rotation, moved], axis=1), J


def _rotated(R: Array, vectors: Array) -> Array:
    """Return vectors (F, 3) rotated by R (F, 3, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", R, vectors))
