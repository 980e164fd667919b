"""Online calibration: corrections of time offset, gravity, extrinsics and intrinsics, where a flight requires them.

A given calibration is kept until the observations of a window of keyframes contradict it. Successive windows do not
overlap, so that each observation is used once. Each window is adjusted with the calibration among the unknowns
(`dronevio.estimator.calibration.adjustment`), and its result is fused with that of the windows before it in an
information filter. No decision about observability is needed: a hover leaves every parameter as it was. A correction is
applied when it is statistically significant and large enough to matter; that part then follows the estimate.

What happens before a correction is lost, so it comes early. The matches of the first keyframe determine the rotation
between the cameras, also at rest. A window in motion begins with the last keyframe at rest, and its beginning is
adjusted several times while it grows. Because the state at rest does not depend on the calibration, such a window also
determines the newest state by the corrected calibration, with which the odometry continues.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.adjustment import CalibrationProblem
from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.corrected_state import propagated_state
from dronevio.estimator.calibration.corrections import GRAVITY, Corrections
from dronevio.estimator.calibration.objective import CalibrationObjective
from dronevio.estimator.calibration.significance import significant_length
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.calibration.window_collector import CalibrationWindow, WindowCollector
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

FIXED_SIGMA = 1e-9  # standard deviation of parameters that are not estimated; it keeps the matrices regular
MIN_PART_KEYFRAMES = 5
"""Smallest number of keyframes of such a part."""
REFINEMENT_SIGMAS = 1.0
"""Significance of further corrections of a part of the calibration that is known to be wrong."""
INFLATION_CORRECTION = (5e-3, np.radians(1.0))
"""Corrections of time offset [s] and rotation [rad] to which `CalibrationConfig.inflation_sigmas` correspond."""
MAX_RELATIVE_SIGMAS = 4.0
"""Prior standard deviations beyond which the matches of a keyframe have another cause than the cameras' rotation."""
MIN_INFLATION = 0.03
"""Smallest share of these that is applied, however small a correction is."""
KEPT_INFLATION = 0.5
"""Share of these up to which the odometry keeps its window; after larger corrections it continues from the adjustment's
newest state, if that is determined."""
STATIONARY_SIGMAS = 4.0
"""Significance of a first correction by a window that begins at rest, or by a part of it: systematic errors of the
take-off dominate there."""
_ROTATION = 2  # index of the part that holds the rotations of all cameras


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
        sigmas = np.array([part.sigma if part.online else FIXED_SIGMA for part in parts])
        is_position = np.r_[[False, False], np.tile(np.repeat([False, True, False], [3, 3, 4]), len(rig.cameras))]
        if len(rig.cameras) > 1 and not c.translation.online and c.position_sigma_m > FIXED_SIGMA:
            sigmas[is_position] = c.position_sigma_m
        self._unknown = sigmas > FIXED_SIGMA  # in adjustments, whether it is corrected or not
        self._sigmas, self._is_plausible = sigmas, True
        self._min_correction = np.array([part.min_correction for part in parts])
        self._significance = np.array([part.significance for part in parts])
        self._refinement = np.array([part.refinement for part in parts])
        self._walk = np.array([part.walk if part.online else 0.0 for part in parts])
        # Parameters that are corrected together: the time offset, gravity, the rotations of all cameras, because a
        # window determines the rotation between two cameras better than that of each, and the other parts of a camera
        self._part = np.concatenate(
            [[0, 1], *(np.repeat([2, 3 + 3 * i, 4 + 3 * i, 5 + 3 * i], [3, 3, 2, 2]) for i in range(len(rig.cameras)))]
        )
        self._mean = np.zeros(len(parts))
        self._covariance = np.diag(sigmas**2)
        self._applied = np.zeros(len(parts))
        self._corrected = np.zeros(len(parts), dtype=np.bool_)  # by the last correction
        self._significant = np.zeros(int(self._part.max()) + 1, dtype=np.bool_)
        self._collector = WindowCollector(c)
        self._waiting: CalibrationWindow | None = None  # before its adjustment
        self._problem: CalibrationProblem | None = None  # the adjustment under way
        self._adjusted: CalibrationWindow | None = None  # its window
        self._is_comparing = len(rig.cameras) > 1 and c.rotation.online  # until the cameras have been compared
        self._corrected_state: NavState | None = None
        self._inflation = 1.0  # share of the covariance inflation
        self._has_stepped = False  # since the last keyframe
        self._updated_ns: int | None = None
        self._is_verified = False
        self._found_covariance = self._covariance  # by the last adjustment, also of a part of a window

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
    def is_verified(self) -> bool:
        """Whether a window in motion has been adjusted, or has corrected the calibration."""
        return self._is_verified

    @property
    def newest_sigmas(self) -> Corrections:
        """The standard deviations by the last adjustment, also of a part of a window, or by the prior."""
        return Corrections.from_vector(np.sqrt(np.diag(self._found_covariance)))

    @property
    def applied(self) -> Corrections:
        """The corrections that are applied to the given calibration."""
        return Corrections.from_vector(self._applied)

    @property
    def is_plausible(self) -> bool:
        """Whether all corrections so far have been plausible; an estimate cannot be trusted after one that was not."""
        return self._is_plausible

    @property
    def covariance_inflation(self) -> Array:
        """(15, 15) Covariance of the error that the last correction leaves in a state, in the order of `NavState`."""
        c, only_gravity = self._config, not np.delete(self._corrected, GRAVITY).any()
        sigmas = np.array(c.gravity_inflation_sigmas if only_gravity else c.inflation_sigmas)
        return np.diag(np.repeat((1.0 if only_gravity else self._inflation) * sigmas, 3) ** 2)

    @property
    def corrected_state(self) -> NavState | None:
        """The newest state by the last correction, with its covariance; None where the window does not determine it.

        A window that begins at rest determines it, because a stationary vehicle's state does not depend on the
        calibration.
        """
        return self._corrected_state

    def restart(self) -> None:
        """Discard the windows under way, because the states are not consistent with those that follow."""
        self._collector.restart()
        self._waiting, self._problem, self._adjusted = None, None, None

    def add(
        self,
        state: NavState,
        angular_velocity_rad_s: Array,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        observations: Observations,
        stationary: bool = False,
    ) -> bool:
        """Add a keyframe and return whether the calibration in use has changed.

        Args:
            state: The smoother's newest state.
            angular_velocity_rad_s: (3,) Angular velocity of the IMU at the keyframe, bias removed [rad/s].
            preintegrated: The preintegrated measurements since the previous keyframe.
            observations: The features of the keyframe by the calibration in use.
            stationary: Whether the vehicle is stationary since the previous keyframe. A window begins with the last
                such keyframe before a motion.
        """
        if not self._estimated.any():
            return False
        applied = self.applied
        parts = (observations, observations.matches, observations.miscalibrated)
        ids, camera, xy = (np.concatenate([getattr(p, name) for p in parts]) for name in ("ids", "camera", "xy"))
        xy = (1.0 + applied.focal[camera]) * xy + applied.principal[camera]
        gravity_m_s2 = self._gravity_m_s2 + applied.gravity_m_s2
        keyframe = WindowKeyframe(
            state, angular_velocity_rad_s, applied.time_offset_s, gravity_m_s2, preintegrated, ids, camera, xy
        )
        if not stationary and not self._collector.is_connected(keyframe):
            self.restart()
        window = self._collector.add(keyframe, stationary)
        if self._is_comparing and self._compare_cameras(keyframe):
            self._waiting = window or self._waiting
            self._corrected_state = state if stationary else None
            return True
        if not self._has_stepped:
            self.step()
        self._has_stepped = False
        self._waiting = window or self._waiting
        return self._problem is not None and self._problem.is_done and self._conclude(self._problem)

    def step(self) -> None:
        """Perform one step of the adjustment under way, at frames between keyframes, which leave time for it."""
        self._has_stepped = True
        if self._waiting is not None:
            window, self._waiting = self._waiting, None
            self._begin(window)
        elif self._problem is not None and not self._problem.is_done:
            self._problem.step()

    def _compare_cameras(self, keyframe: WindowKeyframe) -> bool:
        """Estimate the rotation between the cameras from one keyframe; return whether the calibration has changed.

        Matches observe it in any motion and at rest, before a wrong depth can harm the estimate. The rotation common to
        all cameras keeps its prior.
        """
        c = self._config
        if len(keyframe.ids) - len(np.unique(keyframe.ids)) < c.min_landmarks:
            return False
        config = replace(c.adjustment, min_views=2, max_reprojection_px=100.0, iterations=10, max_decrement=0.1)
        problem = self._problem_of(CalibrationWindow((keyframe,), False, is_complete=False), config, self._covariance)
        if problem.landmark_count < c.min_landmarks:
            return False
        self._is_comparing = False
        while not problem.is_done:
            problem.step()
        found = problem.result
        if found is None or not found.rms_px < c.max_rms_px:
            return False
        if np.abs(Corrections.from_vector(found.mean).rotation_rad).max() > MAX_RELATIVE_SIGMAS * c.rotation.sigma:
            return False
        return self._apply(found.mean, _inverse(found.information), c.min_relative_correction)

    def _begin(self, window: CalibrationWindow) -> None:
        """Set up the adjustment of a window, if it has enough keyframes and landmarks."""
        c, now_ns = self._config, window.keyframes[-1].state.t_ns
        elapsed_s = 0.0 if self._updated_ns is None else (now_ns - self._updated_ns) * 1e-9
        covariance = self._covariance + np.diag(self._walk**2 * elapsed_s)
        if window.is_complete:
            self._updated_ns, self._covariance = now_ns, covariance
        if len(window.keyframes) < (c.min_keyframes if window.is_complete else MIN_PART_KEYFRAMES):
            return
        problem = self._problem_of(window, c.adjustment, covariance)
        if problem.landmark_count >= c.min_landmarks:
            self._problem, self._adjusted = problem, window

    def _problem_of(self, window: CalibrationWindow, config: AdjustmentConfig, covariance: Array) -> CalibrationProblem:
        """Return the adjustment of a window with a prior covariance.

        A window that begins at rest does not estimate gravity, because the accelerometer bias of its prior is that for
        the gravity in use.
        """
        unknown = self._unknown.copy()
        initial = np.where(self._significant[self._part], self._applied, self._mean)
        if window.begins_stationary:
            unknown[GRAVITY], initial[GRAVITY] = False, self._applied[GRAVITY]
            config = replace(config, pixel_sigma=config.stationary_pixel_sigma)
        objective = CalibrationObjective.of(
            window.keyframes,
            self._given.Ts_imu_cam,
            float(self._given.focal_px[0]),
            config,
            self._mean,
            _inverse(covariance),
            unknown,
            self._gravity_m_s2,
            initial=initial,
            begins_stationary=window.begins_stationary,
        )
        return CalibrationProblem(objective, config, window.keyframes[-1].state.t_ns)

    def _conclude(self, problem: CalibrationProblem) -> bool:
        """Take over the result of a window, if it has one, and return whether the calibration in use has changed.

        The estimate keeps the result of complete windows only, because those that follow a part contain its
        observations, too.
        """
        window, found = self._adjusted, problem.result
        self._problem, self._adjusted = None, None
        if window is None or found is None or not found.rms_px < self._config.max_rms_px:
            return False
        mean, covariance = found.mean, _inverse(found.information)
        self._found_covariance = covariance
        if window.begins_stationary:
            mean[GRAVITY] = self._mean[GRAVITY]
        if window.is_complete:
            self._mean, self._covariance, self._is_verified = mean, covariance, True
        min_sigmas = STATIONARY_SIGMAS if window.begins_stationary else 0.0
        if not self._apply(mean, covariance, by_component=not window.begins_stationary, min_sigmas=min_sigmas):
            return False
        self._corrected_state, self._is_verified = None, True
        first, is_large = window.keyframes[0].state.covariance, self._inflation > KEPT_INFLATION
        if window.begins_stationary and is_large and first is not None and np.delete(self._corrected, GRAVITY).any():
            later = self._keyframes_after(found.newest.t_ns)
            newest = found.newest_given(self._applied)
            self._corrected_state = propagated_state(newest, later, first[3:6, 3:6], self._given.rig.imu)
            if window.is_complete:
                self._collector.discard()  # its states do not continue those that follow
        return True

    def _keyframes_after(self, t_ns: int) -> Sequence[WindowKeyframe]:
        """Return the keyframes since a time [ns], of the windows that wait and are under way."""
        waiting = self._waiting.keyframes if self._waiting is not None and self._waiting.is_complete else ()
        return *(keyframe for keyframe in waiting if keyframe.state.t_ns > t_ns), *self._collector.after(t_ns)

    def _apply(
        self,
        mean: Array,
        covariance: Array,
        min_rotation: float | None = None,
        *,
        by_component: bool = False,
        min_sigmas: float = 0.0,
    ) -> bool:
        """Apply the corrections that are significant and large enough, and return whether there are any.

        Args:
            mean: (D,) Estimated corrections.
            covariance: (D, D) Their covariance.
            min_rotation: Smallest correction of the rotations [rad]; that of the configuration by default.
            by_component: Whether each parameter is tested by itself, and not along the principal axes of the
                covariance. These are more sensitive, also to errors of the states of a window that begins in motion.
            min_sigmas: Smallest significance of a first correction, in standard deviations.
        """
        difference, changed = mean - self._applied, False
        if by_component:
            covariance = np.diag(np.diag(covariance))
        for part, is_known in enumerate(self._significant.copy()):
            rows = np.flatnonzero((self._part == part) & self._estimated)
            if not len(rows):
                continue
            smallest, sigmas, refinement = (
                float(values[rows[0]]) for values in (self._min_correction, self._significance, self._refinement)
            )
            if part == _ROTATION and min_rotation is not None:
                smallest = min_rotation
            elif part == _ROTATION:  # the limit is that of the root mean square over the cameras
                is_first_in_motion = by_component and not is_known
                smallest = max(smallest, self._config.min_motion_correction) if is_first_in_motion else smallest
                smallest *= np.sqrt(len(self._given.rig.cameras))
            if is_known and refinement < 1.0:
                smallest, sigmas = refinement * smallest, min(sigmas, REFINEMENT_SIGMAS)
            else:
                sigmas = max(sigmas, min_sigmas)
            if significant_length(difference[rows], covariance[np.ix_(rows, rows)], sigmas) > smallest:
                self._significant[part] = changed = True
        if not changed:
            return False
        self._corrected = self._significant[self._part] & self._estimated
        self._inflation = self._inflation_share(np.where(self._corrected, difference, 0.0))
        self._applied = np.where(self._corrected, mean, self._applied)
        self._is_plausible &= bool((np.abs(self._applied) <= self._config.max_correction_sigmas * self._sigmas).all())
        self._calibration = _corrected(self._given, self.applied)
        return True

    def _inflation_share(self, step: Array) -> float:
        """Return the share of the covariance inflation that a change (D,) of the corrections requires."""
        if step[self._part > _ROTATION].any():
            return 1.0
        sizes = abs(step[0]), float(np.linalg.norm(step[self._part == _ROTATION]))
        return float(np.clip(max(np.divide(sizes, INFLATION_CORRECTION)), MIN_INFLATION, 1.0))


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a covariance or information matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


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
