"""Ground truth in a bag: trajectory of the IMU, and exposure of the frames."""

from pathlib import Path
from typing import cast

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import PoseMessage, position_and_quat_wxyz, velocity_in_body
from dronevio.models.recordings.bag.writer import FRAME_TRUTH_TOPIC, TRUE_VECTORS, TRUTH_TOPIC
from dronevio.models.recordings.frame_truth import FrameTruth, parse_frame_truth
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.models.state import Trajectory

_UNIT_TOLERANCE = 0.05  # as for all trajectories


def read_bag_truth(bag: BagFile, topic: str, rows: slice = slice(None)) -> Trajectory:
    """Read the true trajectory of the IMU.

    Bags that this package wrote have velocity and biases on separate topics. The velocity of other odometry is rotated
    from the body frame into the world frame; other pose messages have no velocity.

    Args:
        bag: The bag.
        topic: Topic of the poses.
        rows: The messages to read, in the order of the bag.

    Raises:
        InputError: A pose is invalid, two time stamps are equal, or topics have different time stamps.
    """
    t_ns, messages = bag.stamped_messages(topic, rows)
    poses = np.array([position_and_quat_wxyz(cast(PoseMessage, message)) for message in messages]).reshape(-1, 7)
    with np.errstate(over="ignore", invalid="ignore"):  # damaged bytes may be arbitrary numbers
        lengths = np.linalg.norm(poses[:, 3:], axis=1)
    wrong = np.flatnonzero(~np.isfinite(poses).all(axis=1) | ~(np.abs(lengths - 1.0) < _UNIT_TOLERANCE))
    if wrong.size:
        found = f"{topic}: {poses[wrong[0]].tolist()} at {t_ns[wrong[0]]} ns"
        raise bag.error(found, "a finite position and a unit quaternion")
    p, quat_wxyz = np.ascontiguousarray(poses[:, :3]), np.ascontiguousarray(poses[:, 3:])
    if topic == TRUTH_TOPIC:
        vectors = {field: _vectors(bag, vector, t_ns, rows) for vector, (field, _) in TRUE_VECTORS.items()}
        return Trajectory(t_ns, p, quat_wxyz, **vectors)
    return Trajectory(t_ns, p, quat_wxyz, _world_velocity([cast(PoseMessage, m) for m in messages], quat_wxyz))


def read_bag_frame_truth(bag: BagFile) -> FrameTruth | None:
    """Read the ground truth of the frames, None if the bag has none.

    Raises:
        InputError: The table of the topic is damaged.
    """
    if bag.topics.get(FRAME_TRUTH_TOPIC) != "std_msgs/msg/String":
        return None
    message = cast("ros.std_msgs__msg__String", bag.first_message(FRAME_TRUTH_TOPIC))
    return parse_frame_truth(Path(f"{bag.path}:{FRAME_TRUTH_TOPIC}"), message.data)


def _vectors(bag: BagFile, topic: str, t_ns: Times, rows: slice) -> Array | None:
    """Return the vectors (N, 3) of a topic at the given times (N,) [ns], None if the topic is missing."""
    if bag.topics.get(topic) != "geometry_msgs/msg/Vector3Stamped":
        return None
    times, messages = bag.stamped_messages(topic, rows)
    if not np.array_equal(times, t_ns):
        raise bag.error(f"{topic}: other time stamps than {TRUTH_TOPIC}", "equal time stamps")
    stamped = [cast("ros.geometry_msgs__msg__Vector3Stamped", message).vector for message in messages]
    vectors = np.array([(v.x, v.y, v.z) for v in stamped]).reshape(-1, 3)
    if not np.isfinite(vectors).all():
        raise bag.error(f"{topic}: a non-finite number", "finite numbers")
    return vectors


def _world_velocity(messages: list[PoseMessage], quat_wxyz: Array) -> Array | None:
    """Return the velocities (N, 3) in the world frame [m/s], None if a message has none."""
    in_body = [velocity for message in messages if (velocity := velocity_in_body(message)) is not None]
    if len(in_body) != len(messages) or not np.isfinite(in_body).all():
        return None
    return np.asarray(np.einsum("nij,nj->ni", matrix_from_quat_wxyz(quat_wxyz), np.array(in_body)))
