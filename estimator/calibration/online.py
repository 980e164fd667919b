"""Online calibration: time offset, mounting and intrinsics of the cameras, where the flight shows that they are wrong.

What a calibration says is believed until the sightings of a window of keyframes disprove it. Windows follow each other
without overlap, so that each sighting counts once; each is adjusted with the calibration among the unknowns
(`dronevio.estimator.calibration.adjustment`), and what it says is added to what the windows before it said: an
information filter. It needs no decision on what can be observed: a hover leaves everything as it was. A correction is
applied when it is significant and large enough to matter; from then on that part follows the estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.adjustment import CalibrationProblem
from dronevio.estimator.calibration.corrections import Corrections
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.types import Observations
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

FIXED_SIGMA = 1e-9  # standard deviation of what is not estimated: nothing moves it, and matrices keep their digits


@dataclass(frozen=True)
class CalibratedPart:
    """One part of the calibration, in the unit of its numbers."""

    online: bool
    """Whether it is estimated."""
    sigma: float
    """How far off the calibration may be: standard deviation."""
    min_correction: float
    """Below this size, a correction is not applied."""
    walk: float
    """How fast it may change, by temperature and age, in its unit a root second."""


@dataclass(frozen=True)
class CalibrationConfig:
    """What of the calibration is estimated in flight."""

    time_offset: CalibratedPart = CalibratedPart(True, sigma=0.01, min_correction=0.0025, walk=1e-5)
    """Of the cameras' clock [s]. Half an interval of an IMU at 200 Hz matters."""
    rotation: CalibratedPart = CalibratedPart(True, sigma=0.02, min_correction=0.005, walk=1e-5)
    """Of each camera, about each axis [rad]. A degree is a bad mount; a quarter of it matters."""
    translation: CalibratedPart = CalibratedPart(False, sigma=0.02, min_correction=0.005, walk=1e-6)
    """Of each camera in the IMU frame [m]."""
    focal: CalibratedPart = CalibratedPart(False, sigma=0.01, min_correction=0.003, walk=1e-6)
    """Focal lengths, relative. One percent is a lens that was screwed in anew."""
    principal: CalibratedPart = CalibratedPart(False, sigma=0.01, min_correction=0.003, walk=1e-6)
    """Principal points, in focal lengths."""
    significance: float = 3.0
    """Standard deviations by which a correction must differ from what is believed."""
    window_s: float = 5.0
    """Length of the windows [s]."""
    max_keyframes: int = 30
    """A window of so many keyframes ends early."""
    min_keyframes: int = 8
    """Shorter ones say nothing."""
    min_landmarks: int = 20
    """Landmarks that must be seen in a window."""
    max_rms_px: float = 2.0
    """A window whose sightings fit worse, whatever the calibration, says nothing [px]."""
    doubt: tuple[float, float, float, float, float] = (0.01, 0.02, 0.1, 0.005, 0.15)
    """How far off a state is that was estimated with a wrong calibration: orientation [rad], position [m], velocity
    [m/s], the biases of gyroscope [rad/s] and accelerometer [m/s²]: about what a degree or 5 ms does."""
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    """Settings of the windows' adjustment."""


class OnlineCalibration:
    """Listens to keyframes, and says what of a rig's calibration is wrong."""

    def __init__(self, rig: Rig, config: CalibrationConfig | None = None) -> None:
        """Begin by believing a calibration.

        Args:
            rig: The calibration.
            config: What is estimated.
        """
        self._config = c = config or CalibrationConfig()
        self._believed = rig
        self._Ts_imu_cam = np.stack([camera.T_imu_cam for camera in rig.cameras])
        self._focal_px = rig.cameras[0].model.fx
        per_camera = [c.rotation] * 3 + [c.translation] * 3 + [c.focal] * 2 + [c.principal] * 2
        parts = [c.time_offset, *per_camera * len(rig.cameras)]
        self._estimated = np.array([part.online for part in parts])
        self._min_correction = np.array([part.min_correction for part in parts])
        self._walk = np.array([part.walk if part.online else 0.0 for part in parts])
        # Numbers that are right or wrong together: the time offset, and each part of each camera
        self._part = np.concatenate(
            [[0], *(1 + 4 * i + np.repeat(np.arange(4), [3, 3, 2, 2]) for i in range(len(rig.cameras)))]
        )
        self._mean = np.zeros(len(parts))
        self._covariance = np.diag([(part.sigma if part.online else FIXED_SIGMA) ** 2 for part in parts])
        self._applied = np.zeros(len(parts))
        self._significant = np.zeros(int(self._part.max()) + 1, dtype=np.bool_)
        self._window: list[WindowKeyframe] = []
        self._waiting: list[WindowKeyframe] = []  # a window that is to be adjusted
        self._adjusted: CalibrationProblem | None = None  # the one on which work goes on
        self._has_worked = False  # since the last keyframe
        self._updated_ns: int | None = None

    @property
    def estimate(self) -> Corrections:
        """What the flight says so far, whether it is applied or not."""
        return Corrections.from_vector(self._mean)

    @property
    def sigmas(self) -> Corrections:
        """The standard deviations of `estimate`."""
        return Corrections.from_vector(np.sqrt(np.diag(self._covariance)))

    @property
    def applied(self) -> Corrections:
        """What the calibration is to be corrected by."""
        return Corrections.from_vector(self._applied)

    @property
    def rig(self) -> Rig:
        """The rig with what is applied to its cameras' mountings."""
        applied = self.applied
        turned = self._Ts_imu_cam @ pose_matrix(exp_so3(applied.rotation_rad), np.zeros_like(applied.translation_m))
        turned[:, :3, 3] += applied.translation_m
        cameras = zip(self._believed.cameras, turned, strict=True)
        return replace(self._believed, cameras=tuple(replace(camera, T_imu_cam=T) for camera, T in cameras))

    @property
    def doubt(self) -> Array:
        """(15, 15) How unsure, beside its covariance, a state is that was estimated with a wrong calibration."""
        return np.diag(np.repeat(self._config.doubt, 3) ** 2)

    def corrected(self, seen: Observations) -> Observations:
        """Return sightings as cameras of the corrected intrinsics normalize them."""
        applied = self.applied
        if not applied.focal.any() and not applied.principal.any():
            return seen

        def normalized(xy: Array, camera: npt.NDArray[np.int64]) -> Array:
            return np.asarray((xy - applied.principal[camera]) / (1.0 + applied.focal[camera]))

        matches, miscalibrated = (replace(m, xy=normalized(m.xy, m.camera)) for m in (seen.matches, seen.miscalibrated))
        return replace(seen, xy=normalized(seen.xy, seen.camera), matches=matches, miscalibrated=miscalibrated)

    def restart(self) -> None:
        """Begin a new window: what came so far does not hang together with what comes."""
        self._window, self._waiting, self._adjusted = [], [], None

    def add(
        self,
        state: NavState,
        rate_rad_s: Array,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        seen: Observations,
    ) -> bool:
        """Take a keyframe, and say whether what is applied has changed.

        Args:
            state: The smoother's newest state.
            rate_rad_s: (3,) How fast the IMU turns there, bias taken out [rad/s].
            preintegrated: The IMU since the keyframe before.
            seen: Its features, at the frame's time as the corrections that are applied have it.
        """
        if not self._estimated.any():
            return False
        c, applied = self._config, self.applied
        sightings = (seen, seen.matches, seen.miscalibrated)
        ids, camera, xy = (np.concatenate([getattr(s, name) for s in sightings]) for name in ("ids", "camera", "xy"))
        xy = (1.0 + applied.focal[camera]) * xy + applied.principal[camera]
        self._window.append(WindowKeyframe(state, rate_rad_s, applied.time_offset_s, preintegrated, ids, camera, xy))
        if not self._has_worked:
            self.work()
        self._has_worked = False
        span_s = (state.t_ns - self._window[0].state.t_ns) * 1e-9
        if span_s >= c.window_s or len(self._window) >= c.max_keyframes:
            self._waiting, self._window = self._window, []
        return self._adjusted is not None and self._adjusted.is_done and self._conclude(self._adjusted)

    def work(self) -> None:
        """Go on with the adjustment of a window by a step; best at frames between keyframes, which have time for it."""
        self._has_worked = True
        if self._waiting:
            window, self._waiting = self._waiting, []
            self._begin(window)
        elif self._adjusted is not None and not self._adjusted.is_done:
            self._adjusted.step()

    def _begin(self, window: Sequence[WindowKeyframe]) -> None:
        """Arrange a window to be adjusted, if it is worth it."""
        c, now_ns = self._config, window[-1].state.t_ns
        elapsed_s = 0.0 if self._updated_ns is None else (now_ns - self._updated_ns) * 1e-9
        self._updated_ns = now_ns
        self._covariance = self._covariance + np.diag(self._walk**2 * elapsed_s)
        problem = CalibrationProblem(
            window,
            self._Ts_imu_cam,
            self._focal_px,
            c.adjustment,
            self._mean,
            np.linalg.inv(self._covariance),
            self._estimated,
        )
        if len(window) >= c.min_keyframes and problem.landmark_count >= c.min_landmarks:
            self._adjusted = problem

    def _conclude(self, problem: CalibrationProblem) -> bool:
        """Take over what a window says, if it says anything; say whether what is applied has changed."""
        self._adjusted, found = None, problem.result
        if found is None or not found.rms_px < self._config.max_rms_px:
            return False
        self._mean, self._covariance = found.mean, np.linalg.inv(found.information)
        return self._apply()

    def _apply(self) -> bool:
        """Apply what is significant and matters; say whether that changed anything."""
        off = np.abs(self._mean - self._applied)
        sigmas = np.sqrt(np.diag(self._covariance))
        wrong = self._estimated & (off > np.maximum(self._config.significance * sigmas, self._min_correction))
        self._significant[self._part[wrong]] = True
        if not wrong.any():
            return False
        self._applied = np.where(self._significant[self._part] & self._estimated, self._mean, self._applied)
        return True
