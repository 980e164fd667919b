"""World frame of a reconstruction from known poses, a rig or an IMU: position, orientation and scale."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.sfm.placement.inertial import InertialAlignment, align_with_imu
    from dronevio.estimator.sfm.placement.world import WorldFrame, place

__all__ = ["InertialAlignment", "WorldFrame", "align_with_imu", "place"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.sfm.placement.inertial": ("InertialAlignment", "align_with_imu"),
        "dronevio.estimator.sfm.placement.world": ("WorldFrame", "place"),
    },
)
