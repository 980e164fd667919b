"""Recordings for the rerun viewer."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.rerun.files import write_estimates, write_rrd
    from dronevio.eval.rerun.log import RerunLog

__all__ = [
    "RerunLog",
    "write_estimates",
    "write_rrd",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.rerun.files": ("write_estimates", "write_rrd"),
        "dronevio.eval.rerun.log": ("RerunLog",),
    },
)
