"""The truth in a bag: the motion of the IMU, and when frames were really exposed."""

from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.imu import Times
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import PoseMessage, position_and_quat_wxyz, velocity_in_body
from dronevio.models.recordings.bag.writer import FRAME_TRUTH_TOPIC, TRUE_VECTORS, TRUTH_TOPIC
from dronevio.models.recordings.frame_truth import FrameTruth, parse_frame_truth
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

_UNIT_TOLERANCE = 0.05  # as for every trajectory that is read


def read_bag_truth(bag: BagFile, topic: str) -> Trajectory:
    """Read the true motion.

    Our own bags have velocity and biases on topics of their own, to the bit. Of other odometry the velocity is turned
    from the moving frame into the world; other poses have none.

    Raises:
        InputError: A pose is none, time stamps do not increase, or what belongs together does not.
    """
    t_ns, messages = bag.stamped(topic)
    poses = np.array([position_and_quat_wxyz(cast(PoseMessage, message)) for message in messages]).reshape(-1, 7)
    with np.errstate(over="ignore", invalid="ignore"):  # what damaged bytes spell
        lengths = np.linalg.norm(poses[:, 3:], axis=1)
    wrong = np.flatnonzero(~np.isfinite(poses).all(axis=1) | ~(np.abs(lengths - 1.0) < _UNIT_TOLERANCE))
    if wrong.size:
        found = f"{topic}: {poses[wrong[0]].tolist()} at {t_ns[wrong[0]]} ns"
        raise bag.fault(found, "a finite position and a quaternion of length 1")
    p, quat_wxyz = np.ascontiguousarray(poses[:, :3]), np.ascontiguousarray(poses[:, 3:])
    if topic == TRUTH_TOPIC:
        vectors = {field: _vectors(bag, vector, t_ns) for vector, (field, _) in TRUE_VECTORS.items()}
        return Trajectory(t_ns, p, quat_wxyz, **vectors)
    return Trajectory(t_ns, p, quat_wxyz, _turned_velocity([cast(PoseMessage, m) for m in messages], quat_wxyz))


def read_bag_frame_truth(bag: BagFile) -> FrameTruth | None:
    """Read when and how frames were really exposed, None where the bag does not say.

    Raises:
        InputError: It is no such table.
    """
    if bag.topics.get(FRAME_TRUTH_TOPIC) != "std_msgs/msg/String":
        return None
    message = cast("ros.std_msgs__msg__String", bag.first(FRAME_TRUTH_TOPIC))
    return parse_frame_truth(Path(f"{bag.path}:{FRAME_TRUTH_TOPIC}"), message.data)


def _vectors(bag: BagFile, topic: str, t_ns: Times) -> Array | None:
    """Return the vectors (N, 3) of a topic at the given times (N,) [ns], None where it is not there."""
    if bag.topics.get(topic) != "geometry_msgs/msg/Vector3Stamped":
        return None
    times, messages = bag.stamped(topic)
    if not np.array_equal(times, t_ns):
        raise bag.fault(f"{topic}: other time stamps than {TRUTH_TOPIC}", "the same")
    stamped = [cast("ros.geometry_msgs__msg__Vector3Stamped", message).vector for message in messages]
    vectors = np.array([(v.x, v.y, v.z) for v in stamped]).reshape(-1, 3)
    if not np.isfinite(vectors).all():
        raise bag.fault(f"{topic}: a number that is not finite", "finite numbers")
    return vectors


def _turned_velocity(messages: list[PoseMessage], quat_wxyz: Array) -> Array | None:
    """Return the velocities (N, 3) in the world [m/s], None where not every message has one."""
    in_body = [velocity for message in messages if (velocity := velocity_in_body(message)) is not None]
    if len(in_body) != len(messages) or not np.isfinite(in_body).all():
        return None
    return np.asarray(np.einsum("nij,nj->ni", matrix_from_quat_wxyz(quat_wxyz), np.array(in_body)))
