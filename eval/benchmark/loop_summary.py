"""What loops do to the accuracy, over the runs of an estimator."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.summary import known_values

LARGE_ERROR_M = 0.02
"""Error of the odometry from which on loops must reduce it [m]."""
EQUAL_M, EQUAL_PERCENT = 1e-3, 5.0
"""A path is no worse than the odometry up to this difference [m] or this share of its error [%]."""


@dataclass(frozen=True)
class Excess:
    """How much larger an error is than that of the odometry."""

    difference_m: float
    """Difference of the two errors, positive if that of the odometry is smaller [m]."""
    percent: float
    """The difference relative to the error of the odometry [%]."""

    @classmethod
    def of(cls, error_m: float, odometry_m: float) -> "Excess":
        """Return the excess of an error over that of the odometry."""
        difference_m = error_m - odometry_m
        return cls(difference_m, 100.0 * difference_m / odometry_m if odometry_m else math.inf)

    @property
    def ratio_to_limit(self) -> float:
        """The excess relative to the larger of the two limits: above 1, the path is worse than the odometry."""
        return min(self.difference_m / EQUAL_M, self.percent / EQUAL_PERCENT)


@dataclass(frozen=True)
class PathSummary:
    """Errors after the first revisit of one kind of path, beside those of the odometry of the same runs."""

    median_m: float
    """Median of the errors [m]."""
    ratio: float | None
    """Median ratio to the error of the odometry, where that exceeds `LARGE_ERROR_M`; None if it never does."""
    worst: Excess | None
    """Largest excess, relative to its limits, over the odometry in all other runs; None if there is none."""

    @classmethod
    def of(cls, pairs: Sequence[tuple[float, float]]) -> "PathSummary | None":
        """Return the summary of pairs of errors of the path and of the odometry [m]; None without any."""
        if not pairs:
            return None
        ratios = [error / odometry for error, odometry in pairs if odometry > LARGE_ERROR_M]
        others = [Excess.of(error, odometry) for error, odometry in pairs if odometry <= LARGE_ERROR_M]
        worst = max(others, key=lambda excess: excess.ratio_to_limit, default=None)
        return cls(median([error for error, _ in pairs]), median(ratios) if ratios else None, worst)


@dataclass(frozen=True)
class LoopSummary:
    """Errors after the first revisit, and loops, over the runs of an estimator."""

    runs: int
    """Number of runs with an error after the first revisit."""
    large: int
    """Number of them in which the error of the odometry exceeds `LARGE_ERROR_M`."""
    odometry_m: float | None
    """Median error of the odometry [m]; None if it is not known."""
    online: PathSummary | None
    """The path as the map corrected it at the time of each frame; None without a map."""
    final: PathSummary | None
    """The path corrected by the final map; None without a map."""
    loops: int | None
    """Number of accepted loops in all runs; None without a map."""
    wrong_loops: int | None
    """Number of wrong loops among them; None without a map."""
    recall_percent: float | None
    """Median recall of the runs with revisits [%]; None without any."""
    smallest_recall_percent: float | None
    """Smallest recall of them [%]."""

    @classmethod
    def of(cls, rows: Iterable[Row]) -> "LoopSummary | None":
        """Return the summary of runs; None if no run has an error after the first revisit."""
        scored = [row for row in rows if row.status == "ok" and row["rmse_after_revisit_m"] is not None]
        if not scored:
            return None
        odometry = [value for row in scored if (value := odometry_error_m(row)) is not None]
        mapped = [row for row in scored if row["loops"] is not None]
        recalls, loops, wrong = (known_values(mapped, name) for name in ("recall_percent", "loops", "wrong_loops"))
        return cls(
            len(scored),
            sum(value > LARGE_ERROR_M for value in odometry),
            median(odometry) if odometry else None,
            PathSummary.of(_pairs(mapped, "rmse_after_revisit_m")),
            PathSummary.of(_pairs(mapped, "final_after_revisit_m")),
            int(sum(loops)) if mapped else None,
            int(sum(wrong)) if mapped else None,
            median(recalls) if recalls else None,
            min(recalls, default=None),
        )


def odometry_error_m(row: Row) -> float | None:
    """Return the error of the odometry of a run after the first revisit [m]; None if it is not known.

    It is that of the scored path if the estimator has no map.
    """
    return row["rmse_after_revisit_m"] if row["loops"] is None else row["odometry_after_revisit_m"]


def _pairs(rows: Iterable[Row], metric: str) -> list[tuple[float, float]]:
    """Return the errors of a path and those of the odometry [m], of the runs that have both."""
    errors = [(row[metric], row["odometry_after_revisit_m"]) for row in rows]
    return [(error, odometry) for error, odometry in errors if error is not None and odometry is not None]
