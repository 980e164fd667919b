"""The experiments of the chapter "Visual SLAM" (7.4) of Dellaert and Hutchinson's *Introduction to Robotics*.

The modules return plain data; `dronevio.book.plots` draws them.
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.book.eqvio import run_eqvio
    from dronevio.estimator.book.imu import run_imu_experiment
    from dronevio.estimator.book.sfm import run_sfm_experiment

__all__ = [
    "run_eqvio",
    "run_imu_experiment",
    "run_sfm_experiment",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.book.eqvio": ("run_eqvio",),
        "dronevio.estimator.book.imu": ("run_imu_experiment",),
        "dronevio.estimator.book.sfm": ("run_sfm_experiment",),
    },
)
