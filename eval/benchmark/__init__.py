"""Benchmarks: many recordings × estimators, each run in a process of its own and stored as a row of a table.

Simulation and estimation are passed in as a `dronevio.eval.benchmark.jobs.BenchmarkPipeline`, because this package
imports neither the simulator nor the estimator.
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.benchmark.rows import read_results, read_rows, write_rows

__all__ = [
    "read_results",
    "read_rows",
    "write_rows",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.benchmark.rows": ("read_results", "read_rows", "write_rows"),
    },
)
