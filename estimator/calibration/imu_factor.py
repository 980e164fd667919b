"""The IMU factor between two keyframes in the adjustment of a calibration.

Unlike GTSAM's combined factor, it depends on one gyroscope bias and one accelerometer bias of the whole window.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.models.rotation import exp_so3, log_so3, skew

Array = npt.NDArray[np.float64]

_BIAS_STEP = 1e-3
"""Step of the forward differences by the biases [rad/s and m/s²]."""


@dataclass(frozen=True, eq=False)
class CalibrationImuFactor:
    """A preintegrated measurement of rotation, position and velocity, linear in a correction of the biases.

    The biases (6,) are those of the gyroscope [rad/s] and then of the accelerometer [m/s²]. See Forster et al.,
    "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017, eq. 45.
    """

    dt_s: float
    """Length of the interval [s]."""
    rotation: Array
    """(3, 3) Preintegrated rotation, `R_start_end`."""
    position_velocity: Array
    """(6,) Preintegrated position [m] and velocity [m/s], in the IMU frame at the start and without gravity."""
    J_bias: Array
    """(9, 6) Jacobian of rotation, position and velocity by the biases."""
    information: Array
    """(9, 9) Information matrix of rotation, position and velocity."""

    @classmethod
    def from_preintegrated(
        cls, preintegrated: gtsam.PreintegratedCombinedMeasurements, bias: Array, gravity_m_s2: float
    ) -> "CalibrationImuFactor":
        """Return the factor of GTSAM's preintegrated measurements, linearized at some biases (6,).

        Args:
            preintegrated: The preintegrated measurements.
            bias: (6,) Biases of the gyroscope [rad/s] and the accelerometer [m/s²].
            gravity_m_s2: Magnitude of gravity of the preintegrated measurements [m/s²].
        """
        dt_s, gravity = float(preintegrated.deltaTij()), np.array([0.0, 0.0, -gravity_m_s2])
        dR, dp_dv = _predicted(preintegrated, bias, gravity)
        J = np.empty((9, 6))
        for axis, step in enumerate(_BIAS_STEP * np.eye(6)):
            dR_step, dp_dv_step = _predicted(preintegrated, bias + step, gravity)
            J[:, axis] = np.concatenate([log_so3(dR.T @ dR_step), dp_dv_step - dp_dv]) / _BIAS_STEP
        information = np.asarray(np.linalg.inv(preintegrated.preintMeasCov()[:9, :9]), dtype=np.float64)
        return cls(dt_s, dR, dp_dv, J, information)

    def residual(self, R: Array, p: Array, v: Array, bias: Array, gravity_m_s2: float) -> tuple[Array, Array]:
        """Return the residual (9,) between two keyframes, and its Jacobian (9, 25).

        Args:
            R: (2, 3, 3) Orientations of the keyframes, `R_world_imu`.
            p: (2, 3) Positions in the world frame [m].
            v: (2, 3) Velocities in the world frame [m/s].
            bias: (6,) Correction of the biases at which the factor was linearized.
            gravity_m_s2: Magnitude of gravity [m/s²].

        Returns:
            The residual of rotation, position and velocity, and its Jacobian by δθ (right), δp, δv of the first
            keyframe, the same of the second, the biases, and the magnitude of gravity.
        """
        dt, R_start, gravity = self.dt_s, R[0].T, np.array([0.0, 0.0, -gravity_m_s2])
        dR = self.rotation @ exp_so3(self.J_bias[:3] @ bias)
        r_rotation = log_so3(dR.T @ R_start @ R[1])
        dp = R_start @ (p[1] - p[0] - v[0] * dt - 0.5 * gravity * dt**2)
        dv = R_start @ (v[1] - v[0] - gravity * dt)
        r = np.concatenate([r_rotation, np.concatenate([dp, dv]) - self.position_velocity - self.J_bias[3:] @ bias])
        J = np.zeros((9, 25))
        J[0:3, 0:3], J[0:3, 9:12] = -R[1].T @ R[0], np.eye(3)
        J[3:6, 0:3], J[3:6, 3:6], J[3:6, 6:9], J[3:6, 12:15] = skew(dp), -R_start, -dt * R_start, R_start
        J[6:9, 0:3], J[6:9, 6:9], J[6:9, 15:18] = skew(dv), -R_start, R_start
        J[:, 18:24] = -self.J_bias
        J[3:6, 24], J[6:9, 24] = 0.5 * dt**2 * R_start[:, 2], dt * R_start[:, 2]
        return r, J


def _predicted(
    preintegrated: gtsam.PreintegratedCombinedMeasurements, bias: Array, gravity: Array
) -> tuple[Array, Array]:
    """Return the preintegrated rotation (3, 3), and position and velocity (6,) without gravity, at some biases (6,)."""
    dt_s = preintegrated.deltaTij()
    end = preintegrated.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    dp_dv = np.concatenate([end.position() - 0.5 * gravity * dt_s**2, end.velocity() - gravity * dt_s])
    return end.attitude().matrix(), dp_dv
