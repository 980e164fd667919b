"""Conversion of configurations to JSON types."""

import json
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.rig import euroc_rig
from dronevio.models.serialization import to_jsonable


class Colour(StrEnum):
    RED = "red"


class Level(Enum):
    HIGH = 3


@dataclass(frozen=True)
class Inner:
    gains: tuple[float, ...] = (1.0, 2.5)
    level: Level = Level.HIGH


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    colour: Colour = Colour.RED
    out: Path = Path("runs/one")
    matrix: npt.NDArray[np.float64] = field(default_factory=lambda: np.arange(4.0).reshape(2, 2))
    count: np.int64 = field(default_factory=lambda: np.int64(7))
    table: dict[int, object] = field(default_factory=lambda: {1: None, 2: [True, np.float32(0.5)]})


def test_nested_dataclasses_become_json_types() -> None:
    plain = to_jsonable(Outer())
    assert plain == {
        "inner": {"gains": [1.0, 2.5], "level": 3},
        "colour": "red",
        "out": "runs/one",
        "matrix": [[0.0, 1.0], [2.0, 3.0]],
        "count": 7,
        "table": {"1": None, "2": [True, 0.5]},
    }
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_a_rig_keeps_its_precision() -> None:
    rig = euroc_rig()
    plain = json.loads(json.dumps(to_jsonable(rig)))
    np.testing.assert_array_equal(plain["cameras"][0]["T_imu_cam"], rig.cameras[0].T_imu_cam)
    assert plain["imu"]["gyro_noise_density"] == rig.imu.gyro_noise_density


@pytest.mark.parametrize("value", [object(), {1, 2}, Outer, lambda: 0, b"bytes", 1j])
def test_other_types_are_refused(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be represented"):
        to_jsonable({"deep": [value]})
