"""Visual SLAM: the odometry, and a map around it that corrects it when places are seen again.

The odometry does not depend on the map: its estimates are those of `VisualInertialOdometry`, to the bit. The map
receives the keyframes of the odometry when they leave its window, and returns the pose of the odometry frame in the map
frame, now and at all keyframes. Both are applied a declared time later, by default 0.3 s, which depends on time stamps
and on numbers of keyframes and loops alone, so that results do not depend on the speed of the machine; see
`CorrectionSchedule`. Meanwhile a worker process updates the map. A pose in the map frame is causal, and it jumps when a
loop is closed; the pose in the odometry frame is continuous. After a loss there is no pose in the map frame until a
place of the map is recognized.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from dronevio.estimator.config import VioConfig
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs
from dronevio.estimator.slam.adjustment.flight_measurements import FlightMeasurements
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.files.g2o import write_g2o
from dronevio.estimator.slam.files.map_file import read_map, write_map
from dronevio.estimator.slam.files.saved_map import LAST_KNOWN_NS, SavedMap
from dronevio.estimator.slam.final_map import FinalMap
from dronevio.estimator.slam.map.map_arrays import MapSummary
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.estimator.slam.mapper import Mapper
from dronevio.estimator.slam.schedule import CorrectionSchedule
from dronevio.estimator.slam.worker.keyframe_messages import KeyframeMessages
from dronevio.estimator.slam.worker.map_builder import (
    LocalMap,
    MapCost,
    MarginalizedKeyframe,
    OdometryMap,
    TrackLost,
)
from dronevio.estimator.slam.worker.map_process import MapProcess
from dronevio.estimator.threads import single_threaded
from dronevio.models.arrays import Array
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
        self._keyframes = KeyframeMessages(2.0 * (odometry or VioConfig()).initialization.longest_window_s)
        self._measurements = FlightMeasurements(rig.imu)
        self._odometry = VisualInertialOdometry(rig, odometry, observer=self._keyframes)
        self._known, self._localize_only = _checked_map(rig, map, localize_only), localize_only
        known = None if self._known is None else self._known.known(is_fixed=localize_only)
        self._map: OdometryMap = MapProcess(rig, c, known) if c.worker else LocalMap(rig, c, known)
        self._schedule = CorrectionSchedule(c.correction_delay)
        self._frames = self._sent = self._loops = self._track = 0
        self._T_map_odom: Array | None = np.eye(4)
        self._map_correction = MapCorrection.empty()
        self._correction: Correction | None = None
        self._final: tuple[int, FinalMap] | None = None  # after a number of frames
        if known is not None:
            self._sent, self._track, self._T_map_odom = len(known.keyframes), 1, None
            self._map_correction = self._map_correction.with_track(LAST_KNOWN_NS + 1)

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
        # Odometry, which tells `_keyframes` of its keyframes
        estimate = self._odometry.add_frame(frame)
        self._frames += 1
        # Keyframes to the map; a loss ends the track, whose corrections are no longer valid
        for message in self._keyframes.take():
            if isinstance(message, TrackLost):
                self._track, self._T_map_odom, self._correction = self._track + 1, None, None
                self._map_correction = self._map_correction.with_track(message.t_ns)
            if isinstance(message, MarginalizedKeyframe) and message.measured is not None:
                self._measurements.add(message.estimate, message.measured)
            self._map.send(message)
            self._sent += 1
            self._schedule.add(frame.t_ns, self._sent, self._loops)
        # Corrections that are due at this frame
        events: list[str] = []
        closed: tuple[tuple[int, int], ...] = ()
        for _ in range(self._schedule.take_due(frame.t_ns)):
            correction = self._map.receive()
            if correction is None:
                continue
            self._loops = max(self._loops, correction.tested_loops)
            self._map_correction = correction.changes.applied(self._map_correction)
            if correction.track == self._track:
                self._T_map_odom, self._correction = correction.T_map_odom, correction
                events += _events(correction)
                closed += correction.loop_times_ns
        estimate = replace(estimate, track=self._track, map_correction=self._map_correction)
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
        return self._final_map().slam_map()

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
        final = self._final_map()
        if self._known is not None and not final.mapper.is_joined:
            raise ConfigError("the flight is not joined with the loaded map; expected a recognized place to save both")
        write_map(Path(path), final.saved_map(self._rig.cameras))

    def adjustment_inputs(self) -> AdjustmentInputs:
        """Return the measurements of the final map for bundle adjustment, with its final poses; see `adjust`.

        Raises:
            ConfigError: No keyframe of the flight has joined the map, or one of them has no measurements.
        """
        return self._final_map().adjustment_inputs()

    def final_graph(self) -> PoseGraph:
        """Return the pose graph of the final map for other programs, without rejected loops; see `final_graph`.

        Its poses are the optimum of its relative poses, which are measured in the final map where keyframes of the
        flight have joined it.

        Raises:
            ConfigError: No keyframe has joined the map.
        """
        return self._final_map().pose_graph()

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
        return self._final_map().reconstruction()

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
    def _final_map(self) -> FinalMap:
        """Return the final map of the frames so far, computed once."""
        if self._final is None or self._final[0] != self._frames:
            self._final = self._frames, FinalMap.of_flight(self.mapper, self._measurements, self._config)
        return self._final[1]

    def close(self) -> None:
        """End the worker process, which otherwise ends with the last reference to this object."""
        self._map.close()


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
