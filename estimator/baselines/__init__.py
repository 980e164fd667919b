"""Baseline estimators that the odometry is compared with."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.baselines.dead_reckoning import DeadReckoning, DeadReckoningConfig
    from dronevio.estimator.baselines.eqvio import (
        Array,
        EquivariantConfig,
        EquivariantFilter,
        EquivariantOdometry,
        FilterSettings,
    )

__all__ = [
    "Array",
    "DeadReckoning",
    "DeadReckoningConfig",
    "EquivariantConfig",
    "EquivariantFilter",
    "EquivariantOdometry",
    "FilterSettings",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.baselines.dead_reckoning": ("DeadReckoning", "DeadReckoningConfig"),
        "dronevio.estimator.baselines.eqvio": (
            "Array",
            "EquivariantConfig",
            "EquivariantFilter",
            "EquivariantOdometry",
            "FilterSettings",
        ),
    },
)
