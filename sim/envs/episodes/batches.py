"""Batches: frozen dataclasses and nested tuples of arrays with one row for each environment."""

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.sim.physics.vehicle_states import Mask

Batch = TypeVar("Batch")


def with_rows(batch: Batch, rows: npt.NDArray[np.intp], part: Batch) -> Batch:
    """Return a copy of a batch with some rows replaced.

    Args:
        batch: Batch of n rows.
        rows: (k,) Indices of the rows to replace.
        part: Batch of the k new rows.
    """
    changes = {}
    for field in fields(batch):  # type: ignore[arg-type]
        value = getattr(batch, field.name).copy()
        value[rows] = getattr(part, field.name)
        changes[field.name] = value
    return replace(batch, **changes)  # type: ignore[type-var]


def merged(mask: Mask, new: Any, old: Any) -> Any:
    """Return nested tuples of arrays whose rows in a mask (n,) are new and whose other rows are old."""
    if isinstance(new, tuple):
        parts = (merged(mask, a, b) for a, b in zip(new, old, strict=True))
        return type(new)(*parts) if new else new
    return np.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)
