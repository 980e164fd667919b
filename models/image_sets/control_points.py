"""Ground control points: points of known position with their pixels in images, from a file beside the images.

``gcp.csv`` has a header and a row for each pixel; a point has as many rows as images in which it was found::

    name,longitude_deg,latitude_deg,altitude_m,image,x_px,y_px,sigma_m
    A,13.4007407,52.5191341,12.079,02.jpg,2639.2,938.1,0.02

The column ``sigma_m``, the standard deviation of each coordinate, may be absent. The centre of the first pixel is
(0, 0). ``gcp_list.txt`` is the file of OpenDroneMap: its first line names the coordinates, and each further line has
x, y, z, the pixel, the image and, if wanted, the name of a point, separated by blanks. Coordinates are longitude and
latitude (``EPSG:4326``, ``WGS84``) or those of a zone of UTM (``EPSG:32633``, ``WGS84 UTM 33N``).
"""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.geodesy import geodetic_from_utm
from dronevio.models.recordings.files import read_text

Indices = npt.NDArray[np.int64]

CSV_NAME, LIST_NAME = "gcp.csv", "gcp_list.txt"
"""Names of the two files in the folder of the images."""
ASSUMED_SIGMA_M = 0.02
"""Standard deviation of the coordinates of a point of which nothing is stated [m]."""

_COLUMNS = ("name", "longitude_deg", "latitude_deg", "altitude_m", "image", "x_px", "y_px")
_UTM_EPSG = re.compile(r"(?:\+init=)?EPSG:(32[67])(\d\d)\s*$", re.IGNORECASE)
_UTM_NAME = re.compile(r"WGS\s?84\s+UTM\s+(\d{1,2})\s?([NS])\s*$", re.IGNORECASE)
_UTM_PROJ = re.compile(r"\+proj=utm\b.*\+zone=(\d{1,2})\b", re.IGNORECASE)
_LONGITUDE_LATITUDE = re.compile(r"(?:(?:\+init=)?EPSG:4326|WGS\s?84|\+proj=longlat\b.*)\s*$", re.IGNORECASE)
_EXPECTED_CRS = "EPSG:4326, or UTM such as EPSG:32633 or WGS84 UTM 33N"


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """G points of known position with M pixels in the images of a set."""

    names: tuple[str, ...]
    """(G,) Their names."""
    geodetic: Array
    """(G, 3) Latitude, longitude [deg] and altitude [m]."""
    sigmas_m: Array
    """(G,) Standard deviation of each coordinate [m]."""
    point: Indices
    """(M,) Index of the point of each pixel."""
    image: Indices
    """(M,) Index of its image in the set."""
    pixels: Array
    """(M, 2) Pixels; the centre of the first is (0, 0)."""
    unknown_images: tuple[str, ...] = ()
    """Names of images in the file that the set does not have."""

    def of_images(self, chosen: Indices) -> "ControlPoints":
        """Return the points with the pixels in some images, which are numbered in the given order."""
        row = {int(image): position for position, image in enumerate(chosen)}
        kept = np.array([int(image) in row for image in self.image], np.bool_)
        image = np.array([row[int(i)] for i in self.image[kept]], np.int64)
        return replace(self, point=self.point[kept], image=image, pixels=self.pixels[kept])


@dataclass(frozen=True)
class _Row:
    """A line of a file: the pixel of a point in an image."""

    line: int
    name: str
    longitude_deg: float
    latitude_deg: float
    altitude_m: float
    image: str
    x_px: float
    y_px: float
    sigma_m: float


def find_control_points(folder: Path, names: Sequence[str]) -> ControlPoints | None:
    """Return the control points of the images in a folder, None if there is no file of them.

    Args:
        folder: The folder of the images.
        names: (I,) Names of the images; the file may state the last parts of their paths.

    Raises:
        InputError: The file is damaged, or no image of the set is in it.
    """
    for name in (CSV_NAME, LIST_NAME):
        if (folder / name).is_file():
            return read_control_points(folder / name, names)
    return None


def read_control_points(path: Path, names: Sequence[str]) -> ControlPoints:
    """Return the control points in a file, ``.csv`` or of OpenDroneMap; see `find_control_points`."""
    text = read_text(path, "a file of ground control points")
    rows = list(_csv_rows(path, text) if path.suffix.lower() == ".csv" else _list_rows(path, text))
    if not rows:
        raise InputError(path, "no control points", "a line for each pixel of a point")
    image_of = {name: i for i, name in enumerate(names)}
    for name, i in list(image_of.items()):  # the last part of a path that only one image has
        short = PurePosixPath(name).name
        image_of.setdefault(short, i if sum(PurePosixPath(n).name == short for n in names) == 1 else -1)
    first: dict[str, _Row] = {}
    for row in rows:
        known = first.setdefault(row.name, row)
        same = (known.longitude_deg, known.latitude_deg, known.altitude_m, known.sigma_m)
        if (row.longitude_deg, row.latitude_deg, row.altitude_m, row.sigma_m) != same:
            raise InputError(path, f"another position of {row.name} than in line {known.line}", "the same", row.line)
    used = [row for row in rows if image_of.get(row.image, -1) >= 0]
    unknown = tuple(dict.fromkeys(row.image for row in rows if image_of.get(row.image, -1) < 0))
    if not used:
        raise InputError(path, f"pixels in {unknown[0]}, which is not among the images", "names of the images")
    number = {name: g for g, name in enumerate(first)}
    points = list(first.values())
    return ControlPoints(
        names=tuple(first),
        geodetic=np.array([[p.latitude_deg, p.longitude_deg, p.altitude_m] for p in points]),
        sigmas_m=np.array([p.sigma_m for p in points]),
        point=np.array([number[row.name] for row in used], np.int64),
        image=np.array([image_of[row.image] for row in used], np.int64),
        pixels=np.array([[row.x_px, row.y_px] for row in used]),
        unknown_images=unknown,
    )


def _csv_rows(path: Path, text: str) -> Iterator[_Row]:
    """Yield the rows of a file with a header."""
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    header = tuple(name.strip() for name in reader.fieldnames or ())
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise InputError(path, f"no column {missing[0]}", ",".join(_COLUMNS), 1)
    reader.fieldnames = header
    for values in reader:
        line = reader.line_num
        texts = {name: (values.get(name) or "").strip() for name in (*_COLUMNS, "sigma_m")}
        numbers = {n: _number(path, line, n, texts[n]) for n in _COLUMNS if n not in ("name", "image")}
        sigma = _number(path, line, "sigma_m", texts["sigma_m"]) if texts["sigma_m"] else ASSUMED_SIGMA_M
        yield _checked(path, _Row(line, name=texts["name"], image=texts["image"], sigma_m=sigma, **numbers))


def _list_rows(path: Path, text: str) -> Iterator[_Row]:
    """Yield the rows of a file of OpenDroneMap."""
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not lines:
        return
    zone = _utm_zone(path, *lines[0])
    for number, line in lines[1:]:
        words = line.split()
        if len(words) < 6:
            raise InputError(path, f"{len(words)} values", "x y z pixel-x pixel-y image [name]", number)
        x, y, z, px, py = (
            _number(path, number, name, word)
            for name, word in zip(("x", "y", "z", "pixel x", "pixel y"), words, strict=False)
        )
        if zone is not None:
            y, x = geodetic_from_utm(np.array([x, y]), *zone).tolist()
        name = words[6] if len(words) > 6 else " ".join(words[:3])
        yield _checked(path, _Row(number, name, x, y, z, words[5], px, py, ASSUMED_SIGMA_M))


def _utm_zone(path: Path, line: int, text: str) -> tuple[int, bool] | None:
    """Return the zone of UTM that a line names, and whether it is in the north; None for longitude and latitude."""
    if _LONGITUDE_LATITUDE.match(text):
        return None
    if found := _UTM_EPSG.match(text):
        zone, is_north = int(found[2]), found[1] == "326"
    elif found := _UTM_NAME.match(text):
        zone, is_north = int(found[1]), found[2].upper() == "N"
    elif found := _UTM_PROJ.match(text):
        zone, is_north = int(found[1]), "+south" not in text
    else:
        raise InputError(path, f"the coordinates {text[:60]!r}", _EXPECTED_CRS, line)
    if not 1 <= zone <= 60:
        raise InputError(path, f"the zone {zone} of UTM", "1 to 60", line)
    return zone, is_north


def _checked(path: Path, row: _Row) -> _Row:
    """Return a row whose values are possible, or raise InputError."""
    if not row.name or not row.image:
        raise InputError(path, "a point without a name or an image", "both", row.line)
    if abs(row.latitude_deg) > 90.0 or abs(row.longitude_deg) > 180.0:
        where = f"latitude {row.latitude_deg:g}°, longitude {row.longitude_deg:g}°"
        raise InputError(path, where, "at most 90° and 180°", row.line)
    if row.sigma_m <= 0.0:
        raise InputError(path, f"sigma_m {row.sigma_m:g}", "a number above zero", row.line)
    return row


def _number(path: Path, line: int, name: str, text: str) -> float:
    """Return a finite number, or raise InputError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(path, f"{name} {text!r}", "a number", line)
    return value
