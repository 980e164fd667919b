"""Online calibration: corrections of time offset, gravity, extrinsics and intrinsics, where a flight requires them.

A given calibration is kept until the observations of a window of keyframes contradict it. Successive windows do not
overlap, so that each observation is used once. Each window is adjusted with the calibration among the unknowns
(`dronevio.estimator.calibration.adjustment`), and its result is fused with that of the windows before it in an
information filter (`dronevio.estimator.calibration.estimate`). No decision about observability is needed: a hover
leaves every parameter as it was. A correction is applied when it is statistically significant and large enough to
matter; that part then follows the estimate.

What happens before a correction is lost, so it comes early. The matches of the first keyframe determine the rotation
between the cameras, also at rest. A window in motion begins with the last keyframe at rest, and its beginning is
adjusted several times while it grows. Because the state at rest does not depend on the calibration, such a window also
determines the newest state by the corrected calibration, with which the odometry continues. So does any window by which
intrinsics turn out to be very wrong.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from dronevio.estimator.calibration.adjustment import CalibrationProblem
from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.corrected_state import propagated_state
from dronevio.estimator.calibration.corrections import GRAVITY, Corrections, inverse_depth_errors
from dronevio.estimator.calibration.estimate import ParameterEstimate, covariance_inflation, inflation_share
from dronevio.estimator.calibration.objective import CalibrationObjective
from dronevio.estimator.calibration.parameters import ParameterTable
from dronevio.estimator.calibration.significance import SignificanceTest
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.calibration.window_collector import NO_KEYFRAMES, CalibrationWindow
from dronevio.estimator.types import Calibration, CalibrationSigmas, Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import Rig
from dronevio.models.state import NavState

MIN_PART_KEYFRAMES = 5
"""Smallest number of keyframes of the beginning of a window that is adjusted before it is complete."""
KEPT_INFLATION = 0.5
"""Share of the covariance inflation up to which the odometry keeps its window; after larger corrections it continues
from the adjustment's newest state, if that is determined."""
MIN_RELATIVE_CORRECTION = 0.0015
"""Smallest correction of the rotation between cameras by the matches of the first keyframe, over all rotation
parameters together [rad]."""
MAX_RELATIVE_SIGMAS = 4.0
"""Prior standard deviations beyond which the matches of a keyframe have another cause than the cameras' rotation."""


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
    """Settings of the online calibration."""

    def problem(
        self, window: CalibrationWindow, estimate: ParameterEstimate, config: AdjustmentConfig
    ) -> CalibrationProblem:
        """Return the adjustment of a window, with an estimate as its prior.

        A window that begins at rest does not estimate gravity, because the accelerometer bias of its prior is that for
        the gravity in use.
        """
        at_rest, is_unknown = window.begins_stationary, self.parameters.is_unknown
        initial = np.where(estimate.follows, estimate.applied, estimate.mean)
        if at_rest:
            is_unknown[GRAVITY], initial[GRAVITY] = False, estimate.applied[GRAVITY]
            config = replace(config, pixel_sigma=config.stationary_pixel_sigma)
        prior = estimate.mean, _inverse(estimate.covariance), is_unknown, self.gravity_m_s2
        objective = CalibrationObjective.of(
            window.keyframes, self.given, config, *prior, initial=initial, begins_stationary=at_rest
        )
        return CalibrationProblem(objective, config, window.keyframes[-1].state.t_ns)


@dataclass(frozen=True)
class Idle:
    """No window is adjusted."""


@dataclass(frozen=True, eq=False)
class Adjusting:
    """A window is adjusted, one step at a time."""

    window: CalibrationWindow
    """The window under adjustment."""
    problem: CalibrationProblem
    """Its adjustment, which changes with each step."""


@dataclass(frozen=True, eq=False)
class Collected:
    """A window waits for its adjustment."""

    window: CalibrationWindow
    """The window that waits."""
    earlier: Idle | Adjusting
    """What goes on if this window has too few keyframes or landmarks."""


class OnlineCalibration:
    """Estimates corrections of a rig's calibration and of gravity from keyframes, and holds the calibration in use."""

    def __init__(self, rig: Rig, config: CalibrationConfig | None = None, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        """Begin with a given calibration and magnitude of gravity.

        Args:
            rig: The given calibration.
            config: Settings.
            gravity_m_s2: Given magnitude of gravity [m/s²].
        """
        c, cameras, given = config or CalibrationConfig(), len(rig.cameras), Calibration(rig)
        parameters = ParameterTable.of(c, cameras, inverse_depth_errors(given))
        self._prior = CalibrationPrior(given, gravity_m_s2, parameters, c)
        self._estimate, self._calibration = ParameterEstimate.prior(self._prior.parameters), self._prior.given
        self._collected = NO_KEYFRAMES
        self._stage: Idle | Collected | Adjusting = Idle()
        self._is_comparing = cameras > 1 and c.rotation.online  # until the cameras have been compared
        self._has_stepped = False  # since the last keyframe
        self._corrected_state: NavState | None = None
        self._corrects_displacement = False

    @property
    def calibration(self) -> Calibration:
        """The calibration in use; the same object until a correction is applied."""
        return self._calibration

    @property
    def estimate(self) -> Corrections:
        """The estimated corrections, whether they are applied or not."""
        return Corrections.from_vector(self._estimate.mean)

    @property
    def sigmas(self) -> Corrections:
        """The standard deviations of `estimate`."""
        return Corrections.from_vector(np.sqrt(np.diag(self._estimate.covariance)))

    @property
    def uncertainty(self) -> CalibrationSigmas:
        """The standard deviations of the error of the calibration in use, of the first camera."""
        return self._estimate.seen_sigmas

    @property
    def applied(self) -> Corrections:
        """The corrections that are applied to the given calibration."""
        return Corrections.from_vector(self._estimate.applied)

    @property
    def is_plausible(self) -> bool:
        """Whether all corrections so far have been plausible; an estimate cannot be trusted after one that was not."""
        return self._estimate.is_plausible

    @property
    def is_known(self) -> bool:
        """Whether the given calibration has not been refuted, or the calibration is known again."""
        return self._estimate.is_known(self._prior.parameters)

    @property
    def covariance_inflation(self) -> Array:
        """(15, 15) Covariance of the error that the last correction leaves in a state, in the order of `NavState`."""
        return covariance_inflation(self._estimate.newest_change, self._prior.config)

    @property
    def corrected_state(self) -> NavState | None:
        """The newest state by the last correction, with its covariance; None where the window does not determine it.

        It is that of the adjustment after a large correction, if the window begins at rest, where the state does not
        depend on the calibration, or if intrinsics are very wrong, which have bent the window of the odometry. Little
        is assumed of the first state of a window that begins in motion.
        """
        return self._corrected_state

    @property
    def corrects_displacement(self) -> bool:
        """Whether `corrected_state` contains no error of the calibration before: its window began at rest."""
        return self._corrects_displacement

    def restart(self) -> None:
        """Discard the windows under way, because the states are not consistent with those that follow."""
        self._collected, self._stage = NO_KEYFRAMES, Idle()

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
        if not self._prior.parameters.groups:
            return False
        # Observations by the given calibration, which stay valid when another correction is applied
        c, parts = self._calibration, (observations, observations.matches, observations.miscalibrated)
        ids, camera, xy = (np.concatenate([getattr(p, name) for p in parts]) for name in ("ids", "camera", "xy"))
        xy, gravity_m_s2 = c.given_xy(xy, camera), self._prior.gravity_m_s2 + c.gravity_correction_m_s2
        keyframe = WindowKeyframe(
            state, angular_velocity_rad_s, c.time_offset_correction_s, gravity_m_s2, preintegrated, ids, camera, xy
        )
        # Windows of successive keyframes
        if not stationary and not self._collected.is_connected(keyframe):
            self.restart()
        self._collected, window = self._collected.added(keyframe, self._prior.config, stationary=stationary)
        if self._is_comparing and self._compare_cameras(keyframe):
            self._corrected_state, is_corrected = state if stationary else None, True
            self._corrects_displacement = stationary
        else:
            is_corrected = self._conclude(window)
        # A complete window, or a longer part of one, replaces the one that waits
        if window is not None:
            stage = self._stage
            self._stage = Collected(window, stage.earlier if isinstance(stage, Collected) else stage)
        self._has_stepped = False
        return is_corrected

    def step(self) -> None:
        """Perform one step of the adjustment under way, at frames between keyframes, which leave time for it."""
        self._has_stepped, stage = True, self._stage
        if isinstance(stage, Collected):
            self._stage = self._adjusting(stage.window) or stage.earlier
        elif isinstance(stage, Adjusting) and not stage.problem.is_done:
            stage.problem.step()

    def _compare_cameras(self, keyframe: WindowKeyframe) -> bool:
        """Estimate the rotation between the cameras from one keyframe; return whether the calibration has changed.

        Matches observe it in any motion and at rest, before a wrong depth can harm the estimate. The rotation common to
        all cameras keeps its prior.
        """
        c = self._prior.config
        if len(keyframe.ids) - len(np.unique(keyframe.ids)) < c.min_landmarks:
            return False
        config = replace(c.adjustment, min_views=2, max_reprojection_px=100.0, iterations=10, max_decrement=0.002)
        window = CalibrationWindow((keyframe,), begins_stationary=False, is_complete=False)
        problem = self._prior.problem(window, self._estimate, config)
        if problem.landmark_count < c.min_landmarks:
            return False
        self._is_comparing = False
        while not problem.is_done:
            problem.step()
        result = problem.result
        if result is None or not result.is_consistent:
            return False
        if np.abs(Corrections.from_vector(result.mean).rotation_rad).max() > MAX_RELATIVE_SIGMAS * c.rotation.sigma:
            return False
        test = SignificanceTest(MIN_RELATIVE_CORRECTION, MIN_RELATIVE_CORRECTION, corrects_intrinsics=False)
        return self._apply(result.mean, _inverse(result.information), test, is_complete=False)

    def _adjusting(self, window: CalibrationWindow) -> Adjusting | None:
        """Set up the adjustment of a window, if it has enough keyframes and landmarks."""
        c = self._prior.config
        predicted = self._estimate.predicted(window.keyframes[-1].state.t_ns, self._prior.parameters.walk)
        if window.is_complete:
            self._estimate = predicted
        if len(window.keyframes) < (c.min_keyframes if window.is_complete else MIN_PART_KEYFRAMES):
            return None
        problem = self._prior.problem(window, predicted, c.adjustment)
        return Adjusting(window, problem) if problem.landmark_count >= c.min_landmarks else None

    def _conclude(self, due: CalibrationWindow | None) -> bool:
        """Take over the result of the adjustment if it is done, and return whether the calibration in use has changed.

        Args:
            due: The window that ends with the newest keyframe, if one does.
        """
        if not self._has_stepped:
            self.step()
        stage = self._stage
        if not isinstance(stage, Adjusting) or not stage.problem.is_done:
            return False
        window, result, self._stage = stage.window, stage.problem.result, Idle()
        if result is None or not result.is_consistent:
            return False
        # Information filter: the prior of the adjustment was the estimate, so that its posterior is the next estimate
        mean, covariance = result.mean.copy(), _inverse(result.information)
        if window.begins_stationary:
            mean[GRAVITY] = self._estimate.mean[GRAVITY]
        self._estimate = self._estimate.fused(mean, covariance, is_complete=window.is_complete)
        self._calibration = self._with_depth(self._calibration)
        # Significance test of each group of parameters
        c, cameras = self._prior.config, len(self._prior.given.rig.cameras)
        begins, is_complete = window.begins_stationary, window.is_complete
        test = SignificanceTest.of_window(c, cameras, begins_stationary=begins, is_complete=is_complete)
        if not self._apply(mean, covariance, test, is_complete=is_complete):
            return False
        self._corrected_state, self._corrects_displacement = None, begins
        # After a large correction, the newest state by the adjustment, propagated over the keyframes since
        first, change = window.keyframes[0].state.covariance, self._estimate.newest_change
        determines = begins or self._prior.parameters.refutes_intrinsics(change)
        if first is not None and determines and inflation_share(change) > KEPT_INFLATION:
            t_ns, newest = result.newest.t_ns, result.newest_given(self._estimate.applied)
            waiting = due.keyframes if due is not None and due.is_complete else ()
            later = (*(k for k in waiting if k.state.t_ns > t_ns), *self._collected.after(t_ns))
            self._corrected_state = propagated_state(newest, later, first[3:6, 3:6], self._prior.given.rig.imu)
            if window.is_complete:
                self._collected = NO_KEYFRAMES  # its states do not continue those that follow
        return True

    def _apply(self, mean: Array, covariance: Array, test: SignificanceTest, *, is_complete: bool) -> bool:
        """Apply the corrections that are significant, and return whether there are any."""
        parameters = self._prior.parameters
        corrected = self._estimate.corrected(mean, covariance, parameters, test, is_complete=is_complete)
        if corrected is None:
            return False
        self._estimate = corrected
        self._calibration = self._with_depth(Corrections.from_vector(corrected.applied).applied_to(self._prior.given))
        return True

    def _with_depth(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the cameras that do not determine depths."""
        without = self._estimate.cameras_without_depth(self._prior.parameters)
        return calibration if without == calibration.without_depth else replace(calibration, without_depth=without)


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a covariance or information matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
