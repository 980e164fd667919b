"""Online calibration of the cameras' time offset, extrinsics and intrinsics."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.calibration.config import CalibratedPart, CalibrationConfig
    from dronevio.estimator.calibration.corrections import Corrections
    from dronevio.estimator.calibration.online import OnlineCalibration

__all__ = ["CalibratedPart", "CalibrationConfig", "Corrections", "OnlineCalibration"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.calibration.corrections": ("Corrections",),
        "dronevio.estimator.calibration.config": ("CalibratedPart", "CalibrationConfig"),
        "dronevio.estimator.calibration.online": ("OnlineCalibration",),
    },
)
