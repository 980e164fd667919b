"""Occupancy grids as files: round trips, the map of ROS by hand, and files that are damaged."""

import io
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.occupancy_maps import (
    RosMap,
    layer_of,
    read_occupancy,
    read_ros_map,
    write_occupancy,
    write_ros_map,
)

STATES = st.integers(UNKNOWN, OCCUPIED)
COORDINATE = st.floats(-1e4, 1e4).map(float)
in_one_folder = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@in_one_folder
@given(
    states=arrays.arrays(np.uint8, arrays.array_shapes(min_dims=3, max_dims=3, max_side=6), elements=STATES),
    low=st.tuples(COORDINATE, COORDINATE, COORDINATE),
    cell_m=st.floats(0.01, 1.0),
    frame=st.sampled_from(["odom", "map"]),
)
def test_a_grid_returns_from_its_file(tmp_path: Path, states, low, cell_m, frame) -> None:  # type: ignore[no-untyped-def]
    write_occupancy(tmp_path / "a.npz", OccupancyGrid(np.array(low), cell_m, states, frame))
    read = read_occupancy(tmp_path / "a.npz")
    assert np.array_equal(read.low_m, low) and read.cell_m == cell_m and read.frame == frame
    assert np.array_equal(read.states, states) and read.states.dtype == np.uint8


@in_one_folder
@given(
    states=arrays.arrays(np.uint8, arrays.array_shapes(min_dims=2, max_dims=2, max_side=7), elements=STATES),
    low=st.tuples(COORDINATE, COORDINATE),
    cell_m=st.floats(0.01, 1.0),
)
def test_a_map_of_ros_returns_from_its_files(tmp_path: Path, states, low, cell_m) -> None:  # type: ignore[no-untyped-def]
    write_ros_map(tmp_path / "a.yaml", RosMap(np.array(low), cell_m, states))
    read = read_ros_map(tmp_path / "a.yaml")
    assert np.array_equal(read.states, states) and np.array_equal(read.low_m, low) and read.cell_m == cell_m


@in_one_folder
@given(data=st.binary(max_size=300), cut=st.integers(0, 600))
def test_no_file_causes_another_error(tmp_path: Path, data: bytes, cut: int) -> None:
    path = tmp_path / "a.npz"
    write_occupancy(path, OccupancyGrid(np.zeros(3), 0.1, np.ones((2, 2, 2), np.uint8)))
    whole = path.read_bytes()
    for content in (data, whole[:cut] + data + whole[cut + len(data) :]):
        path.write_bytes(content)
        with suppress(InputError):
            assert isinstance(read_occupancy(path), OccupancyGrid)


def archive(tmp_path: Path, **changes: object) -> Path:
    """Write an archive with some arrays changed, or removed if they are None."""
    good = {"low_m": np.zeros(3), "cell_m": np.float64(0.1), "states": np.ones((2, 3, 4), np.uint8), "frame": "map"}
    np.savez(tmp_path / "a.npz", **{k: v for k, v in (good | changes).items() if v is not None})  # type: ignore[arg-type]
    return tmp_path / "a.npz"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": None}, "an archive without states"),
        ({"states": np.full((1, 1, 1), 3, np.uint8)}, "states"),
        ({"states": np.full((2, 2, 2), 3, np.uint8)}, "values up to 3; expected 0 to 2"),
        ({"states": np.ones((2, 2), np.uint8)}, "states: [["),
        ({"states": np.ones((2, 2, 2), np.int64)}, "expected (X, Y, Z) bytes"),
        ({"low_m": np.zeros(2)}, "low_m"),
        ({"low_m": np.array([0.0, np.nan, 0.0])}, "expected finite numbers"),
        ({"cell_m": np.float64(0.0)}, "cell_m: 0.0; expected a positive number"),
        ({"cell_m": np.float64(np.inf)}, "expected a positive number"),
        ({"frame": "world"}, "frame: world; expected odom or map"),
        ({"low_m": np.zeros(5000)}, "low_m of "),
        ({"frame": np.array([{}], dtype=object)}, "a damaged archive"),
    ],
)
def test_the_error_names_the_array(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as error:
        read_occupancy(archive(tmp_path, **changes))
    assert message in str(error.value) and "a.npz" in str(error.value)


def test_an_archive_that_grows_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path, content = archive(tmp_path), io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as zipped, zipfile.ZipFile(path) as good:
        for name in good.namelist():
            zipped.writestr(name, bytes(10_000_000) if name == "low_m.npy" else good.read(name))
    path.write_bytes(content.getvalue())
    with pytest.raises(InputError, match="low_m of 10000000 bytes; expected at most"):
        read_occupancy(path)


def test_the_layer_of_a_band() -> None:
    columns = {(0, 0): [1, 1, 1], (0, 1): [1, 2, 1], (1, 0): [1, 0, 1], (1, 1): [2, 0, 1]}
    states = np.zeros((2, 2, 3), np.uint8)
    for (i, j), column in columns.items():
        states[i, j] = column
    grid = OccupancyGrid(np.array([1.0, 2.0, 0.0]), 0.5, states)
    assert layer_of(grid, 0.1, 1.4).states.tolist() == [[FREE, OCCUPIED], [UNKNOWN, OCCUPIED]]
    assert layer_of(grid, 1.1, 1.4).states.tolist() == [[FREE, FREE], [FREE, FREE]]
    assert layer_of(grid, 0.6, 0.6).states.tolist() == [[FREE, OCCUPIED], [UNKNOWN, UNKNOWN]]
    # A band that the grid does not cover is nowhere known to be free
    assert layer_of(grid, 1.1, 2.0).states.tolist() == [[UNKNOWN, UNKNOWN], [UNKNOWN, UNKNOWN]]
    assert not layer_of(grid, -3.0, -2.0).states.any() and not layer_of(grid, 5.0, 6.0).states.any()
    assert layer_of(grid, 0.0, 0.4).low_m.tolist() == [1.0, 2.0]
    with pytest.raises(ConfigError, match="expected the lower end first"):
        layer_of(grid, 1.0, 0.0)


def test_the_image_has_y_up(tmp_path: Path) -> None:
    states = np.array([[FREE, OCCUPIED], [UNKNOWN, FREE], [OCCUPIED, UNKNOWN]], np.uint8)  # x = 0, 1, 2
    write_ros_map(tmp_path / "map.yaml", RosMap(np.array([-1.0, 2.5]), 0.1, states))
    assert (tmp_path / "map.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes([0, 254, 205, 254, 205, 0])
    lines = (tmp_path / "map.yaml").read_text().splitlines()
    assert "origin: [-1.0, 2.5, 0.0]" in lines and "image: map.pgm" in lines and "negate: 0" in lines


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("resolution: 0.1", "resolution: 0", "resolution: 0.0; expected a positive number"),
        ("0.0]", "0.5]", "x, y and a yaw of 0"),
        ("image: map.pgm", "image: ../map.pgm", "a file in the folder of the map"),
        ("image: map.pgm", "image: other.pgm", "no such file"),
        ("mode: trinary", "mode: raw", "expected trinary"),
        ("occupied_thresh: 0.65", "occupied_thresh: 65", "a number from 0 to 1"),
        ("occupied_thresh: 0.65", "occupied_thresh: 0.1", "more than free_thresh"),
        ("free_thresh: 0.196", "", "no field free_thresh"),
    ],
)
def test_the_error_names_the_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "map.yaml"
    write_ros_map(path, RosMap(np.zeros(2), 0.1, np.ones((2, 2), np.uint8)))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as error:
        read_ros_map(path)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P2\n2 2\n255\n1 1 1 1", "a file that starts with"),
        (b"P5\n2 2\n65535\n" + bytes(8), "values up to 65535"),
        (b"P5\n2 2\n255\n" + bytes(3), "3 bytes of pixels; expected 2 × 2 = 4"),
        (b"P5\n999999999 999999999\n255\n", "expected a binary PGM"),
        (b"", "a file that starts with"),
    ],
)
def test_damaged_images(tmp_path: Path, content: bytes, message: str) -> None:
    write_ros_map(tmp_path / "map.yaml", RosMap(np.zeros(2), 0.1, np.ones((2, 2), np.uint8)))
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(InputError) as error:
        read_ros_map(tmp_path / "map.yaml")
    assert message in str(error.value)


def test_comments_and_negated_images(tmp_path: Path) -> None:
    write_ros_map(tmp_path / "map.yaml", RosMap(np.zeros(2), 0.1, np.array([[FREE, OCCUPIED]], np.uint8)))
    (tmp_path / "map.pgm").write_bytes(b"P5\n# by a painter\n1 2\n255\n" + bytes([255, 0]))
    (tmp_path / "map.yaml").write_text((tmp_path / "map.yaml").read_text().replace("negate: 0", "negate: 1"))
    assert read_ros_map(tmp_path / "map.yaml").states.tolist() == [[FREE, OCCUPIED]]
