"""The experiments of the chapter "Visual SLAM" (7.4) of Dellaert and Hutchinson's *Introduction to Robotics*.

The modules return plain data; the modules of `dronevio.book` draw them.
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.book.drift import run_drift_study
    from dronevio.estimator.book.eqvio import run_eqvio
    from dronevio.estimator.book.imu import run_imu_experiment
    from dronevio.estimator.book.sfm import run_sfm_experiment
    from dronevio.estimator.book.visual_inertial import run_camera_study

__all__ = [
    "run_camera_study",
    "run_drift_study",
    "run_eqvio",
    "run_imu_experiment",
    "run_sfm_experiment",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.book.drift": ("run_drift_study",),
        "dronevio.estimator.book.eqvio": ("run_eqvio",),
        "dronevio.estimator.book.imu": ("run_imu_experiment",),
        "dronevio.estimator.book.sfm": ("run_sfm_experiment",),
        "dronevio.estimator.book.visual_inertial": ("run_camera_study",),
    },
)
