"""Dense maps on the fly: depth of images, a local map to fly by, and submaps that bend when a loop closes."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.mapping.config import DenseMapConfig
    from dronevio.estimator.mapping.dense_mapper import DenseMapper

__all__ = ["DenseMapConfig", "DenseMapper"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.mapping.config": ("DenseMapConfig",),
        "dronevio.estimator.mapping.dense_mapper": ("DenseMapper",),
    },
)
