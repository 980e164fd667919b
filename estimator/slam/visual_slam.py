"""Visual SLAM: the odometry, and a map around it that corrects it when places are seen again.

The odometry does not depend on the map: its estimates are those of `VisualInertialOdometry`, to the bit. The map
receives the keyframes of the odometry and returns the pose of the odometry frame in the map frame, `T_map_odom`. It is
applied a fixed number of frames after the keyframe that caused it, so that results do not depend on the speed of the
machine. A pose in the map frame is causal, and it jumps when a loop is closed; the pose in the odometry frame is
continuous.
"""

from collections import deque
from contextlib import suppress
from dataclasses import replace
from functools import reduce

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.departure import Departure
from dronevio.estimator.backend.observations import observation_table
from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.slam.bundle_adjustment import AdjustmentInputs, AdjustmentKeyframe, adjust
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.features import PlaceFeatureExtractor
from dronevio.estimator.slam.localization import KeyframeImages
from dronevio.estimator.slam.mapping import Correction, Mapper, MapSummary, WaitingKeyframe
from dronevio.estimator.slam.pose_graph import PoseGraph
from dronevio.estimator.slam.recognizer import PlaceRecognizer
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.map_correction import MapCorrection
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

    def __init__(self, rig: Rig, odometry: VioConfig | None = None, config: SlamConfig | None = None) -> None:
        """Begin before the first measurement, with an empty map.

        Args:
            rig: The calibration of the cameras and the IMU.
            odometry: Settings of the odometry.
            config: Settings of the map.

        Raises:
            ConfigError: The rig has no camera.
        """
        self._config = c = config or SlamConfig()
        self._map = _MapOfOdometry(rig, c)
        self._odometry = VisualInertialOdometry(rig, odometry, observer=self._map)
        self._rig = rig
        self._imu: list[ImuSamples] = []
        self._frames = 0
        self._due: deque[tuple[int, Correction]] = deque()
        self._T_map_odom = np.eye(4)

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call; see `VisualInertialOdometry`."""
        self._odometry.add_imu(samples)
        self._imu.append(samples)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state in the odometry frame, propagated by the IMU; see `Estimator`."""
        return self._odometry.state_at(t_ns)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Add a frame and return the estimate at its time stamp, with the correction by the map.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
        """
        self._map.begin_frame(frame)
        estimate = self._odometry.add_frame(frame)
        self._frames += 1
        events: list[str] = []
        closed: tuple[tuple[int, int], ...] = ()
        while self._due and self._due[0][0] <= self._frames:
            correction = self._due.popleft()[1]
            self._T_map_odom = correction.T_map_odom
            events += _events(correction)
            closed += correction.loop_times_ns
        self._due += [(self._frames + self._config.correction_delay, each) for each in self._map.take_corrections()]
        if estimate.state is None:
            return estimate
        events_so_far = (*estimate.events, *events)
        return replace(estimate, T_map_odom=self._T_map_odom, events=events_so_far, closed_loops_ns=closed)

    @property
    def mapper(self) -> Mapper:
        """The map of the flight so far."""
        return self._map.mapper

    @property
    def summary(self) -> MapSummary:
        """Size of the map."""
        return self._map.mapper.summary

    def final_correction(self) -> MapCorrection | None:
        """Return the correction of the whole flight by `final_map`; None if no keyframe has joined the map."""
        final = self.final_map()
        return None if final is None else final.correction

    def final_map(self) -> SlamMap | None:
        """Return the map of the whole flight by all measurements; None if no keyframe has joined the map.

        The pose graph gives the initial poses, and visual-inertial bundle adjustment the final ones. Without loops, the
        odometry is not corrected.
        """
        mapper = self._map.mapper
        solution = mapper.final_solution()
        if solution is None:
            return None
        poses, graph = solution.graph.poses, solution.without_rejected
        if graph.loops:
            imu, noise = reduce(ImuSamples.extended, self._imu), self._odometry.imu_noise
            inputs = self._map.adjustment_inputs(graph, imu, self._rig.imu, noise)
            with suppress(RuntimeError):  # by GTSAM, if the system is singular; the poses of the graph remain
                poses = adjust(inputs, self._config.adjustment)
        return mapper.map_of(replace(solution, graph=replace(solution.graph, poses=poses)))


class _MapOfOdometry:
    """Gives the keyframes of the odometry to the mapper; implements `KeyframeObserver`."""

    def __init__(self, rig: Rig, config: SlamConfig) -> None:
        """Begin with an empty map."""
        self.mapper = Mapper(PlaceRecognizer(rig, config.places), config.mapping)
        self._extractor = PlaceFeatureExtractor(config.places.features)
        self._frame: CameraFrame | None = None
        self._waiting: dict[int, OdometryKeyframe] = {}
        self._members: dict[int, OdometryKeyframe] = {}  # keyframes of the map
        self._corrections: list[Correction] = []
        self._is_lost = False

    def begin_frame(self, frame: CameraFrame) -> None:
        """Keep the images of the newest frame, which may become a keyframe."""
        self._frame = frame

    def take_corrections(self) -> list[Correction]:
        """Return the corrections since the last call."""
        corrections, self._corrections = self._corrections, []
        return corrections

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Let a keyframe of the odometry wait until it leaves the window, unless its images are those of an earlier
        frame, or the odometry frame is no longer that of the map.
        """
        frame = self._frame
        if frame is None or self._is_lost or not keyframe.is_of_newest_frame:
            return
        rig, R_odom_imu = keyframe.calibration.rig, keyframe.state.T_world_imu[:3, :3]
        features = self._extractor.extract(frame.images, rig, R_odom_imu, keyframe.observations)
        waiting = WaitingKeyframe(keyframe.t_ns, features, KeyframeImages(frame.images, rig))
        self.mapper.add(waiting, keyframe.window_times_ns)
        self._waiting = {t: known for t, known in self._waiting.items() if t in keyframe.window_times_ns}
        self._waiting[keyframe.t_ns] = keyframe

    def departed(self, departure: Departure) -> None:
        """Let a keyframe of the odometry join the map."""
        correction = self.mapper.depart(departure)
        if correction is not None:
            self._members[departure.t_ns] = self._waiting.pop(departure.t_ns)
            self._corrections.append(correction)

    def adjustment_inputs(
        self, graph: PoseGraph, imu: ImuSamples, imu_model: ImuModel, noise: PreintegrationParams
    ) -> AdjustmentInputs:
        """Return the measurements of all keyframes of the map.

        Args:
            graph: The optimized pose graph, without rejected loops.
            imu: The IMU samples of the flight.
            imu_model: The sensor model.
            noise: The noise of the preintegration.
        """
        keyframes = []
        for member in self.mapper.keyframes:
            known, T_map_imu = self._members[member.t_ns], graph.poses[member.number]
            R_map_odom = T_map_imu[:3, :3] @ member.T_odom_imu[:3, :3].T
            keyframes.append(
                AdjustmentKeyframe(
                    member.number,
                    member.t_ns,
                    T_map_imu,
                    R_map_odom @ known.state.velocity_m_s,
                    known.state.gyro_bias_rad_s,
                    known.state.accel_bias_m_s2,
                    observation_table(member.number, known.observations),
                )
            )
        calibration = self._members[self.mapper.keyframes[-1].t_ns].calibration
        return AdjustmentInputs(keyframes, graph.loops, imu, imu_model, noise, calibration, graph.first_covariance)

    def lost(self) -> None:
        """End the map: later keyframes are in another odometry frame."""
        self._is_lost = True


def _events(correction: Correction) -> list[str]:
    """Return the events of a correction, as texts for users."""
    return [f"loop closed with keyframe {number}" for number in sorted({loop.first for loop in correction.loops})]
