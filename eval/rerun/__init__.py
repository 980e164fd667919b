"""Recordings for the rerun viewer."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.rerun.log import RerunLog, write_estimates, write_rrd

__all__ = [
    "RerunLog",
    "write_estimates",
    "write_rrd",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.rerun.log": ("RerunLog", "write_estimates", "write_rrd"),
    },
)
