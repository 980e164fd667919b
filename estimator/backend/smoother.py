"""The back end: a fixed-lag smoother over keyframes and landmarks.

Each keyframe has a pose, a velocity and biases. GTSAM's preintegrated IMU factors connect consecutive keyframes, and
landmarks connect all keyframes that observe them. With each keyframe the whole window is optimized by Gauss-Newton: the
landmarks are eliminated first (`reprojection`), and what remains is a small dense system (`linear_system`). When the
window is full, either its oldest keyframe is marginalized, with the landmarks that it observes, into a prior
(`marginal_prior`); or, where the vehicle has hardly moved, the second-newest keyframe is dropped, so that the window
keeps its old views and a hovering vehicle does not drift (Leutenegger et al., "Keyframe-based visual-inertial odometry
using nonlinear optimization", IJRR 2015; Usenko et al., "Visual-inertial mapping with non-linear factor recovery",
RA-L 2020).
Landmarks that are still tracked when their first keyframe is marginalized may persist as variables of the prior.

All image coordinates are normalized, so a pixel is 1/fx.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.jolts import optimized
from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate, keyframe_estimate
from dronevio.estimator.backend.landmarks import LandmarkConfig, LandmarkDatabase, TriangulatedLandmarks
from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState
from dronevio.estimator.backend.weighting import median
from dronevio.estimator.backend.window import Window
from dronevio.estimator.imu.covariance import covariance_from_gtsam, covariance_to_gtsam
from dronevio.estimator.imu.noise import ImuVarianceComponents
from dronevio.estimator.optimization.gauss_newton import gauss_newton
from dronevio.estimator.optimization.levenberg_marquardt import levenberg_marquardt
from dronevio.estimator.optimization.linalg import CholeskyFactor, SingularError
from dronevio.estimator.types import GAUGE_SIGMA, NO_FEATURES, Calibration, Observations, common_rows
from dronevio.models.arrays import Array, Integers
from dronevio.models.state import NavState

INITIAL_ROUNDS = 2
"""Number of rounds of the initial bundle adjustment; outliers are rejected before each of them."""
INITIAL_ITERATIONS = 10
"""Number of Levenberg-Marquardt steps per round of the initial bundle adjustment."""
ZUPT_VELOCITY_SIGMA_M_S = 0.01
"""Standard deviation of the velocity in a zero-velocity update [m/s]."""
ZUPT_POSE_SIGMA = 0.003
"""Standard deviation of the relative pose in a zero-velocity update [rad] and [m]."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """The measurements that a keyframe adds to the window."""

    t_ns: int
    """Time of the keyframe [ns]."""
    preintegrated: gtsam.PreintegratedCombinedMeasurements
    """The preintegrated measurements since the previous keyframe."""
    observations: Observations
    """The features of the keyframe."""
    stationary: bool = False
    """Whether the vehicle is stationary since the previous keyframe."""
    rate_rad_s: Array | None = None
    """(3,) Angular velocity of the IMU at the keyframe, bias removed [rad/s]; None if unknown. Without it, the
    observations do not survive a correction of the time offset."""


@dataclass(frozen=True, eq=False)
class KeyframeResult:
    """The result of adding a keyframe."""

    rejected: Integers
    """(N,) Identities of the features that are rejected as outliers."""
    events: tuple[str, ...] = ()
    """Texts for people on failures of the solver, otherwise empty."""
    imu_variance: ImuVarianceComponents | None = None
    """Variance components of the IMU, from the interval that leaves the window."""
    marginalized: KeyframeEstimate | None = None
    """The final estimate of the keyframe that is marginalized, if there is one and it is requested."""


@dataclass(frozen=True, eq=False)
class _Solution:
    """The newest keyframe's state with its covariance."""

    state: NavState
    covariance: Array  # (15, 15)


class KeyframeSmoother:
    """Estimates the states of a window of keyframes."""

    def __init__(
        self,
        calibration: Calibration,
        config: SmootherConfig,
        landmarks: LandmarkConfig,
        start: NavState,
        covariance: Array,
        observations: Observations,
    ) -> None:
        """Begin with one keyframe.

        Args:
            calibration: The calibration.
            config: Settings.
            landmarks: Settings of the landmarks.
            start: The first state.
            covariance: (15, 15) Its covariance, in the order of `NavState`.
            observations: The features of the first keyframe.
        """
        self._calibration, self._config, self._landmark_config = calibration, config, landmarks
        self._window, self._solution = self._begin(start, covariance, observations)
        self._times_ns = {0: start.t_ns}
        self._rates_rad_s: dict[int, Array] = {}  # angular velocities of keyframes in the window
        self._position_covariance = covariance[3:6, 3:6]  # of the keyframe at which the window begins
        self._last_observed = observations, observations  # by the last keyframe but one, and by the last
        self._image_variance: float | None = None
        self._initial_imu_variances: tuple[ImuVarianceComponents, ...] = ()

    @property
    def state(self) -> NavState:
        """The newest keyframe's state."""
        return self._solution.state

    @property
    def gtsam_state(self) -> tuple[gtsam.NavState, gtsam.imuBias.ConstantBias]:
        """The newest keyframe's state as GTSAM's objects, from which preintegration starts."""
        newest = self._window.states[self._window.newest]
        return gtsam.NavState(newest.pose, newest.velocity), newest.bias

    @property
    def landmarks(self) -> Array:
        """(N, 3) Positions in the world of the landmarks that constrain the window [m]."""
        return self._window.landmarks.points.copy()

    @property
    def triangulated_landmarks(self) -> TriangulatedLandmarks:
        """The landmarks that constrain the window."""
        return self._window.landmarks.triangulated(self._window.cameras)

    @property
    def keyframe_times_ns(self) -> tuple[int, ...]:
        """Times of the keyframes in the window [ns]."""
        return tuple(self._times_ns[k] for k in self._window.states)

    @property
    def image_variance(self) -> float | None:
        """Variance of the window's image observations relative to the assumed one; None if it is not observable."""
        return self._image_variance

    @property
    def initial_imu_variances(self) -> tuple[ImuVarianceComponents, ...]:
        """Variance components of the IMU in all intervals of the initial adjustment."""
        return self._initial_imu_variances

    def add_keyframe(self, keyframe: Keyframe, *, report_marginalized: bool = False) -> KeyframeResult:
        """Add a keyframe and optimize the window.

        A failure of the solver does not end the estimate: the window begins again at the predicted state.

        Args:
            keyframe: The keyframe.
            report_marginalized: Whether to return the final estimate of a keyframe that is marginalized.

        Returns:
            The rejected features, events, the variance components of the IMU, and the keyframe that leaves.
        """
        window, parallax_px = self._window, self._parallax_px()
        self._append(keyframe)
        rejected = window.landmarks.triangulate(window.cameras, window.newest)
        predicted = window.states[window.newest]
        try:
            solver = optimized(window, self._gauss_newton, self._image_variance)
            self._solution = self._read_solution(solver)
            marginalizes = self._is_full and self._has_moved(parallax_px)
            imu_variance = window.oldest_imu_variance(solver) if marginalizes else None
            residual, depth_m, observed = window.residuals()
            self._image_variance = window.image_variance(residual, observed)
            outliers = window.landmarks.reject_outliers(residual, depth_m, observed)
            window.remove_landmarks(outliers.tolist())
            marginalized = self._keyframe_estimate(0, solver) if marginalizes and report_marginalized else None
            self._reduce_window(parallax_px)
        except (SingularError, np.linalg.LinAlgError) as error:
            covariance = self._solution.covariance
            start, observations = _nav_state(keyframe.t_ns, predicted), keyframe.observations
            self._window, self._solution = self._begin(start, covariance, observations)
            self._times_ns, self._rates_rad_s = {0: keyframe.t_ns}, {}
            self._position_covariance = covariance[3:6, 3:6]
            self._last_observed = observations, observations
            return KeyframeResult(rejected, (f"solver restored: {error}",))
        return KeyframeResult(np.union1d(rejected, outliers), imu_variance=imu_variance, marginalized=marginalized)

    def complete(self) -> None:
        """Compute the marginal prior, which `add_keyframe` leaves to a later frame.

        A failure is reported by the next keyframe, which needs the prior.
        """
        with suppress(SingularError, np.linalg.LinAlgError):
            self._window.complete()

    def initial_adjustment(self, keyframes: Sequence[Keyframe]) -> float | None:
        """Add the first keyframes together and adjust them by Levenberg-Marquardt.

        The velocity of a dynamic initialization is off by a tenth, too much for the few steps of later keyframes.

        Returns:
            The median reprojection error of the landmarks [px], infinite without landmarks; None without a solution,
            after which the smoother must not be used.
        """
        window = self._window
        for keyframe in keyframes:
            self._append(keyframe)
        try:
            for _ in range(INITIAL_ROUNDS):
                window.landmarks.triangulate(window.cameras, window.newest, retriangulate=True)
                solver = self._levenberg_marquardt()
            self._solution = self._read_solution(solver)
            self._initial_imu_variances = window.imu_variances(solver)
            residual, _, observed = window.residuals()
            self._image_variance = window.image_variance(residual, observed)
            error = np.linalg.norm(residual, axis=1)
            while self._is_full:
                self._reduce_window(np.inf)
        except (SingularError, np.linalg.LinAlgError):
            return None
        return float(np.median(error)) * self._focal_px if len(error) else float("inf")

    def recalibrate(self, calibration: Calibration, covariance_inflation: Array) -> bool:
        """Replace the calibration and adjust the window with it.

        Args:
            calibration: The new calibration.
            covariance_inflation: (15, 15) Diagonal covariance of the error that the previous calibration has left in
                the states, in the order of `NavState`.

        Returns:
            Whether the window could be kept. It cannot if gravity changes, which the preintegrated measurements
            contain, or if there is no solution. Then only `keyframe_estimates` and `restarted` may be called.
        """
        before, window = self._calibration, self._window
        if calibration.gravity_correction_m_s2 != before.gravity_correction_m_s2:
            return False
        self._calibration = calibration
        try:
            window.recalibrate(before, calibration, self._rates_rad_s, covariance_inflation)
            solver = self._levenberg_marquardt()
            self._position_covariance = self._position_covariance + covariance_inflation[3:6, 3:6]
            self._solution = self._read_solution(solver)
            residual, _, observed = window.residuals()
            self._image_variance = window.image_variance(residual, observed)
        except (SingularError, np.linalg.LinAlgError):
            self._calibration = before
            return False
        return True

    def restarted(
        self, calibration: Calibration, covariance_inflation: Array, corrected: NavState | None = None
    ) -> "KeyframeSmoother":
        """Return a smoother with another calibration that begins at the newest state, without the window.

        The observations of the newest keyframe are kept if time offset and lenses are the same, so that landmarks are
        triangulated again after two more keyframes.

        Args:
            calibration: The new calibration.
            covariance_inflation: (15, 15) Covariance that is added to that of the newest state.
            corrected: The newest state by the new calibration, with its covariance, where it is known. It replaces the
                newest state, and nothing is added to its covariance.
        """
        state, covariance = self._solution.state, self._solution.covariance + covariance_inflation
        if corrected is not None and corrected.covariance is not None:
            state, covariance = corrected, corrected.covariance
        is_same_time = calibration.time_offset_correction_s == self._calibration.time_offset_correction_s
        is_same_lens = calibration.intrinsics is self._calibration.intrinsics
        observations = calibration.usable(self._last_observed[1]) if is_same_time and is_same_lens else NO_FEATURES
        return KeyframeSmoother(calibration, self._config, self._landmark_config, state, covariance, observations)

    def keyframe_estimates(self) -> tuple[KeyframeEstimate, ...]:
        """Return the final estimates of all keyframes but the newest, for the end of the window."""
        try:
            solver = CholeskyFactor(self._window.linearize().H)
        except (SingularError, np.linalg.LinAlgError):
            return ()
        return tuple(self._keyframe_estimate(index, solver) for index in range(len(self._window.states) - 1))

    def _keyframe_estimate(self, index: int, solver: CholeskyFactor) -> KeyframeEstimate:
        """Return the final estimate of a keyframe of the window."""
        return keyframe_estimate(self._window, index, solver, self._times_ns, self._position_covariance)

    @property
    def _focal_px(self) -> float:
        return float(self._calibration.focal_px[0])

    def _begin(self, start: NavState, covariance: Array, observations: Observations) -> tuple[Window, _Solution]:
        """Return a window of one keyframe with a given covariance (15, 15).

        The position is not observable, and an uncertainty of metres would cost the linear systems the digits that they
        need. Within the window the position is therefore known, and its uncertainty is added to the solution.
        """
        bias = gtsam.imuBias.ConstantBias(start.accel_bias_m_s2, start.gyro_bias_rad_s)
        first = KeyframeState(gtsam.Pose3(start.T_world_imu), start.velocity_m_s, bias)
        gauge_fixed = covariance.copy()
        gauge_fixed[3:6, :] = gauge_fixed[:, 3:6] = 0.0
        gauge_fixed[3:6, 3:6] = GAUGE_SIGMA**2 * np.eye(3)
        gtsam_covariance = covariance_to_gtsam(gauge_fixed, start.T_world_imu[:3, :3])
        information = np.asarray(np.linalg.inv(gtsam_covariance), dtype=np.float64)
        landmarks = LandmarkDatabase(self._focal_px, self._landmark_config)
        landmarks.add_observations(0, observations)
        c, Ts_imu_cam = self._config, self._calibration.Ts_imu_cam
        sigma = c.image_sigma_px(len(Ts_imu_cam)) / self._focal_px
        window = Window(first, information, landmarks, Ts_imu_cam, sigma, c.robust_sigmas)
        return window, _Solution(_nav_state(start.t_ns, first, covariance), covariance)

    def _append(self, keyframe: Keyframe) -> None:
        """Add a keyframe at the state that the IMU predicts, with the factors to the previous keyframe."""
        window, j = self._window, self._window.newest
        k = j + 1
        nav, bias = self.gtsam_state
        predicted = keyframe.preintegrated.predict(nav, bias)
        motion = gtsam.CombinedImuFactor(X(j), V(j), X(k), V(k), B(j), B(k), keyframe.preintegrated)
        factors: list[gtsam.NoiseModelFactor] = [motion]
        if keyframe.stationary:
            zero_velocity = gtsam.noiseModel.Isotropic.Sigma(3, ZUPT_VELOCITY_SIGMA_M_S)
            zero_motion = gtsam.noiseModel.Isotropic.Sigma(6, ZUPT_POSE_SIGMA)
            factors.append(gtsam.PriorFactorVector(V(k), np.zeros(3), zero_velocity))
            factors.append(gtsam.BetweenFactorPose3(X(j), X(k), gtsam.Pose3(), zero_motion))
        window.append(KeyframeState(predicted.pose(), predicted.velocity(), bias), factors)
        earlier = list(window.states)[:-1]
        self._times_ns = {i: self._times_ns[i] for i in earlier} | {k: keyframe.t_ns}
        self._rates_rad_s = {i: self._rates_rad_s[i] for i in earlier if i in self._rates_rad_s}
        if keyframe.rate_rad_s is not None:
            self._rates_rad_s[k] = keyframe.rate_rad_s
        window.landmarks.add_observations(k, keyframe.observations)
        self._last_observed = self._last_observed[1], keyframe.observations

    def _reduce_window(self, parallax_px: float) -> None:
        """Remove a keyframe if there is one too many: the second-newest if it has hardly moved, else the oldest."""
        window = self._window
        if self._is_full and self._has_moved(parallax_px):
            before_ns, newest_ns = sorted(self._times_ns.values())[-2:]
            is_single = len(self._calibration.Ts_imu_cam) == 1
            drift_rad = 0.0 if is_single else self._config.drift_rad * np.sqrt((newest_ns - before_ns) * 1e-9)
            window.marginalize(min(window.states), self._config.max_persistent, drift_rad)
        elif self._is_full:
            window.drop_keyframe(sorted(window.states)[-2])

    @property
    def _is_full(self) -> bool:
        """Whether there is a keyframe too many."""
        return len(self._window.states) > self._config.max_keyframes

    def _has_moved(self, parallax_px: float) -> bool:
        """Return whether the last keyframe has enough parallax to be worth more than the oldest."""
        return parallax_px >= self._config.min_parallax_px

    def _parallax_px(self) -> float:
        """Return the median displacement of the features between the last two keyframes, rotation removed [px]."""
        before, now = self._last_observed
        states = list(self._window.states.values())
        i, j = common_rows(before.ids, now.ids)
        if len(states) < 2 or len(i) == 0:
            return float("inf")
        R = self._calibration.Ts_imu_cam[now.camera[j], :3, :3]
        R_now_before = states[-1].pose.rotation().matrix().T @ states[-2].pose.rotation().matrix()
        rays = np.column_stack([before.xy[i], np.ones(len(i))])[:, :, None]
        rotated = (np.swapaxes(R, 1, 2) @ (R_now_before @ (R @ rays)))[..., 0]
        displacement = np.linalg.norm(now.xy[j] - rotated[:, :2] / rotated[:, 2:], axis=1)
        return median(displacement) * self._focal_px

    def _gauss_newton(self) -> CholeskyFactor:
        """Optimize the window by a few steps and return the factor of the last linear system."""
        window, iterations, last = self._window, self._config.iterations, self._config.max_decrement
        step = gauss_newton(window.objective, window.estimate, CholeskyFactor, iterations, lambda s: s.decrement < last)
        window.estimate = step.x
        return step.factor

    def _levenberg_marquardt(self) -> CholeskyFactor:
        """Optimize the window by Levenberg-Marquardt and return the factor of the linear system at the minimum."""
        window = self._window
        minimum = levenberg_marquardt(window.objective, window.estimate, CholeskyFactor, INITIAL_ITERATIONS)
        window.estimate = minimum.x
        return CholeskyFactor(minimum.equations.H)

    def _read_solution(self, solver: CholeskyFactor) -> _Solution:
        """Return the newest keyframe's state and covariance."""
        window = self._window
        newest = window.states[window.newest]
        columns = STATE_DIM * (len(window.states) - 1) + np.arange(STATE_DIM)
        P = covariance_from_gtsam(solver.inverse_block(columns), newest.pose.rotation().matrix())
        P[3:6, 3:6] += self._position_covariance
        return _Solution(_nav_state(self._times_ns[window.newest], newest, P), P)


def _nav_state(t_ns: int, state: KeyframeState, covariance: Array | None = None) -> NavState:
    """Return a keyframe's state in the estimator's own type."""
    bias = state.bias
    return NavState(t_ns, state.pose.matrix(), state.velocity, bias.gyroscope(), bias.accelerometer(), covariance)
