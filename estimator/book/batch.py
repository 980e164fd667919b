"""Who is right about a flight whose truth is not known: what the images and the IMU say, all of them at once.

Two answers. The first is a reference: every keyframe, every landmark and the whole IMU in one factor graph, solved by
Levenberg-Marquardt (full smoothing; Triggs et al., "Bundle adjustment, a modern synthesis", 2000): what could be known
after the flight, where an estimator had to answer at once. The second judges a path by the images alone: its positions
are held, orientations and landmarks are free, and what is left of the reprojection errors is the path's fault.
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
from dronevio.estimator.imu.preintegration import PreintegrationConfig, integrate, preintegration_params
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

STRIDE = 4
"""Every fourth frame is looked at, five a second: features hardly move in between."""
PIXEL_SIGMA = 1.0  # of a feature that is not wrong [px]
CAUCHY_PX = 2.0  # beyond this, a feature counts less and less [px]
MIN_SIGHTINGS = 4  # frames that must have seen a landmark
MIN_PARALLAX_RAD = np.radians(1.0)
HELD_SIGMA_M = 1e-3  # how far a judged path may give way
FREE_SIGMA_RAD = 0.1  # orientations are free, but for frames that see nothing
START_SIGMAS = np.r_[np.full(3, 0.05), np.full(3, 1e-3)]  # of the first pose [rad, m]; its tilt is found anew
BIAS_SIGMAS = np.r_[np.full(3, 0.3), np.full(3, 0.1)]  # of the first biases, accelerometer [m/s²] and gyroscope [rad/s]
MAX_ITERATIONS = 50
SHARE_THAT_IS_RIGHT = 0.8  # of the features: one in five is wrong


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a path leaves of the reprojection errors."""

    median_px: float
    """Median [px]."""
    rms_px: float
    """Root mean square of the smallest four fifths; one feature in five is wrong [px]."""
    sightings: int
    """How many there are."""


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Who is seen in which frame, and where; sorted by landmark, then by time."""

    ids: Rows  # (N,) identities of the landmarks
    frame: Rows  # (N,) an index of the chosen frames
    xy: Array  # (N, 2) normalized

    @property
    def starts(self) -> Rows:
        """(L,) Where each landmark's sightings begin."""
        return np.flatnonzero(np.diff(self.ids, prepend=-1))

    @property
    def counts(self) -> Rows:
        """(L,) How often each landmark is seen."""
        return np.diff(np.append(self.starts, len(self.ids)))

    @property
    def landmark(self) -> Rows:
        """(N,) Which of the L landmarks is seen."""
        return np.repeat(np.arange(len(self.starts)), self.counts)

    def of(self, landmarks: npt.NDArray[np.bool_]) -> "_Sightings":
        """Return the sightings of some of the L landmarks."""
        rows = np.repeat(landmarks, self.counts)
        return _Sightings(self.ids[rows], self.frame[rows], self.xy[rows])


class Judge:
    """Holds what was seen on a flight, at every fourth of the frames for which there is a path."""

    def __init__(self, flight: FeatureRecording, path: Trajectory) -> None:
        """Choose the frames and the landmarks.

        Args:
            flight: What was sensed.
            path: A path of the IMU with velocities and biases, good enough to begin with.
        """
        self._flight = flight
        self._rows = np.arange(0, len(path), STRIDE)
        self._first = path[self._rows]
        self._T_imu_cam = flight.rig.cameras[0].T_imu_cam
        self._focal_px = flight.rig.cameras[0].model.fx
        seen = _collect(flight, self._first.t_ns)
        seen = seen.of(seen.counts >= MIN_SIGHTINGS)
        found = self._triangulated(seen, self._first.Ts_world_imu)
        good = found.in_front & (found.parallax_rad > MIN_PARALLAX_RAD)
        self._seen, self._points = seen.of(good), found.points[good]

    @property
    def t_ns(self) -> Times:
        """(M,) Time stamps of the chosen frames [ns]."""
        return self._first.t_ns

    def reference(self) -> Array:
        """Return the positions (M, 3) of full smoothing [m].

        Raises:
            RuntimeError: The linear system has no unique solution.
        """
        graph, values = self._images(self._first.Ts_world_imu, self._points)
        path, isotropic = self._first, gtsam.noiseModel.Isotropic.Sigma
        assert path.velocity_m_s is not None and path.gyro_bias_rad_s is not None and path.accel_bias_m_s2 is not None
        bias = gtsam.imuBias.ConstantBias(path.accel_bias_m_s2[-1], path.gyro_bias_rad_s[-1])
        for k, velocity in enumerate(path.velocity_m_s):
            values.insert(V(k), velocity)
            values.insert(B(k), bias)
        pose = values.atPose3(X(0))
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Diagonal.Sigmas(START_SIGMAS)))
        graph.add(gtsam.PriorFactorVector(V(0), path.velocity_m_s[0], isotropic(3, 1.0)))
        graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(BIAS_SIGMAS)))
        for k, preintegrated in enumerate(self._preintegrated(bias), 1):
            j = k - 1
            graph.add(gtsam.CombinedImuFactor(X(j), V(j), X(k), V(k), B(j), B(k), preintegrated))
        solved = _optimized(graph, values)
        return np.array([solved.atPose3(X(k)).translation() for k in range(len(path))])

    def residuals(self, p_world_imu: Array) -> Residuals:
        """Return what a path leaves of the reprojection errors.

        Args:
            p_world_imu: (M, 3) Positions at the chosen frames, laid on the path that this judge began with [m].
        """
        Ts = self._first.Ts_world_imu.copy()
        Ts[:, :3, 3] = p_world_imu
        graph, values = self._images(Ts, self._triangulated(self._seen, Ts).points)
        held = gtsam.noiseModel.Diagonal.Sigmas(np.r_[np.full(3, FREE_SIGMA_RAD), np.full(3, HELD_SIGMA_M)])
        for k, T in enumerate(Ts):
            graph.add(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(T), held))
        solved = _optimized(graph, values)
        Ts_cam = np.array([solved.atPose3(X(k)).matrix() for k in self._seen.frame.tolist()]) @ self._T_imu_cam
        points = np.array([solved.atPoint3(L(i)) for i in self._seen.landmark.tolist()])
        x, y, z = np.einsum("nji,nj->in", Ts_cam[:, :3, :3], points - Ts_cam[:, :3, 3])
        error_px = self._focal_px * np.linalg.norm(np.stack([x, y], axis=1) / z[:, None] - self._seen.xy, axis=1)
        right = np.sort(error_px)[: int(SHARE_THAT_IS_RIGHT * len(error_px))]
        return Residuals(float(np.median(error_px)), float(np.sqrt(np.mean(right**2))), len(error_px))

    def _images(self, Ts_world_imu: Array, points: Array) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return a factor for each sighting, and first values for poses and landmarks."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k, T in enumerate(Ts_world_imu):
            values.insert(X(k), gtsam.Pose3(T))
        for i, point in enumerate(points):
            values.insert(L(i), point)
        lens, sensor = gtsam.Cal3_S2(), gtsam.Pose3(self._T_imu_cam)
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_PX / PIXEL_SIGMA)
        noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA / self._focal_px))
        seen = self._seen
        for i, k, xy in zip(seen.landmark.tolist(), seen.frame.tolist(), seen.xy, strict=True):
            graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, noise, X(k), L(i), lens, False, False, sensor))
        return graph, values

    def _triangulated(self, seen: _Sightings, Ts_world_imu: Array) -> Triangulation:
        Ts = (Ts_world_imu @ self._T_imu_cam)[seen.frame]
        return triangulate(seen.starts, Ts[:, :3, :3], Ts[:, :3, 3], seen.xy)

    def _preintegrated(self, bias: gtsam.imuBias.ConstantBias) -> Iterator[gtsam.PreintegratedCombinedMeasurements]:
        """Yield the IMU between the chosen frames."""
        buffer, params = ImuBuffer(), preintegration_params(self._flight.rig.imu, PreintegrationConfig())
        buffer.add(self._flight.imu)
        buffer.take_until(int(self.t_ns[0]))
        for t_ns in self.t_ns[1:].tolist():
            preintegrated = gtsam.PreintegratedCombinedMeasurements(params, bias)
            integrate(preintegrated, buffer.take_until(t_ns), params)
            yield preintegrated


def _optimized(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(MAX_ITERATIONS)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _collect(flight: FeatureRecording, t_ns: Times) -> _Sightings:
    """Return who is seen in the frames of the given time stamps."""
    frames = [flight.features[i] for i in np.searchsorted(flight.frame_times_ns, t_ns)]
    seen = np.concatenate([ids for ids, _ in frames])
    frame = np.repeat(np.arange(len(frames)), [len(ids) for ids, _ in frames])
    order = np.lexsort((frame, seen))
    return _Sightings(seen[order], frame[order], np.concatenate([xy for _, xy in frames])[order])
