"""Visual-inertial bundle adjustment of a map: all keyframes, landmarks, IMU measurements and loops together.

The pose graph summarizes the odometry by relative poses. Here its measurements are used again, with all later
knowledge: GTSAM's preintegrated IMU factors, and reprojection factors of the landmarks with a robust loss (Mur-Artal
and Tardós, "Visual-inertial monocular SLAM with map reuse", RA-L 2017; Qin et al., T-RO 2018). It is section 7.4.3 of
the book as one factor graph.

With one camera, the scale follows from a regression of the accelerations by the IMU on those by the images. Errors of
the latter, such as vibration between camera and IMU, attenuate it: the map becomes too small (regression dilution;
Fuller, "Measurement Error Models", 1987, section 1.1). `Scale.ODOMETRY` is for IMUs that do not keep their data sheet:
an IMU factor spans a second, over which such errors matter little, and the relative poses of the odometry hold the
scale that its windows have found.

A loop enters it by the landmarks of the earlier visit that the later keyframe sees. With one camera, its relative pose
cannot replace them: the scale of its position has the error of the landmarks at that time, and since the residual is in
metres, a smaller map would have smaller residuals.

The keyframes of a loaded map have no measurements of their flights but the corners of their images. Those of landmarks
that the new flight sees again are observations, too, and the saved pose graph holds the keyframes, so that the scale is
that of the loaded map.

With several cameras, the orientation of the others relative to the first one is estimated, too. Stereo matches share an
error of a hundredth of a pixel: at disparities of ten pixels, the map is too small by a tenth of a percent. A rotation
of the second camera explains it, and the scale then follows from near landmarks.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import Annotated

import gtsam
import gtsam_unstable
import numpy as np
from gtsam.symbol_shorthand import B, E, L, V, X

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationParams
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph, factor_graph
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array, Integers
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.ranges import Range, Settings

LONG_INTERVAL_S = 1.0
"""Shortest interval of an IMU factor where the odometry determines the scale [s]; shorter at the end of a track."""
ODOMETRY_VARIANCE = 10.0
"""Factor on the covariances of the relative poses by the odometry, which has used the IMU measurements, too."""
RIG_TRANSLATION_SIGMA_M = 1e-5
"""Prior standard deviation of the position of a camera on the rig [m], so small that it is not estimated: the baseline
determines the scale."""


class Scale(StrEnum):
    """Source of the scale of a map with one camera."""

    IMU = "IMU"
    """All IMU measurements of the flight together."""
    ODOMETRY = "odometry"
    """The odometry, as far as the IMU does not contradict it."""


@dataclass(frozen=True)
class AdjustmentConfig(Settings):
    """Settings of the bundle adjustment of a map."""

    pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 0.1
    """Standard deviation of an image observation of the best quality [px]."""
    robust_sigmas: Annotated[float, Range(0.1, 1e3)] = 2.0
    """Scale of the Cauchy loss of the observations, in standard deviations."""
    min_views: Annotated[int, Range(2, 100)] = 3
    """Smallest number of observations of a landmark."""
    min_parallax_deg: Annotated[float, Range(0.01, 90.0)] = 0.5
    """Smallest parallax of a landmark [°]."""
    max_error_px: Annotated[float, Range(above=0.0)] = 6.0
    """Largest reprojection error of a landmark by the initial poses [px]."""
    iterations: Annotated[int, Range(1, 100)] = 15
    """Largest number of Levenberg-Marquardt steps."""
    tolerance: Annotated[float, Range(1e-9, 1.0)] = 1e-3
    """Relative decrease of the error at which the steps end."""
    rig_rotation_sigma_deg: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Prior standard deviation of the orientation of the cameras after the first on the rig [°]; 0 for a calibration
    without errors."""


@dataclass(frozen=True, eq=False)
class AdjustmentKeyframe:
    """A keyframe with its initial state in the map frame."""

    number: int
    """Number of the keyframe."""
    t_ns: int
    """Time by the IMU's clock [ns]."""
    T_map_imu: Array
    """(4, 4) Initial pose of the IMU."""
    velocity_m_s: Array
    """(3,) Initial velocity in the map frame [m/s]."""
    gyro_bias_rad_s: Array
    """(3,) Initial gyroscope bias [rad/s]."""
    accel_bias_m_s2: Array
    """(3,) Initial accelerometer bias [m/s²]."""
    bias_covariance: Array
    """(6, 6) Covariance of the biases by the odometry: gyroscope, then accelerometer."""
    observations: ObservationTable
    """Its observations of landmarks by all cameras."""
    estimate: KeyframeEstimate
    """Its final estimate by the odometry."""
    track: int = 0
    """Number of the odometry frame. The IMU measurements between two tracks are not used."""


@dataclass(frozen=True, eq=False)
class SavedKeyframes:
    """The keyframes of a loaded map."""

    graph: PoseGraph
    """Their pose graph, with the initial poses."""
    observations: ObservationTable
    """Their observations of landmarks that loops connect with the flight."""


@dataclass(frozen=True, eq=False)
class AdjustmentInputs:
    """The measurements of a map."""

    keyframes: Sequence[AdjustmentKeyframe]
    """Keyframes with measurements, in the order of time."""
    loops: Sequence[RelativePose]
    """Loops between them, and with saved keyframes; those without observations are used as relative poses."""
    imu: ImuSamples
    """IMU samples from before the first to after the last keyframe."""
    imu_model: ImuModel
    """The sensor model."""
    params: PreintegrationParams
    """The noise of the preintegration."""
    calibration: Calibration
    """The calibration in use."""
    first: int
    """Number of the keyframe whose yaw and position are those of the map frame."""
    first_covariance: Array
    """(6, 6) Prior covariance of its pose: δθ, then δp, both in the IMU frame."""
    saved: SavedKeyframes | None = None
    """The keyframes of a loaded map, the first one of the map among them; None without a loaded map."""

    @property
    def poses(self) -> dict[int, Array]:
        """Initial poses (4, 4) of all keyframes in the map frame, by their numbers."""
        saved = {} if self.saved is None else self.saved.graph.poses
        return {**saved, **{keyframe.number: keyframe.T_map_imu for keyframe in self.keyframes}}


@dataclass(frozen=True, eq=False)
class AdjustedMap:
    """The solution of a bundle adjustment."""

    poses: Mapping[int, Array]
    """Poses (4, 4) of the keyframes in the map frame, by their numbers."""
    gyro_bias_rad_s: Array
    """(3,) Gyroscope bias at the newest keyframe [rad/s]."""
    accel_bias_m_s2: Array
    """(3,) Accelerometer bias at the newest keyframe [m/s²]."""
    scale: Scale
    """Source of the scale."""


def adjust(inputs: AdjustmentInputs, config: AdjustmentConfig, scale: Scale = Scale.IMU) -> AdjustedMap:
    """Return the most probable poses and biases.

    Args:
        inputs: The measurements, two keyframes or more.
        config: Settings.
        scale: What determines the scale.
    """
    # Landmarks by the initial poses
    keyframes, relative = inputs.keyframes, [loop for loop in inputs.loops if not len(loop.observations)]
    table, points = triangulated(map_observations(inputs, config), inputs, config)
    # Poses, with the prior of the first keyframe and the graph of a loaded map
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for keyframe in keyframes:
        values.insert(X(keyframe.number), pose3=gtsam.Pose3(keyframe.T_map_imu))
        if keyframe.number == inputs.first:
            noise = gtsam.noiseModel.Gaussian.Covariance(inputs.first_covariance)
            graph.add(gtsam.PriorFactorPose3(X(keyframe.number), gtsam.Pose3(keyframe.T_map_imu), noise))
    if inputs.saved is not None:
        _add_saved(graph, values, inputs.saved.graph, {*table.keyframe.tolist(), *(each.first for each in relative)})
    # IMU factors, and where the odometry determines the scale its relative poses
    intervals = list(_imu_intervals(keyframes, LONG_INTERVAL_S if scale is Scale.ODOMETRY else 0.0))
    _add_imu(graph, values, inputs, intervals)
    if scale is Scale.ODOMETRY:
        _add_relative_poses(graph, _odometry(keyframes), ODOMETRY_VARIANCE)
    # Loops without observations, and reprojections
    _add_relative_poses(graph, relative)
    _add_landmarks(graph, values, inputs, config, table, points)
    # Levenberg-Marquardt
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(config.iterations)
    params.setRelativeErrorTol(config.tolerance)
    params.setOrderingType("METIS")  # COLAMD takes longer than four steps in a map of 16 000 landmarks, METIS 0.5 s
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    fixed = () if inputs.saved is None else inputs.saved.graph.fixed
    poses = {n: T if n in fixed else solution.atPose3(X(n)).matrix() for n, T in inputs.poses.items()}
    bias = solution.atConstantBias(B(intervals[-1][1].number)) if intervals else _bias(keyframes[-1])
    return AdjustedMap(poses, bias.gyroscope(), bias.accelerometer(), scale)


def _add_saved(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, saved: PoseGraph, connected: Collection[int]
) -> None:
    """Add the pose graph of saved keyframes.

    Those that stay where they are matter only where they are connected with the flight; without factors with others,
    they are no variables for METIS.
    """
    is_fixed = frozenset(saved.fixed)
    held = saved.among({number for number in saved.poses if number in connected or number not in is_fixed})
    for number, T_map_imu in held.poses.items():
        values.insert(X(number), pose3=gtsam.Pose3(T_map_imu))
    graph.push_back(factor_graph(held))


def _add_imu(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    inputs: AdjustmentInputs,
    intervals: Sequence[tuple[AdjustmentKeyframe, AdjustmentKeyframe]],
) -> None:
    """Add the preintegrated IMU measurements of intervals, and the velocities and biases between which they stand.

    The biases at the start of each track have the turn-on biases of the data sheet as a prior.
    """
    imu, buffer = inputs.imu_model, ImuBuffer(inputs.imu_model)
    sigmas = np.repeat([imu.accel_turn_on_bias_m_s2, imu.gyro_turn_on_bias_rad_s], 3)
    turn_on = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    buffer.add(inputs.imu)
    known: set[int] = set()
    for first, second in intervals:
        i, j = first.number, second.number
        if i not in known:  # the start of a track
            buffer.take_until(first.t_ns)
            _insert_motion(values, first)
            graph.add(gtsam.PriorFactorConstantBias(B(i), gtsam.imuBias.ConstantBias(), turn_on))
        _insert_motion(values, second)
        known.add(j)
        preintegration = Preintegration(inputs.params, _bias(first))
        preintegration.integrate(buffer.take_until(second.t_ns))
        graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), preintegration.measurements))


def _imu_intervals(
    keyframes: Sequence[AdjustmentKeyframe], least_s: float
) -> Iterator[tuple[AdjustmentKeyframe, AdjustmentKeyframe]]:
    """Yield the first and the last keyframes of consecutive intervals of a least length, each in one track."""
    start = keyframes[0]
    for keyframe, following in zip(keyframes, [*keyframes[1:], None], strict=True):
        if keyframe.track != start.track:
            start = keyframe
        is_last = following is None or following.track != keyframe.track
        if keyframe is not start and (is_last or keyframe.t_ns - start.t_ns >= least_s * 1e9):
            yield start, keyframe
            start = keyframe


def _odometry(keyframes: Sequence[AdjustmentKeyframe]) -> list[RelativePose]:
    """Return the relative poses of consecutive keyframes by the windows that the earlier ones have left.

    The final estimates of both belong to different windows: what the later window has learned of the inclination and of
    the biases moves only one of them.
    """
    return [
        RelativePose(first.number, second.number, first.estimate.T_imu_next, first.estimate.relative_covariance)
        for first, second in pairwise(keyframes)
        if first.track == second.track and first.estimate.next_t_ns == second.t_ns
    ]


def _insert_motion(values: gtsam.Values, keyframe: AdjustmentKeyframe) -> None:
    """Add the initial velocity and biases of a keyframe."""
    values.insert(V(keyframe.number), vector=keyframe.velocity_m_s)
    values.insert(B(keyframe.number), constant_bias=_bias(keyframe))


def _add_relative_poses(
    graph: gtsam.NonlinearFactorGraph, relatives: Sequence[RelativePose], variance: float = 1.0
) -> None:
    """Add relative poses of keyframes, with a factor on their covariances."""
    for each in relatives:
        noise = gtsam.noiseModel.Gaussian.Covariance(variance * each.covariance)
        graph.add(gtsam.BetweenFactorPose3(X(each.first), X(each.second), gtsam.Pose3(each.T_first_second), noise))


def _add_landmarks(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    inputs: AdjustmentInputs,
    config: AdjustmentConfig,
    table: ObservationTable,
    points: Mapping[int, Array],
) -> None:
    """Add landmarks and their reprojection factors."""
    sensors = [gtsam.Pose3(T) for T in inputs.calibration.Ts_imu_cam]
    estimated = {camera for camera in np.unique(table.camera).tolist() if camera and config.rig_rotation_sigma_deg}
    _add_rig(graph, values, {camera: sensors[camera] for camera in estimated}, config)
    focal_px = float(inputs.calibration.focal_px[0])
    unit, loss = gtsam.Cal3_S2(), gtsam.noiseModel.mEstimator.Cauchy.Create(config.robust_sigmas)
    for landmark, position in points.items():
        values.insert(L(landmark), point3=position)
    rows = zip(
        table.landmark.tolist(),
        table.keyframe.tolist(),
        table.camera.tolist(),
        table.xy,
        table.sigma_scale.tolist(),
        strict=True,
    )
    for landmark, keyframe, camera, xy, scale in rows:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, scale / focal_px)
        robust = gtsam.noiseModel.Robust.Create(loss, noise)
        pose, point = X(keyframe), L(landmark)
        if camera in estimated:
            graph.add(gtsam_unstable.ProjectionFactorPPPCal3_S2(xy, robust, pose, E(camera), point, unit))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, robust, pose, point, unit, sensors[camera]))


def _add_rig(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    Ts_imu_cam: Mapping[int, gtsam.Pose3],
    config: AdjustmentConfig,
) -> None:
    """Add the poses on the rig of some cameras as variables, with their priors."""
    sigmas = np.repeat([np.radians(config.rig_rotation_sigma_deg), RIG_TRANSLATION_SIGMA_M], 3)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    for camera, T_imu_cam in Ts_imu_cam.items():
        values.insert(E(camera), pose3=T_imu_cam)
        graph.add(gtsam.PriorFactorPose3(E(camera), T_imu_cam, noise))


def map_observations(inputs: AdjustmentInputs, config: AdjustmentConfig) -> ObservationTable:
    """Return the observations by tracks, stereo matches and loops, sorted by landmark, with deviations in pixels."""
    tracks = ObservationTable.concatenated([keyframe.observations for keyframe in inputs.keyframes])
    tracks = tracks if inputs.saved is None else tracks + inputs.saved.observations
    tracks = replace(tracks, sigma_scale=config.pixel_sigma * tracks.sigma_scale)
    table = ObservationTable.concatenated([tracks, *(loop.observations for loop in inputs.loops)]).by_landmark()
    # A keyframe may see a landmark by several loops, since a track spans several earlier keyframes.
    of_one = np.column_stack([table.landmark, table.keyframe, table.camera])
    return table[np.sort(np.unique(of_one, axis=0, return_index=True)[1])]


def triangulated(
    table: ObservationTable, inputs: AdjustmentInputs, config: AdjustmentConfig
) -> tuple[ObservationTable, Mapping[int, Array]]:
    """Return the landmarks that are used, triangulated from the poses of the keyframes.

    Args:
        table: Observations, sorted by landmark.
        inputs: The keyframes and the calibration.
        config: Settings.

    Returns:
        The observations of the landmarks with enough views and parallax, and the positions (3,) of these landmarks by
        their identities, in increasing order.
    """
    table, starts, counts = _with_views(table, config.min_views)
    if not len(table):
        return table, {}
    Ts = {number: T @ inputs.calibration.Ts_imu_cam for number, T in inputs.poses.items()}
    T = np.stack([Ts[k][c] for k, c in zip(table.keyframe.tolist(), table.camera.tolist(), strict=True)])
    triangulation = triangulate(starts, T[:, :3, :3], T[:, :3, 3], table.xy)
    limit = config.max_error_px / float(inputs.calibration.focal_px[0])
    is_used = (
        triangulation.in_front
        & (triangulation.parallax_rad > np.radians(config.min_parallax_deg))
        & (triangulation.rms < limit)
    )
    ids = table.landmark[starts]
    points = {int(i): point for i, point in zip(ids[is_used], triangulation.points[is_used], strict=True)}
    return table[np.repeat(is_used, counts)], points


def _with_views(table: ObservationTable, min_views: int) -> tuple[ObservationTable, Integers, Integers]:
    """Return the rows of landmarks with enough observations, and where each landmark starts and its number of rows."""
    _, counts = np.unique(table.landmark, return_counts=True)
    table = table[np.repeat(counts >= min_views, counts)]
    counts = counts[counts >= min_views]
    return table, np.cumsum(counts) - counts, counts


def _bias(keyframe: AdjustmentKeyframe) -> gtsam.imuBias.ConstantBias:
    """Return the initial biases of a keyframe."""
    return gtsam.imuBias.ConstantBias(keyframe.accel_bias_m_s2, keyframe.gyro_bias_rad_s)
