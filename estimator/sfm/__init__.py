"""Structure from motion from images alone: features, matches, tracks, incremental mapping and bundle adjustment."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.sfm.config import SfmConfig
    from dronevio.estimator.sfm.pipeline import SfmResult, reconstruct
    from dronevio.estimator.sfm.workspace import Workspace

__all__ = ["SfmConfig", "SfmResult", "Workspace", "reconstruct"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.sfm.config": ("SfmConfig",),
        "dronevio.estimator.sfm.pipeline": ("SfmResult", "reconstruct"),
        "dronevio.estimator.sfm.workspace": ("Workspace",),
    },
)
