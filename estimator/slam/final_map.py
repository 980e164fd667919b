"""The final map of a flight: its poses by all measurements, and the forms in which other programs receive it.

The pose graph gives the initial poses, and visual-inertial bundle adjustment the final ones, where loops correct the
odometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dronevio.estimator.slam.adjustment.adjuster import solved
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs
from dronevio.estimator.slam.adjustment.final_graph import at_optimum, measured_in_map
from dronevio.estimator.slam.adjustment.flight_measurements import FlightMeasurements
from dronevio.estimator.slam.adjustment.structure import map_structure
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.files.saved_arrays import MIN_KEYFRAMES
from dronevio.estimator.slam.files.saved_map import SavedMap, saved_map
from dronevio.estimator.slam.map.pose_graph import OptimizedGraph, PoseGraph
from dronevio.estimator.slam.mapper import Mapper
from dronevio.models.errors import ConfigError
from dronevio.models.reconstructions.recorded import RecordedReconstruction
from dronevio.models.rig import RigCamera
from dronevio.models.slam_map import SlamMap


@dataclass(frozen=True, eq=False)
class FinalMap:
    """The map after a flight."""

    mapper: Mapper
    """The map as it was built."""
    measurements: FlightMeasurements
    """The measurements of the keyframes of the flight."""
    config: SlamConfig
    """Settings."""
    solution: OptimizedGraph | None
    """The pose graph with the final poses; None if no keyframe has joined the map."""
    adjustment: str
    """Outcome of the bundle adjustment; empty without one."""

    @classmethod
    def of_flight(cls, mapper: Mapper, measurements: FlightMeasurements, config: SlamConfig) -> "FinalMap":
        """Optimize the pose graph with all loops, and adjust the map.

        Args:
            mapper: The map as it was built.
            measurements: The measurements of the keyframes of the flight.
            config: Settings.
        """
        solution, adjustment = mapper.final_solution(), ""
        if solution is not None:
            solution, adjustment = _adjusted(solution, mapper, measurements, config)
        return cls(mapper, measurements, config, solution, adjustment)

    def slam_map(self) -> SlamMap | None:
        """Return the map as arrays; None if no keyframe has joined it.

        Without loops, the odometry is not corrected.
        """
        if self.solution is None:
            return None
        slam_map = replace(self.mapper.map_of(self.solution), adjustment=self.adjustment)
        if not len(slam_map.closed):
            return slam_map
        # The correction is that of the causal path, which is then at the final poses where the keyframes are.
        return replace(slam_map, Ts_odom_imu=self.measurements.causal_poses(self.mapper.keyframes))

    def saved_map(self, cameras: Sequence[RigCamera]) -> SavedMap:
        """Return the map for later flights.

        Args:
            cameras: Calibration of the cameras.

        Raises:
            ConfigError: The map has too few keyframes.
        """
        count = 0 if self.solution is None else len(self.solution.graph.poses)
        if self.solution is None or count < MIN_KEYFRAMES:
            raise ConfigError(f"map with {count} keyframes; expected {MIN_KEYFRAMES} or more to save it")
        return saved_map(cameras, self.solution.without_rejected, self.mapper.keyframes, self.mapper.patches)

    def adjustment_inputs(self) -> AdjustmentInputs:
        """Return the measurements for bundle adjustment, with the final poses.

        Raises:
            ConfigError: No keyframe of the flight has joined the map, or one of them has no measurements.
        """
        keyframes = self.mapper.keyframes
        if self.solution is None or not self.measurements.covers(keyframes):
            raise ConfigError("map without keyframes of this flight and their measurements; expected one or more")
        return self.measurements.inputs(keyframes, self.solution.without_rejected)

    def pose_graph(self) -> PoseGraph:
        """Return the pose graph for other programs, at the optimum of its relative poses and without rejected loops.

        Raises:
            ConfigError: No keyframe has joined the map.
        """
        if self.solution is None:
            raise ConfigError("map without keyframes; expected one or more to write its graph")
        graph, keyframes, c = self.solution.without_rejected, self.mapper.keyframes, self.config
        if self.measurements.covers(keyframes):
            inputs, pose = self.measurements.inputs(keyframes, graph), c.mapping.localization.pose
            graph = measured_in_map(graph, inputs, c.adjustment, pose, self.mapper.adjusted_until)
        return at_optimum(graph)

    def reconstruction(self) -> RecordedReconstruction:
        """Return the keyframes of the flight at their final poses, with the landmarks that they observe.

        Raises:
            ConfigError: No keyframe of the flight has joined the map.
        """
        keyframes = self.measurements.of_flight(self.mapper.keyframes)
        if self.solution is None or not keyframes:
            raise ConfigError("map without keyframes of this flight; expected one or more to write its landmarks")
        graph = self.solution.without_rejected.between({keyframe.number for keyframe in keyframes})
        inputs = self.measurements.inputs(keyframes, graph)
        return map_structure(inputs, self.config.adjustment, self.measurements.stamps_ns(keyframes))


def _adjusted(
    solution: OptimizedGraph, mapper: Mapper, measurements: FlightMeasurements, config: SlamConfig
) -> tuple[OptimizedGraph, str]:
    """Return a pose graph with the poses by bundle adjustment, if it has loops, and the outcome as text."""
    graph, keyframes = solution.without_rejected, mapper.keyframes
    if not measurements.covers(keyframes) or not measurements.loops(keyframes, graph):
        return solution, ""
    outcome = solved(measurements.inputs(keyframes, graph), config.adjustment)
    if outcome.poses is None:  # those of the pose graph remain
        return solution, outcome.text
    return replace(solution, graph=replace(solution.graph, poses=outcome.poses)), outcome.text
