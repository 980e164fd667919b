"""Visual SLAM: the odometry, and a map around it that corrects it when places are seen again.

The odometry does not depend on the map: its estimates are those of `VisualInertialOdometry`, to the bit. The map
receives the keyframes of the odometry and returns the pose of the odometry frame in the map frame, `T_map_odom`. It is
applied a number of frames after the keyframe that caused it, which depends on numbers of keyframes and loops alone, so
that results do not depend on the speed of the machine. Meanwhile a worker process updates the map. A pose in the map
frame is causal, and it jumps when a loop is closed; the pose in the odometry frame is continuous. After a loss there is
no pose in the map frame until a place of the map is recognized.
"""

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.slam.adjustment.adjuster import solved
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs
from dronevio.estimator.slam.adjustment.final_graph import at_optimum, measured_in_map
from dronevio.estimator.slam.adjustment.flight_measurements import FlightMeasurements, KeyframeMeasurements
from dronevio.estimator.slam.adjustment.structure import map_structure
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.files.g2o import write_g2o
from dronevio.estimator.slam.files.map_file import read_map, write_map
from dronevio.estimator.slam.files.saved_arrays import MIN_KEYFRAMES
from dronevio.estimator.slam.files.saved_map import SavedMap, saved_map
from dronevio.estimator.slam.map.map_arrays import MapSummary
from dronevio.estimator.slam.map.pose_graph import OptimizedGraph, PoseGraph
from dronevio.estimator.slam.mapper import Mapper
from dronevio.estimator.slam.schedule import CorrectionSchedule
from dronevio.estimator.slam.worker.map_builder import (
    ImagedKeyframe,
    LocalMap,
    MapCost,
    MapMessage,
    MarginalizedKeyframe,
    OdometryMap,
    TrackLost,
    WindowKeyframe,
)
from dronevio.estimator.slam.worker.map_process import MapProcess
from dronevio.estimator.threads import single_threaded
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.map_correction import MapCorrection
from dronevio.models.protocols import Recording
from dronevio.models.reconstructions.ply import write_ply
from dronevio.models.reconstructions.recorded import RecordedReconstruction, with_images, write_colmap_folder
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig
from dronevio.models.slam_map import SlamMap
from dronevio.models.state import CameraFrame, Estimate, NavState

Array = npt.NDArray[np.float64]


class VisualSlam:
    """Estimates the motion of a rig in a map that it builds; implements `Estimator`.

    Example:
        >>> slam = VisualSlam(rig)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         slam.add_imu(measurement)
        ...     else:
        ...         T_map_imu = slam.add_frame(measurement).T_map_imu
    """

    def __init__(
        self,
        rig: Rig,
        odometry: VioConfig | None = None,
        config: SlamConfig | None = None,
        *,
        map: SavedMap | Path | str | None = None,
        localize_only: bool = False,
    ) -> None:
        """Begin before the first measurement, with an empty map or a saved one.

        With a saved map, there is no pose in the map frame until one of its places is recognized. Mapping then goes on:
        the optimization of the pose graph moves the saved keyframes, too, and `save_map` saves all of them.

        Args:
            rig: The calibration of the cameras and the IMU.
            odometry: Settings of the odometry.
            config: Settings of the map.
            map: A saved map, or its file.
            localize_only: Whether the saved keyframes stay where they are, and the map is not saved again.

        Raises:
            ConfigError: The rig has no camera, the map is that of another calibration, or there is no map to localize
                in.
            InputError: The file of the map cannot be read.
        """
        self._config = c = config or SlamConfig()
        self._rig = rig
        self._keyframes = _KeyframeMessages(2.0 * (odometry or VioConfig()).initialization.longest_window_s)
        self._measurements = FlightMeasurements(rig.imu)
        self._odometry = VisualInertialOdometry(rig, odometry, observer=self._keyframes)
        self._known, self._localize_only = _checked_map(rig, map, localize_only), localize_only
        known = None if self._known is None else self._known.known(is_fixed=localize_only)
        self._map: OdometryMap = MapProcess(rig, c, known) if c.worker else LocalMap(rig, c, known)
        self._schedule = CorrectionSchedule(c.correction_delay)
        self._frames = self._sent = self._loops = self._track = 0
        self._T_map_odom: Array | None = np.eye(4)
        self._correction: Correction | None = None
        self._final: _Final | None = None
        if known is not None:
            self._sent, self._track, self._T_map_odom = len(known.keyframes), 1, None

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call; see `VisualInertialOdometry`."""
        self._odometry.add_imu(samples)
        self._keyframes.add_imu(samples)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state in the odometry frame, propagated by the IMU; see `Estimator`."""
        return self._odometry.state_at(t_ns)

    @single_threaded()
    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Add a frame and return the estimate at its time stamp, with the correction by the map.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
            DefectError: The worker process died, or failed in a way that no input should cause.
        """
        has_map_pose, noise = self._T_map_odom is not None, self._odometry.imu_noise
        self._keyframes.begin_frame(frame, noise, has_map_pose=has_map_pose)
        estimate = self._odometry.add_frame(frame)
        self._frames += 1
        for message in self._keyframes.take():
            if isinstance(message, TrackLost):
                self._track, self._T_map_odom, self._correction = self._track + 1, None, None
            if isinstance(message, MarginalizedKeyframe) and message.measured is not None:
                self._measurements.add(message.estimate, message.measured)
            self._map.send(message)
            self._sent += 1
            self._schedule.add(frame.t_ns, self._sent, self._loops)
        events: list[str] = []
        closed: tuple[tuple[int, int], ...] = ()
        for _ in range(self._schedule.take_due(frame.t_ns)):
            correction = self._map.receive()
            if correction is None:
                continue
            self._loops = max(self._loops, correction.tested_loops)
            if correction.track == self._track:
                self._T_map_odom, self._correction = correction.T_map_odom, correction
                events += _events(correction)
                closed += correction.loop_times_ns
        state = estimate.state
        if state is None:
            return estimate
        return replace(
            estimate,
            T_map_odom=self._T_map_odom,
            map_covariance=self._map_covariance(state),
            events=(*estimate.events, *events),
            closed_loops_ns=closed,
        )

    def _map_covariance(self, state: NavState) -> Array | None:
        """Return the covariance (6, 6) of the pose in the map frame; before the first correction, the odometry's."""
        if self._correction is not None:
            return self._correction.covariance_at(state)
        return None if self._T_map_odom is None or state.covariance is None else state.covariance[:6, :6]

    @property
    def mapper(self) -> Mapper:
        """The map of the flight so far; a copy, if it is built by a worker process."""
        return self._map.ask(_itself)

    @property
    def summary(self) -> MapSummary:
        """Size of the map."""
        return self._map.ask(_summary)

    @property
    def map_cost(self) -> MapCost:
        """Cost of the map so far, beside that of the frames: the worker's processor time, and how often it was late."""
        return self._map.cost(self._frames)

    def final_correction(self) -> MapCorrection | None:
        """Return the correction of the whole flight by `final_map`; None if no keyframe has joined the map."""
        final = self.final_map()
        return None if final is None else final.correction

    def final_map(self) -> SlamMap | None:
        """Return the map of the whole flight by all measurements; None if no keyframe has joined the map.

        The pose graph gives the initial poses, and visual-inertial bundle adjustment the final ones. Without loops, the
        odometry is not corrected. A loaded map has no measurements of its former flights: its keyframes are held by the
        saved pose graph, or stay where they are.
        """
        final = self._final_solution()
        mapper, solution = final.mapper, final.solution
        if solution is None:
            return None
        slam_map = replace(mapper.map_of(solution), adjustment=final.adjustment)
        # The correction is that of the causal path, which is then at the final poses where the keyframes are.
        return (
            replace(slam_map, Ts_odom_imu=self._measurements.causal_poses(mapper.keyframes))
            if len(slam_map.closed)
            else slam_map
        )

    def save_map(self, path: Path | str) -> None:
        """Save the final map, together with the map that was loaded, for later flights.

        Args:
            path: File to write; an earlier one is replaced when the new one is complete.

        Raises:
            ConfigError: The map has too few keyframes, it may only be localized in, or the flight has not been joined
                with the map that was loaded.
            InputError: The file cannot be written.
        """
        if self._localize_only:
            raise ConfigError("save_map() with localize_only; expected one of them, since the map stays as it is")
        final = self._final_solution()
        mapper, solution = final.mapper, final.solution
        if self._known is not None and not mapper.is_joined:
            raise ConfigError("the flight is not joined with the loaded map; expected a recognized place to save both")
        count = 0 if solution is None else len(solution.graph.poses)
        if solution is None or count < MIN_KEYFRAMES:
            raise ConfigError(f"map with {count} keyframes; expected {MIN_KEYFRAMES} or more to save it")
        graph = solution.without_rejected
        write_map(Path(path), saved_map(self._rig.cameras, graph, mapper.keyframes, mapper.patches))

    def adjustment_inputs(self) -> AdjustmentInputs:
        """Return the measurements of the final map for bundle adjustment, with its final poses; see `adjust`.

        Raises:
            ConfigError: No keyframe of the flight has joined the map, or one of them has no measurements.
        """
        final = self._final_solution()
        keyframes = final.mapper.keyframes
        if final.solution is None or not self._measurements.covers(keyframes):
            raise ConfigError("map without keyframes of this flight and their measurements; expected one or more")
        return self._measurements.inputs(keyframes, final.solution.without_rejected)

    def final_graph(self) -> PoseGraph:
        """Return the pose graph of the final map for other programs, without rejected loops; see `final_graph`.

        Its poses are the optimum of its relative poses, which are measured in the final map where keyframes of the
        flight have joined it.

        Raises:
            ConfigError: No keyframe has joined the map.
        """
        final = self._final_solution()
        mapper, solution = final.mapper, final.solution
        if solution is None:
            raise ConfigError("map without keyframes; expected one or more to write its graph")
        graph, c = solution.without_rejected, self._config
        if self._measurements.covers(mapper.keyframes):
            inputs, pose = self._measurements.inputs(mapper.keyframes, graph), c.mapping.localization.pose
            graph = measured_in_map(graph, inputs, c.adjustment, pose, mapper.adjusted_until)
        return at_optimum(graph)

    def save_graph(self, path: Path | str) -> None:
        """Write `final_graph` as a g2o file.

        Args:
            path: File to write; an earlier one is replaced when the new one is complete.

        Raises:
            ConfigError: No keyframe has joined the map.
            InputError: The file cannot be written.
        """
        write_g2o(Path(path), self.final_graph())

    def reconstruction(self) -> RecordedReconstruction:
        """Return the keyframes of the flight at their final poses, with the landmarks that they observe.

        Keyframes of a loaded map are left out, since a saved map has no images.

        Raises:
            ConfigError: No keyframe of the flight has joined the map.
        """
        final = self._final_solution()
        mapper, solution = final.mapper, final.solution
        keyframes = self._measurements.of_flight(mapper.keyframes)
        if solution is None or not keyframes:
            raise ConfigError("map without keyframes of this flight; expected one or more to write its landmarks")
        graph = solution.without_rejected.between({keyframe.number for keyframe in keyframes})
        inputs = self._measurements.inputs(keyframes, graph)
        return map_structure(inputs, self._config.adjustment, self._measurements.stamps_ns(keyframes))

    def save_colmap(self, folder: Path | str, recording: Recording) -> None:
        """Write keyframes and landmarks as a folder with ``images`` and a model of COLMAP, ``sparse/0``.

        Args:
            folder: Folder to write to, empty or new.
            recording: The recording of the flight, whose images are read again: the map does not keep them.

        Raises:
            ConfigError: No keyframe of the flight has joined the map, COLMAP does not have the lens of a camera, or the
                recording is another one.
            InputError: The folder cannot be written to or contains another model, or an image cannot be read.
        """
        write_colmap_folder(Path(folder), self.reconstruction(), recording)

    def save_ply(self, path: Path | str, recording: Recording | None = None) -> None:
        """Write the landmarks as a PLY file.

        Args:
            path: File to write; an earlier one is replaced when the new one is complete.
            recording: The recording of the flight, whose images give the points their gray values.

        Raises:
            ConfigError: No keyframe of the flight has joined the map, or the recording is another one.
            InputError: The file cannot be written, or an image cannot be read.
        """
        structure = self.reconstruction()
        write_ply(Path(path), structure.reconstruction if recording is None else with_images(structure, recording))

    @single_threaded()
    def _final_solution(self) -> "_Final":
        """Return the final map; see `final_map`."""
        if self._final is None or self._final.frames != self._frames:
            mapper, adjustment = self.mapper, ""
            solution = mapper.final_solution()
            if solution is not None:
                solution, adjustment = self._adjusted(mapper, solution)
            self._final = _Final(self._frames, mapper, solution, adjustment)
        return self._final

    def _adjusted(self, mapper: Mapper, solution: OptimizedGraph) -> tuple[OptimizedGraph, str]:
        """Return the pose graph with the poses by bundle adjustment, if it has loops, and the outcome as text."""
        graph = solution.without_rejected
        keyframes, measurements = mapper.keyframes, self._measurements
        if not measurements.covers(keyframes) or not measurements.loops(keyframes, graph):
            return solution, ""
        outcome = solved(measurements.inputs(keyframes, graph), self._config.adjustment)
        if outcome.poses is None:  # those of the pose graph remain
            return solution, outcome.text
        return replace(solution, graph=replace(solution.graph, poses=outcome.poses)), outcome.text

    def close(self) -> None:
        """End the worker process, which otherwise ends with the last reference to this object."""
        self._map.close()


@dataclass(frozen=True, eq=False)
class _Final:
    """The final map after a number of frames."""

    frames: int
    mapper: Mapper
    solution: OptimizedGraph | None
    """Its pose graph with the final poses; None if no keyframe has joined it."""
    adjustment: str
    """The outcome of the bundle adjustment; empty without one."""


class _KeyframeMessages:
    """Keeps the keyframes of the odometry until they leave the window; implements `KeyframeObserver`."""

    def __init__(self, window_s: float) -> None:
        """Begin without keyframes.

        Args:
            window_s: Longest time by which the first keyframe of a track is earlier than the frame that begins it [s].
        """
        self._window_ns = round(window_s * 1e9)
        self._frame: CameraFrame | None = None
        self._imu: deque[ImuSamples] | None = None  # since those of the last keyframe; None before the first samples
        self._has_track = False  # whether there has been a keyframe since the last loss
        self._imu_noise: PreintegrationParams | None = None
        self._has_map_pose = True
        self._waiting: dict[int, tuple[OdometryKeyframe, ImagedKeyframe, int]] = {}  # and its stamp
        self._messages: list[MapMessage] = []

    def add_imu(self, samples: ImuSamples) -> None:
        """Keep IMU samples for the next keyframe that leaves the window."""
        self._imu = deque() if self._imu is None else self._imu
        if len(samples):
            self._imu.append(samples)

    def begin_frame(self, frame: CameraFrame, imu_noise: PreintegrationParams, *, has_map_pose: bool) -> None:
        """Keep the images of the newest frame, which may become a keyframe.

        Args:
            frame: The frame.
            imu_noise: The noise of the IMU as it is known.
            has_map_pose: Whether the pose of the odometry frame in the map frame is known.
        """
        self._frame, self._imu_noise, self._has_map_pose = frame, imu_noise, has_map_pose
        while not self._has_track and self._imu and self._imu[0].t_ns[-1] < frame.t_ns - self._window_ns:
            self._imu.popleft()

    def take(self) -> list[MapMessage]:
        """Return the messages since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Let a keyframe of the odometry wait until it leaves the window, unless its images are those of an earlier
        frame. If no image connects it with the one before, another track begins.
        """
        self._has_track = True
        self._waiting = {t: known for t, known in self._waiting.items() if t in keyframe.window_times_ns}
        frame = keyframe.frame or self._frame
        if frame is None or not keyframe.is_of_newest_frame:
            return
        if not keyframe.is_connected:
            self.lost()
            self._has_track = True
        images, R_odom_imu = tuple(frame.images), keyframe.state.T_world_imu[:3, :3]
        imaged = ImagedKeyframe(images, keyframe.calibration.rig, R_odom_imu, keyframe.observations)
        self._waiting[keyframe.t_ns] = keyframe, imaged, frame.t_ns
        if not self._has_map_pose:
            estimate = KeyframeEstimate.of_state(keyframe.state, keyframe.landmark_ids, keyframe.landmarks_odom)
            self._messages.append(WindowKeyframe(imaged, estimate))

    def marginalized(self, estimate: KeyframeEstimate) -> None:
        """Let a keyframe of the odometry join the map, if its images are known."""
        waiting = self._waiting.pop(estimate.t_ns, None)
        if waiting is None:
            return
        known, imaged, stamp_ns = waiting
        measured = None
        if self._imu is not None and self._imu_noise is not None:
            # Several keyframes may leave the window at one frame, of which the later ones have no further samples.
            imu, self._imu = ImuSamples.concatenated(self._imu or [ImuSamples.empty()]), deque()
            measured = KeyframeMeasurements(
                known.state, known.observations, known.calibration, imu, self._imu_noise, stamp_ns
            )
        self._messages.append(MarginalizedKeyframe(imaged, estimate, measured))

    def lost(self) -> None:
        """Begin another track: later keyframes are in another odometry frame."""
        self._waiting, self._has_map_pose, self._has_track = {}, False, False
        self._messages.append(TrackLost(0 if self._frame is None else self._frame.t_ns))


def _checked_map(rig: Rig, saved: SavedMap | Path | str | None, localize_only: bool) -> SavedMap | None:
    """Return the map with which a flight begins, None without one.

    Raises:
        ConfigError: It is that of another calibration, or there is none to localize in.
        InputError: Its file cannot be read.
    """
    if saved is None:
        if localize_only:
            raise ConfigError("localize_only without a map; expected a map that was saved")
        return None
    if isinstance(saved, SavedMap):
        saved.check_rig(rig)
        return saved
    path = Path(saved)
    read = read_map(path)
    with as_input_error(path):
        read.check_rig(rig)
    return read


def _itself(mapper: Mapper) -> Mapper:
    return mapper


def _summary(mapper: Mapper) -> MapSummary:
    return mapper.summary


def _events(correction: Correction) -> list[str]:
    """Return the events of a correction, as texts for users."""
    joined = ["track joined with the map"] if correction.is_joined else []
    return [
        *joined,
        *correction.events,
        *(f"loop closed with keyframe {k}" for k in sorted({loop.first for loop in correction.loops})),
    ]
