"""Benchmarks of the application: their flights, the variants of flights, and the jobs that estimate them."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.benchmark.jobs import Workbench
    from dronevio.benchmark.measured_flights import MeasuredFlight
    from dronevio.benchmark.variants import Variant

__all__ = [
    "MeasuredFlight",
    "Variant",
    "Workbench",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.benchmark.jobs": ("Workbench",),
        "dronevio.benchmark.measured_flights": ("MeasuredFlight",),
        "dronevio.benchmark.variants": ("Variant",),
    },
)
