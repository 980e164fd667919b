"""Messages of the odometry to its map, and a map in the process of the odometry.

`VisualSlam` sends one message for each keyframe that leaves the window, and receives one answer to each message, in the
same order. Who answers is an `OdometryMap`: `LocalMap` at once and in the same process, `MapProcess` meanwhile and in
another one. Both let a `MapBuilder` do the work, so that their answers are equal.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.adjustment.adjuster import Adjuster, LocalAdjuster
from dronevio.estimator.slam.adjustment.flight_measurements import FlightMeasurements, KeyframeMeasurements
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.correction_changes import CorrectionChanges, changes_since
from dronevio.estimator.slam.files.saved_map import KnownMap
from dronevio.estimator.slam.mapper import Mapper
from dronevio.estimator.slam.places.features import PlaceFeatureExtractor
from dronevio.estimator.slam.places.localization import KeyframeImages, KeyframeView
from dronevio.estimator.slam.places.recognizer import PlaceRecognizer
from dronevio.estimator.slam.schedule import AdjustmentSchedule
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array, Image
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rig import Rig

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class ImagedKeyframe:
    """A keyframe of the odometry with its images, as it was when it was added."""

    images: tuple[Image, ...]
    """Images of the cameras."""
    rig: Rig
    """The calibration that was in use."""
    R_odom_imu: Array
    """(3, 3) Causal estimate of the orientation of the IMU in the odometry frame."""
    observations: Observations
    """The features of the keyframe in all cameras."""
    stamp_ns: int | None = None
    """Time stamp of its frame [ns]; None if it is the time of the keyframe, which is by the clock of the IMU."""


@dataclass(frozen=True, eq=False)
class WindowKeyframe:
    """A new keyframe of the odometry's window, sent while the track has no pose in the map."""

    keyframe: ImagedKeyframe
    """The keyframe as it was added."""
    estimate: KeyframeEstimate
    """Its causal estimate."""


@dataclass(frozen=True, eq=False)
class MarginalizedKeyframe:
    """A keyframe that has left the odometry's window."""

    keyframe: ImagedKeyframe
    """The keyframe as it was added."""
    estimate: KeyframeEstimate
    """Its final estimate."""
    measured: KeyframeMeasurements | None = None
    """Its measurements, for the bundle adjustment of the map; without them, the map is not adjusted."""


@dataclass(frozen=True)
class TrackLost:
    """The odometry is lost: later keyframes are in another odometry frame."""

    t_ns: int
    """Time at which the next track begins [ns]."""


MapMessage = WindowKeyframe | MarginalizedKeyframe | TrackLost
"""A message of the odometry to its map."""


@dataclass(frozen=True)
class MapCost:
    """Cost of the map beside that of the odometry."""

    frames: int
    """Number of frames of the odometry."""
    results: int
    """Number of answers of the map that were due."""
    waits: int
    """Number of answers for which a frame had to wait, since the worker process was not ready."""
    worker_cpu_s: float
    """Processor time of the worker process without its start, and of the adjustments that it has started [s]; 0 for a
    map in the process of the odometry."""

    @property
    def worker_cpu_ms_per_frame(self) -> float:
        """Mean processor time of the worker process per frame of the odometry [ms]."""
        return 1e3 * self.worker_cpu_s / max(self.frames, 1)


class OdometryMap(Protocol):
    """Builds the map of an odometry, and answers its messages in their order."""

    def send(self, message: MapMessage, /) -> None:
        """Send a message without waiting for its answer."""

    def receive(self) -> Correction | None:
        """Return the answer to the oldest message that has not been answered; None if it changes no correction."""

    def ask(self, function: Callable[[Mapper], Result], /) -> Result:
        """Return what a function returns for the mapper after all messages so far.

        Args:
            function: A function of a module or a method of `Mapper`; the result is a copy if the mapper is in another
                process.
        """

    def cost(self, frames: int) -> MapCost:
        """Return the cost of the map, for an odometry of so many frames."""

    def close(self) -> None:
        """Discard the map."""


class MapBuilder:
    """Builds a map from the messages of an odometry."""

    def __init__(self, rig: Rig, config: SlamConfig, known: KnownMap | None, adjuster: Adjuster) -> None:
        """Begin with an empty map, or continue a saved one.

        Args:
            rig: The calibration.
            config: Settings.
            known: A saved map, None for an empty one.
            adjuster: Adjusts the map during the flight.

        Raises:
            ConfigError: The map was saved with patches of another size.
        """
        recognizer = PlaceRecognizer(rig, config.places)
        self.mapper = Mapper(recognizer, config.mapping)
        """The map so far."""
        if known is not None:
            for keyframe in known.keyframes:
                if len(keyframe.features):  # others are culled
                    recognizer.insert(keyframe)
            self.mapper.load(known)
        self._extractor = PlaceFeatureExtractor(config.places.features)
        self._measurements = FlightMeasurements(rig.imu)
        self._schedule = AdjustmentSchedule(config.adjustment_schedule)
        self._adjuster = adjuster
        self._keyframes = 0
        self._stamps_ns: dict[int, int] = {}  # by the times of keyframes
        self._known = MapCorrection.empty()  # as corrections have reported it

    @property
    def adjustment_cpu_s(self) -> float:
        """Processor time of the adjustments in another process [s]."""
        return self._adjuster.cpu_s

    def process(self, message: MapMessage) -> Correction | None:
        """Return the correction by a message; None if it has none."""
        match message:
            case TrackLost(t_ns):
                self.mapper.start_track(t_ns)
                return None
            case WindowKeyframe(keyframe, estimate):
                return self.mapper.locate(estimate, self._view(keyframe))
            case MarginalizedKeyframe(keyframe, estimate, measured):
                events = self._finish_adjustment()
                correction = replace(self.mapper.add(estimate, self._view(keyframe)), events=events)
                self._stamps_ns[estimate.t_ns] = estimate.t_ns if keyframe.stamp_ns is None else keyframe.stamp_ns
                correction = replace(correction, changes=self._report_changes())
                if measured is not None:
                    self._measurements.add(estimate, measured)
                    self._begin_adjustment(correction)
                return correction

    def _report_changes(self) -> CorrectionChanges:
        """Return what has changed of the correction at the keyframes of the map since the last report."""
        poses = self.mapper.poses
        keyframes = [k for k in self.mapper.keyframes if k.number in poses and k.t_ns in self._stamps_ns]
        stamps_ns = np.array([self._stamps_ns[keyframe.t_ns] for keyframe in keyframes], np.int64)
        Ts_map_imu = np.array([poses[keyframe.number] for keyframe in keyframes]).reshape(-1, 4, 4)
        changes = changes_since(self._known, stamps_ns, keyframes, Ts_map_imu)
        self._known = changes.applied(self._known)
        return changes

    def _finish_adjustment(self) -> tuple[str, ...]:
        """Adjust the map if the result of an adjustment is due at a new keyframe, and return what happened."""
        self._keyframes += 1
        outcome = self._adjuster.result() if self._schedule.takes_effect(self._keyframes) else None
        if outcome is None:
            return ()
        if outcome.poses is not None:
            self.mapper.adjust(outcome.poses)
        return (f"adjustment of the map: {outcome.text}",)

    def _begin_adjustment(self, correction: Correction) -> None:
        """Begin an adjustment if it is time for one and the newest keyframe is in the map."""
        graph, keyframes, measurements = self.mapper.accepted_graph, self.mapper.keyframes, self._measurements
        if graph is None or correction.T_map_odom is None or not measurements.covers(keyframes):
            return
        if self._schedule.begins(self._keyframes, len(measurements.loops(keyframes, graph))):
            self._adjuster.start(measurements.inputs(keyframes, graph))

    def _view(self, keyframe: ImagedKeyframe) -> KeyframeView:
        """Return what the cameras show at a keyframe."""
        k = keyframe
        features = self._extractor.extract(k.images, k.rig, k.R_odom_imu, k.observations)
        return KeyframeView(features, KeyframeImages(k.images, k.rig))


class LocalMap:
    """Builds the map in the process of the odometry, which it delays; an `OdometryMap` for tests and debugging."""

    def __init__(self, rig: Rig, config: SlamConfig, known: KnownMap | None = None) -> None:
        """Begin with an empty map, or continue a saved one; see `MapBuilder`."""
        self._builder = MapBuilder(rig, config, known, LocalAdjuster(config.adjustment))
        self._answers: deque[Correction | None] = deque()
        self._results = 0

    def send(self, message: MapMessage) -> None:
        """Process a message, and keep the answer until it is received."""
        self._answers.append(self._builder.process(message))

    def receive(self) -> Correction | None:
        """Return the oldest answer."""
        self._results += 1
        return self._answers.popleft()

    def ask(self, function: Callable[[Mapper], Result]) -> Result:
        """Return what a function returns for the mapper."""
        return function(self._builder.mapper)

    def cost(self, frames: int) -> MapCost:
        """Return the cost of the map, which is part of the cost of the frames."""
        return MapCost(frames, self._results, 0, 0.0)

    def close(self) -> None:
        """Do nothing: the map ends with its last reference."""
