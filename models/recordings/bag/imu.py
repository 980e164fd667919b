"""IMU samples of a bag: from one topic, or from two with the halves of an IMU, as of RealSense cameras.

A message of type sensor_msgs/Imu has room for both halves. The one that a topic lacks is zero, or its covariance says
that it is missing.
"""

from itertools import islice
from typing import Literal, cast

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.arrays import Array
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import imu_halves
from dronevio.models.recordings.bag.stamps import TopicStamps
from dronevio.models.recordings.split_imu import interpolated_accel

Halves = Literal["both", "gyro", "accel"]

_EXAMINED = 100  # messages of a topic, to see what it measures


def named_halves(topic: str) -> Halves:
    """Return what a topic measures by its name."""
    is_gyro, is_accel = "gyro" in topic.lower(), "accel" in topic.lower()
    if is_gyro == is_accel:
        return "both"
    return "gyro" if is_gyro else "accel"


def halves_of(bag: BagFile, topic: str) -> Halves:
    """Return what a topic measures, by its name or else by its first messages.

    Raises:
        InputError: A message is damaged.
    """
    if named_halves(topic) != "both":
        return named_halves(topic)
    messages = cast("list[ros.sensor_msgs__msg__Imu]", list(islice(bag.messages(topic), _EXAMINED)))
    has_gyro, has_accel = (half is not None and bool(np.any(half)) for half in imu_halves(messages))
    if has_gyro == has_accel:
        return "both"
    return "gyro" if has_gyro else "accel"


def pair_of(bag: BagFile, topics: tuple[str, ...]) -> tuple[str, str] | None:
    """Return the topic of the gyroscope and that of the accelerometer; None unless there is one of each.

    Raises:
        InputError: A message is damaged.
    """
    halves = {topic: halves_of(bag, topic) for topic in topics}
    gyro, accel = ([topic for topic in topics if halves[topic] == half] for half in ("gyro", "accel"))
    return (gyro[0], accel[0]) if len(gyro) == len(accel) == 1 else None


def read_imu_rows(bag: BagFile, topics: tuple[str, ...]) -> tuple[TopicStamps, Array]:
    """Return the time stamps (N,) of IMU samples and their values (N, 6), in the order of the bag.

    Args:
        bag: The bag.
        topics: The topic of the IMU, or those of its gyroscope and its accelerometer; the time stamps are those of the
            first.

    Returns:
        The time stamps, and angular velocities [rad/s] with specific forces [m/s²].

    Raises:
        InputError: A message is damaged, or half of the IMU is missing.
    """
    stamps, gyro, accel = _halves(bag, topics[0])
    rows = np.arange(len(stamps.t_ns))
    if len(topics) == 2:
        others, _, accel = _halves(bag, topics[1])
        if accel is not None:
            rows, accel = interpolated_accel(stamps.t_ns, others.t_ns, accel)
        if not len(rows):
            raise bag.error(f"{' and '.join(topics)} do not overlap in time", "two halves of an IMU on one clock")
    if gyro is None or accel is None:
        raise bag.error(
            f"{' and '.join(topics)}: IMU messages without {'angular velocity' if gyro is None else 'acceleration'}",
            "both, in one topic or in two (--topics.imu GYROSCOPE ACCELEROMETER)",
        )
    return stamps.selected(rows), np.hstack([gyro[rows], accel])


def _halves(bag: BagFile, topic: str) -> tuple[TopicStamps, Array | None, Array | None]:
    """Return the time stamps (N,) of a topic and the halves (N, 3) that it has."""
    stamps, messages = bag.listed_messages(topic)
    return stamps, *imu_halves(cast("list[ros.sensor_msgs__msg__Imu]", messages))
