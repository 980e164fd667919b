"""The back end: a fixed-lag smoother over keyframes, with smart factors for the landmarks.

Each keyframe has a pose, a velocity and biases. Consecutive ones are joined by the preintegrated IMU, and all that see
a landmark by a smart factor, which eliminates the landmark itself (Carlone et al., "Eliminating conditionally
independent sets in factor graphs", ICRA 2014). Keyframes older than the lag are marginalised into a prior.

All image coordinates here are normalised (at depth 1 in the camera frame), so a pixel is 1/fx.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.covariance import covariance_from_gtsam, covariance_to_gtsam
from dronevio.estimator.frontend import Observations
from dronevio.estimator.landmarks import KnownLandmarks, LandmarkConfig, LandmarkWindow, Track
from dronevio.estimator.solver import FixedLagSolver, insert_state, stamps_of
from dronevio.estimator.start import GAUGE_SIGMA
from dronevio.models.rig import RigCamera
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

TRIANGULATION_RANK_TOLERANCE = 1e-3  # GTSAM's own check, in normalised coordinates; ours is the parallax


@dataclass(frozen=True)
class SmootherConfig:
    """Settings of the fixed-lag smoother."""

    lag_s: float = 5.0
    """Length of the window [s]."""
    max_distance_m: float = 60.0
    """Landmarks beyond are ignored [m]."""
    relinearise_threshold: float = 0.01
    """Change of a variable that makes iSAM2 linearise again."""
    max_linearisation_drift: float = 0.05
    """Distance of a pose from where it was linearised beyond which the whole window is linearised anew [rad or m]."""
    launch_rounds: int = 2
    """How often the first keyframes are optimised, the landmarks judged anew before each time."""
    still_velocity_sigma: float = 0.01
    """How surely the velocity is zero at rest [m/s]."""
    still_pose_sigma: float = 0.003
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


class KeyframeSmoother:
    """Estimates the states of the last few seconds' keyframes."""

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
        self._Ts_imu_cam = np.stack([camera.T_imu_cam for camera in cameras])
        self._cameras = gtsam.CameraSetPinholePoseCal3_S2()
        for T_imu_cam in self._Ts_imu_cam:
            self._cameras.push_back(gtsam.PinholePoseCal3_S2(gtsam.Pose3(T_imu_cam), gtsam.Cal3_S2()))
        self._smart = gtsam.SmartProjectionParams()
        self._smart.setDegeneracyMode(gtsam.DegeneracyMode.ZERO_ON_DEGENERACY)
        self._smart.setRankTolerance(TRIANGULATION_RANK_TOLERANCE)
        self._smart.setLandmarkDistanceThreshold(config.max_distance_m)
        self._solver: FixedLagSolver
        self._landmarks: LandmarkWindow
        self._k: int  # index of the newest keyframe since the last restart
        self._poses: dict[int, tuple[Array, Array]]  # of the cameras at the window's keyframes
        self._nav: gtsam.NavState
        self._bias: gtsam.imuBias.ConstantBias
        self._prior: gtsam.NonlinearFactorGraph  # what was known at the last restart
        self._first_values: gtsam.Values
        self._position_covariance: Array  # (3, 3) of the keyframe at which the solver started
        self._covariance: Array  # (15, 15) of the newest keyframe, in the order of NavState
        self._state: NavState
        self._restart(start, covariance)
        self._landmarks.observe(0, start.t_ns * 1e-9, observations)

    @property
    def state(self) -> NavState:
        """The newest keyframe's state."""
        return self._state

    @property
    def gtsam_state(self) -> tuple[gtsam.NavState, gtsam.imuBias.ConstantBias]:
        """The newest keyframe's state, for preintegration to start from."""
        return self._nav, self._bias

    @property
    def landmarks(self) -> Array:
        """(N, 3) Positions in the world of the landmarks that constrain the window [m]."""
        return self._landmarks.points()

    @property
    def known_landmarks(self) -> KnownLandmarks:
        """The landmarks that constrain the window."""
        return self._landmarks.known()

    def add_keyframe(
        self,
        t_ns: int,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        observations: Observations,
        still: bool,
    ) -> KeyframeResult:
        """Add a keyframe and optimise the window.

        Args:
            t_ns: Time of the keyframe.
            preintegrated: The IMU since the last keyframe.
            observations: The features seen.
            still: Whether the drone has not moved since the last keyframe.

        Returns:
            What came of it. An exception in the solver ends no flight: it starts again at the predicted state.
        """
        k = self._k + 1
        predicted = preintegrated.predict(self._nav, self._bias)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        insert_state(values, k, predicted, self._bias)
        self._add_motion(graph, k, preintegrated, still)
        self._landmarks.observe(k, t_ns * 1e-9, observations)
        self._poses[k] = self._camera_poses(predicted.pose())
        tracks, wrong = self._landmarks.judge(self._poses, seen_from=k)
        removed = [track.slot for track in (*tracks, *wrong) if track.slot is not None]
        self._landmarks.drop(wrong)
        first_smart = graph.size()
        for track in tracks:
            graph.add(self._smart_factor(track))
        self._k = k
        rejected = np.array([track.id for track in wrong], dtype=np.int64)
        try:
            slots = self._solver.update(graph, values, stamps_of(k, t_ns), removed)
            self._read_states(t_ns)
        except RuntimeError as error:  # an indeterminate linear system: too little parallax, or a wild outlier
            self._restart(_nav_state(t_ns, predicted, self._bias), self._covariance)
            return KeyframeResult(rejected, (f"solver restored: {str(error).strip().splitlines()[0]}",))
        for track, slot in zip(tracks, slots[first_smart:], strict=True):
            track.slot = slot
        self._landmarks.forget_before(min(self._poses), k)
        self._follow_linearisation()
        return KeyframeResult(rejected)

    def launch(self, keyframes: Sequence[Keyframe]) -> float | None:
        """Add the first keyframes, all at once, and optimise them together by Levenberg-Marquardt.

        A start in motion is off by a tenth of its velocity, too far for the single linear step that a keyframe gets
        later.

        Returns:
            The landmarks' typical reprojection error [px], infinite where there are no landmarks; None where there is
            no solution, and this smoother is of no more use.
        """
        graph, values = gtsam.NonlinearFactorGraph(self._prior), gtsam.Values(self._first_values)
        nav, stamps = self._nav, stamps_of(0, self._state.t_ns)
        for k, keyframe in enumerate(keyframes, 1):
            nav = keyframe.preintegrated.predict(nav, self._bias)
            self._add_motion(graph, k, keyframe.preintegrated, keyframe.still)
            insert_state(values, k, nav, self._bias)
            stamps |= stamps_of(k, keyframe.t_ns)
            self._landmarks.observe(k, keyframe.t_ns * 1e-9, keyframe.observations)
        self._k = len(keyframes)
        tracks: list[Track] = []
        try:
            for _ in range(self._config.launch_rounds):
                self._poses = {k: self._camera_poses(values.atPose3(X(k))) for k in range(self._k + 1)}
                tracks, wrong = self._landmarks.judge(self._poses)
                self._landmarks.drop(wrong)
                whole = gtsam.NonlinearFactorGraph(graph)
                for track in tracks:
                    whole.add(self._smart_factor(track))
                values = gtsam.LevenbergMarquardtOptimizer(whole, values).optimize()
            self._solver = self._new_solver()
            slots = self._solver.update(whole, values, stamps)
            self._read_states(keyframes[-1].t_ns)
        except RuntimeError:
            return None
        for track, slot in zip(tracks, slots[graph.size() :], strict=True):
            track.slot = slot
        return self._landmarks.typical_error(self._poses) * self._focal_px

    def _restart(self, start: NavState, covariance: Array) -> None:
        """Begin anew at a state, as sure of it as the covariance (15, 15) says.

        Nothing observes the position, and metres of uncertainty in it leave the solver's linear systems without the
        digits that they need. It gets a position that is known, and what was unsure is added to what it says later.
        """
        self._solver = self._new_solver()
        self._landmarks = LandmarkWindow(self._focal_px, self._landmark_config)
        self._poses = {}
        self._k = 0
        pose = gtsam.Pose3(start.T_world_imu)
        self._bias = gtsam.imuBias.ConstantBias(start.accel_bias_m_s2, start.gyro_bias_rad_s)
        self._nav = gtsam.NavState(pose, start.velocity_m_s)
        self._prior, self._first_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._position_covariance = covariance[3:6, 3:6]
        anchored = covariance.copy()
        anchored[3:6, :] = anchored[:, 3:6] = 0.0
        anchored[3:6, 3:6] = GAUGE_SIGMA**2 * np.eye(3)
        P = covariance_to_gtsam(anchored, start.T_world_imu[:3, :3])
        gaussian = gtsam.noiseModel.Gaussian.Covariance
        self._prior.add(gtsam.PriorFactorPose3(X(0), pose, gaussian(P[:6, :6])))
        self._prior.add(gtsam.PriorFactorVector(V(0), start.velocity_m_s, gaussian(P[6:9, 6:9])))
        self._prior.add(gtsam.PriorFactorConstantBias(B(0), self._bias, gaussian(P[9:, 9:])))
        insert_state(self._first_values, 0, self._nav, self._bias)
        self._solver.update(self._prior, self._first_values, stamps_of(0, start.t_ns))
        self._read_states(start.t_ns)

    def _new_solver(self) -> FixedLagSolver:
        return FixedLagSolver(self._config.lag_s, self._config.relinearise_threshold)

    def _add_motion(
        self,
        graph: gtsam.NonlinearFactorGraph,
        k: int,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        still: bool,
    ) -> None:
        """Tie keyframe k to the one before: by the IMU, and if the drone stood still, by that."""
        c, j = self._config, k - 1
        graph.add(gtsam.CombinedImuFactor(X(j), V(j), X(k), V(k), B(j), B(k), preintegrated))
        if still:
            no_speed = gtsam.noiseModel.Isotropic.Sigma(3, c.still_velocity_sigma)
            no_motion = gtsam.noiseModel.Isotropic.Sigma(6, c.still_pose_sigma)
            graph.add(gtsam.PriorFactorVector(V(k), np.zeros(3), no_speed))
            graph.add(gtsam.BetweenFactorPose3(X(j), X(k), gtsam.Pose3(), no_motion))

    def _smart_factor(self, track: Track) -> gtsam.SmartProjectionRigFactorPinholePoseCal3_S2:
        """Return the factor that ties all keyframes that saw a landmark."""
        noise = gtsam.noiseModel.Isotropic.Sigma(2, track.sigma)
        factor = gtsam.SmartProjectionRigFactorPinholePoseCal3_S2(noise, self._cameras, self._smart)
        factor.add(track.xy, [X(k) for k in track.keyframes], track.cameras)
        return factor

    def _read_states(self, t_ns: int) -> None:
        """Take over what the solver found: the newest state, and the poses of the window's keyframes."""
        k = self._k
        poses = {i: self._solver.pose(i) for i in self._solver.keyframes}
        self._poses = {i: self._camera_poses(pose) for i, pose in poses.items()}
        self._bias = self._solver.bias(k)
        self._nav = gtsam.NavState(poses[k], self._solver.velocity(k))
        self._covariance = covariance_from_gtsam(self._solver.covariance(k), poses[k].rotation().matrix())
        self._covariance[3:6, 3:6] += self._position_covariance
        self._state = _nav_state(t_ns, self._nav, self._bias, self._covariance)

    def _follow_linearisation(self) -> None:
        """Linearise the window anew if it has moved far."""
        if self._solver.drift_from_linearisation() <= self._config.max_linearisation_drift:
            return
        try:
            self._landmarks.move_slots(self._solver.linearise_anew())
            self._read_states(self._state.t_ns)
        except RuntimeError:  # the solver as it was still works
            return

    def _camera_poses(self, pose: gtsam.Pose3) -> tuple[Array, Array]:
        """Return the orientations (C, 3, 3) and positions (C, 3) of the cameras for a pose of the IMU."""
        Ts_world_cam = pose.matrix() @ self._Ts_imu_cam
        return Ts_world_cam[:, :3, :3], Ts_world_cam[:, :3, 3]


def _nav_state(
    t_ns: int, nav: gtsam.NavState, bias: gtsam.imuBias.ConstantBias, covariance: Array | None = None
) -> NavState:
    return NavState(t_ns, nav.pose().matrix(), nav.velocity(), bias.gyroscope(), bias.accelerometer(), covariance)
