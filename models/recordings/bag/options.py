"""What a user may say of a bag that does not explain itself."""

from dataclasses import dataclass


@dataclass(frozen=True)
class BagTopics:
    """Topics of a bag; what is empty is found by type."""

    images: tuple[str, ...] = ()
    """Images of each camera, in the order of the calibration (sensor_msgs Image or CompressedImage)."""
    imu: str = ""
    """The IMU's samples (sensor_msgs Imu)."""
    truth: str = ""
    """True poses of the IMU frame (nav_msgs Odometry, geometry_msgs PoseStamped or TransformStamped)."""
