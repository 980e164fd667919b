"""World frame of a reconstruction: position, orientation and scale, which images alone do not determine.

Known poses determine all of them, the baselines of a rig the scale. Without either, the frame is arbitrary.
"""

from dataclasses import dataclass
from typing import Literal

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust
from dronevio.estimator.sfm.config import SfmConfig
from dronevio.estimator.sfm.gauge import aligned
from dronevio.estimator.sfm.model import KnownPoses, Scene, SfmState
from dronevio.estimator.sfm.rig import impose_rig
from dronevio.models.image_sets import ImageSet

ScaleSource = Literal["arbitrary", "rig", "poses", "earlier"]
"""What determines the unit of a reconstruction; if it is not arbitrary, the unit is the metre."""
MIN_POSES = 3
"""Smallest number of images with measured poses that determine a world frame."""
PRIOR_TOLERANCE = 1e-3
"""Relative decrease of the error at which the adjustment with measured poses stops."""


@dataclass(frozen=True)
class WorldFrame:
    """How the world frame of a reconstruction is determined."""

    scale: ScaleSource = "arbitrary"
    """What determines the scale."""
    is_vertical: bool = False
    """Whether the z axis points up."""

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the metre."""
        return self.scale != "arbitrary"


def place(
    scene: Scene, state: SfmState, images: ImageSet, config: SfmConfig, poses: KnownPoses | None = None
) -> tuple[SfmState, WorldFrame]:
    """Return a reconstruction in a world frame that is determined as well as possible, and how it is determined.

    Args:
        scene: The measurements.
        state: The reconstruction, of arbitrary scale unless some of its poses are fixed.
        images: The images, with the mounting of their cameras on a rig.
        config: Settings.
        poses: Known poses of the images, None without any.
    """
    if poses is not None:
        known = int((poses.is_known & state.is_registered).sum())
        if poses.is_exact and (scene.is_fixed & state.is_registered).any():
            return state, WorldFrame("poses")
        if not poses.is_exact and known >= MIN_POSES:
            adjustment = BundleAdjustmentConfig(
                relative_tolerance=PRIOR_TOLERANCE, cauchy_px=config.mapper.final_cauchy_px
            )
            state = aligned(state, poses.Ts_world_cam)
            return adjust(scene, state, state.used(scene), adjustment, priors=poses), WorldFrame("poses")
    state, is_metric = impose_rig(scene, state, images, config.mapper.final_cauchy_px)
    return state, WorldFrame("rig" if is_metric else "arbitrary")
