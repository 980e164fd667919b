"""Bundle adjustment: poses, points and cameras of a reconstruction together."""

from dronevio.estimator.sfm.adjustment.bundle_adjustment import (
    BundleAdjustmentConfig,
    adjust,
    intrinsics_covariances,
)
from dronevio.estimator.sfm.adjustment.pose_factors import RelativePose

__all__ = ["BundleAdjustmentConfig", "RelativePose", "adjust", "intrinsics_covariances"]
