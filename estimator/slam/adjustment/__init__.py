"""Bundle adjustment of the map, and whether its result agrees with the odometry."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.adjustment.adjuster import Adjuster, LocalAdjuster, ProcessAdjuster
    from dronevio.estimator.slam.adjustment.bundle_adjustment import (
        AdjustedMap,
        AdjustmentConfig,
        AdjustmentInputs,
        adjust,
    )
    from dronevio.estimator.slam.adjustment.structure import map_structure

__all__ = [
    "AdjustedMap",
    "Adjuster",
    "AdjustmentConfig",
    "AdjustmentInputs",
    "LocalAdjuster",
    "ProcessAdjuster",
    "adjust",
    "map_structure",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.slam.adjustment.adjuster": (
            "Adjuster",
            "LocalAdjuster",
            "ProcessAdjuster",
        ),
        "dronevio.estimator.slam.adjustment.bundle_adjustment": (
            "AdjustedMap",
            "AdjustmentConfig",
            "AdjustmentInputs",
            "adjust",
        ),
        "dronevio.estimator.slam.adjustment.structure": ("map_structure",),
    },
)
