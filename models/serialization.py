"""Settings as plain data, to be saved with what they made."""

import math
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path

import numpy as np


def to_plain(value: object) -> object:
    """Return nested dataclasses, arrays and paths as what JSON can hold.

    Raises:
        TypeError: A value that is none of these.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Enum):
        return to_plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, dict):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # a range without end, say: JSON has no infinity
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} is no setting")
