"""Options for reading bags whose contents are ambiguous."""

from dataclasses import dataclass

ROS1_SUFFIX = ".bag"
"""Suffix of bags of ROS 1."""
STORAGES = (ROS1_SUFFIX, ".mcap", ".db3")
"""Suffixes of the files of bags."""


@dataclass(frozen=True)
class BagTopics:
    """Topics of a bag. Empty fields are found by message type."""

    images: tuple[str, ...] = ()
    """Image topic of each camera in the order of the calibration (sensor_msgs Image or CompressedImage)."""
    imu: tuple[str, ...] = ()
    """Topic of the IMU samples (sensor_msgs Imu), or two topics, of the gyroscope and of the accelerometer."""
    truth: str = ""
    """Topic of the true poses of the IMU (nav_msgs Odometry, geometry_msgs PoseStamped or TransformStamped)."""
