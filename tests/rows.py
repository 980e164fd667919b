"""Rows of benchmarks by keyword, as tests write them by hand."""

from typing import Any

from dronevio.eval.benchmark.isolation import Status
from dronevio.eval.benchmark.rows import Row


def row_of(
    scenario: str,
    world: str,
    seed: int | None,
    estimator: str,
    config_hash: str = "c",
    versions: str = "v",
    status: Status = "ok",
    reason: str = "",
    **columns: Any,
) -> Row:
    """Return a row with some columns, metrics among them."""
    row = Row(scenario, world, seed, estimator, config_hash, versions, status, reason)
    return changed(row, **columns)


def changed(row: Row, **columns: Any) -> Row:
    """Return a row with other values in some columns, which must exist."""
    before = row.columns
    assert columns.keys() <= before.keys()
    return Row.from_columns(before | columns, row.own_metrics)
