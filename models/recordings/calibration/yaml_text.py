"""Text of the values in calibration files, which every YAML parser reads without loss of precision."""

import json
import re
from typing import TypeAlias

from dronevio.models.arrays import Array

Value: TypeAlias = "float | str | tuple[Value, ...]"

_PLAIN = re.compile(r"(?!(?i:null|true|false|yes|no|on|off|y|n)$)[A-Za-z][\w ()./+-]*(?<! )", re.ASCII)
"""Texts that YAML 1.1 reads as they are, without quotation marks; some words are null or truth values."""


def yaml_text(value: Value) -> str:
    """Return the text of a value."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(yaml_text, value))}]"
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition("e")
        return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else repr(value)  # 1e-05 is a word in YAML 1.1
    return value if _PLAIN.fullmatch(value) else json.dumps(value)


def pose_yaml(key: str, T: Array) -> str:
    """Return the lines of a rigid transform (4, 4) as in EuRoC's files."""
    rows = ",\n         ".join(", ".join(map(yaml_text, row)) for row in T.tolist())
    return f"{key}:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"


def rows_yaml(key: str, T: Array) -> str:
    """Return the lines of a matrix as a list of rows, as in Kalibr's files."""
    return f"{key}:\n" + "".join(f"  - {yaml_text(tuple(row))}\n" for row in T.tolist())


def indented(text: str) -> str:
    """Return lines with the indentation of a nested map."""
    return "".join(f"  {line}\n" for line in text.splitlines())
