"""Safe parser of YAML files of other programs, such as Kalibr, with the line number of each value.

ruamel.yaml parses the text, and only numbers, words, lists and maps are constructed. Tags, aliases and multiple
documents, which calibration files do not need, are refused because of their risks.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, Event
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from dronevio.models.errors import InputError
from dronevio.models.recordings.calibration.sensor_yaml import SensorYaml, Value, parse_number
from dronevio.models.recordings.files import read_text

_OPENCV_HEADER = re.compile(r"\A%YAML:1\.0[^\n]*\n(---[^\n]*\n)?")
_MAX_CHARACTERS = 200_000  # a calibration has a few thousand
_MAX_DEPTH = 8  # of nested lists and maps; the pose of a camera has depth 3
_STANDARD = "tag:yaml.org,2002:"
_PLAIN_TAGS = frozenset(f"{_STANDARD}{kind}" for kind in ("bool", "float", "int", "null", "seq", "str", "timestamp"))


def read_yaml(path: Path) -> SensorYaml:
    """Read a YAML file.

    Raises:
        InputError: The file is missing, not YAML, or has a feature that is refused.
    """
    return parse_yaml(path, read_text(path, "a calibration in YAML"))


def parse_yaml(path: Path, text: str) -> SensorYaml:
    """Parse a YAML text.

    Args:
        path: File of the text, for error messages.
        text: The text, in which a first line ``%YAML:1.0``, which OpenCV writes, is ignored.

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
        mark = error.problem_mark or error.context_mark
        raise InputError(path, error.problem or "invalid YAML", "YAML", mark.line + 1 if mark else None) from None
    except (YAMLError, RecursionError, ValueError) as error:  # control characters, excessive nesting
        raise InputError(path, (str(error) or type(error).__name__).split("\n")[0][:80], "YAML") from None
    yaml = SensorYaml(path, {}, {})
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


def _collect(yaml: SensorYaml, node: MappingNode, prefix: str) -> None:
    """Add the values of a map to ``yaml`` by dotted keys, or raise InputError."""
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, ScalarNode):
            raise InputError(yaml.path, "a key that is not a word", "key: value", line)
        name = prefix + str(key_node.value)
        if name in yaml.lines:
            raise InputError(yaml.path, f"a second {name}", "each field once", line)
        yaml.lines[name] = line
        if isinstance(value_node, MappingNode):
            _collect(yaml, value_node, f"{name}.")
        elif not _is_null(value_node):
            yaml.values[name] = _value(yaml.path, value_node)


def _value(path: Path, node: Node) -> Value:
    """Return the value of a node, or raise InputError."""
    line = node.start_mark.line + 1
    if isinstance(node, MappingNode):
        raise InputError(path, "a map in a list", "numbers and words", line)
    if str(node.tag) not in _PLAIN_TAGS:
        raise InputError(path, f"the tag {node.tag}", "plain values", line)
    if isinstance(node, SequenceNode):
        return tuple(_value(path, item) for item in node.value)
    text = str(node.value)
    if isinstance(node, ScalarNode) and node.style is not None:  # quoted; JSON may use surrogate pairs
        return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    number = parse_number(text)
    return text if number is None else number


def _is_null(node: Node) -> bool:
    """Return whether a node has no value."""
    return isinstance(node, ScalarNode) and str(node.tag) == f"{_STANDARD}null"
