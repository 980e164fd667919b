"""The IMU between two keyframes of a window whose calibration is adjusted (Forster et al. 2017, eq. 45).

GTSAM's factors would do, were it not for the biases: here they are two for a whole window, not two for a keyframe.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import exp_so3, log_so3, skew

Array = npt.NDArray[np.float64]

GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])


@dataclass(frozen=True, eq=False)
class CalibrationImuFactor:
    """The IMU between two keyframes, and how it depends on the biases (gyroscope, accelerometer)."""

    dt_s: float
    """Its length [s]."""
    R: Array
    """(3, 3) Turn."""
    pv: Array
    """(6,) Displacement and change of velocity in the axes at the start, without gravity."""
    J: Array
    """(9, 6) Of turn, displacement and change of velocity by the biases."""
    information: Array
    """(9, 9) How surely the three are known."""

    @classmethod
    def of(cls, preintegrated: gtsam.PreintegratedCombinedMeasurements, bias: Array) -> "CalibrationImuFactor":
        """Take GTSAM's preintegration at some biases (6,)."""
        dt_s = float(preintegrated.deltaTij())
        R, pv = _predicted(preintegrated, bias)
        J = np.empty((9, 6))
        for axis, step in enumerate(1e-3 * np.eye(6)):
            R_step, pv_step = _predicted(preintegrated, bias + step)
            J[:, axis] = np.concatenate([log_so3(R.T @ R_step), pv_step - pv]) / 1e-3
        information = np.asarray(np.linalg.inv(preintegrated.preintMeasCov()[:9, :9]), dtype=np.float64)
        return cls(dt_s, R, pv, J, information)

    def residual(self, R: Array, p: Array, v: Array, bias: Array) -> tuple[Array, Array]:
        """Return the residual (9,) between two keyframes, and how it moves with both and the biases (9, 24)."""
        dt, back = self.dt_s, R[0].T
        turned = self.R @ exp_so3(self.J[:3] @ bias)
        r_turn = log_so3(turned.T @ back @ R[1])
        q_p = back @ (p[1] - p[0] - v[0] * dt - 0.5 * GRAVITY * dt**2)
        q_v = back @ (v[1] - v[0] - GRAVITY * dt)
        r = np.concatenate([r_turn, np.concatenate([q_p, q_v]) - self.pv - self.J[3:] @ bias])
        J = np.zeros((9, 24))
        J[0:3, 0:3], J[0:3, 9:12] = -R[1].T @ R[0], np.eye(3)
        J[3:6, 0:3], J[3:6, 3:6], J[3:6, 6:9], J[3:6, 12:15] = skew(q_p), -back, -dt * back, back
        J[6:9, 0:3], J[6:9, 6:9], J[6:9, 15:18] = skew(q_v), -back, back
        J[:, 18:] = -self.J
        return r, J


def _predicted(preintegrated: gtsam.PreintegratedCombinedMeasurements, bias: Array) -> tuple[Array, Array]:
    """Return turn (3, 3), and displacement and change of velocity (6,) without gravity, for some biases."""
    dt_s = preintegrated.deltaTij()
    end = preintegrated.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    pv = np.concatenate([end.position() - 0.5 * GRAVITY * dt_s**2, end.velocity() - GRAVITY * dt_s])
    return end.attitude().matrix(), pv
