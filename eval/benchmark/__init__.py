"""Many runs: suites of recordings × estimators, each run a process of its own and a row of a table.

What only the door can do, to fly and to estimate, is handed in as `Workshop`.
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
