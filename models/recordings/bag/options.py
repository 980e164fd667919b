"""Options for reading bags whose contents are ambiguous."""

from dataclasses import dataclass


@dataclass(frozen=True)
class BagTopics:
    """Topics of a bag. Empty fields are found by message type."""

    images: tuple[str, ...] = ()
    """Image topic of each camera in the order of the calibration (sensor_msgs Image or CompressedImage)."""
    imu: str = ""
    """Topic of the IMU samples (sensor_msgs Imu)."""
    truth: str = ""
    """Topic of the true poses of the IMU (nav_msgs Odometry, geometry_msgs PoseStamped or TransformStamped)."""
