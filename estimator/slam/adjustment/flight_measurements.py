"""Measurements of the odometry at the keyframes of a map, for bundle adjustment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.observations import ObservationTable, observation_table
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs, AdjustmentKeyframe, SavedKeyframes
from dronevio.estimator.slam.files.saved_map import LAST_KNOWN_NS
from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel, ImuSamples, Times
from dronevio.models.state import NavState

ADJUSTED_MATCH_SIGMA_SCALE = 0.3
"""Standard deviation of a stereo match relative to that of its track in bundle adjustment, where the matches keep the
scale in spite of errors shared by the observations of a track."""


@dataclass(frozen=True, eq=False)
class KeyframeMeasurements:
    """Measurements of the odometry at a keyframe and since the previous one."""

    state: NavState
    """The causal estimate in the odometry frame."""
    observations: Observations
    """The features of the keyframe in all cameras."""
    calibration: Calibration
    """The calibration that was in use."""
    imu: ImuSamples
    """IMU samples since those of the previous keyframe, up to this keyframe or later."""
    imu_noise: PreintegrationParams
    """Estimate of the IMU noise at that time."""
    stamp_ns: int
    """Time stamp of the frame by the clock of the cameras [ns]."""


class FlightMeasurements:
    """The measurements of the keyframes of a flight."""

    def __init__(self, imu_model: ImuModel) -> None:
        """Begin without measurements.

        Args:
            imu_model: The sensor model.
        """
        self._imu_model = imu_model
        self._keyframes: dict[int, KeyframeMeasurements] = {}  # by their times [ns]
        self._estimates: dict[int, KeyframeEstimate] = {}

    def add(self, estimate: KeyframeEstimate, measured: KeyframeMeasurements) -> None:
        """Add the measurements of a keyframe.

        Args:
            estimate: The final estimate of the keyframe by the odometry.
            measured: The measurements.
        """
        self._keyframes[estimate.t_ns] = measured
        self._estimates[estimate.t_ns] = estimate

    def of_flight(self, keyframes: Sequence[MapKeyframe]) -> list[MapKeyframe]:
        """Return the keyframes that have measurements, unlike those of a loaded map."""
        return [keyframe for keyframe in keyframes if keyframe.t_ns in self._keyframes]

    def stamps_ns(self, keyframes: Sequence[MapKeyframe]) -> Times:
        """Return the time stamps (K,) of the frames of keyframes with measurements [ns]."""
        return np.array([self._keyframes[keyframe.t_ns].stamp_ns for keyframe in keyframes], dtype=np.int64)

    def covers(self, keyframes: Sequence[MapKeyframe]) -> bool:
        """Return whether keyframes of this flight are among some, and all of them have measurements."""
        of_flight = [keyframe for keyframe in keyframes if keyframe.t_ns > LAST_KNOWN_NS]
        return bool(of_flight) and len(self.of_flight(of_flight)) == len(of_flight)

    def loops(self, keyframes: Sequence[MapKeyframe], graph: PoseGraph) -> list[RelativePose]:
        """Return the loops of a graph whose later keyframe has measurements."""
        numbers = {keyframe.number for keyframe in self.of_flight(keyframes)}
        return [loop for loop in graph.loops if loop.second in numbers]

    def causal_poses(self, keyframes: Sequence[MapKeyframe]) -> Array:
        """Return the poses (K, 4, 4) of keyframes in the odometry frame as they were estimated at their frames.

        Without measurements, it is the pose when the keyframe left the window.
        """
        known = ((keyframe, self._keyframes.get(keyframe.t_ns)) for keyframe in keyframes)
        return np.stack([keyframe.T_odom_imu if m is None else m.state.T_world_imu for keyframe, m in known])

    def inputs(self, keyframes: Sequence[MapKeyframe], graph: PoseGraph) -> AdjustmentInputs:
        """Return the measurements of a map for its bundle adjustment.

        Args:
            keyframes: The keyframes of the map in the order of time; those without measurements are of a loaded map.
            graph: The pose graph with the initial poses, without rejected loops.
        """
        newest, of_flight, loops = (
            self._keyframes[keyframes[-1].t_ns],
            self.of_flight(keyframes),
            self.loops(keyframes, graph),
        )
        saved = [keyframe for keyframe in keyframes if keyframe.t_ns <= LAST_KNOWN_NS]
        return AdjustmentInputs(
            [self._initialized(keyframe, graph) for keyframe in of_flight],
            loops,
            ImuSamples.concatenated([measured.imu for measured in self._keyframes.values()]),
            self._imu_model,
            newest.imu_noise,
            newest.calibration,
            graph.first,
            graph.first_covariance,
            _saved(saved, graph, loops) if saved else None,
        )

    def _initialized(self, keyframe: MapKeyframe, graph: PoseGraph) -> AdjustmentKeyframe:
        """Return a keyframe with its measurements and its initial state in the map frame."""
        measured, T_map_imu = self._keyframes[keyframe.t_ns], graph.poses[keyframe.number]
        R_map_odom = T_map_imu[:3, :3] @ keyframe.T_odom_imu[:3, :3].T
        return AdjustmentKeyframe(
            keyframe.number,
            keyframe.t_ns,
            T_map_imu,
            R_map_odom @ measured.state.velocity_m_s,
            measured.state.gyro_bias_rad_s,
            measured.state.accel_bias_m_s2,
            np.zeros((6, 6)) if measured.state.covariance is None else measured.state.covariance[9:, 9:],
            observation_table(keyframe.number, measured.observations, ADJUSTED_MATCH_SIGMA_SCALE),
            self._estimates[keyframe.t_ns],
            keyframe.track,
        )


def _saved(keyframes: Sequence[MapKeyframe], graph: PoseGraph, loops: Sequence[RelativePose]) -> SavedKeyframes:
    """Return the keyframes of a loaded map, with their observations of the landmarks of loops."""
    seen = np.unique(np.concatenate([loop.observations.landmark for loop in loops])) if loops else np.zeros(0, np.int64)
    tables = [_corners(keyframe)[np.isin(keyframe.features.landmark, seen)] for keyframe in keyframes]
    numbers = {keyframe.number for keyframe in keyframes}
    return SavedKeyframes(graph.among(numbers), ObservationTable.concatenated(tables))


def _corners(keyframe: MapKeyframe) -> ObservationTable:
    """Return the corners of a keyframe as observations of the best quality."""
    f, none = keyframe.features, np.zeros(len(keyframe.features), np.int64)
    return ObservationTable(f.landmark, none + keyframe.number, f.camera, f.xy, np.ones(len(f)), none)
