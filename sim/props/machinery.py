"""Equipment of a machine hall: machines, tanks, pipes, crates, a catwalk, a crane.

Each piece stands at the origin of its own frame, its front toward +y, x along it, z up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures
from dronevio.sim.appearance import textures_industrial as works
from dronevio.sim.appearance.instances import Instance, single_instance
from dronevio.sim.appearance.prisms import UNPAINTED, lateral_surface, prism_boxes
from dronevio.sim.appearance.solids import Box, Paint, Sheet, parts_of
from dronevio.sim.appearance.textures import Colour, scaled, vary

Random = np.random.Generator

MACHINE_COLOURS: tuple[Colour, ...] = ((92, 128, 108), (88, 116, 142), (170, 150, 92), (136, 140, 138), (156, 96, 74))
PIPE_COLOURS: tuple[Colour, ...] = ((74, 120, 158), (150, 152, 150), (92, 136, 92), (170, 118, 60), (168, 70, 58))
STEEL: Colour = (122, 126, 128)
TIMBER: Colour = (176, 140, 98)
_PPM = 112.0
_SIDES = 16
_THIN_SIDES = 10
_R_ALONG_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # takes z to x
_R_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # takes z to y


@dataclass(frozen=True, eq=False)
class Kit:
    """An object of flat and curved parts."""

    boxes: tuple[Box, ...] = ()
    """Flat parts of the object."""
    sheets: tuple[Sheet, ...] = ()
    """Curved parts of the object."""
    obstacles: tuple[Box, ...] = ()
    """Keep-out boxes of the object."""
    filling: tuple[Box, ...] = ()
    """Boxes that fill the curved parts."""

    def moved(self, R: Array, position: Array) -> "Kit":
        """Return the object rotated by R (3, 3) about the origin, then translated by ``position`` (3,)."""
        parts = (self.boxes, self.obstacles, self.filling)
        boxes, obstacles, filling = (tuple(box.moved(R, position) for box in part) for part in parts)
        sheets = tuple(replace(sheet, grid=sheet.grid @ R.T + position) for sheet in self.sheets)
        return Kit(boxes, sheets, obstacles, filling)

    def as_instance(self, kind: str) -> "Kit":
        """Return the object as one instance of a kind."""
        thing = Instance(kind)
        boxes, filling = (parts_of(thing, part) for part in (self.boxes, self.filling))
        return replace(self, boxes=boxes, sheets=parts_of(thing, self.sheets), filling=filling)


def kit_of(boxes: Sequence[Box], parts: Sequence[Kit] = ()) -> Kit:
    """Return an object of solid boxes and other objects."""
    return Kit(
        tuple(boxes) + tuple(box for part in parts for box in part.boxes),
        tuple(sheet for part in parts for sheet in part.sheets),
        tuple(boxes) + tuple(box for part in parts for box in part.obstacles),
        tuple(box for part in parts for box in part.filling),
    )


def block(
    place: tuple[float, float, float],
    size: tuple[float, float, float],
    paint: Paint,
    front: Paint | None = None,
    ppm: float = _PPM,
) -> Box:
    """Return a box from the centre of its base and its width, depth and height [m]."""
    w, d, h = size
    return Box(np.array(place) + [0.0, 0.0, 0.5 * h], 0.5 * np.array([w, d, h]), paint, front, pixels_per_m=ppm)


def steel(colour: Colour = STEEL) -> Paint:
    """Return the paint of steel."""
    return partial(works.casing_plain, colour=colour)


def drumlike(
    radius_m: float, length_m: float, paint: Paint, cap: Paint, lid_m: float = 0.0, sides: int = _SIDES
) -> Kit:
    """Return an upright cylinder from z = 0, its lid flat or raised."""
    rings, spread = np.array([length_m, 0.0]), np.full(2, radius_m)
    top = np.array([length_m + lid_m, length_m + lid_m, length_m])
    sheets = [Sheet(lateral_surface(rings, spread, sides), paint, pixels_per_m=_PPM)]
    sheets.append(Sheet(lateral_surface(top, radius_m * np.array([0.0, 0.64, 1.0]), sides), cap, pixels_per_m=_PPM))
    solid = prism_boxes(radius_m, 0.0, length_m, sides)
    if lid_m > 0.0:
        solid += prism_boxes(0.64 * radius_m, length_m, length_m + lid_m, sides)
    return Kit((), tuple(sheets), tuple(solid), tuple(solid))


@single_instance
def pipe_run(points: Sequence[Sequence[float]], radius_m: float, colour: Colour) -> Kit:
    """Return a pipe along legs that are parallel to the axes, with a collar at each corner."""
    path, parts = np.array(points, dtype=np.float64), []
    paint = partial(works.pipe, colour=colour, ppm=_PPM)
    for a, b in pairwise(path):
        length, axis = float(np.linalg.norm(b - a)), int(np.argmax(np.abs(b - a)))
        low = np.minimum(a, b)
        grid = lateral_surface(np.array([length, 0.0]), np.full(2, radius_m), _THIN_SIDES)
        R = (_R_ALONG_X, _R_ALONG_Y, np.eye(3))[axis]
        inside = tuple(prism_boxes(radius_m, 0.0, length, _THIN_SIDES))
        tube = Kit((), (Sheet(grid, paint, pixels_per_m=_PPM),), inside, inside)
        parts.append(tube.moved(R, low))
    collar = steel(scaled(colour, 0.8))
    joints = [Box(joint, np.full(3, 1.15 * radius_m), collar, pixels_per_m=80.0) for joint in path[1:-1]]
    return kit_of(joints, parts)


@single_instance
def machine(rng: Random, w: float, d: float, h: float) -> Kit:
    """Return a machine tool: a plinth, a body in two steps, a cabinet at its side, pipes on top."""
    colour = vary(rng, MACHINE_COLOURS[int(rng.integers(len(MACHINE_COLOURS)))], 0.08)
    skin = partial(works.casing, colour=colour, ppm=_PPM)
    other = partial(works.casing, colour=scaled(colour, 0.82), ppm=_PPM)
    step, share = rng.uniform(0.45, 0.62), rng.uniform(0.55, 0.7)
    side = float(rng.choice([-1.0, 1.0]))
    boxes = [
        block((0.0, 0.0, 0.0), (w + 0.14, d + 0.14, 0.16), works.hazard),
        block((0.0, -0.04, 0.16), (w, d - 0.08, step * h - 0.16), skin),
        block((side * 0.5 * (1.0 - share) * w, -0.1, step * h), (share * w, d - 0.35, (1.0 - step) * h), other),
        block((-side * 0.28 * w, 0.02, step * h), (0.3 * w, 0.5 * d, 0.3), steel()),
    ]
    panel = partial(works.console, colour=(150, 154, 148), ppm=_PPM)
    reach = 0.5 * d - 0.06
    boxes.append(block((-side * 0.3 * w, reach, 0.5), (0.62, 0.16, 0.95), steel(), panel))
    lamp_at = (side * 0.5 * (1.0 - share) * w, 0.0, h)
    boxes.append(block(lamp_at, (0.05, 0.05, 0.22), steel()))
    boxes.append(
        block((lamp_at[0], 0.0, h + 0.22), (0.12, 0.12, 0.16), partial(works.casing_plain, colour=works.YELLOW))
    )
    pipe_colour = PIPE_COLOURS[int(rng.integers(len(PIPE_COLOURS)))]
    x = -side * 0.28 * w
    up = pipe_run([(x, -0.3 * d, step * h), (x, -0.3 * d, h), (x + side * 0.4 * w, -0.3 * d, h)], 0.08, pipe_colour)
    return kit_of(boxes, [up])


@single_instance
def turbine(rng: Random) -> Kit:
    """Return a large turbine on its bed, along x: a drum between two housings, a generator, a shaft."""
    colour = vary(rng, MACHINE_COLOURS[int(rng.integers(len(MACHINE_COLOURS)))], 0.08)
    skin = partial(works.casing, colour=colour, ppm=_PPM)
    bands = partial(works.tank_side, colour=colour, ppm=_PPM, number=int(rng.integers(1, 9)))
    boxes = [
        block((0.0, 0.0, 0.0), (3.7, 2.3, 0.35), works.hazard),
        block((0.0, 0.0, 0.35), (3.5, 1.6, 0.4), skin),
        block((-1.35, 0.0, 0.75), (0.5, 2.0, 1.9), skin),
        block((1.15, 0.0, 0.75), (0.35, 1.9, 1.7), skin),
        block((1.55, 0.0, 0.75), (0.45, 1.2, 1.1), steel()),
    ]
    drum = drumlike(0.85, 2.15, bands, partial(textures.plain, colour=STEEL)).moved(
        _R_ALONG_X, np.array([-1.1, 0.0, 1.6])
    )
    feed = pipe_run([(-1.35, 0.4, 2.65), (-1.35, 0.4, 3.05), (0.6, 0.4, 3.05), (0.6, 0.4, 2.4)], 0.13, PIPE_COLOURS[4])
    return kit_of(boxes, [drum, feed])


@single_instance
def tank(rng: Random, radius_m: float, height_m: float, number: int) -> Kit:
    """Return an upright tank on feet, a ladder at its front, a valve below."""
    colour = vary(rng, ((176, 180, 178), (196, 188, 164), (120, 146, 160), (164, 110, 84))[int(rng.integers(4))], 0.06)
    skin = partial(works.tank_side, colour=colour, ppm=_PPM, number=number)
    lift = 0.45
    lid = partial(textures.plain, colour=scaled(colour, 0.92))
    body = drumlike(radius_m, height_m - lift - 0.18 * radius_m, skin, lid, 0.18 * radius_m)
    feet = [
        block((s * 0.6 * radius_m, t * 0.6 * radius_m, 0.0), (0.14, 0.14, lift + 0.02), steel())
        for s in (-1.0, 1.0)
        for t in (-1.0, 1.0)
    ]
    feet.append(block((0.0, 0.0, 0.0), (1.5 * radius_m, 1.5 * radius_m, 0.06), works.hazard))
    rails = [
        block((s * 0.2, radius_m + 0.09, 0.0), (0.035, 0.035, height_m - 0.3 * radius_m + 0.4), steel(works.YELLOW))
        for s in (-1.0, 1.0)
    ]
    rungs = [
        block((0.0, radius_m + 0.09, z), (0.4, 0.028, 0.028), steel(works.YELLOW), ppm=40.0)
        for z in np.arange(0.3, height_m - 0.3 * radius_m, 0.34)
    ]
    solid = kit_of(feet, [body.moved(np.eye(3), np.array([0.0, 0.0, lift]))])
    return with_lattice(solid, rails + rungs)


@single_instance
def crates(rng: Random) -> Kit:
    """Return a stack of crates on a pallet."""
    colour = vary(rng, TIMBER, 0.1)
    boxes = [block((0.0, 0.0, 0.0), (1.5, 1.3, 0.12), partial(works.crate, colour=(140, 112, 80), ppm=_PPM))]
    z = 0.12
    for _ in range(int(rng.integers(1, 4))):
        size = (rng.uniform(0.85, 1.25), rng.uniform(0.8, 1.1), rng.uniform(0.5, 0.85))
        box = block((0.0, 0.0, 0.0), size, partial(works.crate, colour=vary(rng, colour, 0.08), ppm=_PPM))
        boxes.append(box.moved(rotation_z(rng.uniform(-0.12, 0.12)), np.array([0.0, 0.0, z])))
        z += size[2]
    return kit_of(boxes)


@single_instance
def drums(rng: Random) -> Kit:
    """Return steel drums on a pallet."""
    wood = partial(works.crate, colour=(140, 112, 80), ppm=_PPM)
    parts = []
    for x, y in ((-0.32, -0.32), (0.32, -0.32), (-0.32, 0.32), (0.32, 0.32)):
        if rng.random() < 0.85:
            colour = vary(
                rng, ((44, 92, 150), (176, 60, 44), (88, 110, 84), (206, 158, 44))[int(rng.integers(4))], 0.08
            )
            skin, lid = partial(works.drum, colour=colour, ppm=_PPM), partial(textures.plain, colour=colour)
            one = drumlike(0.29, 0.88, skin, lid, sides=12)
            parts.append(one.moved(rotation_z(rng.uniform(0.0, 6.0)), np.array([x, y, 0.12])))
    return kit_of([block((0.0, 0.0, 0.0), (1.3, 1.3, 0.12), wood)], parts)


@single_instance
def cabinet(rng: Random) -> Kit:
    """Return a control cabinet."""
    colour = vary(rng, (152, 156, 150), 0.08)
    front = partial(works.console, colour=colour, ppm=_PPM)
    return kit_of([block((0.0, 0.0, 0.0), (1.1, 0.5, 2.0), steel(colour), front)])


@single_instance
def catwalk(length_m: float, height_m: float) -> Kit:
    """Return a walkway along x on posts, with rails at its front, and cross braces."""
    plate = partial(works.grating, colour=STEEL, ppm=96.0)
    half, deep = 0.5 * length_m, 1.2
    rail_y, post_y = 0.5 * deep - 0.03, 0.5 * deep - 0.12
    yellow, post = steel(works.YELLOW), steel((104, 112, 110))
    floor = [block((0.0, 0.0, height_m - 0.08), (length_m, deep, 0.08), plate, works.hazard, 96.0)]
    rails = [block((0.0, rail_y, height_m + z), (length_m, 0.05, 0.05), yellow, ppm=40.0) for z in (0.02, 0.55, 1.05)]
    for x in np.linspace(-half + 0.1, half - 0.1, max(round(length_m / 2.6), 2) + 1):
        floor.append(block((x, post_y, 0.0), (0.14, 0.14, height_m - 0.08), post, ppm=96.0))
        rails.append(block((x, rail_y, height_m), (0.044, 0.044, 1.1), yellow, ppm=40.0))
    return with_lattice(kit_of(floor), rails)


def with_lattice(kit: Kit, bars: Sequence[Box]) -> Kit:
    """Return an object with vertical bars, and one obstacle around them, since a drone cannot pass between them."""
    return Kit((*kit.boxes, *bars), kit.sheets, (*kit.obstacles, around(bars)), kit.filling)


def around(boxes: Sequence[Box]) -> Box:
    """Return the bounding box of some boxes."""
    reach = np.array([np.abs(box.R) @ box.half for box in boxes])
    centres = np.array([box.centre for box in boxes])
    low, high = (centres - reach).min(axis=0), (centres + reach).max(axis=0)
    return Box(0.5 * (low + high), 0.5 * (high - low), UNPAINTED)


@single_instance
def crane(rng: Random, span_m: float, height_m: float) -> Kit:
    """Return a bridge crane across y: two girders, a trolley, a hook on its rope."""
    paint = partial(works.casing, colour=works.YELLOW, ppm=80.0)
    boxes = [block((s * 0.55, 0.0, height_m), (0.28, span_m, 0.55), paint, works.hazard, 80.0) for s in (-1.0, 1.0)]
    boxes += [
        block((0.0, s * 0.5 * (span_m - 0.4), height_m - 0.02), (1.9, 0.42, 0.4), works.hazard) for s in (-1.0, 1.0)
    ]
    y = rng.uniform(-0.3, 0.3) * span_m
    boxes.append(block((0.0, y, height_m + 0.3), (0.8, 0.9, 0.5), steel((170, 72, 56))))
    boxes.append(block((0.0, y, height_m - 0.6), (0.03, 0.03, 0.9), steel((60, 60, 62))))
    boxes.append(block((0.0, y, height_m - 0.95), (0.3, 0.2, 0.4), works.hazard))
    return kit_of(boxes)
