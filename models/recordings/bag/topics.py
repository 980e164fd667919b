"""Selection of the topics of cameras, IMU and ground truth in a bag, by message type or by the user."""

from collections.abc import Sequence
from typing import cast

from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.imu import halves_of, named_halves, pair_of
from dronevio.models.recordings.bag.messages import ImageMessage, is_grey_or_colour
from dronevio.models.recordings.bag.missing import MissingParts, missing
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.writer import COMPRESSED, TRUTH_TOPIC
from dronevio.models.recordings.calibration.kalibr import IMU_TOPIC

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMU_TYPES = ("sensor_msgs/msg/Imu",)
POSE_TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")

_TRUTH_NAMES = ("groundtruth", "ground_truth", "vicon", "mocap", "optitrack")


def find_topics(bag: BagFile, requested: BagTopics, calibrated: Sequence[str], parts: MissingParts) -> BagTopics:
    """Return the topics to read; those that are missing are empty, and that of the ground truth if there is none.

    Args:
        bag: The bag.
        requested: Topics that the user selected.
        calibrated: Image topics that the calibration names, empty if it has none.
        parts: Collects missing image and IMU topics.

    Raises:
        InputError: A topic has another message type, or is ambiguous.
    """
    images: tuple[str, ...] = ()
    imu: tuple[str, ...] = ()
    with parts.collected():
        images = tuple(_checked(bag, topic, IMAGE_TYPES) for topic in requested.images) or image_topics(bag, calibrated)
    with parts.collected():
        imu = _requested_imu(bag, requested.imu) if requested.imu else _imu_topics(bag)
    truth = _checked(bag, requested.truth, POSE_TYPES) if requested.truth else truth_topic(bag)
    return BagTopics(images, imu, truth)


def camera_info_topic(image_topic: str) -> str:
    """Return the CameraInfo topic of an image topic, by the naming convention of ROS."""
    return f"{image_topic.removesuffix(COMPRESSED).rpartition('/')[0]}/camera_info"


def _checked(bag: BagFile, topic: str, types: Sequence[str]) -> str:
    """Return a topic that the user selected if it has one of the given types, or raise InputError."""
    if topic not in bag.topics:
        raise missing(
            bag,
            f"no topic {topic}",
            f"one of {', '.join(bag.topics_of_type(*types)) or 'the topics of the bag, but none has this type'}",
        )
    if bag.topics[topic] not in types:
        raise bag.error(f"{topic} with messages of {bag.topics[topic]}", f"messages of {' or '.join(types)}")
    return topic


def image_topics(bag: BagFile, calibrated: Sequence[str]) -> tuple[str, ...]:
    """Return the image topics; see `find_topics`.

    Raises:
        InputError: There is no image topic, or the selection is ambiguous.
    """
    available = bag.topics_of_type(*IMAGE_TYPES)
    if calibrated and all(topic in available or topic + COMPRESSED in available for topic in calibrated):
        return tuple(topic if topic in available else topic + COMPRESSED for topic in calibrated)
    distinct = [
        topic
        for topic in available
        if topic.removesuffix(COMPRESSED) not in available or not topic.endswith(COMPRESSED)
    ]
    # Depth images are excluded.
    topics = tuple(topic for topic in distinct if is_grey_or_colour(cast(ImageMessage, bag.first_message(topic))))
    if not topics:
        raise missing(
            bag, f"no camera among the topics {_listed(available or tuple(bag.topics))}", " or ".join(IMAGE_TYPES)
        )
    if calibrated and len(topics) != len(calibrated):
        raise bag.error(
            f"{len(topics)} topics with images, {_listed(topics)},"
            f" for the {len(calibrated)} cameras of the calibration",
            "equal numbers, or a selection (--topics.images)",
        )
    return topics


def _requested_imu(bag: BagFile, topics: tuple[str, ...]) -> tuple[str, ...]:
    """Return the selected topic of the IMU, or those of gyroscope and accelerometer; or raise InputError."""
    checked = tuple(_checked(bag, topic, IMU_TYPES) for topic in topics)
    if len(checked) == 1:
        return _whole(bag, checked[0])
    pair = pair_of(bag, checked) if len(checked) == 2 else None
    if pair is None:
        raise bag.error(f"--topics.imu {' '.join(checked)}", "one IMU, or one gyroscope and one accelerometer")
    return pair


def _imu_topics(bag: BagFile) -> tuple[str, ...]:
    """Return the topic of the IMU, or those of its gyroscope and accelerometer, or raise InputError."""
    topics = bag.topics_of_type(*IMU_TYPES)
    if IMU_TOPIC in topics:
        return (IMU_TOPIC,)
    if not topics:
        raise missing(bag, f"no IMU among the topics {_listed(tuple(bag.topics))}", IMU_TYPES[0])
    if len(topics) == 1:
        return _whole(bag, topics[0])
    whole = tuple(topic for topic in topics if halves_of(bag, topic) == "both")
    if len(whole) == 1:
        return whole
    pair = None if whole else pair_of(bag, topics)
    if pair is None:
        raise bag.error(
            f"several IMUs, {_listed(topics)}", "one, or one gyroscope and one accelerometer (--topics.imu)"
        )
    return pair


def _whole(bag: BagFile, topic: str) -> tuple[str]:
    """Return the only topic of an IMU, or raise InputError if its name is that of one half."""
    half = named_halves(topic)
    if half != "both":
        lacking = "an accelerometer" if half == "gyro" else "a gyroscope"
        expected = "two topics with both (--topics.imu GYROSCOPE ACCELEROMETER)"
        raise missing(bag, f"{topic} without {lacking}", expected)
    return (topic,)


def truth_topic(bag: BagFile) -> str:
    """Return the topic of the ground truth, empty if none has a known name; other odometry may be an estimate."""
    topics = bag.topics_of_type(*POSE_TYPES)
    if TRUTH_TOPIC in topics:
        return TRUTH_TOPIC
    named = [topic for topic in topics if any(name in topic.lower() for name in _TRUTH_NAMES)]
    return named[0] if len(named) == 1 else ""


def _listed(topics: Sequence[str]) -> str:
    """Return a list of topics for an error message."""
    return ", ".join(topics[:8]) + (" and others" if len(topics) > 8 else "") if topics else "(none)"
