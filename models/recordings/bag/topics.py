"""Which topics of a bag are the cameras, the IMU and the truth: found by type, or as the user says."""

from collections.abc import Sequence
from typing import cast

from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import ImageMessage, is_grey_or_colour
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.writer import COMPRESSED, TRUTH_TOPIC
from dronevio.models.recordings.calibration.kalibr import IMU_TOPIC

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMU_TYPES = ("sensor_msgs/msg/Imu",)
POSE_TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")

_NAMES_OF_TRUTH = ("groundtruth", "ground_truth", "vicon", "mocap", "optitrack")


def find_topics(bag: BagFile, wanted: BagTopics, calibrated: Sequence[str], cameras: int | None) -> BagTopics:
    """Return which topics to read; the truth's is empty where there is none.

    Args:
        bag: The bag.
        wanted: What the user says.
        calibrated: Of each camera of the calibration, if there is one, the topic that it names, or nothing.
        cameras: Use only the first so many cameras; None for all.

    Raises:
        InputError: A topic is missing or of another type, or several could be meant.
    """
    images = tuple(_checked(bag, topic, IMAGE_TYPES) for topic in wanted.images) or image_topics(bag, calibrated)
    return BagTopics(
        images[:cameras],
        _checked(bag, wanted.imu, IMU_TYPES) if wanted.imu else _imu_topic(bag),
        _checked(bag, wanted.truth, POSE_TYPES) if wanted.truth else truth_topic(bag),
    )


def camera_info_topic(image_topic: str) -> str:
    """Return where the camera that takes a topic's images is described, as ROS has it: beside them."""
    return f"{image_topic.removesuffix(COMPRESSED).rpartition('/')[0]}/camera_info"


def _checked(bag: BagFile, topic: str, types: Sequence[str]) -> str:
    """Return a topic that the user chose, or raise InputError."""
    if topic not in bag.topics:
        raise bag.fault(f"no topic {topic}", f"one of {', '.join(bag.of_type(*types)) or 'that type; there is none'}")
    if bag.topics[topic] not in types:
        raise bag.fault(f"{topic} with messages of {bag.topics[topic]}", f"messages of {' or '.join(types)}")
    return topic


def image_topics(bag: BagFile, calibrated: Sequence[str]) -> tuple[str, ...]:
    """Return the topics of the cameras; `find_topics` tells more.

    Raises:
        InputError: There is none, or several could be meant.
    """
    there = bag.of_type(*IMAGE_TYPES)
    if calibrated and all(topic in there or topic + COMPRESSED in there for topic in calibrated):
        return tuple(topic if topic in there else topic + COMPRESSED for topic in calibrated)
    once = [topic for topic in there if topic.removesuffix(COMPRESSED) not in there or not topic.endswith(COMPRESSED)]
    # A depth image is none of what a camera sees.
    found = tuple(topic for topic in once if is_grey_or_colour(cast(ImageMessage, bag.first(topic))))
    if not found:
        raise bag.fault(f"no camera among the topics {_listed(there or tuple(bag.topics))}", " or ".join(IMAGE_TYPES))
    if calibrated and len(found) != len(calibrated):
        raise bag.fault(
            f"{len(found)} topics with images, {_listed(found)}, for the {len(calibrated)} cameras of the calibration",
            "as many, or to be told which (topics.images)",
        )
    return found


def _imu_topic(bag: BagFile) -> str:
    """Return the topic of the IMU, or raise InputError."""
    found = bag.of_type(*IMU_TYPES)
    if IMU_TOPIC in found:
        return IMU_TOPIC
    if not found:
        raise bag.fault(f"no IMU among the topics {_listed(tuple(bag.topics))}", IMU_TYPES[0])
    if len(found) > 1:
        raise bag.fault(f"several IMUs, {_listed(found)}", "one, or to be told which (topics.imu)")
    return found[0]


def truth_topic(bag: BagFile) -> str:
    """Return the topic of the truth, nothing where none is known: an odometry by another name may be an estimate."""
    found = bag.of_type(*POSE_TYPES)
    if TRUTH_TOPIC in found:
        return TRUTH_TOPIC
    named = [topic for topic in found if any(name in topic.lower() for name in _NAMES_OF_TRUTH)]
    return named[0] if len(named) == 1 else ""


def _listed(topics: Sequence[str]) -> str:
    """Return topics as a message can show them."""
    return ", ".join(topics[:8]) + (" ..." if len(topics) > 8 else "") if topics else "(there are none)"
