"""Strict parser of the subset of YAML in the ``sensor.yaml`` files of data sets.

Some of these files begin with ``%YAML:1.0``, which OpenCV requires and YAML parsers refuse. The subset consists of
``key: value`` with numbers, words and lists in brackets, possibly over several lines, and of maps by indentation, as in
``T_BS``. Everything else is refused with its line number.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError
from dronevio.models.recordings.files import read_text

Array = npt.NDArray[np.float64]
Value: TypeAlias = "float | str | tuple[Value, ...]"

_KEY = re.compile(r"( *)([A-Za-z_][\w.-]*) *:(?: +(.*))?", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_WORD = re.compile(r"""[^]\[{}&*!|>'%@`,?:#"-].*""")
_PLAIN = re.compile(r"(?!(?i:null|true|false|yes|no|on|off|y|n)$)[A-Za-z][\w ()./+-]*(?<! )", re.ASCII)
"""Texts that YAML 1.1 reads as they are, without quotation marks; some words are null or truth values."""
_ORTHONORMAL = 1e-4  # published extrinsics have as few as 5 digits
_MAX_ELEMENT = 1e6  # larger elements of a pose are regarded as errors [m]


@dataclass(frozen=True)
class SensorYaml:
    """Values of a YAML file by dotted key, such as ``T_BS.data``, with their line numbers."""

    path: Path
    """Path of the file."""
    values: dict[str, Value]
    """Numbers, words and lists by key; nested keys are joined by dots."""
    lines: dict[str, int]
    """Line number of each key, counted from 1."""

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def error(self, key: str, expected: str) -> InputError:
        """Return the error for a field that is missing or invalid."""
        if key not in self.values:
            return InputError(self.path, f"no field {key}", f"{key}: {expected}")
        return InputError(self.path, f"{key}: {yaml_text(self.values[key])}", expected, self.lines[key])

    def number(self, key: str) -> float:
        """Return a number, or raise InputError."""
        value = self.values.get(key)
        if not isinstance(value, float):
            raise self.error(key, "a number")
        return value

    def positive(self, key: str) -> float:
        """Return a positive number, or raise InputError."""
        value = self.values.get(key)
        if not isinstance(value, float) or value <= 0.0:
            raise self.error(key, "a positive number")
        return value

    def word(self, key: str) -> str:
        """Return a text, or raise InputError."""
        value = self.values.get(key)
        if not isinstance(value, str):
            raise self.error(key, "a word")
        return value

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Return a list of ``count`` numbers, or raise InputError."""
        value = self.values.get(key)
        if not isinstance(value, tuple) or len(value) != count:
            raise self.error(key, f"a list of {count} numbers")
        found = tuple(item for item in value if isinstance(item, float))
        if len(found) != count:
            raise self.error(key, f"a list of {count} numbers")
        return found

    def pose(self, key: str) -> Array:
        """Return the rigid transform (4, 4) in ``key.data``, row by row, or raise InputError."""
        data = f"{key}.data"
        return self._rigid(data, self.numbers(data, 16))

    def pose_of_rows(self, key: str) -> Array:
        """Return the rigid transform (4, 4) in ``key``, a list of four rows, or raise InputError."""
        rows = self.values.get(key)
        flat = tuple(item for row in rows if isinstance(row, tuple) for item in row) if isinstance(rows, tuple) else ()
        numbers = tuple(item for item in flat if isinstance(item, float))
        if not isinstance(rows, tuple) or len(rows) != 4 or len(flat) != 16 or len(numbers) != 16:
            raise self.error(key, "four rows of four numbers")
        return self._rigid(key, numbers)

    def _rigid(self, key: str, numbers: tuple[float, ...]) -> Array:
        """Return the 16 numbers of a key as a rigid transform (4, 4), or raise InputError."""
        T = np.array(numbers).reshape(4, 4)
        R = T[:3, :3]
        is_bounded = bool(np.abs(T).max() < _MAX_ELEMENT)
        is_rigid = is_bounded and np.allclose(R @ R.T, np.eye(3), atol=_ORTHONORMAL) and np.linalg.det(R) > 0.0
        if not is_rigid or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
            raise self.error(
                key, "a rigid transform, row by row, with an orthonormal rotation and the last row 0 0 0 1"
            )
        return T


def read_sensor_yaml(path: Path) -> SensorYaml:
    """Read a ``sensor.yaml``.

    Raises:
        InputError: The file is missing or uses more than this subset of YAML.
    """
    values: dict[str, Value] = {}
    lines: dict[str, int] = {}
    parents: list[tuple[int, str]] = []  # indentation and dotted name of the enclosing maps
    for line, text in _statements(path):
        match = _KEY.fullmatch(text)
        if not match:
            raise InputError(path, repr(text[:40]), "key: value", line)
        indent, key, rest = len(match[1]), match[2], (match[3] or "").strip()
        while parents and parents[-1][0] >= indent:
            parents.pop()
        if indent and not parents:
            raise InputError(path, f"indented {key} outside a map", "key: value at the beginning of the line", line)
        name = f"{parents[-1][1]}.{key}" if parents else key
        if name in lines:
            raise InputError(path, f"a second {name}, after that of line {lines[name]}", "each field once", line)
        lines[name] = line
        if rest:
            values[name] = _value(path, line, rest)
        else:
            parents.append((indent, name))
    return SensorYaml(path, values, lines)


def parse_number(text: str) -> float | None:
    """Return the finite number of a text, None if the text is not one."""
    number = float(text) if _NUMBER.fullmatch(text) else np.nan
    return number if np.isfinite(number) else None


def yaml_text(value: Value) -> str:
    """Return the text of a value in this subset of YAML, without loss of precision."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(yaml_text, value))}]"
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition("e")
        return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else repr(value)  # 1e-05 is a word in YAML 1.1
    return value if _PLAIN.fullmatch(value) else json.dumps(value)


def pose_yaml(key: str, T: Array) -> str:
    """Return the lines of a rigid transform (4, 4), without loss of precision."""
    rows = ",\n         ".join(", ".join(map(yaml_text, row)) for row in T.tolist())
    return f"{key}:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"


def _statements(path: Path) -> list[tuple[int, str]]:
    """Return line number and text of each statement, without comments and with lists joined into one line."""
    statements: list[tuple[int, str]] = []
    open_list = False
    for line, raw in enumerate(read_text(path, "a sensor description in YAML").split("\n"), 1):
        text = _without_comment(raw).rstrip()
        if not text.strip() or text == "---" or (text.startswith("%YAML") and not statements):
            continue
        if "\t" in text:
            raise InputError(path, "a tab", "spaces", line)
        if open_list:
            statements[-1] = (statements[-1][0], f"{statements[-1][1]} {text.strip()}")
        else:
            statements.append((line, text))
        statement = statements[-1][1]
        open_list = '"' not in statement and statement.count("[") > statement.count("]")
    if open_list:
        raise InputError(path, "a list without an end", "a closing bracket", statements[-1][0])
    return statements


def _without_comment(text: str) -> str:
    """Return a line without its comment, which starts with # at its beginning or after white space, outside quotes."""
    quoted = False
    for i, character in enumerate(text):
        if character == '"' and (i == 0 or text[i - 1] != "\\"):
            quoted = not quoted
        if character == "#" and not quoted and (i == 0 or text[i - 1] in " \t"):
            return text[:i]
    return text


def _value(path: Path, line: int, text: str) -> Value:
    """Return the value of a text, or raise InputError."""
    if not text.startswith("["):
        return _scalar(path, line, text)
    if not text.endswith("]"):
        raise InputError(path, repr(text[-40:]), "a list that ends with ]", line)
    inside = text[1:-1].strip().removesuffix(",")
    return tuple(_scalar(path, line, item.strip()) for item in inside.split(",")) if inside else ()


def _scalar(path: Path, line: int, text: str) -> float | str:
    """Return a number or a word, or raise InputError."""
    number = parse_number(text)
    if number is not None:
        return number
    if text.startswith('"'):
        try:
            return str(json.loads(text))
        except ValueError:
            pass
    elif _WORD.fullmatch(text) and not _NUMBER.fullmatch(text) and text.lower() not in (".nan", ".inf"):
        return text
    raise InputError(path, repr(text[:40]), "a finite number or a plain word", line)
