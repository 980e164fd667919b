"""Batches: frozen dataclasses whose fields are arrays with one row for each environment."""

from dataclasses import fields, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

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
