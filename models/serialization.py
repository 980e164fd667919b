"""Conversion of configuration dataclasses to types that JSON can represent."""

import math
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path

import numpy as np


def to_jsonable(value: object) -> object:
    """Return nested dataclasses, arrays, enumerations and paths as dicts, lists, strings and numbers.

    Raises:
        TypeError: A value has another type.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_jsonable(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Enum):
        return to_jsonable(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, dict):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # JSON has neither infinity nor NaN
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be represented in JSON")
