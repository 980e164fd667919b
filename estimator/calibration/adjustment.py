"""Bundle adjustment of a window of keyframes with their IMU and with the calibration among the unknowns.

Gauss-Newton steps estimate the poses and velocities of the keyframes, the IMU biases, the landmarks and the calibration
together (`objective`). The marginal information on the calibration accounts for all other unknowns: what the motion
does not make observable keeps its prior.
"""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.estimator.calibration.objective import BIAS_DIM, STATE_DIM, CalibrationEquations, CalibrationObjective
from dronevio.estimator.calibration.window import AdjustmentConfig
from dronevio.estimator.optimization.gauss_newton import gauss_newton_step
from dronevio.estimator.optimization.linalg import CholeskyFactor, SingularError
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState

MAX_RMS_PX, MIN_AGREEMENT = 2.0, 0.5
"""Largest reprojection error [px] and smallest mean weight of the observations of a window whose result is used."""


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """The posterior of the corrections after a window."""

    mean: Array
    """(D,) Vector of the corrections."""
    information: Array
    """(D, D) Information matrix of the corrections."""
    rms_px: float
    """Root mean square reprojection error, weighted by the robust loss [px]."""
    agreement: float
    """Mean weight of the observations in this loss, of the camera where it is smallest."""
    newest: NavState
    """State of the newest keyframe by the corrected calibration, with its covariance relative to the first keyframe."""
    newest_gain: Array
    """(15, D) Change of that state, in the order of `NavState`, if a correction differs from its mean: P_xc P_cc⁻¹."""

    @property
    def is_consistent(self) -> bool:
        """Whether the observations of every camera agree with each other."""
        return self.rms_px < MAX_RMS_PX and self.agreement > MIN_AGREEMENT

    def newest_given(self, corrections: Array) -> NavState:
        """Return the state of the newest keyframe if the corrections (D,) are others than the mean.

        Its expectation is conditional on the corrections. The covariance is that of `newest`, because they are not
        known exactly.
        """
        x, delta = self.newest, self.newest_gain @ (corrections - self.mean)
        return replace(
            x,
            T_world_imu=pose_matrix(x.T_world_imu[:3, :3] @ exp_so3(delta[:3]), x.T_world_imu[:3, 3] + delta[3:6]),
            velocity_m_s=x.velocity_m_s + delta[6:9],
            gyro_bias_rad_s=x.gyro_bias_rad_s + delta[9:12],
            accel_bias_m_s2=x.accel_bias_m_s2 + delta[12:],
        )


class CalibrationProblem:
    """The bundle adjustment of a window, solved one Gauss-Newton step at a time."""

    def __init__(self, objective: CalibrationObjective, config: AdjustmentConfig, newest_ns: int) -> None:
        """Begin at the initial variables of an objective; the newest keyframe's time is in nanoseconds."""
        self._objective, self._config, self._newest_ns = objective, config, newest_ns
        self._x, self._steps, self._is_done = objective.initial, 0, False
        self._result: AdjustmentResult | None = None

    @property
    def landmark_count(self) -> int:
        """Number of landmarks in the adjustment."""
        return len(self._x.points)

    @property
    def is_done(self) -> bool:
        """Whether all steps are taken, or the problem turned out to have no solution."""
        return self._is_done

    @property
    def result(self) -> AdjustmentResult | None:
        """The result; None before all steps are taken, and where the problem has no solution."""
        return self._result

    def step(self) -> None:
        """Take one Gauss-Newton step."""
        self._steps += 1
        try:
            equations = self._objective.linearize(self._x)
            step = gauss_newton_step(equations, CholeskyFactor)
        except (SingularError, np.linalg.LinAlgError):
            self._is_done = True
            return
        self._x = step.x
        is_last = step.decrement < self._config.max_decrement * len(step.delta)
        self._is_done = is_last or self._steps >= self._config.iterations
        if self._is_done:
            newest_and_common = np.arange(len(step.delta))[-len(self._objective.estimated) - BIAS_DIM - STATE_DIM :]
            covariance = step.factor.inverse_block(newest_and_common)
            self._result = self._result_of(covariance, equations)

    def _result_of(self, covariance: Array, equations: CalibrationEquations) -> AdjustmentResult:
        """Return the result.

        Args:
            covariance: (15 + E, 15 + E) Covariance of the newest keyframe, the biases and the estimated corrections.
            equations: The equations of the last step.
        """
        x, n, estimated = self._x, STATE_DIM + BIAS_DIM, self._objective.estimated
        information = self._objective.prior_information.copy()
        of_corrections = np.linalg.inv(covariance[n:, n:])
        information[np.ix_(estimated, estimated)] = of_corrections
        gain = np.zeros((n, len(information)))
        gain[:, estimated] = covariance[:n, n:] @ of_corrections
        T = pose_matrix(x.state.R_world_imu[-1], x.state.p_world_imu[-1])
        newest = NavState(self._newest_ns, T, x.state.v_world_imu[-1], x.bias[:3], x.bias[3:], covariance[:n, :n])
        return AdjustmentResult(x.corrections, information, equations.rms_px, equations.agreement, newest, gain)
