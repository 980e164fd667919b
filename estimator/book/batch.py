"""Batch optimization over a recording without ground truth, to assess the trajectories of estimators.

Full smoothing estimates every keyframe and landmark in one factor graph with all IMU measurements, by
Levenberg-Marquardt (Triggs et al., "Bundle adjustment, a modern synthesis", 2000). It uses the whole recording, while
an estimator is causal, and therefore serves as reference. The second assessment uses the images alone: the positions
of a trajectory are fixed, orientations and landmarks are free, and the remaining reprojection errors measure how well
the positions explain the images.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, L, V, X

from dronevio.estimator.backend.triangulation import Triangulation, triangulate
from dronevio.estimator.book.eqvio import FeatureRecording
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

Rows = npt.NDArray[np.int64]

STRIDE = 4
"""Every fourth frame is a keyframe, five per second, because features hardly move in between."""
PIXEL_SIGMA = 1.0  # standard deviation of a correct observation [px]
CAUCHY_PX = 2.0  # scale of the robust loss [px]
MIN_OBSERVATIONS = 4  # keyframes that have to observe a landmark
MIN_PARALLAX_RAD = np.radians(1.0)
FIXED_POSITION_SIGMA_M = 1e-3  # prior on fixed positions
FREE_ORIENTATION_SIGMA_RAD = 0.1  # weak prior on free orientations, for keyframes without observations
INITIAL_POSE_SIGMAS = np.r_[np.full(3, 0.05), np.full(3, 1e-3)]  # prior on the first pose [rad, m]; tilt is estimated
INITIAL_BIAS_SIGMAS = np.r_[np.full(3, 0.3), np.full(3, 0.1)]  # of accelerometer [m/s²] and gyroscope [rad/s]
MAX_ITERATIONS = 50
INLIER_RATIO = 0.8  # about one observation in five is an outlier


@dataclass(frozen=True, eq=False)
class ReprojectionErrors:
    """Reprojection errors that remain for a trajectory."""

    median_px: float
    """Median of the errors [px]."""
    rms_px: float
    """Root mean square of the smallest four fifths of the errors, without the outliers [px]."""
    observations: int
    """Number of observations."""


@dataclass(frozen=True, eq=False)
class _Observations:
    """N observations of L landmarks, sorted by landmark, then by time."""

    ids: Rows  # (N,) identities of the landmarks
    frame: Rows  # (N,) indices of the keyframes
    xy: Array  # (N, 2) normalized coordinates

    @property
    def starts(self) -> Rows:
        """(L,) First row of each landmark."""
        return np.flatnonzero(np.diff(self.ids, prepend=-1))

    @property
    def counts(self) -> Rows:
        """(L,) Number of observations of each landmark."""
        return np.diff(np.append(self.starts, len(self.ids)))

    @property
    def landmark(self) -> Rows:
        """(N,) Index of the observed landmark."""
        return np.repeat(np.arange(len(self.starts)), self.counts)

    def of(self, landmarks: npt.NDArray[np.bool_]) -> "_Observations":
        """Return the observations of the landmarks that a mask (L,) selects."""
        rows = np.repeat(landmarks, self.counts)
        return _Observations(self.ids[rows], self.frame[rows], self.xy[rows])


class BatchAdjustment:
    """The observations of a recording at every fourth frame of a trajectory, and optimizations over all of them."""

    def __init__(self, recording: FeatureRecording, initial: Trajectory) -> None:
        """Select keyframes and landmarks.

        Args:
            recording: IMU samples and features.
            initial: Initial trajectory of the IMU, with velocities and biases.
        """
        self._recording = recording
        self._initial = initial[np.arange(0, len(initial), STRIDE)]
        self._T_imu_cam = recording.rig.cameras[0].T_imu_cam
        self._focal_px = recording.rig.cameras[0].model.fx
        observations = _collect(recording, self._initial.t_ns)
        observations = observations.of(observations.counts >= MIN_OBSERVATIONS)
        landmarks = self._triangulated(observations, self._initial.Ts_world_imu)
        good = landmarks.in_front & (landmarks.parallax_rad > MIN_PARALLAX_RAD)
        self._observations, self._points = observations.of(good), landmarks.points[good]

    @property
    def t_ns(self) -> Times:
        """(M,) Time stamps of the keyframes [ns]."""
        return self._initial.t_ns

    def full_smoothing(self) -> Array:
        """Return the positions (M, 3) of full smoothing [m].

        Raises:
            RuntimeError: The linear system has no unique solution.
        """
        graph, values = self._visual_graph(self._initial.Ts_world_imu, self._points)
        initial, isotropic = self._initial, gtsam.noiseModel.Isotropic.Sigma
        assert initial.velocity_m_s is not None
        assert initial.gyro_bias_rad_s is not None
        assert initial.accel_bias_m_s2 is not None
        bias = gtsam.imuBias.ConstantBias(initial.accel_bias_m_s2[-1], initial.gyro_bias_rad_s[-1])
        for k, velocity in enumerate(initial.velocity_m_s):
            values.insert(V(k), velocity)
            values.insert(B(k), bias)
        pose = values.atPose3(X(0))
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Diagonal.Sigmas(INITIAL_POSE_SIGMAS)))
        graph.add(gtsam.PriorFactorVector(V(0), initial.velocity_m_s[0], isotropic(3, 1.0)))
        graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(INITIAL_BIAS_SIGMAS)))
        for k, preintegrated in enumerate(self._preintegrated(bias), 1):
            j = k - 1
            graph.add(gtsam.CombinedImuFactor(X(j), V(j), X(k), V(k), B(j), B(k), preintegrated))
        result = _optimized(graph, values)
        return np.array([result.atPose3(X(k)).translation() for k in range(len(initial))])

    def reprojection_errors(self, p_world_imu: Array) -> ReprojectionErrors:
        """Return the reprojection errors that remain for given positions, with free orientations and landmarks.

        Args:
            p_world_imu: (M, 3) Positions at the keyframes, aligned to the initial trajectory [m].
        """
        Ts = self._initial.Ts_world_imu.copy()
        Ts[:, :3, 3] = p_world_imu
        graph, values = self._visual_graph(Ts, self._triangulated(self._observations, Ts).points)
        sigmas = np.r_[np.full(3, FREE_ORIENTATION_SIGMA_RAD), np.full(3, FIXED_POSITION_SIGMA_M)]
        prior = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        for k, T in enumerate(Ts):
            graph.add(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(T), prior))
        result, observations = _optimized(graph, values), self._observations
        Ts_cam = np.array([result.atPose3(X(k)).matrix() for k in observations.frame.tolist()]) @ self._T_imu_cam
        points = np.array([result.atPoint3(L(i)) for i in observations.landmark.tolist()])
        x, y, z = np.einsum("nji,nj->in", Ts_cam[:, :3, :3], points - Ts_cam[:, :3, 3])
        error_px = self._focal_px * np.linalg.norm(np.stack([x, y], axis=1) / z[:, None] - observations.xy, axis=1)
        smallest = np.sort(error_px)[: int(INLIER_RATIO * len(error_px))]
        return ReprojectionErrors(float(np.median(error_px)), float(np.sqrt(np.mean(smallest**2))), len(error_px))

    def _visual_graph(self, Ts_world_imu: Array, points: Array) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return a projection factor for each observation, and initial values of poses and landmarks."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k, T in enumerate(Ts_world_imu):
            values.insert(X(k), gtsam.Pose3(T))
        for i, point in enumerate(points):
            values.insert(L(i), point)
        calibration, body_P_sensor = gtsam.Cal3_S2(), gtsam.Pose3(self._T_imu_cam)
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_PX / PIXEL_SIGMA)
        noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA / self._focal_px))
        o = self._observations
        for i, k, xy in zip(o.landmark.tolist(), o.frame.tolist(), o.xy, strict=True):
            factor = gtsam.GenericProjectionFactorCal3_S2
            graph.add(factor(xy, noise, X(k), L(i), calibration, False, False, body_P_sensor))
        return graph, values

    def _triangulated(self, observations: _Observations, Ts_world_imu: Array) -> Triangulation:
        Ts = (Ts_world_imu @ self._T_imu_cam)[observations.frame]
        return triangulate(observations.starts, Ts[:, :3, :3], Ts[:, :3, 3], observations.xy)

    def _preintegrated(self, bias: gtsam.imuBias.ConstantBias) -> Iterator[gtsam.PreintegratedCombinedMeasurements]:
        """Yield the preintegrated IMU measurements between consecutive keyframes."""
        buffer, params = ImuBuffer(), PreintegrationParams.of(self._recording.rig.imu, PreintegrationConfig())
        buffer.add(self._recording.imu)
        buffer.take_until(int(self.t_ns[0]))
        for t_ns in self.t_ns[1:].tolist():
            preintegration = Preintegration(params, bias)
            preintegration.integrate(buffer.take_until(t_ns))
            yield preintegration.measurements


def _optimized(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(MAX_ITERATIONS)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _collect(recording: FeatureRecording, t_ns: Times) -> _Observations:
    """Return the observations in the frames of the given time stamps."""
    frames = [recording.features[i] for i in np.searchsorted(recording.frame_times_ns, t_ns)]
    ids = np.concatenate([ids for ids, _ in frames])
    frame = np.repeat(np.arange(len(frames)), [len(ids) for ids, _ in frames])
    order = np.lexsort((frame, ids))
    return _Observations(ids[order], frame[order], np.concatenate([xy for _, xy in frames])[order])
