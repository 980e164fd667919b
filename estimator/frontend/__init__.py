"""The visual front end: features detected, tracked and matched across the cameras of a rig."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.frontend.protocol import FrontEnd
    from dronevio.estimator.frontend.rig import RigTracker
    from dronevio.estimator.frontend.rolling_shutter import ExposureCompensation
    from dronevio.estimator.frontend.stereo import StereoConfig, StereoMatcher
    from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig

__all__ = [
    "ExposureCompensation",
    "FeatureTracker",
    "FrontEnd",
    "RigTracker",
    "StereoConfig",
    "StereoMatcher",
    "TrackerConfig",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.frontend.protocol": ("FrontEnd",),
        "dronevio.estimator.frontend.rig": ("RigTracker",),
        "dronevio.estimator.frontend.rolling_shutter": ("ExposureCompensation",),
        "dronevio.estimator.frontend.stereo": ("StereoConfig", "StereoMatcher"),
        "dronevio.estimator.frontend.tracker": ("FeatureTracker", "TrackerConfig"),
    },
)
