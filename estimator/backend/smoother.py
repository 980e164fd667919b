"""The back end: a fixed-lag smoother over keyframes and landmarks.

Each keyframe has a pose, a velocity and biases. GTSAM's preintegrated IMU joins consecutive ones, and landmarks join
all that saw them. Every keyframe has the whole window optimized by Gauss-Newton: landmarks are eliminated first
(`reprojection`), what is left is small and dense (`window`). When the window is full, either its oldest keyframe is
marginalized with the landmarks that it saw, into a prior that keeps what they said (`prior`); or, where the drone has
hardly moved, the last keyframe but one goes, so that the window keeps what it saw long ago and a hovering drone does
not drift (Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear optimization", IJRR 2015; Usenko
et al., "Visual-inertial mapping with non-linear factor recovery", RA-L 2020). Landmarks that outlive the window's edge
stay as variables of the prior.

All image coordinates here are normalized (at depth 1 in the camera frame), so a pixel is 1/fx.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.backend.landmarks import LandmarkConfig, LandmarkDatabase, TriangulatedLandmarks
from dronevio.estimator.backend.linalg import CholeskyFactor, SingularError
from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState
from dronevio.estimator.backend.window import Window
from dronevio.estimator.imu.covariance import covariance_from_gtsam, covariance_to_gtsam
from dronevio.estimator.imu.noise import ImuVarianceComponents
from dronevio.estimator.types import GAUGE_SIGMA, NOTHING_SEEN, Observations
from dronevio.models.rig import RigCamera
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SmootherConfig:
    """Settings of the fixed-lag smoother."""

    max_keyframes: int = 9
    """Keyframes in the window."""
    min_parallax_px: float = 5.0
    """A keyframe whose features have moved less since the one before goes before the oldest [px], rotation apart."""
    max_persistent: int = 20
    """Landmarks that may stay as variables of the prior when the first keyframe that saw them leaves."""
    iterations: int = 2
    """Gauss-Newton steps a keyframe."""
    pixel_sigma: float = 0.145
    """Standard deviation of an image measurement of the best quality [px]. Tracks err by .1 px, but alike from frame
    to frame: with this, errors of simulated flights are as large as covariances say."""
    robust_sigmas: float = 1.0
    """Residuals beyond so many standard deviations, or medians where those are larger, lose weight as under Cauchy's
    loss."""
    initial_rounds: int = 2
    """How often the first keyframes are optimized, the landmarks judged anew before each time."""
    initial_iterations: int = 10
    """Levenberg-Marquardt steps a round."""
    zupt_velocity_sigma_m_s: float = 0.01
    """How surely the velocity is zero at rest [m/s]."""
    zupt_pose_sigma: float = 0.003
    """How surely the pose stays at rest, from one keyframe to the next [rad and m]."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """What a keyframe adds to the window."""

    t_ns: int
    """Time of the keyframe."""
    preintegrated: gtsam.PreintegratedCombinedMeasurements
    """The IMU since the last keyframe."""
    observations: Observations
    """The features seen."""
    still: bool
    """Whether the drone has not moved since the last keyframe."""


@dataclass(frozen=True, eq=False)
class KeyframeResult:
    """What came of a keyframe."""

    rejected: npt.NDArray[np.int64]
    """(N,) Identities of the features that turned out to be wrong."""
    events: tuple[str, ...] = ()
    """For people: empty, or what went wrong and how it was mended."""
    imu_variance: ImuVarianceComponents | None = None
    """How well the IMU fits the window, of an interval that leaves it."""


class KeyframeSmoother:
    """Estimates the states of a window of keyframes."""

    def __init__(
        self,
        cameras: Sequence[RigCamera],
        config: SmootherConfig,
        landmarks: LandmarkConfig,
        start: NavState,
        covariance: Array,
        observations: Observations,
    ) -> None:
        """Begin with one keyframe.

        Args:
            cameras: The rig's cameras.
            config: Settings.
            landmarks: Settings of the landmarks.
            start: The first state.
            covariance: (15, 15) How sure it is, in the order of `NavState`.
            observations: The features seen from it.
        """
        self._config = config
        self._landmark_config = landmarks
        self._focal_px = cameras[0].model.fx
        self._Ts_imu_cam: Array = np.stack([camera.T_imu_cam for camera in cameras])
        self._window: Window
        self._last_seen: tuple[Observations, Observations]  # of the last keyframe but one, and of the last
        self._position_covariance: Array  # (3, 3) of the keyframe at which the window began
        self._state: NavState
        self._restart(start, covariance, observations)

    @property
    def state(self) -> NavState:
        """The newest keyframe's state."""
        return self._state

    @property
    def gtsam_state(self) -> tuple[gtsam.NavState, gtsam.imuBias.ConstantBias]:
        """The newest keyframe's state, for preintegration to start from."""
        newest = self._window.states[self._window.newest]
        return gtsam.NavState(newest.pose, newest.velocity), newest.bias

    @property
    def landmarks(self) -> Array:
        """(N, 3) Positions in the world of the landmarks that constrain the window [m]."""
        return self._window.landmarks.points.copy()

    @property
    def known_landmarks(self) -> TriangulatedLandmarks:
        """The landmarks that constrain the window."""
        return self._window.landmarks.triangulated(self._window.cameras)

    def add_keyframe(
        self,
        t_ns: int,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        observations: Observations,
        still: bool,
    ) -> KeyframeResult:
        """Add a keyframe and optimize the window.

        Args:
            t_ns: Time of the keyframe.
            preintegrated: The IMU since the last keyframe.
            observations: The features seen.
            still: Whether the drone has not moved since the last keyframe.

        Returns:
            What came of it. An exception in the solver ends no flight: it starts again at the predicted state.
        """
        window, moved_px = self._window, self._parallax_px()
        self._append(Keyframe(t_ns, preintegrated, observations, still))
        rejected = window.landmarks.triangulate(window.cameras, window.newest)
        predicted = window.states[window.newest]
        try:
            for _ in range(self._config.iterations):
                system = window.linearize()
                solver = CholeskyFactor(system.H)
                window.update(system, solver.solve(system.b))
            self._read_state(t_ns, solver)
            imu_variance = window.oldest_imu_variance(solver) if self._is_full and self._has_moved(moved_px) else None
            wrong = window.landmarks.reject_outliers(*window.residuals())
            window.remove_landmarks(wrong.tolist())
            self._make_room(moved_px)
        except (SingularError, np.linalg.LinAlgError) as error:
            self._restart(_nav_state(t_ns, predicted), self._covariance, observations)
            return KeyframeResult(rejected, (f"solver restored: {error}",))
        return KeyframeResult(np.union1d(rejected, wrong), imu_variance=imu_variance)

    def launch(self, keyframes: Sequence[Keyframe]) -> float | None:
        """Add the first keyframes, all at once, and optimize them together by Levenberg-Marquardt.

        A start in motion is off by a tenth of its velocity, too far for the few steps that a keyframe gets later.

        Returns:
            The landmarks' typical reprojection error [px], infinite where there are no landmarks; None where there is
            no solution, and this smoother is of no more use.
        """
        window = self._window
        for keyframe in keyframes:
            self._append(keyframe)
        try:
            for _ in range(self._config.initial_rounds):
                window.landmarks.triangulate(window.cameras, window.newest, retriangulate=True)
                solver = self._optimize_from_afar()
            self._read_state(keyframes[-1].t_ns, solver)
            error = np.linalg.norm(window.residuals()[0], axis=1)
            while self._is_full:
                self._make_room(np.inf)
        except (SingularError, np.linalg.LinAlgError):
            return None
        return float(np.median(error)) * self._focal_px if len(error) else float("inf")

    def recalibrate(self, cameras: Sequence[RigCamera], doubt: Array) -> None:
        """Take over a better calibration of the cameras, and begin anew: what the old one has told is in all there is.

        Args:
            cameras: The rig's cameras.
            doubt: (15, 15) What is added to the covariance of the newest state.
        """
        self._Ts_imu_cam = np.stack([camera.T_imu_cam for camera in cameras])
        self._restart(self._state, self._covariance + doubt, NOTHING_SEEN)

    def _restart(self, start: NavState, covariance: Array, observations: Observations) -> None:
        """Begin anew at a state, as sure of it as the covariance (15, 15) says.

        Nothing observes the position, and metres of uncertainty in it leave linear systems without the digits that they
        need. It gets a position that is known, and what was unsure is added to what it says later.
        """
        bias = gtsam.imuBias.ConstantBias(start.accel_bias_m_s2, start.gyro_bias_rad_s)
        first = KeyframeState(gtsam.Pose3(start.T_world_imu), start.velocity_m_s, bias)
        self._position_covariance = covariance[3:6, 3:6]
        anchored = covariance.copy()
        anchored[3:6, :] = anchored[:, 3:6] = 0.0
        anchored[3:6, 3:6] = GAUGE_SIGMA**2 * np.eye(3)
        covariance_there = covariance_to_gtsam(anchored, start.T_world_imu[:3, :3])
        information = np.asarray(np.linalg.inv(covariance_there), dtype=np.float64)
        landmarks = LandmarkDatabase(self._focal_px, self._landmark_config)
        landmarks.add_observations(0, observations)
        c = self._config
        self._window = Window(
            first, information, landmarks, self._Ts_imu_cam, c.pixel_sigma / self._focal_px, c.robust_sigmas
        )
        self._covariance = covariance
        self._last_seen = observations, observations
        self._state = _nav_state(start.t_ns, first, covariance)

    def _append(self, keyframe: Keyframe) -> None:
        """Add a keyframe where the IMU says that it is, and tie it to the one before."""
        c, window, j = self._config, self._window, self._window.newest
        k = j + 1
        nav, bias = self.gtsam_state
        predicted = keyframe.preintegrated.predict(nav, bias)
        motion = gtsam.CombinedImuFactor(X(j), V(j), X(k), V(k), B(j), B(k), keyframe.preintegrated)
        factors: list[gtsam.NoiseModelFactor] = [motion]
        if keyframe.still:
            no_speed = gtsam.noiseModel.Isotropic.Sigma(3, c.zupt_velocity_sigma_m_s)
            no_motion = gtsam.noiseModel.Isotropic.Sigma(6, c.zupt_pose_sigma)
            factors.append(gtsam.PriorFactorVector(V(k), np.zeros(3), no_speed))
            factors.append(gtsam.BetweenFactorPose3(X(j), X(k), gtsam.Pose3(), no_motion))
        window.append(KeyframeState(predicted.pose(), predicted.velocity(), bias), factors)
        window.landmarks.add_observations(k, keyframe.observations)
        self._last_seen = self._last_seen[1], keyframe.observations

    def _make_room(self, moved_px: float) -> None:
        """Let a keyframe go, if there are too many: the last but one where it had hardly moved, else the oldest."""
        window = self._window
        if self._is_full and self._has_moved(moved_px):
            window.marginalize(min(window.states), self._config.max_persistent)
        elif self._is_full:
            window.drop_keyframe(sorted(window.states)[-2])

    @property
    def _is_full(self) -> bool:
        """Whether there is a keyframe too many."""
        return len(self._window.states) > self._config.max_keyframes

    def _has_moved(self, moved_px: float) -> bool:
        """Say whether the last keyframe has enough parallax to be worth more than the oldest."""
        return moved_px >= self._config.min_parallax_px

    def _parallax_px(self) -> float:
        """Return how far features have typically moved between the last two keyframes, rotation taken out [px]."""
        before, now = self._last_seen
        states = list(self._window.states.values())
        common = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
        _, i, j = common
        if len(states) < 2 or len(i) == 0:
            return float("inf")
        R = self._Ts_imu_cam[now.camera[j], :3, :3]
        turn = states[-1].pose.rotation().matrix().T @ states[-2].pose.rotation().matrix()
        rays = np.column_stack([before.xy[i], np.ones(len(i))])[:, :, None]
        turned = (np.swapaxes(R, 1, 2) @ (turn @ (R @ rays)))[..., 0]
        moved = np.linalg.norm(now.xy[j] - turned[:, :2] / turned[:, 2:], axis=1)
        return float(np.median(moved)) * self._focal_px

    def _optimize_from_afar(self) -> CholeskyFactor:
        """Optimize the window by Levenberg-Marquardt; return the last linear system, factorized."""
        window, damping = self._window, 1e-4
        system, cost = window.linearize(), window.cost()
        for _ in range(self._config.initial_iterations):
            states, points = window.states, window.landmarks.points
            damped = system.H + damping * np.diag(np.diag(system.H))
            window.update(system, CholeskyFactor(damped).solve(system.b))
            new_cost = window.cost()
            if new_cost < cost:
                converged = cost - new_cost < 1e-3 * cost
                damping, system, cost = 0.1 * damping, window.linearize(), window.cost()
                if converged:
                    break
            else:
                window.states, window.landmarks.points = states, points
                damping *= 10.0
        return CholeskyFactor(system.H)

    def _read_state(self, t_ns: int, solver: CholeskyFactor) -> None:
        """Take over the newest keyframe's state and covariance."""
        window = self._window
        newest = window.states[window.newest]
        columns = STATE_DIM * (len(window.states) - 1) + np.arange(STATE_DIM)
        P = covariance_from_gtsam(solver.inverse_block(columns), newest.pose.rotation().matrix())
        P[3:6, 3:6] += self._position_covariance
        self._covariance = P
        self._state = _nav_state(t_ns, newest, P)


def _nav_state(t_ns: int, state: KeyframeState, covariance: Array | None = None) -> NavState:
    bias = state.bias
    return NavState(t_ns, state.pose.matrix(), state.velocity, bias.gyroscope(), bias.accelerometer(), covariance)
