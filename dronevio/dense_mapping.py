"""The dense map of a recording: an estimator runs, its depth images enter the map, and surfaces are made at the end."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dronevio.estimator.config import VioConfig
from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.estimator.mapping.keyframe_depths import KeyframeDepths
from dronevio.estimator.mapping.surfaces import surfaces
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.estimator.threads import single_threaded
from dronevio.estimators.driver import RunObserver, estimate_recording, require_poses
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid, PlacedSubmap
from dronevio.models.progress import Progress, notebook_line, silent
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.segments import segments_of
from dronevio.models.state import CameraFrame, Estimate, Health, Trajectory
from dronevio.models.summary import Summarized, size_text
from dronevio.models.surfaces import Mesh, PointCloud

DepthListener = Callable[[DepthImage, Estimate, DenseMapper], None]
"""Receives each depth image with its estimate and the map that it has entered."""


@dataclass(frozen=True, eq=False, repr=False)
class DenseMap(Summarized):
    """The dense map of a flight."""

    run: EstimatorRun
    """The estimates of all frames; with visual SLAM, also the sparse map."""
    trajectory: Trajectory
    """The poses of the IMU in the map frame: by the final map, or those of the odometry without visual SLAM."""
    occupancy: OccupancyGrid
    """What is free, occupied and unknown, in the map frame."""
    submaps: tuple[PlacedSubmap, ...]
    """The parts of the map."""
    cloud: PointCloud
    """Points of the surfaces, in the map frame."""
    mesh: Mesh
    """Triangles of the surfaces, in the map frame."""
    depth_cpu_ms: Array
    """(D,) Processor time of each depth image, its evidence and its entry in the map [ms]."""

    def _summary(self) -> list[tuple[str, str]]:
        grid = self.occupancy
        return [
            ("side of a cell", f"{grid.cell_m:g} m"),
            ("size in x, y, z", size_text(np.stack([grid.low_m, grid.high_m]))),
            ("free", f"{self.volume_m3(FREE):.2f} m³"),
            ("occupied", f"{self.volume_m3(OCCUPIED):.2f} m³"),
            ("points of the surfaces", f"{len(self.cloud)}"),
            ("triangles", f"{len(self.mesh.triangles)}"),
            ("depth images", f"{len(self.depth_cpu_ms)}, {np.mean(self.depth_cpu_ms):.1f} ms of processor time each"),
            ("length of the path", f"{self.trajectory.length_m:.2f} m"),
        ]

    def volume_m3(self, state: int) -> float:
        """Return the volume of the cells in a state; see `dronevio.models.occupancy` [m³]."""
        return float(np.count_nonzero(self.occupancy.states == state)) * self.occupancy.cell_m**3


class MapObserver:
    """Enters the frames of a running estimator into a dense map; a `RunObserver`."""

    def __init__(self, mapper: DenseMapper, range_m: float, listeners: Sequence[DepthListener] = ()) -> None:
        """Take a map before its first frame, the range of depths [m], and who is told of depth images."""
        self._mapper, self._range_m, self._listeners = mapper, range_m, listeners
        self.depths = KeyframeDepths()
        self.cpu_ms: list[float] = []

    def imu(self, samples: ImuSamples) -> None:
        """Do nothing: the estimates contain what the samples tell."""

    def frame(self, frame: CameraFrame, estimate: Estimate, cpu_ms: float) -> None:
        """Enter a frame into the map."""
        begin_s = time.process_time()
        with single_threaded():
            depth = self._mapper.add_frame(frame, estimate)
        if depth is None:
            return
        self.cpu_ms.append((time.process_time() - begin_s) * 1e3)
        self.depths.add(depth, self._range_m)
        for listener in self._listeners:
            listener(depth, estimate, self._mapper)


def map_recording(
    recording: Recording,
    config: DenseMapConfig | None = None,
    estimator: VisualInertialOdometry | VisualSlam | None = None,
    *,
    listeners: Sequence[DepthListener] = (),
    observers: Sequence[RunObserver] = (),
    progress: Progress = silent,
    surface_progress: Progress = silent,
) -> DenseMap:
    """Return the dense map of a recording.

    Args:
        recording: The recording.
        config: Settings of the map.
        estimator: The estimator before its first measurement; visual SLAM by default.
        listeners: Receive the depth images while the map grows.
        observers: Receive the measurements and the estimates.
        progress: Called with the number of processed frames.
        surface_progress: Called with the number of depth images that the mesh contains.

    Raises:
        InputError: An image cannot be read.
        ConfigError: The cameras of the recording give no depth.
        EvaluationError: The estimator has no pose, or no depth has entered the map.
    """
    config = config or DenseMapConfig()
    mapper = DenseMapper(recording.rig, config)
    chosen = VisualSlam(recording.rig) if estimator is None else estimator
    observer = MapObserver(mapper, config.range_m, listeners)
    run = estimate_recording(recording, chosen, progress, (observer, *observers))
    if isinstance(chosen, VisualSlam):
        run = replace(run, map=chosen.final_map())
        if run.map is not None:
            mapper.correct(run.map.correction)
    trajectory = require_poses(run, recording)
    kept, occupancy = observer.depths.kept, mapper.fused()
    if occupancy is None or not (occupancy.states == OCCUPIED).any():
        tracked = sum(each.health is Health.TRACKING for each in run.estimates)
        raise EvaluationError(
            f"{recording.name}: no surface within {config.range_m:g} m in {len(observer.cpu_ms)} depth images, of"
            f" {tracked} frames that were tracked among {len(run.estimates)}; expected textured surfaces within"
            " --range-m, and with one camera, motion"
        )
    Ts_map_odom = _corrections(run, np.array([depth.t_ns for depth in kept], dtype=np.int64))
    joined = np.flatnonzero(np.isfinite(Ts_map_odom[:, 0, 0]))
    cloud, mesh = surfaces([kept[i] for i in joined], Ts_map_odom[joined], 0.5 * config.cell_m, surface_progress)
    final = trajectory if run.map is None else run.final_trajectory
    return DenseMap(run, final, occupancy, mapper.submaps, cloud, mesh, np.array(observer.cpu_ms))


def _corrections(run: EstimatorRun, t_ns: Times) -> Array:
    """Return the poses (N, 4, 4) of the odometry frame in the map at times (N,); not numbers where it is not joined."""
    return np.tile(np.eye(4), (len(t_ns), 1, 1)) if run.map is None else run.map.correction.at(t_ns)


def map(
    recording: Recording | str | Path,
    config: DenseMapConfig | None = None,
    *,
    slam: bool = True,
    estimator: VioConfig | None = None,
    slam_config: SlamConfig | None = None,
    progress: Progress | None = None,
) -> DenseMap:
    """Return the dense map of a recording: what is free, occupied and unknown, and its surfaces.

    Its users know it as ``dv.map``, so that it has the name of a built-in function of Python in this module.

    Args:
        recording: A recording, or the path of one. Where its clock steps, the longest part is used.
        config: Settings of the map: the side of its cells and the range of depths.
        slam: Whether loops correct the map (`VisualSlam`); otherwise it drifts as the odometry does.
        estimator: Settings of the odometry.
        slam_config: Settings of visual SLAM.
        progress: Called with the number of processed frames; by default, a notebook shows it.

    Raises:
        InputError: The recording cannot be read.
        ConfigError: An argument is of another type, or the recording has no camera.
        EvaluationError: The estimator has no pose, or no depth has entered the map.
    """
    source = open_recording(Path(recording), repair=True) if isinstance(recording, str | Path) else recording
    if not hasattr(source, "rig"):
        raise ConfigError(f"map() of {type(source).__name__}; expected a recording or its path")
    if config is not None and not isinstance(config, DenseMapConfig):
        raise ConfigError(f"map() with {config!r}; expected a DenseMapConfig")
    longest = max(segments_of(source), key=lambda segment: len(segment.frame_times_ns))
    rig = longest.rig
    chosen = VisualSlam(rig, estimator, slam_config) if slam else VisualInertialOdometry(rig, estimator)
    return map_recording(
        longest,
        config,
        chosen,
        progress=progress or notebook_line("mapping"),
        surface_progress=notebook_line("surfaces"),
    )
