"""Calibration files in YAML: round trip, the styles of other programs, and refused texts."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml as independent
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dronevio.models.errors import InputError
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, read_yaml
from dronevio.models.recordings.calibration.yaml_text import Value, pose_yaml, yaml_text
from dronevio.models.rig import EUROC_T_IMU_CAM0

CAMERA = """\
%YAML:1.0
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,  # the middle row
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]

rate_hz: 20
resolution: [752, 480]
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
"""


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("yaml") / "sensor.yaml"


def read(path: Path, text: str) -> YamlDocument:
    path.write_text(text, newline="")
    return read_yaml(path)


@pytest.mark.parametrize("text", [CAMERA, CAMERA.replace("\n", "\r\n")])
def test_the_file_of_the_data_set_is_read(scratch: Path, text: str) -> None:
    yaml = read(scratch, text)
    assert yaml.word("comment") == "VI-Sensor cam0 (MT9M034)"
    assert yaml.number("rate_hz") == 20.0
    assert yaml.numbers("resolution", 2) == (752.0, 480.0)
    assert yaml.numbers("intrinsics", 4) == (458.654, 457.296, 367.215, 248.375)
    np.testing.assert_array_equal(yaml.pose("T_BS"), EUROC_T_IMU_CAM0)
    assert yaml.lines["rate_hz"] == 15


reserved = st.sampled_from(["null", "Null", "NULL", "true", "Yes", "off", "N"])  # null or truth values in YAML 1.1
words = st.one_of(st.from_regex(r"[A-Za-z][A-Za-z ()0-9-]{0,12}", fullmatch=True), st.text(max_size=12), reserved)
scalars = st.one_of(st.floats(allow_nan=False, allow_infinity=False), words)
values = st.one_of(scalars, st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=5).map(tuple))


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), values, max_size=5))
def test_round_trip_is_exact(scratch: Path, content: dict[str, Value]) -> None:
    yaml = read(scratch, "".join(f"{key}: {yaml_text(value)}\n" for key, value in content.items()))
    assert yaml.values == content


@pytest.mark.parametrize("word", ["Null", "true", "Yes", "off", "N"])
def test_reserved_words_are_text_for_other_parsers(word: str) -> None:
    assert independent.safe_load(f"name: {yaml_text(word)}") == {"name": word}


@settings(max_examples=100, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.floats(-3, 3))
def test_round_trip_of_poses_is_exact(scratch: Path, p: tuple[float, float, float], angle: float) -> None:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = p
    np.testing.assert_array_equal(read(scratch, pose_yaml("T_BS", T)).pose("T_BS"), T)


@pytest.mark.parametrize(
    ("text", "line", "found"),
    [
        ("a: 1\nb 2\n", 2, "':'"),
        ("a: 1\na: 2\n", 2, "a second a, after that of line 1"),
        ("b: 1\na: [1, 2\n", 2, "']'"),
        ("b: 1\na: [1,\n 2\nc: 1\n", 2, "']'"),
        ("a: [1, 2] 3\n", 1, ""),
        ("b: 1\na: [1, {c: 2}]\n", 2, "maps and values in the list a"),
        ("b: 1\na: [[1, {c: 2}]]\n", 2, "a map in a list of lists"),
        ('b: 1\na: "x\n', 2, "end of stream"),
        ("- a\n", 1, "not a map"),
        ("a: !!python/object:os.system x\n", 1, "python/object:os.system"),
        ("a: !!python/object:os.system {x: 1}\n", 1, "python/object:os.system"),
        ("a: &x 1\nb: *x\n", 2, "an alias, *x"),
        ("a:\n\tb: 1\n", 2, "'\\t'"),
        ("a: 1\n%YAML:1.0\n", 3, "document"),
        ("a: 1\n---\nb: 1\n", 2, "another document"),
    ],
)
def test_unsupported_yaml_is_refused(scratch: Path, text: str, line: int, found: str) -> None:
    with pytest.raises(InputError) as caught:
        read(scratch, text)
    assert caught.value.line == line and found in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "T_BS: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   data: [ 1., 0., -0.5e-3,\n       1e-3 ]\n",
        "T_BS:\n  rows: 2\n  cols: 2\n  dt: d\n  data:\n  - 1.0\n  - 0\n  - -.5e-3\n  - 1.E-03\n",
        "# comment\n\nT_BS: {rows: 2, cols: 2, dt: 'd',\n data: [1,\n 0, -0.0005, 0.001]}",
        '{"T_BS": {"rows": 2, "cols": 2, "dt": "d", "data": [1.0, 0, -5e-4, 1E-3]}}',
    ],
)
@pytest.mark.parametrize("header", ["", "%YAML:1.0\n", "%YAML:1.0\n---\n", "# comment\n\n%YAML:1.0\n"])
def test_the_styles_of_other_programs_are_read(scratch: Path, header: str, text: str) -> None:
    yaml = read(scratch, header + text)
    assert yaml.values == {
        "T_BS.rows": 2.0,
        "T_BS.cols": 2.0,
        "T_BS.dt": "d",
        "T_BS.data": (1.0, 0.0, -0.0005, 0.001),
    }
    assert yaml.lines["T_BS.rows"] >= yaml.lines["T_BS"] > header.count("\n")


def test_maps_in_lists_have_numbers(scratch: Path) -> None:
    yaml = read(scratch, "a:\n- {b: 1}\n- b: [2, 3]\n  c: {d: x}\n")
    assert yaml.values == {"a.0.b": 1.0, "a.1.b": (2.0, 3.0), "a.1.c.d": "x"}
    with pytest.raises(InputError, match=r"sensor.yaml:1: a: a map or a map in a list; expected a number"):
        yaml.number("a")


def flat(document: object, prefix: str) -> dict[str, object]:
    """Return the values of nested maps, and of maps in lists, by dotted keys."""
    if isinstance(document, dict):
        return {name: v for key, value in document.items() for name, v in flat(value, f"{prefix}.{key}").items()}
    if isinstance(document, list) and document and isinstance(document[0], dict):
        return flat(dict(enumerate(document)), prefix)
    if document is None:
        return {}
    return {prefix[1:]: plain(document)}


def plain(value: object) -> object:
    """Return a value with floats for numbers and tuples for lists."""
    if isinstance(value, list):
        return tuple(plain(item) for item in value)
    if isinstance(value, bool):
        return str(value).lower()
    return float(value) if isinstance(value, (int, float)) else value


names = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,7}", fullmatch=True)
# PyYAML takes exponents without a point for words, which they are not in a calibration.
texts = st.text(max_size=20).filter(lambda text: not re.fullmatch(r"[+-]?[\d.]+(e[+-]?\d+)?", text.strip(), re.I))
numbers = st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.integers(-(2**53), 2**53))
items = st.one_of(numbers, texts, st.booleans(), st.none())
lists = st.one_of(st.lists(st.one_of(numbers, texts), max_size=6), st.lists(st.lists(numbers, max_size=4), max_size=4))
maps = st.dictionaries(names, st.one_of(items, lists), max_size=4)
documents = st.dictionaries(names, st.one_of(items, lists, maps, st.lists(maps, min_size=1, max_size=3)), max_size=4)


def _reads_back(text: str, document: dict[str, object]) -> bool:
    """Return whether PyYAML reads a document back that it has written."""
    try:
        return bool(independent.safe_load(text) == document)
    except independent.YAMLError:
        return False


@settings(max_examples=150, deadline=None)
@given(
    documents,
    st.sampled_from([None, True, False]),
    st.sampled_from([None, "'", '"', "|", ">"]),
    st.sampled_from([20, 80, 10_000]),
    st.sampled_from([None, 2, 5]),
    st.booleans(),
)
def test_what_pyyaml_writes_in_any_style_is_read(
    scratch: Path,
    document: dict[str, object],
    flow: bool | None,
    style: str | None,
    width: int,
    indent: int | None,
    explicit: bool,
) -> None:
    class WithoutAliases(independent.SafeDumper):  # type: ignore[misc]
        def ignore_aliases(self, data: object) -> bool:
            return True

    text = independent.dump(
        document,
        Dumper=WithoutAliases,
        default_flow_style=flow,
        default_style=style,
        width=width,
        indent=indent,
        explicit_start=explicit,
    )
    assume(_reads_back(text, document))  # PyYAML itself fails at some block scalars
    assert read(scratch, text).values == flat(document, "")


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("rate_hz: 20", "rate_hz: twenty", "rate_hz"),
        ("rate_hz: 20", "rate_hz: 0", "rate_hz"),
        ("rate_hz: 20", "", "rate_hz"),
        ("[752, 480]", "[752]", "resolution"),
        ("[752, 480]", "[752, high]", "resolution"),
        ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 1.0]", "T_BS.data"),
        ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.0, 2.0]", "T_BS.data"),
        ("0.999660727178", "-0.999660727178", "T_BS.data"),
        ("0.999557249008", "0.9", "T_BS.data"),
    ],
)
def test_errors_name_the_field(scratch: Path, old: str, new: str, field: str) -> None:
    yaml = read(scratch, CAMERA.replace(old, new))
    with pytest.raises(InputError, match=field):
        _ = yaml.positive("rate_hz"), yaml.numbers("resolution", 2), yaml.pose("T_BS")


@settings(max_examples=400, deadline=None)
@given(st.integers(0, len(CAMERA)), st.integers(0, 30), st.text("ab:[],# \n\t-%\"'0.1", max_size=5))
def test_broken_text_is_refused_or_read(scratch: Path, start: int, length: int, inserted: str) -> None:
    try:
        yaml = read(scratch, CAMERA[:start] + inserted + CAMERA[start + length :])
    except InputError as error:
        assert str(error).startswith(str(scratch)) and "\n" not in str(error)
    else:
        for value in yaml.values.values():
            json.dumps(value, allow_nan=False)
