"""Recordings for the rerun viewer."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.rerun.files import write_estimates, write_rrd
    from dronevio.eval.rerun.log import RerunLog
    from dronevio.eval.rerun.reconstruction import write_reconstruction_rerun

__all__ = [
    "RerunLog",
    "write_estimates",
    "write_reconstruction_rerun",
    "write_rrd",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.rerun.files": ("write_estimates", "write_rrd"),
        "dronevio.eval.rerun.log": ("RerunLog",),
        "dronevio.eval.rerun.reconstruction": ("write_reconstruction_rerun",),
    },
)
