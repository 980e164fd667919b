"""The IMU factors of section 7.4.1 together with the observations of a camera: the drift stops.

The drone flies on the same circle, inside a sphere of landmarks. A camera that points forward observes those in its
image at every keyframe. The graph has an IMU factor between consecutive keyframes, with biases that are random walks,
and a projection factor for each observation. It is solved again whenever some keyframes have been added: initial values
of their states are predicted by the IMU from the last solution, and new landmarks are triangulated. Every estimate
therefore depends on the measurements before it only, and the true states serve to compute errors.

A landmark is the same in all rounds, so that the drone returns to landmarks that it knows. This is why the error is
bounded; without such returns the camera reduces the drift, but does not stop it.

Sources: Dellaert and Hutchinson, *Introduction to Robotics*, sections 7.4.2 and 7.4.3; Forster et al., "On-manifold
preintegration for real-time visual-inertial odometry", T-RO 2017.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, L, V, X

from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.book.drift import dead_reckoning, predicted_covariance, simulate_increments
from dronevio.estimator.book.loop import LoopFlight
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.imu import ImuModel
from dronevio.models.progress import Progress, silent
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import pose_matrix

Rows = npt.NDArray[np.int64]

KEYFRAME_S = 0.5
"""Interval between keyframes, that between the states of the chapter [s]."""
KEYFRAMES_PER_SOLUTION = 5
"""Number of keyframes that are added before the graph is solved again."""
LANDMARKS = 150
"""Number of landmarks on the sphere."""
SPHERE_RADIUS_M = 8.0
"""Radius of the sphere of landmarks about the centre of the circle [m]."""
PIXEL_SIGMA = 1.0
"""Standard deviation of an observation [px]."""
START_SIGMA = 1e-6
"""Standard deviation of the first state and the biases, which are practically exact [rad, m, m/s and units of bias]."""
MIN_OBSERVATIONS = 3
"""Number of keyframes that have to observe a landmark before it becomes part of the graph."""
MIN_PARALLAX_RAD = np.radians(3.0)
"""Smallest parallax of a landmark; the depth of one with less is not determined."""
CAMERA = RigCamera(
    CameraModel(640, 480, fx=320.0, fy=320.0, cx=319.5, cy=239.5),
    pose_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.0, 0.0])),
)
"""A camera with a horizontal field of view of 90°, 0.1 m in front of the IMU."""

_MODEL_NOISE = PreintegrationConfig(1.0, 1.0, 1.0, 0.0, 0.0, integration_sigma=1e-7)  # as the samples are simulated


@dataclass(frozen=True, eq=False)
class CameraStudy:
    """Errors and standard deviations of the newest position in R flights at M times, with and without the camera."""

    imu: ImuModel
    """The IMU, with white noise and random walks of its biases."""
    t_s: Array
    """(M,) Times of the newest keyframes [s]."""
    error_m: Array
    """(R, M) Distance of the newest position from the true one, with the camera [m]."""
    sigma_m: Array
    """(R, M) Standard deviation of the newest position by its marginal covariance, with the camera [m]."""
    imu_error_m: Array
    """(R, M) Distance from the true position with the same IMU samples alone [m]."""
    imu_sigma_m: Array
    """(M,) Standard deviation of the position by theory with the IMU alone [m]."""
    landmarks: float
    """Mean number of landmarks in the last graph of a flight."""
    observations: float
    """Mean number of projection factors in the last graph of a flight."""
    normalized_error: float
    """Twice the error of the last graph at its solution, by the number of residuals minus that of unknowns, as a mean
    over the flights. It is near 1 if the noise models are correct."""

    @property
    def rms_m(self) -> Array:
        """(M,) Root mean square error over the flights, with the camera [m]."""
        return np.asarray(np.sqrt(np.mean(self.error_m**2, axis=0)))

    @property
    def imu_rms_m(self) -> Array:
        """(M,) Root mean square error over the flights, with the same IMU samples alone [m]."""
        return np.asarray(np.sqrt(np.mean(self.imu_error_m**2, axis=0)))

    @property
    def rms_sigma_m(self) -> Array:
        """(M,) Root mean square of the standard deviations over the flights, with the camera [m]."""
        return np.asarray(np.sqrt(np.mean(self.sigma_m**2, axis=0)))


@dataclass(frozen=True, eq=False)
class _Estimate:
    """The estimates of one flight at M times."""

    positions_m: Array  # (M, 3)
    sigma_m: Array  # (M,)
    landmarks: int
    observations: int
    error: float  # of the last graph


@dataclass(frozen=True, eq=False)
class _Observations:
    """N observations, sorted by landmark, then by keyframe."""

    landmark: Rows
    keyframe: Rows
    xy: Array  # (N, 2) normalized coordinates

    def until(self, keyframe: int) -> "_Observations":
        """Return the observations up to a keyframe."""
        rows = self.keyframe <= keyframe
        return _Observations(self.landmark[rows], self.keyframe[rows], self.xy[rows])

    def of(self, landmarks: Rows) -> "_Observations":
        """Return the observations of some landmarks."""
        rows = np.isin(self.landmark, landmarks)
        return _Observations(self.landmark[rows], self.keyframe[rows], self.xy[rows])


def run_camera_study(
    imu: ImuModel, rng: np.random.Generator, *, runs: int, duration_s: float = 60.0, progress: Progress = silent
) -> CameraStudy:
    """Simulate flights with IMU and camera, and estimate them with and without the camera.

    Args:
        imu: Rate and noise densities of the IMU.
        rng: Random generator of landmarks, pixel noise and IMU errors.
        runs: Number of flights R.
        duration_s: Duration of a flight, rounded down to a multiple of the interval between solutions [s].
        progress: Reports the number of estimated flights.

    Raises:
        RuntimeError: A linear system has no unique solution.
    """
    flight = LoopFlight(duration_s=duration_s, imu_rate_hz=imu.rate_hz)
    newest = _newest_keyframes(duration_s)
    t_s = newest.astype(np.float64) * KEYFRAME_S
    true_m, rows = flight.states(t_s).p_world_imu, np.round(t_s * imu.rate_hz).astype(int) - 1
    estimates, imu_errors = [], []
    for run in range(runs):
        gyro, accel = simulate_increments(flight, imu, rng, 1)
        imu_errors.append(np.linalg.norm(dead_reckoning(flight, gyro, accel)[0, rows] - true_m, axis=1))
        preintegrated = _preintegrated(imu, gyro[0], accel[0], int(newest[-1]))
        estimates.append(_estimated(flight, preintegrated, _simulated_observations(flight, int(newest[-1]), rng)))
        progress(run + 1, runs)
    initial = START_SIGMA**2 * np.eye(15)
    imu_covariance = predicted_covariance(flight, imu, t_s, initial)[:, 3:6, 3:6]
    # Each IMU factor and its state have 15 residuals and 15 unknowns, as have the priors and the first state.
    normalized = [2.0 * one.error / (2 * one.observations - 3 * one.landmarks) for one in estimates]
    return CameraStudy(
        imu=imu,
        t_s=t_s,
        error_m=np.stack([np.linalg.norm(one.positions_m - true_m, axis=1) for one in estimates]),
        sigma_m=np.stack([one.sigma_m for one in estimates]),
        imu_error_m=np.stack(imu_errors),
        imu_sigma_m=np.sqrt(np.trace(imu_covariance, axis1=1, axis2=2)),
        landmarks=float(np.mean([one.landmarks for one in estimates])),
        observations=float(np.mean([one.observations for one in estimates])),
        normalized_error=float(np.mean(normalized)),
    )


def _newest_keyframes(duration_s: float) -> Rows:
    """Return the newest keyframe (M,) of each solution."""
    solutions = int(duration_s / KEYFRAME_S + 1e-9) // KEYFRAMES_PER_SOLUTION
    return np.arange(1, solutions + 1) * KEYFRAMES_PER_SOLUTION


def _estimated(
    flight: LoopFlight, preintegrated: list[gtsam.PreintegratedCombinedMeasurements], observed: _Observations
) -> _Estimate:
    """Return the estimates of a flight, each from the measurements until then."""
    start = flight.scenario.navState(0.0)
    values = gtsam.Values()
    _insert_state(values, 0, start, gtsam.imuBias.ConstantBias())
    positions, sigma_m = [], []
    for last in range(KEYFRAMES_PER_SOLUTION, len(preintegrated) + 1, KEYFRAMES_PER_SOLUTION):
        for k in range(last - KEYFRAMES_PER_SOLUTION, last):
            state, bias = gtsam.NavState(values.atPose3(X(k)), values.atVector(V(k))), values.atConstantBias(B(k))
            _insert_state(values, k + 1, preintegrated[k].predict(state, bias), bias)
        used = _insert_landmarks(values, observed.until(last), last)
        graph = _graph(start, preintegrated[:last], used)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        covariance = gtsam.Marginals(graph, values).marginalCovariance(X(last))
        positions.append(values.atPose3(X(last)).translation())
        sigma_m.append(np.sqrt(np.trace(covariance[3:, 3:])))
    landmarks = len(np.unique(used.landmark))
    return _Estimate(np.array(positions), np.array(sigma_m), landmarks, len(used.xy), graph.error(values))


def _simulated_observations(flight: LoopFlight, last: int, rng: np.random.Generator) -> _Observations:
    """Return the noisy observations of random landmarks on the sphere, at the keyframes from 0 to ``last``."""
    truth = flight.states(np.arange(last + 1, dtype=np.float64) * KEYFRAME_S)
    directions = rng.standard_normal((LANDMARKS, 3))
    points = SPHERE_RADIUS_M * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    points = points + [0.0, 0.0, flight.radius_m]
    T, model = pose_matrix(truth.R_world_imu, truth.p_world_imu) @ CAMERA.T_imu_cam, CAMERA.model
    p_cam = np.einsum("kji,lkj->lki", T[:, :3, :3], points[:, None] - T[:, :3, 3])
    pixels = model.project(p_cam)
    with np.errstate(invalid="ignore"):  # NaN behind the camera
        visible = np.all((pixels > -0.5) & (pixels < np.array([model.width, model.height]) - 0.5), axis=2)
    landmark, keyframe = np.nonzero(visible)
    noisy = pixels[visible] + PIXEL_SIGMA * rng.standard_normal((len(landmark), 2))
    return _Observations(landmark, keyframe, model.normalize(noisy))


def _preintegrated(
    imu: ImuModel, gyro_rad_s: Array, accel_m_s2: Array, intervals: int
) -> list[gtsam.PreintegratedCombinedMeasurements]:
    """Return the preintegrated measurements of the intervals between keyframes."""
    params, n = PreintegrationParams.of(imu, _MODEL_NOISE), round(KEYFRAME_S * imu.rate_hz)
    preintegrated, dt_s = [], np.full(n, 1.0 / imu.rate_hz)
    for k in range(intervals):
        preintegration, rows = Preintegration(params, gtsam.imuBias.ConstantBias()), slice(k * n, (k + 1) * n)
        preintegration.integrate(Increments(dt_s, gyro_rad_s[rows], accel_m_s2[rows]))
        preintegrated.append(preintegration.measurements)
    return preintegrated


def _insert_state(values: gtsam.Values, k: int, state: gtsam.NavState, bias: gtsam.imuBias.ConstantBias) -> None:
    """Insert the initial values of a keyframe."""
    values.insert(X(k), state.pose())
    values.insert(V(k), state.velocity())
    values.insert(B(k), bias)


def _insert_landmarks(values: gtsam.Values, observed: _Observations, last: int) -> _Observations:
    """Triangulate and insert those landmarks that can be, and return the observations of all that have a value."""
    Ts = np.stack([values.atPose3(X(k)).matrix() for k in range(last + 1)]) @ CAMERA.T_imu_cam
    ids, starts, counts = np.unique(observed.landmark, return_index=True, return_counts=True)
    T = Ts[observed.keyframe]
    triangulation = triangulate(starts, T[:, :3, :3], T[:, :3, 3], observed.xy)
    good = triangulation.in_front & (triangulation.parallax_rad > MIN_PARALLAX_RAD) & (counts >= MIN_OBSERVATIONS)
    for i in np.flatnonzero(good).tolist():
        if not values.exists(L(int(ids[i]))):
            values.insert(L(int(ids[i])), triangulation.points[i])
    return observed.of(np.array([i for i in ids.tolist() if values.exists(L(i))], dtype=np.int64))


def _graph(
    start: gtsam.NavState, preintegrated: list[gtsam.PreintegratedCombinedMeasurements], observed: _Observations
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of priors on the first state, IMU factors and projection factors."""
    graph, isotropic = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma
    graph.addPriorPose3(X(0), start.pose(), isotropic(6, START_SIGMA))
    graph.addPriorVector(V(0), start.velocity(), isotropic(3, START_SIGMA))
    graph.addPriorConstantBias(B(0), gtsam.imuBias.ConstantBias(), isotropic(6, START_SIGMA))
    for k, pim in enumerate(preintegrated):
        graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), pim))
    noise, calibration = isotropic(2, PIXEL_SIGMA / CAMERA.model.fx), gtsam.Cal3_S2()
    body_P_sensor, factor = gtsam.Pose3(CAMERA.T_imu_cam), gtsam.GenericProjectionFactorCal3_S2
    for i, k, xy in zip(observed.landmark.tolist(), observed.keyframe.tolist(), observed.xy, strict=True):
        graph.add(factor(xy, noise, X(k), L(i), calibration, False, False, body_P_sensor))
    return graph
