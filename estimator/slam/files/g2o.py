"""A pose graph as a g2o file, which other programs optimize or display.

Lines ``VERTEX_SE3:QUAT`` hold the poses and ``EDGE_SE3:QUAT`` the relative poses of odometry and loops, each with its
information matrix (Kümmerle et al., "g2o: A general framework for graph optimization", ICRA 2011). The matrix is that
of the position and of the rotation vector, as GTSAM and the examples of Ceres read it. The program g2o itself takes the
vector part of the quaternion in place of the rotation vector, which is half of it: there, rotations count a quarter.
The format has no line for directions of gravity or for priors on positions: roll and pitch are then those of the first
pose and of the relative poses.
"""

from pathlib import Path

import numpy as np

from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.models.arrays import Array
from dronevio.models.recordings.files import write_text
from dronevio.models.rotation import quat_wxyz_from_matrix


def write_g2o(path: Path, graph: PoseGraph) -> None:
    """Write a pose graph as a g2o file, atomically.

    Args:
        path: The file.
        graph: The graph; its loops are written as if all of them were right.

    Raises:
        InputError: The file cannot be written.
    """
    lines = [f"VERTEX_SE3:QUAT {number} {_numbers(_pose(T))}" for number, T in sorted(graph.poses.items())]
    lines.append(f"FIX {graph.first}")
    for each in (*graph.odometry, *graph.loops):
        numbers = _numbers(np.concatenate([_pose(each.T_first_second), _information(each)]))
        lines.append(f"EDGE_SE3:QUAT {each.first} {each.second} {numbers}")
    write_text(path, "\n".join(lines) + "\n")


def _pose(T: Array) -> Array:
    """Return a pose as position and quaternion (x, y, z, qx, qy, qz, qw)."""
    w, x, y, z = quat_wxyz_from_matrix(T[:3, :3])
    return np.array([*T[:3, 3], x, y, z, w])


def _information(relative: RelativePose) -> Array:
    """Return the upper triangle (21,) of the information matrix of a relative pose, in the order of the file.

    These are the position, then the rotation vector.
    """
    order = np.array([3, 4, 5, 0, 1, 2])
    information = np.linalg.inv(relative.covariance[np.ix_(order, order)])
    return np.asarray(0.5 * (information + information.T)[np.triu_indices(6)])


def _numbers(values: Array) -> str:
    """Return numbers as text that gives the same numbers when it is read."""
    return " ".join(repr(value) for value in values.tolist())
