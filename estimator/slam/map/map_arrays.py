"""The map as arrays and its size, for files, reports and viewers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.map.pose_graph import OptimizedGraph
from dronevio.models.map_correction import FIRST_NS
from dronevio.models.slam_map import SlamMap


@dataclass(frozen=True)
class MapSummary:
    """Size of a map."""

    keyframes: int
    """Number of keyframes."""
    loops: int
    """Number of loops that are closed."""
    rejected_loops: int
    """Number of loops that contradict the others, or wait for the next optimization."""
    separate_tracks: int = 0
    """Number of tracks of the odometry that are not joined with the map."""


def slam_map(solution: OptimizedGraph, keyframes: Sequence[MapKeyframe], starts_ns: Sequence[int]) -> SlamMap:
    """Return a map as arrays; a landmark that several keyframes observe is where the last one of them puts it.

    Args:
        solution: The pose graph with optimized poses.
        keyframes: Its keyframes in the order of time, one or more.
        starts_ns: Times at which the tracks after the first one begin [ns].
    """
    graph = solution.graph
    row = {keyframe.number: i for i, keyframe in enumerate(keyframes)}
    Ts_map_imu = np.stack([graph.poses[keyframe.number] for keyframe in keyframes])
    points = [
        keyframe.landmarks_imu @ T[:3, :3].T + T[:3, 3] for keyframe, T in zip(keyframes, Ts_map_imu, strict=True)
    ]
    ids = np.concatenate([keyframe.landmark_ids for keyframe in keyframes])
    last = len(ids) - 1 - np.unique(ids[::-1], return_index=True)[1]
    return SlamMap(
        t_ns=np.array([keyframe.t_ns for keyframe in keyframes], dtype=np.int64),
        Ts_map_imu=Ts_map_imu,
        Ts_odom_imu=np.stack([keyframe.T_odom_imu for keyframe in keyframes]),
        loops=np.array([(row[loop.first], row[loop.second]) for loop in graph.loops], dtype=np.int64).reshape(-1, 2),
        Ts_then_now=np.array([loop.T_first_second for loop in graph.loops]).reshape(-1, 4, 4),
        rejected=np.isin(np.arange(len(graph.loops)), list(solution.rejected)),
        points=np.concatenate(points)[last],
        track=np.array([keyframe.track for keyframe in keyframes], dtype=np.int64),
        starts_ns=np.array([FIRST_NS, *starts_ns], dtype=np.int64),
    )
