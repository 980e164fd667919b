"""Dense maps of simulated flights, on true poses or on those of visual SLAM, with stereo depth or with the true one."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from dronevio.estimator.mapping import DenseMapConfig, DenseMapper
from dronevio.estimator.mapping.depth_source import DepthSource, depth_source
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.imu import ImuSamples
from dronevio.models.occupancy import OccupancyGrid
from dronevio.models.protocols import Recording, measurements
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState, Trajectory

TRUE_SIGMA_M = 0.005
"""Standard deviation that is stated with true depths [m]."""


T_ODOM_WORLD = pose_matrix(rotation_z(0.37), np.array([0.033, 0.057, 0.041]))
"""Pose of the true world in the odometry frame of maps on true poses, so that walls do not lie between cells."""


class TrueDepth:
    """The true depth images of the first camera, at half the resolution, without distortion; a depth source."""

    def __init__(self, folder: Path, camera: RigCamera) -> None:
        """Derive the pixels of the recorded images at which depths are read."""
        self._folder, self._T_imu_cam, model = folder / "mav0" / "depth0" / "data", camera.T_imu_cam, camera.model
        f, width, height = 0.5 * model.central_focal_px[0], model.width // 2, model.height // 2
        K = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        self.camera = Pinhole(width, height, K)
        at = model.project(self.camera.rays().astype(np.float64))
        self._pixels = np.where(np.isfinite(at), at, -1e4).astype(np.float32)

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the true depth image of a frame at its estimated pose; None without a pose."""
        millimetres = cv2.imread(str(self._folder / f"{frame.t_ns}.png"), cv2.IMREAD_UNCHANGED)
        if estimate.state is None or millimetres is None:
            return None
        raw, grey = (
            np.asarray(cv2.remap(np.asarray(image), self._pixels[..., 0], self._pixels[..., 1], cv2.INTER_NEAREST))
            for image in (millimetres, frame.images[0])
        )
        depth = (1e-3 * raw).astype(np.float32)
        sigma = np.where(depth > 0.0, TRUE_SIGMA_M, 0.0).astype(np.float32)
        T_odom_cam = estimate.state.T_world_imu @ self._T_imu_cam
        return DepthImage(frame.t_ns, self.camera, T_odom_cam, depth, sigma, grey.astype(np.uint8))


class SharedDepth:
    """A depth source that matches a frame once for several maps, at the pose of each."""

    def __init__(self, source: DepthSource) -> None:
        """Take the source."""
        self._source = source
        self._last: tuple[int, Array, DepthImage] | None = None

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image of a frame at an estimated pose; None without one."""
        if estimate.state is None:
            return None
        if self._last is None or self._last[0] != frame.t_ns:
            found = self._source.depth(frame, estimate)
            if found is None:
                return None
            self._last = frame.t_ns, inverse_pose(estimate.state.T_world_imu) @ found.T_odom_cam, found
        _, T_imu_cam, found = self._last
        return replace(found, T_odom_cam=estimate.state.T_world_imu @ T_imu_cam)


@dataclass(eq=False)
class MapRun:
    """A dense map while it grows, and the poses with which it was built."""

    mapper: DenseMapper
    """The map."""
    t_ns: list[int] = field(default_factory=list)
    """Times of the frames that entered the map [ns]."""
    estimates: list[Estimate] = field(default_factory=list)
    """Their estimates."""

    def add(self, frame: CameraFrame, estimate: Estimate) -> bool:
        """Add a frame; return whether it entered the map."""
        if self.mapper.add_frame(frame, estimate) is None:
            return False
        self.t_ns.append(frame.t_ns)
        self.estimates.append(estimate)
        return True

    def T_grid_world(self, truth: Trajectory) -> Array:
        """Return the pose (4, 4) of the true world in the frame of the local map, by the newest pose."""
        true, _ = interpolate(truth, np.array(self.t_ns[-1:], dtype=np.int64))
        T_odom_imu = self.estimates[-1].T_odom_imu
        assert T_odom_imu is not None
        return np.asarray(T_odom_imu @ inverse_pose(true.Ts_world_imu[0]))


def true_estimates(recording: Recording) -> Iterator[tuple[CameraFrame, Estimate]]:
    """Yield the frames of a recording with their true poses."""
    assert recording.ground_truth is not None
    true, rows = interpolate(recording.ground_truth, recording.frame_times_ns)
    for pose, row in enumerate(rows.tolist()):
        t_ns = int(recording.frame_times_ns[row])
        yield recording.frame(row), true_estimate(t_ns, true.Ts_world_imu[pose])


def true_estimate(t_ns: int, T_world_imu: Array) -> Estimate:
    """Return an estimate with a given pose, as good as certain, whose odometry frame is that of the map."""
    state = NavState(t_ns, T_world_imu, np.zeros(3), np.zeros(3), np.zeros(3), 1e-12 * np.eye(15), np.zeros(3))
    return Estimate(t_ns, Health.TRACKING, state, T_map_odom=np.eye(4))


def slam_estimates(recording: Recording) -> Iterator[tuple[CameraFrame, Estimate]]:
    """Yield the frames of a recording with the estimates of visual SLAM."""
    with closing(VisualSlam(recording.rig)) as slam:
        for measurement in measurements(recording):
            if isinstance(measurement, ImuSamples):
                slam.add_imu(measurement)
            else:
                yield measurement, slam.add_frame(measurement)


def runs_of(
    folder: Path, recording: Recording, config: DenseMapConfig, watch: Callable[[str, MapRun], None]
) -> dict[str, MapRun]:
    """Return the maps of a flight by what they were built from.

    Args:
        folder: Recording with the true depth of the first camera.
        recording: The same, opened.
        config: Settings of the maps.
        watch: Called with the name of a map and the map after each of its updates.

    Returns:
        Maps of stereo depth on true poses, of stereo depth on estimated poses, and of true depth on true poses.
    """
    stereo, rig = SharedDepth(depth_source(recording.rig)), recording.rig
    sources: dict[str, DepthSource] = {
        "true poses": stereo,
        "estimate": stereo,
        "true depth": TrueDepth(folder, rig.cameras[0]),
    }
    runs = {name: MapRun(DenseMapper(rig, config, source)) for name, source in sources.items()}
    assert recording.ground_truth is not None
    true, rows = interpolate(recording.ground_truth, recording.frame_times_ns)
    poses = dict(zip(recording.frame_times_ns[rows].tolist(), true.Ts_world_imu, strict=True))
    for frame, estimate in slam_estimates(recording):
        if frame.t_ns not in poses or estimate.state is None:
            continue  # all maps have the same frames
        exact = true_estimate(frame.t_ns, T_ODOM_WORLD @ poses[frame.t_ns])
        for name, run in runs.items():
            if run.add(frame, estimate if name == "estimate" else exact):
                watch(name, run)
    return runs


def in_world(run: MapRun, truth: Trajectory, grid: OccupancyGrid) -> tuple[Array, Array]:
    """Return rotation (3, 3) and translation (3,) that take points of the true world into the frame of a fused map.

    The path of the map is aligned in position and yaw; the pose of each frame in the map is that of its submap.
    """
    from dronevio.eval.metrics.alignment import align

    t_ns = np.array(run.t_ns, dtype=np.int64)
    true, rows = interpolate(truth, t_ns)
    positions = path_in_map(run)[rows] if grid.frame == "map" else path_in_odometry(run)[rows]
    found = align(true.p_world_imu, positions)
    return found.R_truth_estimate.T, -found.R_truth_estimate.T @ found.t_m


def path_in_odometry(run: MapRun) -> Array:
    """Return the positions (N, 3) of the frames of a map in the odometry frame [m]."""
    return np.array([estimate.T_odom_imu[:3, 3] for estimate in run.estimates if estimate.T_odom_imu is not None])


def path_in_map(run: MapRun) -> Array:
    """Return the positions (N, 3) of the frames of a map in the map frame, by the submap of each [m]."""
    placed = [submap for submap in run.mapper.submaps if submap.T_map_odom is not None]
    starts = np.array([submap.anchor_ns for submap in placed])
    chosen = np.clip(np.searchsorted(starts, run.t_ns, side="right") - 1, 0, None)
    Ts_map_odom = np.array([submap.T_map_odom for submap in placed])[chosen]
    return np.asarray(np.einsum("nij,nj->ni", Ts_map_odom[:, :3, :3], path_in_odometry(run)) + Ts_map_odom[:, :3, 3])
