"""Multi-view stereo: dense surfaces of a scene from images with known cameras, as a point cloud and a mesh."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.dense.config import DenseConfig
    from dronevio.estimator.dense.pipeline import DenseResult, densify

__all__ = ["DenseConfig", "DenseResult", "densify"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.dense.config": ("DenseConfig",),
        "dronevio.estimator.dense.pipeline": ("DenseResult", "densify"),
    },
)
