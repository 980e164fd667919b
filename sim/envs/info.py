"""Info dictionaries: values of n environments by name, in the forms of single and vector environments."""

from typing import Any

import numpy as np

from dronevio.models.arrays import Mask

Info = dict[str, Any]
"""Arrays with one row for each environment, or dicts of such arrays, by name."""


def row_of(info: Info, row: int) -> Info:
    """Return the info of one environment: Python scalars, strings and arrays of its own."""
    return {name: row_of(value, row) if isinstance(value, dict) else _plain(value[row]) for name, value in info.items()}


def with_masks(info: Info, mask: Mask) -> Info:
    """Return the info with Gymnasium's masks: ``_name`` tells which environments have a value of that name.

    Values of other environments are zero or empty.
    """
    masked: Info = {}
    for name, value in info.items():
        masked[name] = with_masks(value, mask) if isinstance(value, dict) else _blanked(value, mask)
        masked[f"_{name}"] = mask.copy()
    return masked


def _blanked(value: Any, mask: Mask) -> Any:
    """Return an array whose rows outside a mask are zero or empty."""
    if mask.all():
        return value
    blanked = np.zeros_like(value)
    blanked[mask] = value[mask]
    return blanked


def _plain(value: Any) -> Any:
    """Return a Python scalar for a scalar, or a copy of an array."""
    return value.item() if np.ndim(value) == 0 else np.array(value)
