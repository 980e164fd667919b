"""Descriptions of worlds in YAML: size, surfaces, landing pad, obstacles and scattered obstacles.

Names of fields and limits are checked, with the line in messages. The page `docs/how-to/own-world.md` documents them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, parse_yaml
from dronevio.sim.worlds.own.folder import WorldFolder
from dronevio.sim.worlds.own.looks import TEXTURES, Look, decoded_image
from dronevio.sim.worlds.own.meshes import SUFFIXES, Mesh, read_mesh
from dronevio.sim.worlds.own.mjcf import StaticGeom, StaticModel, read_static

MOST_OBSTACLES = 1000
"""Largest number of obstacles of a world, scattered ones included."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of images of surfaces."""

_SIZE_M = (3.0, 200.0)  # length and width of a world
_HEIGHT_M = (2.5, 50.0)
_PART_M = (0.01, 200.0)  # a length of an obstacle
_SIZES = {"box": ("size_m",), "cylinder": ("radius_m", "height_m"), "sphere": ("radius_m",), "mesh": ("scale",)}
_AROUND_M, _ABOVE_M, _LEAST_HEIGHT_M = 2.0, 1.5, 4.0  # of the bounds around, above and over geoms of MJCF
_LOOK_FIELDS = ("texture", "colour", "repeat_m")
_SHAPE_FIELDS = ("shape", "name", "rotation_deg", "file", *_LOOK_FIELDS)


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape and look of an obstacle, or of scattered ones."""

    kind: str
    """``box``, ``cylinder``, ``sphere`` or ``mesh``."""
    least: Array
    """(K,) Smallest lengths [m]: width, depth and height of a box; radius and height of a cylinder; radius of a sphere;
    factor of the lengths of a mesh."""
    greatest: Array
    """(K,) Largest lengths; those of an obstacle that is not scattered equal the smallest."""
    R: Array
    """(3, 3) Orientation."""
    look: Look
    """Look of all surfaces."""
    name: str
    """Name of the obstacles for segmentation, such as ``tree``."""
    mesh: Mesh | None = None
    """The mesh around the origin, if it is one."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """An obstacle at a place."""

    shape: Shape
    """Its shape."""
    position_m: tuple[float, ...]
    """Its centre, or x and y if it stands on the floor [m]."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Obstacles at random places on the floor."""

    shape: Shape
    """Their shape, with ranges of lengths."""
    count: int
    """Their number."""
    region_m: Array
    """(2, 2) Lower and upper corner of the rectangle in which they stand [m]."""
    pad_distance_m: float
    """Least distance of their surfaces from the centre of the landing pad [m]."""
    gap_m: float
    """Least gap between them, and to all other obstacles [m]."""
    where: str
    """Field of the description, for error messages."""


@dataclass(frozen=True, eq=False)
class Description:
    """A world as described in a file."""

    path: Path
    """The file."""
    low: Array
    """(3,) Lower corner of the flight space [m]; z is the floor."""
    high: Array
    """(3,) Upper corner [m]."""
    outdoors: bool
    """Whether there is a sky instead of walls and a ceiling."""
    pad_m: Array
    """(3,) Centre of the landing pad [m]."""
    floor: Look
    """Look of the floor or ground."""
    walls: Look
    """Look of the walls."""
    ceiling: Look
    """Look of the ceiling."""
    text: str
    """Description for listings."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles at places."""
    scatters: tuple[Scatter, ...] = ()
    """Scattered obstacles."""
    free_box_m: Array | None = None
    """(2, 3) Given box free of obstacles, with its centre above the pad [m]; None to find one."""
    route_m: Array | None = None
    """(R, 3) Given closed tour [m]; None to find one."""
    model: StaticModel | None = None
    """Static geoms of an MJCF file, which belong to the world."""


@dataclass(frozen=True, eq=False)
class Fields:
    """The fields of a map in a document, with checks."""

    folder: WorldFolder
    """The file and its folder."""
    yaml: YamlDocument
    """The document."""
    prefix: str = ""
    """What precedes the names of the fields, such as ``obstacles.3.``."""

    def has(self, name: str) -> bool:
        """Return whether a field is given."""
        return self.prefix + name in self.yaml

    def error(self, name: str, expected: str) -> InputError:
        """Return the error of a field."""
        return self.yaml.error(self.prefix + name, expected)

    def only(self, known: Sequence[str]) -> None:
        """Check that there are no other fields than known ones.

        Raises:
            InputError: There are.
        """
        for key, line in self.yaml.lines.items():
            name = key.removeprefix(self.prefix)
            if key.startswith(self.prefix) and name.partition(".")[0] not in known:
                found = f"unknown field {self.prefix}{name.partition('.')[0]}"
                raise InputError(self.yaml.path, found, f"some of {', '.join(known)}", line)

    def items(self, name: str) -> list["Fields"]:
        """Return the maps of a list; none without the field."""
        key = self.prefix + name
        if not self.has(name):
            if key in self.yaml.lines:
                raise InputError(self.yaml.path, f"{key}: nothing", "a list of maps", self.yaml.lines[key])
            return []
        inside = [other.removeprefix(f"{key}.") for other in self.yaml.lines if other.startswith(f"{key}.")]
        numbers = list(dict.fromkeys(part.partition(".")[0] for part in inside))
        if key in self.yaml.values or numbers != [str(k) for k in range(len(numbers))]:
            raise self.error(name, "a list of maps")
        return [Fields(self.folder, self.yaml, f"{key}.{number}.") for number in numbers]

    def part(self, name: str) -> "Fields":
        """Return the fields of a map."""
        if self.prefix + name in self.yaml.values:
            raise self.error(name, "a map, such as {texture: plain}")
        return Fields(self.folder, self.yaml, f"{self.prefix}{name}.")

    def number(self, name: str, limits: tuple[float, float], default: float | None = None) -> float:
        """Return a number within limits."""
        return self.numbers(name, (1,), limits, None if default is None else (default,))[0]

    def numbers(
        self, name: str, counts: tuple[int, ...], limits: tuple[float, float], default: Sequence[float] | None = None
    ) -> tuple[float, ...]:
        """Return one or more numbers within limits; a list unless there is one."""
        if default is not None and not self.has(name):
            return tuple(default)
        value = self.yaml.values.get(self.prefix + name)
        listed = value if isinstance(value, tuple) else (value,)
        found = tuple(item for item in listed if isinstance(item, float) and limits[0] <= item <= limits[1])
        if len(found) != len(listed) or len(found) not in counts:
            many = " or ".join(map(str, counts))
            what = "a number" if counts == (1,) else f"{many} numbers"
            raise self.error(name, f"{what} from {limits[0]:g} to {limits[1]:g}")
        return found

    def rows(self, name: str, counts: tuple[int, int], width: int, limits: tuple[float, float]) -> Array:
        """Return a list of lists (N, width) of numbers within limits, with a number of rows within ``counts``."""
        value = self.yaml.values.get(self.prefix + name)
        rows = value if isinstance(value, tuple) else ()
        found = [row for row in rows if isinstance(row, tuple) and len(row) == width]
        numbers = [item for row in found for item in row if isinstance(item, float) and limits[0] <= item <= limits[1]]
        many = f"{counts[0]}" if counts[0] == counts[1] else f"{counts[0]} to {counts[1]}"
        if not counts[0] <= len(rows) <= counts[1] or len(numbers) != width * len(rows):
            raise self.error(name, f"{many} lists of {width} numbers from {limits[0]:g} to {limits[1]:g}")
        return np.array(numbers).reshape(-1, width)

    def corners(self, name: str, width: int, limits: tuple[float, float]) -> Array:
        """Return a lower and an upper corner (2, width)."""
        found = self.rows(name, (2, 2), width, limits)
        if np.any(found[0] > found[1]):
            raise self.error(name, "the lower corner before the upper one")
        return found

    def word(self, name: str, default: str) -> str:
        """Return a text of at most 80 characters."""
        if not self.has(name):
            return default
        value = self.yaml.values.get(self.prefix + name)
        if not isinstance(value, str) or not 0 < len(value) <= 80 or not value.isprintable():
            raise self.error(name, "a text of 1 to 80 characters")
        return value

    def choice(self, name: str, known: Sequence[str], default: str | None = None) -> str:
        """Return one of some words."""
        value = self.yaml.values.get(self.prefix + name, default)
        if not isinstance(value, str) or value not in known:
            raise self.error(name, f"one of {', '.join(known)}")
        return value

    def content(self, name: str, suffixes: Sequence[str]) -> tuple[str, bytes]:
        """Return the name and the content of a file that a field names."""
        key = self.prefix + name
        file = self.word(name, "")
        if not file:
            raise self.error(name, f"a file {' or '.join(suffixes)} in the folder of the world")
        return file, self.folder.read(file, key, suffixes, self.yaml.lines.get(key))

    def look(self, default: str) -> Look:
        """Return a look from texture, colour and repeat_m."""
        colour = self.numbers("colour", (3,), (0.0, 255.0), ()) or None
        image, texture = None, self.word("texture", default)
        if Path(texture).suffix.lower() in IMAGE_SUFFIXES:
            name, content = self.content("texture", IMAGE_SUFFIXES)
            try:
                image = decoded_image(content)
            except ValueError as error:
                found = f"{self.prefix}texture: {name!r}: {error}"
                expected = "a PNG or JPEG image of at most 8192 px a side"
                raise InputError(self.yaml.path, found, expected, self.yaml.lines[f"{self.prefix}texture"]) from None
            if colour is not None:
                raise self.error("colour", "no colour with an image")
            texture = default
        elif texture not in TEXTURES:
            raise self.error("texture", f"an image {' or '.join(IMAGE_SUFFIXES)}, or one of {', '.join(TEXTURES)}")
        repeat_m = self.number("repeat_m", (0.05, 100.0)) if self.has("repeat_m") else None
        if repeat_m is not None and image is None:
            raise self.error("repeat_m", "an image as texture")
        return Look(texture, None if colour is None else (colour[0], colour[1], colour[2]), image, repeat_m)

    def shape(self, scattered: bool) -> Shape:
        """Return the shape of an obstacle, or of scattered ones, whose lengths may be ranges."""
        kind = self.choice("shape", tuple(_SIZES))
        for other in {name for names in _SIZES.values() for name in names} - set(_SIZES[kind]):
            if self.has(other):
                raise self.error(other, f"only {' and '.join(_SIZES[kind])} of a {kind}")
        ranges = [self._lengths(name, 3 if kind == "box" else 1, scattered, kind) for name in _SIZES[kind]]
        least, greatest = (np.concatenate([pair[side] for pair in ranges]) for side in (0, 1))
        angles = self.numbers("rotation_deg", (1, 3), (-360.0, 360.0), (0.0,))
        roll, pitch, yaw = angles if len(angles) == 3 else (0.0, 0.0, angles[0])
        R = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        mesh = None
        if kind == "mesh":
            name, content = self.content("file", SUFFIXES)
            key = f"{self.prefix}file"
            mesh = read_mesh(self.yaml.path, key, name, content, self.yaml.lines[key]).centred()
            longest_m = 2.0 * float(mesh.half.max() * greatest[0])
            if not longest_m <= _PART_M[1]:
                raise self.error("scale", f"a mesh of at most {_PART_M[1]:g} m instead of {longest_m:.3g} m")
        elif self.has("file"):
            raise self.error("file", "a file with the shape mesh only")
        look = self.look("plain")
        if mesh is not None and mesh.image is not None and not self.has("texture"):
            look = replace(look, image=mesh.image)
        return Shape(kind, least, greatest, R, look, self.word("name", kind), mesh)

    def _lengths(self, name: str, count: int, scattered: bool, kind: str) -> tuple[Array, Array]:
        """Return the smallest and largest lengths of a field, which are equal unless it is a range."""
        limits = (1e-4, 1e4) if name == "scale" else _PART_M
        value = self.yaml.values.get(self.prefix + name)
        if count == 3 and scattered and isinstance(value, tuple) and value and isinstance(value[0], tuple):
            low, high = self.corners(name, 3, limits)
            return low, high
        counts = (1, 2) if scattered and count == 1 else (count,)
        default = (1.0,) if name == "scale" else None
        found = np.array(self.numbers(name, counts, limits, default))
        if count == 1 and found[0] > found[-1]:
            raise self.error(name, "the smaller number first")
        return (found, found) if count == 3 else (found[:1], found[-1:])


def read_description(folder: WorldFolder, text: str) -> Description:
    """Return the world that a YAML text describes.

    Args:
        folder: The file of the text and its folder.
        text: The text.

    Raises:
        InputError: A field is missing, unknown or not possible, or a file that it names is.
    """
    fields = Fields(folder, parse_yaml(folder.path, text))
    known = ("size_m", "outdoors", "pad_m", "floor", "walls", "ceiling", "description", "obstacles", "scatter")
    fields.only((*known, "free_box_m", "route_m", "mjcf"))
    length, width, height = fields.numbers("size_m", (3,), (0.0, _SIZE_M[1]))
    if min(length, width) < _SIZE_M[0] or not _HEIGHT_M[0] <= height <= _HEIGHT_M[1]:
        expected = (
            f"length and width of {_SIZE_M[0]:g} to {_SIZE_M[1]:g} m and a height of {_HEIGHT_M[0]:g} to"
            f" {_HEIGHT_M[1]:g} m"
        )
        raise fields.error("size_m", expected)
    low, high = np.array([-0.5 * length, -0.5 * width, 0.0]), np.array([0.5 * length, 0.5 * width, height])
    outdoors = fields.choice("outdoors", ("true", "false"), "false") == "true"
    looks = {}
    for name, default in (("floor", "grass" if outdoors else "concrete"), ("walls", "plaster"), ("ceiling", "white")):
        if outdoors and name != "floor" and (fields.has(name) or name in fields.yaml.lines):
            raise fields.error(name, f"no {name} outdoors")
        part = fields.part(name)
        part.only(_LOOK_FIELDS)
        looks[name] = part.look(default)
    pad = np.array([*fields.numbers("pad_m", (2,), (-100.0, 100.0), (0.0, 0.0)), 0.0])
    if np.any(pad[:2] < low[:2] + 1.0) or np.any(pad[:2] > high[:2] - 1.0):
        raise fields.error("pad_m", "a place at least 1 m from the edges of the world")
    obstacles, scatters = _obstacles(fields, low, high), _scatters(fields, low, high)
    total = len(obstacles) + sum(scatter.count for scatter in scatters)
    if total > MOST_OBSTACLES:
        found = f"{total} obstacles, scattered ones included"
        raise InputError(folder.path, found, f"at most {MOST_OBSTACLES}")
    model = read_static(folder, *fields.content("mjcf", (".xml",))) if fields.has("mjcf") else None
    return Description(
        folder.path,
        low,
        high,
        outdoors,
        pad,
        looks["floor"],
        looks["walls"],
        looks["ceiling"],
        fields.word("description", f"the world in {folder.path.name}"),
        obstacles,
        scatters,
        fields.corners("free_box_m", 3, (-100.0, 100.0)) if fields.has("free_box_m") else None,
        fields.rows("route_m", (3, 200), 3, (-100.0, 100.0)) if fields.has("route_m") else None,
        model,
    )


def description_of_model(folder: WorldFolder, content: bytes) -> Description:
    """Return the world that an MJCF file describes: a place under the sky with its static geoms.

    The floor is its first level plane, or at the lowest point of its geoms. The bounds are those of the floor, or
    `_AROUND_M` beyond the geoms if that is infinite. The landing pad is below its site ``pad``, or the origin.

    Args:
        folder: The file and its folder.
        content: Its content.

    Raises:
        InputError: The file is not MJCF that can be a world.
    """
    model = read_static(folder, folder.path.name, content)
    solid = [geom for geom in model.geoms if geom.is_solid]
    boxes = [model.box_of(geom) for geom in solid if geom.kind != "plane"]
    floor = next((geom for geom in solid if geom.is_level), None)
    if floor is None and not boxes:
        raise InputError(folder.path, "no static geom that collides", "a floor and obstacles")
    low, high = _bounds(floor, boxes)
    size = high - low
    if size[:2].min() < _SIZE_M[0] or size.max() > _SIZE_M[1]:
        found = f"a world of {size[0]:.3g} × {size[1]:.3g} × {size[2]:.3g} m"
        raise InputError(folder.path, found, f"{_SIZE_M[0]:g} to {_SIZE_M[1]:g} m")
    pad = np.array([*(np.zeros(2) if model.pad_m is None else model.pad_m[:2]), low[2]])
    if np.any(pad[:2] < low[:2] + 1.0) or np.any(pad[:2] > high[:2] - 1.0):
        found = f"the landing pad at {np.round(pad[:2], 2).tolist()} m"
        raise InputError(folder.path, found, "a site named pad at least 1 m from the edges of the world")
    ground = Look("grass") if floor is None else floor.look
    text = f"the world in {folder.path.name}"
    return Description(folder.path, low, high, True, pad, ground, ground, ground, text, model=model)


def _bounds(floor: StaticGeom | None, boxes: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the lower and the upper corner (3,) of a world with a floor and the bounding boxes of geoms [m]."""
    corners = np.array(boxes).reshape(-1, 2, 3)
    level = float(corners[:, 0, 2].min()) if floor is None else float(floor.position[2])
    top = max(float(corners[:, 1, 2].max(initial=level)) + _ABOVE_M, level + _LEAST_HEIGHT_M)
    if floor is not None and floor.size[0] > 0.0 and floor.size[1] > 0.0:
        reach = np.abs(floor.R[:2, :2]) @ floor.size[:2]
        return np.array([*(floor.position[:2] - reach), level]), np.array([*(floor.position[:2] + reach), top])
    low, high = corners[:, 0, :2].min(axis=0, initial=0.0), corners[:, 1, :2].max(axis=0, initial=0.0)
    return np.array([*(low - _AROUND_M), level]), np.array([*(high + _AROUND_M), top])


def _obstacles(fields: Fields, low: Array, high: Array) -> tuple[Obstacle, ...]:
    """Return the obstacles at places."""
    obstacles = []
    for item in fields.items("obstacles"):
        item.only((*_SHAPE_FIELDS, "position_m", *dict.fromkeys(name for names in _SIZES.values() for name in names)))
        shape = item.shape(False)
        position = np.array(item.numbers("position_m", (2, 3), (-200.0, 200.0)))
        count = len(position)
        if np.any(position < low[:count]) or np.any(position > high[:count]):
            bounds = ", ".join(f"{a:g} to {b:g}" for a, b in zip(low, high, strict=True))
            raise item.error("position_m", f"a place in the world: {bounds} m")
        obstacles.append(Obstacle(shape, tuple(position.tolist())))
    return tuple(obstacles)


def _scatters(fields: Fields, low: Array, high: Array) -> tuple[Scatter, ...]:
    """Return the scattered obstacles."""
    scatters = []
    for item in fields.items("scatter"):
        sizes = dict.fromkeys(name for names in _SIZES.values() for name in names)
        item.only((*_SHAPE_FIELDS, "count", "region_m", "pad_distance_m", "gap_m", *sizes))
        count = item.number("count", (1, MOST_OBSTACLES))
        if count != int(count):
            raise item.error("count", f"a whole number from 1 to {MOST_OBSTACLES}")
        region = item.corners("region_m", 2, (-100.0, 100.0)) if item.has("region_m") else np.stack([low, high])[:, :2]
        if np.any(region[0] < low[:2]) or np.any(region[1] > high[:2]):
            raise item.error("region_m", "a rectangle within the world")
        scatters.append(
            Scatter(
                item.shape(True),
                int(count),
                region,
                item.number("pad_distance_m", (0.0, 200.0), 2.0),
                item.number("gap_m", (0.0, 100.0), 0.8),
                item.prefix.rstrip("."),
            )
        )
    return tuple(scatters)
