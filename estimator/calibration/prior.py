"""The given calibration, what is unknown of it, and how windows of keyframes are adjusted by it."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.adjustment import CalibrationProblem
from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.corrections import GRAVITY, Corrections
from dronevio.estimator.calibration.estimate import ParameterEstimate, SignificanceTest
from dronevio.estimator.calibration.parameters import ParameterTable
from dronevio.estimator.calibration.window import AdjustmentConfig
from dronevio.estimator.calibration.window_collector import CalibrationWindow
from dronevio.estimator.types import Calibration
from dronevio.models.rotation import exp_so3, pose_matrix

Array = npt.NDArray[np.float64]

STATIONARY_SIGMAS = 4.0
"""Significance of a first correction by a window that begins at rest, or by a part of it: systematic errors of the
take-off dominate there."""


@dataclass(frozen=True, eq=False)
class CalibrationPrior:
    """The given calibration, and what is unknown of it."""

    given: Calibration
    """The calibration without corrections."""
    gravity_m_s2: float
    """Given magnitude of gravity [m/s²]."""
    parameters: ParameterTable
    """The parameters of its corrections."""
    config: CalibrationConfig
    """Settings."""

    def corrected(self, applied: Array) -> Calibration:
        """Return the calibration with corrections (D,) applied."""
        c, rig = Corrections.from_vector(applied), self.given.rig
        Ts = self.given.Ts_imu_cam @ pose_matrix(exp_so3(c.rotation_rad), np.zeros_like(c.translation_m))
        Ts[:, :3, 3] += c.translation_m
        cameras = tuple(replace(camera, T_imu_cam=T) for camera, T in zip(rig.cameras, Ts, strict=True))
        intrinsics = (c.focal, c.principal) if c.focal.any() or c.principal.any() else (None, None)
        return Calibration(replace(rig, cameras=cameras), c.time_offset_s, *intrinsics, c.gravity_m_s2)

    def problem(
        self, window: CalibrationWindow, estimate: ParameterEstimate, config: AdjustmentConfig | None = None
    ) -> CalibrationProblem:
        """Return the adjustment of a window with an estimate as its prior.

        A window that begins at rest does not estimate gravity, because the accelerometer bias of its prior is that for
        the gravity in use.

        Args:
            window: The window.
            estimate: What is known before.
            config: Settings of the adjustment; those of the configuration by default.
        """
        config, is_unknown = config or self.config.adjustment, self.parameters.is_unknown
        initial = np.where(estimate.follows, estimate.applied, estimate.mean)
        if window.begins_stationary:
            is_unknown[GRAVITY], initial[GRAVITY] = False, estimate.applied[GRAVITY]
            config = replace(config, pixel_sigma=config.stationary_pixel_sigma)
        return CalibrationProblem(
            window.keyframes,
            self.given.Ts_imu_cam,
            float(self.given.focal_px[0]),
            config,
            estimate.mean,
            inverse(estimate.covariance),
            is_unknown,
            self.gravity_m_s2,
            initial=initial,
            begins_stationary=window.begins_stationary,
        )

    def significance_of(self, window: CalibrationWindow) -> SignificanceTest:
        """Return which corrections by a window are significant.

        The smallest rotation is that of the root mean square over the cameras.
        """
        c, cameras = self.config, len(self.given.rig.cameras)
        rotation_rad = c.rotation.min_correction * np.sqrt(cameras)
        if window.begins_stationary:
            return SignificanceTest(rotation_rad, rotation_rad, STATIONARY_SIGMAS)
        in_motion_rad = max(c.rotation.min_correction, c.min_motion_correction) * np.sqrt(cameras)
        return SignificanceTest(in_motion_rad, rotation_rad, by_component=True)


def inverse(matrix: Array) -> Array:
    """Return the inverse of a covariance or information matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
