"""The map of an estimator in a recording: corrected path, correction over time, loops, points and pose graph.

What the estimator knows at its frames is logged with them, also while it runs. The map after the flight is logged at
its end: it is valid at all times.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from dronevio.eval import colours
from dronevio.eval.map_results import MapResults, OnlineCorrection
from dronevio.eval.metrics import Alignment
from dronevio.eval.rerun.entities import MapEntities
from dronevio.eval.rerun.sink import Sink
from dronevio.models.arrays import Array
from dronevio.models.state import Trajectory

_PATH_RADIUS, _GRAPH_RADIUS = rr.Radius.ui_points(1.5), rr.Radius.ui_points(0.8)
_POINT_RADIUS, _NODE_RADIUS, _LOOP_RADIUS = (rr.Radius.ui_points(points) for points in (1.0, 2.0, 1.0))


class MapLog:
    """Logs the map of one estimator."""

    def __init__(self, sink: Sink, entities: MapEntities) -> None:
        """Log how the curves of the map are drawn.

        Args:
            sink: Output of the rows.
            entities: Paths of the entities of the map.
        """
        self._sink, self._entities = sink, entities
        self._last_p: Array = np.zeros((0, 3))
        rgb = colours.rgb(colours.CORRECTED)
        sink.static(entities.path_so_far, rr.LineStrips3D.from_fields(colors=rgb, radii=_PATH_RADIUS))
        sink.curve_styles(entities.position, [f"{axis} [m]" for axis in "xyz"], colours.AXES)
        sink.curve_styles(entities.yaw, ["yaw [°]"], [colours.CORRECTED])
        sink.curve_styles(entities.loop_count, ["closed loops"], [colours.LOOP])

    def online(self, path: Trajectory, correction: OnlineCorrection) -> None:
        """Log what was known at the next frames.

        Args:
            path: The corrected poses, in the displayed world frame.
            correction: The correction since the last call.
        """
        p = np.concatenate([self._last_p, path.p_world_imu])
        self._last_p = p[-1:]
        if len(p) > 1:
            self._sink.segments(self._entities.path_so_far, path.t_ns[1 - len(p) :], p[:-1], p[1:])
        self._sink.values(self._entities.position, correction.t_ns, correction.position_m)
        self._sink.values(self._entities.yaw, correction.t_ns, correction.yaw_deg)
        self._sink.values(self._entities.loop_count, correction.t_ns, correction.loops.astype(float))

    def final(self, results: MapResults, alignment: Alignment) -> None:
        """Log the map after the flight.

        Args:
            results: The map with its alignment.
            alignment: Alignment of the odometry with the displayed world frame.
        """
        slam_map, to_truth, entities = results.map, results.final_alignment, self._entities
        corrected = to_truth.positions(results.final.p_world_imu)
        before = alignment.positions(slam_map.Ts_odom_imu[:, :3, 3])
        after = to_truth.positions(slam_map.Ts_map_imu[:, :3, 3])
        self._strips(entities.path, [corrected], colours.CORRECTED)
        for entity, nodes, colour in (
            (entities.graph_before, before, colours.ESTIMATE),
            (entities.graph_after, after, colours.CORRECTED),
        ):
            self._strips(entity, [nodes], colour)
            drawn = rr.Points3D(nodes.astype(np.float32), colors=colours.rgb(colour), radii=_NODE_RADIUS)
            self._sink.static(f"{entity}/keyframes", drawn)
        for entity, rows, colour in (
            (entities.loops, slam_map.closed, colours.LOOP),
            (entities.rejected_loops, slam_map.loops[slam_map.rejected], colours.REJECTED_LOOP),
        ):
            self._strips(entity, list(after[rows]), colour)
        points = to_truth.positions(slam_map.points).astype(np.float32)
        rgb = colours.rgb(colours.SURROUNDINGS)
        self._sink.static(entities.points, rr.Points3D(points, colors=rgb, radii=_POINT_RADIUS))

    def _strips(self, entity: str, strips: Sequence[Array], colour: str) -> None:
        """Log lines, each of points (N, 3) [m], that are valid at all times."""
        radius = _LOOP_RADIUS if len(strips) > 1 else _GRAPH_RADIUS
        lines = rr.LineStrips3D(
            [strip.astype(np.float32) for strip in strips], colors=colours.rgb(colour), radii=radius
        )
        self._sink.static(entity, lines)
