"""Visual SLAM: the odometry, and a map around it that corrects it when places are seen again.

The odometry does not depend on the map: its estimates are those of `VisualInertialOdometry`, to the bit. The map
receives the keyframes of the odometry and returns the pose of the odometry frame in the map frame, `T_map_odom`. It is
applied a number of frames after the keyframe that caused it, which depends on numbers of keyframes and loops alone, so
that results do not depend on the speed of the machine. Meanwhile a worker process updates the map. A pose in the map
frame is causal, and it jumps when a loop is closed; the pose in the odometry frame is continuous.
"""

from collections.abc import Sequence
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
from dronevio.estimator.slam.keyframe import MapKeyframe
from dronevio.estimator.slam.map_builder import (
    DepartedKeyframe,
    LocalMap,
    MapCost,
    MapMessage,
    OdometryMap,
    TrackLost,
)
from dronevio.estimator.slam.map_process import MapProcess
from dronevio.estimator.slam.mapping import Correction, Mapper, MapSummary
from dronevio.estimator.slam.pose_graph import PoseGraph
from dronevio.estimator.slam.schedule import CorrectionSchedule
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
        self._rig = rig
        self._imu: list[ImuSamples] = []
        self._keyframes = _DepartingKeyframes()
        self._odometry = VisualInertialOdometry(rig, odometry, observer=self._keyframes)
        self._map: OdometryMap = MapProcess(rig, c) if c.worker else LocalMap(rig, c)
        self._schedule = CorrectionSchedule(c.correction_delay)
        self._frames = self._sent = self._loops = 0
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
            DefectError: The worker process died, or failed in a way that no input should cause.
        """
        self._keyframes.begin_frame(frame)
        estimate = self._odometry.add_frame(frame)
        self._frames += 1
        for message in self._keyframes.take():
            self._map.send(message)
            self._sent += 1
            self._schedule.add(self._frames, self._sent, self._loops)
        events: list[str] = []
        closed: tuple[tuple[int, int], ...] = ()
        for _ in range(self._schedule.take_due(self._frames)):
            correction = self._map.receive()
            if correction is not None:
                self._T_map_odom = correction.T_map_odom
                self._loops += len(correction.loops) + correction.rejected
                events += _events(correction)
                closed += correction.loop_times_ns
        if estimate.state is None:
            return estimate
        events_so_far = (*estimate.events, *events)
        return replace(estimate, T_map_odom=self._T_map_odom, events=events_so_far, closed_loops_ns=closed)

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
        odometry is not corrected.
        """
        mapper = self.mapper
        solution = mapper.final_solution()
        if solution is None:
            return None
        poses, graph = solution.graph.poses, solution.without_rejected
        if graph.loops:
            imu, noise = reduce(ImuSamples.extended, self._imu), self._odometry.imu_noise
            inputs = self._keyframes.adjustment_inputs(mapper.keyframes, graph, imu, self._rig.imu, noise)
            with suppress(RuntimeError):  # by GTSAM, if the system is singular; the poses of the graph remain
                poses = adjust(inputs, self._config.adjustment)
        return mapper.map_of(replace(solution, graph=replace(solution.graph, poses=poses)))

    def close(self) -> None:
        """End the worker process, which otherwise ends with the last reference to this object."""
        self._map.close()


class _DepartingKeyframes:
    """Keeps the keyframes of the odometry until they leave the window; implements `KeyframeObserver`."""

    def __init__(self) -> None:
        """Begin without keyframes."""
        self._frame: CameraFrame | None = None
        self._waiting: dict[int, tuple[OdometryKeyframe, CameraFrame]] = {}
        self._members: dict[int, OdometryKeyframe] = {}  # keyframes that have departed
        self._messages: list[MapMessage] = []

    def begin_frame(self, frame: CameraFrame) -> None:
        """Keep the images of the newest frame, which may become a keyframe."""
        self._frame = frame

    def take(self) -> list[MapMessage]:
        """Return the messages since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Let a keyframe of the odometry wait until it leaves the window, unless its images are those of an earlier
        frame.
        """
        self._waiting = {t: known for t, known in self._waiting.items() if t in keyframe.window_times_ns}
        if self._frame is not None and keyframe.is_of_newest_frame:
            self._waiting[keyframe.t_ns] = keyframe, self._frame

    def departed(self, departure: Departure) -> None:
        """Let a keyframe of the odometry join the map, if its images are known."""
        waiting = self._waiting.pop(departure.t_ns, None)
        if waiting is None:
            return
        keyframe, frame = waiting
        self._members[departure.t_ns] = keyframe
        self._messages.append(
            DepartedKeyframe(
                keyframe.t_ns,
                tuple(frame.images),
                keyframe.calibration.rig,
                keyframe.state.T_world_imu[:3, :3],
                keyframe.observations,
                departure,
            )
        )

    def adjustment_inputs(
        self,
        keyframes_of_map: Sequence[MapKeyframe],
        graph: PoseGraph,
        imu: ImuSamples,
        imu_model: ImuModel,
        noise: PreintegrationParams,
    ) -> AdjustmentInputs:
        """Return the measurements of all keyframes of the map.

        Args:
            keyframes_of_map: The keyframes of the map.
            graph: The optimized pose graph, without rejected loops.
            imu: The IMU samples of the flight.
            imu_model: The sensor model.
            noise: The noise of the preintegration.
        """
        keyframes = []
        for member in keyframes_of_map:
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
        calibration = self._members[keyframes_of_map[-1].t_ns].calibration
        return AdjustmentInputs(keyframes, graph.loops, imu, imu_model, noise, calibration, graph.first_covariance)

    def lost(self) -> None:
        """Tell the map that later keyframes are in another odometry frame."""
        self._waiting = {}
        self._messages.append(TrackLost())


def _itself(mapper: Mapper) -> Mapper:
    return mapper


def _summary(mapper: Mapper) -> MapSummary:
    return mapper.summary


def _events(correction: Correction) -> list[str]:
    """Return the events of a correction, as texts for users."""
    return [f"loop closed with keyframe {number}" for number in sorted({loop.first for loop in correction.loops})]
