"""Calibration files in YAML or JSON: a safe parser, and typed access to the values with the lines of errors.

ruamel.yaml parses the text, and only numbers, words, lists and maps are constructed. Numbers are read as in YAML 1.2,
which has exponents without a decimal point (``1e-3``). OpenCV's first line ``%YAML:1.0`` and its tag
``!!opencv-matrix`` are ignored. Other tags, aliases and multiple documents, which calibration files do not need, are
refused because of their risks.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, Event
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.recordings.calibration.yaml_text import Value, yaml_text
from dronevio.models.recordings.files import read_text

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_OPENCV_HEADER = re.compile(r"\A((?:[ \t]*(?:#[^\n]*)?\n)*)%YAML:1\.0[^\n]*(\n---[^\n]*)?")
_MAX_CHARACTERS = 200_000  # a calibration has a few thousand
_MAX_DEPTH = 8  # of nested lists and maps; the vignette of Basalt has depth 6
_STANDARD = "tag:yaml.org,2002:"
_PLAIN_TAGS = frozenset(f"{_STANDARD}{kind}" for kind in ("bool", "float", "int", "null", "seq", "str", "timestamp"))
_MAP_TAGS = frozenset(f"{_STANDARD}{kind}" for kind in ("map", "opencv-matrix"))
_ORTHONORMAL = 1e-4  # published extrinsics have as few as 5 digits
_MAX_ELEMENT = 1e6  # larger elements of a pose are regarded as errors [m]


@dataclass(frozen=True)
class YamlDocument:
    """Values of a file by dotted key, such as ``T_BS.data``, with their line numbers."""

    path: Path
    """Path of the file."""
    values: dict[str, Value]
    """Numbers, words and lists by key. The keys of nested maps are joined by dots; the maps in a list have numbers as
    keys, counted from 0."""
    lines: dict[str, int]
    """Line number of each key, counted from 1."""

    def __contains__(self, key: str) -> bool:
        return key in self.values or self._has_maps(key)

    def error(self, key: str, expected: str) -> InputError:
        """Return the error for a field that is missing or invalid."""
        if key in self.values:
            return InputError(self.path, f"{key}: {yaml_text(self.values[key])}", expected, self.lines[key])
        if self._has_maps(key):
            return InputError(self.path, f"{key}: a map or a map in a list", expected, self.lines.get(key))
        return InputError(self.path, f"no field {key}", f"{key}: {expected}")

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

    def numbers(self, key: str, *counts: int) -> tuple[float, ...]:
        """Return a list of numbers, whose length is one of the counts, or raise InputError."""
        value = self.values.get(key)
        numbers = tuple(item for item in value if isinstance(item, float)) if isinstance(value, tuple) else ()
        if not isinstance(value, tuple) or len(value) not in counts or len(numbers) != len(value):
            raise self.error(key, f"a list of {' or '.join(map(str, counts))} numbers")
        return numbers

    def image_size(self, key: str) -> tuple[int, int]:
        """Return width and height [px], or raise InputError."""
        width, height = self.numbers(key, 2)
        if any(side < 1 or side != int(side) for side in (width, height)):
            raise self.error(key, "width and height in whole pixels")
        return int(width), int(height)

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

    def _has_maps(self, key: str) -> bool:
        """Return whether a key has a map, or a list of maps."""
        return any(other.startswith(f"{key}.") for other in self.lines)

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


def read_yaml(path: Path) -> YamlDocument:
    """Read a calibration file in YAML or JSON.

    Raises:
        InputError: The file is missing, not YAML, or has a feature that is refused.
    """
    return parse_yaml(path, read_text(path, "a calibration in YAML or JSON"))


def parse_yaml(path: Path, text: str) -> YamlDocument:
    """Parse a text in YAML or JSON.

    Args:
        path: File of the text, for error messages.
        text: The text.

    Raises:
        InputError: The text is not YAML, or has a feature that is refused.
    """
    if len(text) > _MAX_CHARACTERS:
        raise InputError(path, f"{len(text)} characters", f"a calibration with at most {_MAX_CHARACTERS}")
    text = _OPENCV_HEADER.sub(lambda header: "\n" * header[0].count("\n"), text)
    try:
        _check_events(path, YAML(typ="safe", pure=True).parse(text))
        root = YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as error:
        # The context is where an unfinished list or text begins, or the beginning of a block or document.
        begins = None if re.search("block|document", error.context or "") else error.context_mark
        mark = begins or error.problem_mark or error.context_mark
        raise InputError(path, error.problem or "invalid YAML", "YAML", mark.line + 1 if mark else None) from None
    except (YAMLError, RecursionError, ValueError) as error:  # control characters, excessive nesting
        raise InputError(path, (str(error) or type(error).__name__).split("\n")[0][:80], "YAML") from None
    yaml = YamlDocument(path, {}, {})
    if root is None:
        return yaml
    if not isinstance(root, MappingNode):
        raise InputError(path, "a document that is not a map", "key: value", 1)
    _collect(yaml, root, "")
    return yaml


def _check_events(path: Path, events: Iterator[Event]) -> None:
    """Raise InputError for aliases and for excessive nesting."""
    depth = 0
    for event in events:
        line = event.start_mark.line + 1
        if isinstance(event, AliasEvent):
            raise InputError(path, f"an alias, *{event.anchor}", "a document without aliases", line)
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise InputError(path, f"lists and maps nested {depth} deep", f"a depth of at most {_MAX_DEPTH}", line)


def _collect(yaml: YamlDocument, node: MappingNode, prefix: str) -> None:
    """Add the values of a map to ``yaml`` by dotted keys, or raise InputError."""
    line = node.start_mark.line + 1
    if str(node.tag) not in _MAP_TAGS:
        raise InputError(yaml.path, f"the tag {node.tag}", "plain values", line)
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, ScalarNode):
            raise InputError(yaml.path, "a key that is not a word", "key: value", line)
        name = prefix + str(key_node.value)
        if name in yaml.lines:
            found = f"a second {name}, after that of line {yaml.lines[name]}"
            raise InputError(yaml.path, found, "each field once", line)
        yaml.lines[name] = line
        if isinstance(value_node, MappingNode):
            _collect(yaml, value_node, f"{name}.")
        elif isinstance(value_node, SequenceNode) and any(isinstance(item, MappingNode) for item in value_node.value):
            for number, item in enumerate(value_node.value):
                if not isinstance(item, MappingNode):
                    raise InputError(yaml.path, f"maps and values in the list {name}", "only one of them", line)
                _collect(yaml, item, f"{name}.{number}.")
        elif not _is_null(value_node):
            yaml.values[name] = _value(yaml.path, value_node)


def _value(path: Path, node: Node) -> Value:
    """Return the value of a node, or raise InputError."""
    line, tag = node.start_mark.line + 1, str(node.tag)
    if isinstance(node, MappingNode):
        raise InputError(path, "a map in a list of lists", "numbers and words", line)
    if tag not in _PLAIN_TAGS:
        raise InputError(path, f"the tag {tag}", "plain values", line)
    if isinstance(node, SequenceNode):
        return tuple(_value(path, item) for item in node.value)
    text = str(node.value)
    if isinstance(node, ScalarNode) and node.style is not None and tag == f"{_STANDARD}str":
        return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")  # JSON may use surrogate pairs
    number = float(text) if _NUMBER.fullmatch(text) else np.nan
    return float(number) if np.isfinite(number) else text


def _is_null(node: Node) -> bool:
    """Return whether a node has no value."""
    return isinstance(node, ScalarNode) and str(node.tag) == f"{_STANDARD}null"
