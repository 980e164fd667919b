"""Online calibration: corrections of time offset, gravity, extrinsics and intrinsics, where a flight requires them.

A given calibration is kept until the observations of a window of keyframes contradict it. Successive windows do not
overlap, so that each observation is used once. Each window is adjusted with the calibration among the unknowns
(`dronevio.estimator.calibration.adjustment`), and its result is fused with that of the windows before it in an
information filter. No decision about observability is needed: a hover leaves every parameter as it was. A correction is
applied when it is statistically significant and large enough to matter; that part then follows the estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeAlias

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.adjustment import CalibrationProblem
from dronevio.estimator.calibration.corrections import GRAVITY, Corrections
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

FiveSigmas: TypeAlias = tuple[float, float, float, float, float]
FIXED_SIGMA = 1e-9  # standard deviation of parameters that are not estimated; it keeps the matrices regular


@dataclass(frozen=True)
class CalibratedPart(Settings):
    """Settings of one part of the calibration, in the unit of its parameters."""

    online: bool
    """Whether this part is estimated online."""
    sigma: Annotated[float, Range(1e-6, 10.0)]
    """Prior standard deviation of the given calibration."""
    min_correction: Annotated[float, Range(low=0.0)]
    """Smallest correction that is applied."""
    walk: Annotated[float, Range(0.0, 1.0)]
    """Random walk of the parameters, due to temperature and ageing, per √s."""
    significance: Annotated[float, Range(low=0.0)] = 3.0
    """Standard deviations by which an estimate must differ from the calibration in use before it is applied."""


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """Settings of the online calibration."""

    time_offset: CalibratedPart = CalibratedPart(True, sigma=0.01, min_correction=0.001, walk=1e-5)
    """Time offset of the cameras [s]. The smallest correction is a fifth of a sampling interval of a 200 Hz IMU."""
    gravity: CalibratedPart = CalibratedPart(True, sigma=0.03, min_correction=0.01, walk=0.0, significance=1.5)
    """Magnitude of gravity [m/s²], 9.780 at the equator and 9.832 at the poles. One camera observes it only where the
    thrust varies, because scale and gravity are proportional otherwise. The significance is small, because the prior is
    the true distribution on Earth."""
    rotation: CalibratedPart = CalibratedPart(True, sigma=0.02, min_correction=0.005, walk=1e-5)
    """Rotation of each camera, about each axis [rad]. The smallest correction is a quarter of a degree."""
    translation: CalibratedPart = CalibratedPart(False, sigma=0.02, min_correction=0.005, walk=1e-6)
    """Translation of each camera in the IMU frame [m]."""
    focal: CalibratedPart = CalibratedPart(False, sigma=0.01, min_correction=0.003, walk=1e-6)
    """Focal lengths of each camera, relative."""
    principal: CalibratedPart = CalibratedPart(False, sigma=0.01, min_correction=0.003, walk=1e-6)
    """Principal point of each camera, in units of the focal lengths."""
    window_s: Annotated[float, Range(0.5, 60.0)] = 5.0
    """Length of the windows [s]."""
    max_keyframes: Annotated[int, Range(3, 100)] = 30
    """Largest number of keyframes in a window; a window that reaches it ends early."""
    min_keyframes: Annotated[int, Range(3, 100)] = 8
    """Smallest number of keyframes of a window that is adjusted."""
    min_landmarks: Annotated[int, Range(5, 1000)] = 20
    """Smallest number of landmarks of a window that is adjusted."""
    max_rms_px: Annotated[float, Range(above=0.0)] = 2.0
    """Largest root mean square reprojection error of a window whose result is used [px]."""
    inflation_sigmas: Annotated[FiveSigmas, Range(0.0, 10.0)] = (
        0.01,
        0.02,
        0.1,
        0.005,
        0.15,
    )
    """Standard deviations of the error that a wrong calibration leaves in the state when it is corrected: orientation
    [rad], position [m], velocity [m/s], gyroscope bias [rad/s] and accelerometer bias [m/s²]. They correspond to a
    rotation of one degree or a time offset of 5 ms."""
    gravity_inflation_sigmas: Annotated[FiveSigmas, Range(0.0, 10.0)] = (
        0.001,
        0.002,
        0.01,
        0.0,
        0.03,
    )
    """Those that wrong gravity leaves. The accelerometer bias compensates most of it."""
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    """Settings of the adjustment of the windows."""


class OnlineCalibration:
    """Estimates corrections of a rig's calibration and of gravity from keyframes, and holds the calibration in use."""

    def __init__(self, rig: Rig, config: CalibrationConfig | None = None, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        """Begin with a given calibration and magnitude of gravity.

        Args:
            rig: The given calibration.
            config: Settings.
            gravity_m_s2: Given magnitude of gravity [m/s²].
        """
        self._config, self._gravity_m_s2 = config or CalibrationConfig(), gravity_m_s2
        c = self._config
        self._calibration = self._given = Calibration(rig)
        per_camera = [c.rotation] * 3 + [c.translation] * 3 + [c.focal] * 2 + [c.principal] * 2
        parts = [c.time_offset, c.gravity, *per_camera * len(rig.cameras)]
        self._estimated = np.array([part.online for part in parts])
        self._min_correction = np.array([part.min_correction for part in parts])
        self._significance = np.array([part.significance for part in parts])
        self._walk = np.array([part.walk if part.online else 0.0 for part in parts])
        # Parameters that are corrected together: the time offset, gravity, and each part of each camera
        self._part = np.concatenate(
            [[0, 1], *(2 + 4 * i + np.repeat(np.arange(4), [3, 3, 2, 2]) for i in range(len(rig.cameras)))]
        )
        self._mean = np.zeros(len(parts))
        self._covariance = np.diag([(part.sigma if part.online else FIXED_SIGMA) ** 2 for part in parts])
        self._applied = np.zeros(len(parts))
        self._corrected = np.zeros(len(parts), dtype=np.bool_)  # by the last correction
        self._significant = np.zeros(int(self._part.max()) + 1, dtype=np.bool_)
        self._window: list[WindowKeyframe] = []
        self._waiting: list[WindowKeyframe] = []  # a complete window before its adjustment
        self._problem: CalibrationProblem | None = None  # the adjustment under way
        self._has_stepped = False  # since the last keyframe
        self._updated_ns: int | None = None

    @property
    def calibration(self) -> Calibration:
        """The calibration in use; the same object until a correction is applied."""
        return self._calibration

    @property
    def estimate(self) -> Corrections:
        """The estimated corrections, whether they are applied or not."""
        return Corrections.from_vector(self._mean)

    @property
    def sigmas(self) -> Corrections:
        """The standard deviations of `estimate`."""
        return Corrections.from_vector(np.sqrt(np.diag(self._covariance)))

    @property
    def applied(self) -> Corrections:
        """The corrections that are applied to the given calibration."""
        return Corrections.from_vector(self._applied)

    @property
    def covariance_inflation(self) -> Array:
        """(15, 15) Covariance of the error that the last correction leaves in a state, in the order of `NavState`."""
        c, only_gravity = self._config, not np.delete(self._corrected, GRAVITY).any()
        return np.diag(np.repeat(c.gravity_inflation_sigmas if only_gravity else c.inflation_sigmas, 3) ** 2)

    def restart(self) -> None:
        """Discard the windows under way, because the states are not consistent with those that follow."""
        self._window, self._waiting, self._problem = [], [], None

    def add(
        self,
        state: NavState,
        angular_velocity_rad_s: Array,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        observations: Observations,
    ) -> bool:
        """Add a keyframe and return whether the calibration in use has changed.

        Args:
            state: The smoother's newest state.
            angular_velocity_rad_s: (3,) Angular velocity of the IMU at the keyframe, bias removed [rad/s].
            preintegrated: The preintegrated measurements since the previous keyframe.
            observations: The features of the keyframe by the calibration in use.
        """
        if not self._estimated.any():
            return False
        c, applied = self._config, self.applied
        parts = (observations, observations.matches, observations.miscalibrated)
        ids, camera, xy = (np.concatenate([getattr(p, name) for p in parts]) for name in ("ids", "camera", "xy"))
        xy = (1.0 + applied.focal[camera]) * xy + applied.principal[camera]
        gravity_m_s2 = self._gravity_m_s2 + applied.gravity_m_s2
        self._window.append(
            WindowKeyframe(
                state, angular_velocity_rad_s, applied.time_offset_s, gravity_m_s2, preintegrated, ids, camera, xy
            )
        )
        if not self._has_stepped:
            self.step()
        self._has_stepped = False
        span_s = (state.t_ns - self._window[0].state.t_ns) * 1e-9
        if span_s >= c.window_s or len(self._window) >= c.max_keyframes:
            self._waiting, self._window = self._window, []
        return self._problem is not None and self._problem.is_done and self._conclude(self._problem)

    def step(self) -> None:
        """Perform one step of the adjustment under way, at frames between keyframes, which leave time for it."""
        self._has_stepped = True
        if self._waiting:
            window, self._waiting = self._waiting, []
            self._begin(window)
        elif self._problem is not None and not self._problem.is_done:
            self._problem.step()

    def _begin(self, window: Sequence[WindowKeyframe]) -> None:
        """Set up the adjustment of a window, if it has enough keyframes and landmarks."""
        c, now_ns = self._config, window[-1].state.t_ns
        elapsed_s = 0.0 if self._updated_ns is None else (now_ns - self._updated_ns) * 1e-9
        self._updated_ns = now_ns
        self._covariance = self._covariance + np.diag(self._walk**2 * elapsed_s)
        problem = CalibrationProblem(
            window,
            self._given.Ts_imu_cam,
            float(self._given.focal_px[0]),
            c.adjustment,
            self._mean,
            np.linalg.inv(self._covariance),
            self._estimated,
            self._gravity_m_s2,
        )
        if len(window) >= c.min_keyframes and problem.landmark_count >= c.min_landmarks:
            self._problem = problem

    def _conclude(self, problem: CalibrationProblem) -> bool:
        """Take over the result of a window, if it has one, and return whether the calibration in use has changed."""
        self._problem, found = None, problem.result
        if found is None or not found.rms_px < self._config.max_rms_px:
            return False
        self._mean, self._covariance = found.mean, np.linalg.inv(found.information)
        return self._apply()

    def _apply(self) -> bool:
        """Apply the corrections that are significant and large enough, and return whether there are any."""
        difference = np.abs(self._mean - self._applied)
        sigmas = np.sqrt(np.diag(self._covariance))
        significant = self._estimated & (difference > np.maximum(self._significance * sigmas, self._min_correction))
        self._significant[self._part[significant]] = True
        if not significant.any():
            return False
        self._corrected = self._significant[self._part] & self._estimated
        self._applied = np.where(self._corrected, self._mean, self._applied)
        self._calibration = _corrected(self._given, self.applied)
        return True


def _corrected(given: Calibration, corrections: Corrections) -> Calibration:
    """Return a given calibration with corrections applied."""
    Ts = given.Ts_imu_cam @ pose_matrix(exp_so3(corrections.rotation_rad), np.zeros_like(corrections.translation_m))
    Ts[:, :3, 3] += corrections.translation_m
    cameras = zip(given.rig.cameras, Ts, strict=True)
    rig = replace(given.rig, cameras=tuple(replace(camera, T_imu_cam=T) for camera, T in cameras))
    intrinsics = corrections.focal.any() or corrections.principal.any()
    return Calibration(
        rig,
        corrections.time_offset_s,
        corrections.focal if intrinsics else None,
        corrections.principal if intrinsics else None,
        corrections.gravity_m_s2,
    )
