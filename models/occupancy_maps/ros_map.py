"""A layer of an occupancy grid as a map of ROS: an image (PGM) and its place (YAML), as `map_server` reads them.

A pixel is a cell of the plane, the first row has the largest y, and x points to the right. The image has the values of
`map_server` in the mode "trinary": 0 occupied, 254 free, 205 unknown.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, States
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, read_yaml
from dronevio.models.recordings.files import read_bytes, write_bytes, write_text

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""Thresholds of the probability of being occupied, those that `map_saver` writes."""
MAX_PIXELS = 400_000_000
"""Largest number of pixels of a map that is read."""
_PIXEL_OF_STATE = np.array([205, 254, 0], np.uint8)  # by UNKNOWN, FREE, OCCUPIED
_SPACE = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P5" + _SPACE + rb"(\d{1,9})" + _SPACE + rb"(\d{1,9})" + _SPACE + rb"(\d{1,5})\s")
_PGM = "a binary PGM image (P5) with 8 bits"


@dataclass(frozen=True, eq=False)
class RosMap:
    """What is free and occupied in a plane."""

    low_m: Array
    """(2,) Lower corner of the first cell, x and y [m]."""
    cell_m: float
    """Side of a cell [m]."""
    states: States
    """(X, Y) States of the cells; see `dronevio.models.occupancy`."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: A shape is wrong, or the side of a cell is not positive.
        """
        if self.low_m.shape != (2,) or self.states.ndim != 2 or not self.cell_m > 0.0:
            raise ConfigError(
                f"map with a corner of shape {self.low_m.shape}, states of shape {self.states.shape} and"
                f" cell_m = {self.cell_m}; expected (2,), (X, Y) and more than 0"
            )


def layer_of(grid: OccupancyGrid, low_z_m: float, high_z_m: float) -> RosMap:
    """Return what a vehicle meets that fills a band of heights.

    A cell of the plane is occupied if any cell of the band is, free if all are, and otherwise unknown. What the grid
    does not contain is unknown.

    Args:
        grid: The grid.
        low_z_m: Lower end of the band in the frame of the grid [m].
        high_z_m: Upper end of the band, not below the lower one [m].

    Raises:
        ConfigError: The upper end is below the lower one.
    """
    if not low_z_m <= high_z_m:
        raise ConfigError(f"band of heights from {low_z_m} to {high_z_m} m; expected the lower end first")
    first, last = (int(np.floor((z - grid.low_m[2]) / grid.cell_m)) for z in (low_z_m, high_z_m))
    count = grid.states.shape[2]
    band = grid.states[:, :, max(first, 0) : max(last + 1, 0)]
    is_covered = first >= 0 and last < count
    occupied = (band == OCCUPIED).any(axis=2)
    free = (band == FREE).all(axis=2) & is_covered
    states = np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)
    return RosMap(grid.low_m[:2].copy(), grid.cell_m, states)


def write_ros_map(path: Path, ros_map: RosMap) -> None:
    """Write a map as two files.

    Args:
        path: The YAML file to write; the image has its name with the suffix ``.pgm``.
        ros_map: The map.

    Raises:
        InputError: A file cannot be written.
    """
    path = Path(path)
    image = path.with_suffix(".pgm")
    pixels = _PIXEL_OF_STATE[ros_map.states.T[::-1]]
    header = f"P5\n{pixels.shape[1]} {pixels.shape[0]}\n255\n".encode("ascii")
    write_bytes(image, header + pixels.tobytes())
    x, y = (float(value) for value in ros_map.low_m)
    lines = (
        f"image: {image.name}",
        "mode: trinary",
        f"resolution: {float(ros_map.cell_m)!r}",
        f"origin: [{x!r}, {y!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    )
    write_text(path, "\n".join(lines) + "\n")


def read_ros_map(path: str | Path) -> RosMap:
    """Read a map of ROS in the mode "trinary", as `map_server` does.

    Args:
        path: The YAML file, whose image is a binary PGM file in the same folder or below it.

    Raises:
        InputError: A file is missing or invalid, or the map is rotated; the message names the field.
    """
    path = Path(path)
    yaml = read_yaml(path)
    cell_m, origin = yaml.positive("resolution"), yaml.numbers("origin", 3)
    if origin[2] != 0.0:
        raise yaml.error("origin", "x, y and a yaw of 0")
    if "mode" in yaml and yaml.word("mode") != "trinary":
        raise yaml.error("mode", "trinary")
    negate = yaml.number("negate") if "negate" in yaml else 0.0
    occupied_above, free_below = _threshold(yaml, "occupied_thresh"), _threshold(yaml, "free_thresh")
    if occupied_above <= free_below:
        raise yaml.error("occupied_thresh", f"more than free_thresh, {free_below}")
    name = Path(yaml.word("image"))
    if name.is_absolute() or ".." in name.parts:
        raise yaml.error("image", "a file in the folder of the map")
    pixels = _read_pgm(path.parent / name).astype(np.float32) / 255.0
    occupancy = pixels if negate else 1.0 - pixels
    states = np.full(occupancy.shape, UNKNOWN, np.uint8)
    states[occupancy < free_below] = FREE
    states[occupancy > occupied_above] = OCCUPIED
    return RosMap(np.array(origin[:2]), cell_m, np.ascontiguousarray(states[::-1].T))


def _threshold(yaml: YamlDocument, key: str) -> float:
    """Return a probability, or raise InputError."""
    value = yaml.number(key)
    if not 0.0 <= value <= 1.0:
        raise yaml.error(key, "a number from 0 to 1")
    return value


def _read_pgm(path: Path) -> States:
    """Return the pixels (H, W) of a binary PGM image with 8 bits.

    Raises:
        InputError: The file cannot be read, or is no such image.
    """
    data = read_bytes(path, _PGM)
    header = _HEADER.match(data[:4096])
    if header is None:
        raise InputError(path, f"a file that starts with {data[:12]!r}", _PGM)
    width, height, most = (int(number) for number in header.groups())
    if most != 255 or not 0 < width * height <= MAX_PIXELS:
        raise InputError(path, f"{width} × {height} px with values up to {most}", f"{_PGM}, 1 to {MAX_PIXELS} px")
    pixels = data[header.end() :]
    if len(pixels) != width * height:
        raise InputError(path, f"{len(pixels)} bytes of pixels", f"{width} × {height} = {width * height}")
    return np.frombuffer(pixels, np.uint8).reshape(height, width)
