"""The race: coloured gates on a mown field, to be flown through in order; banners, a stand and trees around it."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.sim import pictures, plants, textures
from dronevio.sim import textures_nature as nature
from dronevio.sim import textures_race as race
from dronevio.sim.cutouts import Print, joined
from dronevio.sim.layout import Layout, WorldBuilder
from dronevio.sim.lightmap import AreaLight
from dronevio.sim.plants import Plant
from dronevio.sim.solids import Box, Face, Paint, Sheet, Surface, turn_z
from dronevio.sim.textures import Colour, Image
from dronevio.sim.worlds import outdoors

Array = npt.NDArray[np.float64]
Random = np.random.Generator

_LOW, _HIGH = np.array([-22.0, -14.5, 0.0]), np.array([22.0, 14.5, 8.0])
_FREE_BOX_M = np.array([[-4.2, -3.4, 0.0], [4.2, 3.4, 5.0]])
_START_M = np.array([0.0, 0.0, 1.5])
_GATES_M = np.array(
    [
        [7.6, -2.2, 1.9],
        [14.6, -8.4, 1.7],
        [17.6, 0.6, 2.6],
        [12.6, 8.8, 1.8],
        [3.6, 7.4, 3.3],
        [-5.4, 9.6, 1.8],
        [-14.2, 8.0, 2.4],
        [-17.8, -0.6, 1.7],
        [-12.2, -8.8, 3.0],
        [-2.4, -7.8, 1.8],
    ]
)
"""Middles of the gates, before they are moved at random."""
_JITTER_M = np.array([0.7, 0.7, 0.25])
_RUN_M = 1.7  # the route is straight so far before and behind a gate
_OPENINGS_M = (1.9, 2.4)
_BAR_M = 0.28  # of a gate's frame
_LOOSE_M = 1.3  # from the route, seen from above, to what stands beside it
_FIELD_M = np.array([26.0, 18.0])  # half the mown grass
_FIELD_PX_PER_M = 79.0
_FENCE_M = np.array([23.2, 15.6])  # half of what the banners enclose
_PAD_M = 1.2
_WOODS_M, _PASTURE_PX_PER_M = 66.0, 9.0  # half of what lies around, and its resolution

_GRASSES: tuple[Colour, ...] = ((112, 140, 66), (128, 146, 74), (140, 144, 80), (104, 132, 72))
_LEAVES: tuple[tuple[Colour, ...], ...] = (
    ((84, 116, 52), (100, 128, 58), (72, 104, 52), (112, 130, 66)),
    ((170, 120, 50), (150, 92, 46), (120, 124, 58), (186, 150, 66)),
)
_BARKS: tuple[Colour, ...] = ((120, 98, 76), (104, 90, 76), (140, 128, 116), (112, 86, 64))
_STEEL: Colour = (150, 152, 156)
_STRAW: Colour = (204, 172, 98)
_NOTHING: Paint = partial(textures.plain, colour=race.BLACK)


@dataclass(frozen=True, eq=False)
class _Gate:
    """A gate."""

    middle: Array
    """(3,) Middle of its opening [m]."""
    heading_rad: float
    """Direction in which it is flown."""
    opening_m: float
    """Width and height of its opening [m]."""

    @property
    def ahead(self) -> Array:
        """(3,) Unit vector in which it is flown."""
        return np.array([np.cos(self.heading_rad), np.sin(self.heading_rad), 0.0])


def layout(rng: Random) -> Layout:
    """Draw a race course."""
    weather, toward = outdoors.WEATHERS[int(rng.integers(4))], outdoors.sun(rng)
    gates = _course(rng)
    route = np.vstack([_START_M, *[gate.middle + step * gate.ahead for gate in gates for step in (-_RUN_M, _RUN_M)]])
    colours = [race.PAINTS[int(i)] for i in rng.permutation(len(race.PAINTS))]
    frames: list[Box] = []
    for number, gate in enumerate(gates):
        build = _arch if rng.random() < 0.4 else _square
        frames += build(rng, gate, number + 1, colours[number % len(colours)])
    beside = _beside(rng, route, gates)
    stand, others = _stand(rng), _paddock(rng)
    trees = _trees(rng, toward)
    casting = [*frames, *beside, *stand, *others]
    ground = Sheet(
        outdoors.flat((-_FIELD_M[0], -_FIELD_M[1]), (_FIELD_M[0], _FIELD_M[1]), 0.0),
        partial(_field, colour=_GRASSES[int(rng.integers(4))], gates=gates, casting=casting, toward=toward),
        1.0,
        _FIELD_PX_PER_M,
    )
    grass = _GRASSES[int(rng.integers(4))]
    far = tuple(nature.scaled(grass, f) for f in (0.62, 0.72, 0.82))
    wide = _WOODS_M
    beyond = Sheet(
        outdoors.flat((-wide, -wide), (wide, wide), -0.05),
        partial(_pasture, colours=far, casting=[_crown(tree) for tree in trees], toward=toward),
        1.0,
        _PASTURE_PX_PER_M,
    )
    return Layout(
        low=_LOW.copy(),
        high=_HIGH.copy(),
        shell=(
            ground,
            beyond,
            outdoors.sky(weather),
            *_fence(rng),
            *(face for box in stand + others for face in box.faces()),
        ),
        boxes=(*frames, *beside),
        obstacles=(*frames, *beside),
        lights=(outdoors.sunlight(toward), AreaLight(-100.0 * toward[None] * [1, 1, -1], 2.0e3)),
        pad=np.zeros(3),
        free_box=_FREE_BOX_M.copy(),
        route=route,
        walled=False,
        shading=tuple(stand),
        prints=(
            Print(
                partial(plants.bark_image, colours=_BARKS, sun=toward),
                700,
                1024,
                joined([part for tree in trees for part in tree.wood]),
            ),
            Print(
                partial(plants.leaf_image, colours=_LEAVES[int(rng.integers(2))]),
                256,
                2048,
                joined([part for tree in trees for part in tree.leaves]),
            ),
        ),
    )


def _course(rng: Random) -> list[_Gate]:
    """Return the gates in order, each turned toward where the route goes on."""
    middles = _GATES_M + rng.uniform(-1.0, 1.0, _GATES_M.shape) * _JITTER_M
    around = np.vstack([_START_M, middles, _START_M])
    way = around[2:] - around[:-2]
    headings = np.arctan2(way[:, 1], way[:, 0])
    openings = rng.uniform(*_OPENINGS_M, len(middles))
    return [_Gate(m, float(h), float(o)) for m, h, o in zip(middles, headings, openings, strict=True)]


def _placed(gate: _Gate, boxes: list[Box]) -> list[Box]:
    """Return boxes of a gate's own frame (y where it is flown, the opening's middle at the origin) in the world."""
    R = turn_z(gate.heading_rad - 0.5 * np.pi)
    return [box.moved(R, gate.middle) for box in boxes]


def _square(rng: Random, gate: _Gate, number: int, colour: Colour) -> list[Box]:
    """Return a square gate on legs."""
    half, bar, z = 0.5 * gate.opening_m, 0.5 * _BAR_M, gate.middle[2]
    pattern = (race.chequers, race.bars, race.lettered)[int(rng.integers(3))]
    print_, label = partial(pattern, colour=colour), partial(race.numbered, colour=colour, number=number)
    deep = 0.07
    boxes = [
        Box(np.array([s * (half + bar), 0.0, 0.0]), np.array([bar, deep, half]), print_, pixels_per_m=160.0)
        for s in (-1.0, 1.0)
    ]
    wide = half + 2.0 * bar
    boxes.append(Box(np.array([0.0, 0.0, half + bar]), np.array([wide, deep, bar]), label, label, pixels_per_m=160.0))
    boxes.append(Box(np.array([0.0, 0.0, -half - bar]), np.array([wide, deep, bar]), print_, pixels_per_m=160.0))
    legs = z - half - 2.0 * bar
    steel = partial(textures.plain, colour=_STEEL)
    if legs > 0.02:
        for s in (-1.0, 1.0):
            foot = np.array([s * (half + bar), 0.0, 0.5 * legs - z])
            boxes.append(Box(foot, np.array([0.045, 0.045, 0.5 * legs]), steel, pixels_per_m=120.0))
    for s in (-1.0, 1.0):
        foot = np.array([s * (half + bar), 0.0, 0.02 - z])
        boxes.append(Box(foot, np.array([0.2, 0.32, 0.02]), steel, pixels_per_m=120.0))
    return _placed(gate, boxes)


def _arch(rng: Random, gate: _Gate, number: int, colour: Colour) -> list[Box]:
    """Return an inflated arch: two pillars, and segments that bend over the opening."""
    bar, z = 0.5 * (_BAR_M + 0.14), gate.middle[2]
    radius = 0.5 * gate.opening_m + 0.25 + bar  # to the middle of the tube
    pattern = partial((race.chequers, race.lettered)[int(rng.integers(2))], colour=colour)
    label = partial(race.numbered, colour=colour, number=number)
    boxes = [
        Box(np.array([s * radius, 0.0, -0.5 * z]), np.array([bar, bar, 0.5 * z]), pattern, pixels_per_m=150.0)
        for s in (-1.0, 1.0)
    ]
    count = 5
    along = radius * np.tan(0.5 * np.pi / count) + 0.4 * bar * np.tan(0.5 * np.pi / count)
    for k in range(count):
        angle = (k + 0.5) * np.pi / count
        c, s = np.cos(angle), np.sin(angle)
        tangent = np.array([[s, 0.0, c], [0.0, 1.0, 0.0], [-c, 0.0, s]])  # its z axis points away from the middle
        shown = label if k == count // 2 else pattern
        centre = radius * np.array([c, 0.0, s])
        # every other one is a hair thinner: where they overlap, no two faces lie in one plane
        thick = bar - 0.004 * (k % 2) - 0.002
        boxes.append(Box(centre, np.array([along, thick, thick]), shown, shown, R=tangent, pixels_per_m=150.0))
    return _placed(gate, boxes)


def _beside(rng: Random, route: Array, gates: list[_Gate]) -> list[Box]:
    """Return what stands along the course: flags, bales of straw."""
    boxes: list[Box] = []
    taken = np.array([gate.middle[:2] for gate in gates])
    places, _ = outdoors.scattered(rng, _LOW[:2] + 1.2, _HIGH[:2] - 1.2, 240, np.full(240, 0.5), 1.3)
    away = outdoors.distance_to_legs(places, route)
    apart = np.linalg.norm(places[:, None] - taken, axis=2).min(axis=1)
    in_infield = np.all(np.abs(places) < _FREE_BOX_M[1, :2] + 0.9, axis=1)
    for place in places[(away > _LOOSE_M) & (apart > 2.6) & ~in_infield][:34]:
        at, R = np.array([*place, 0.0]), turn_z(rng.uniform(0.0, 2.0 * np.pi))
        parts = _flag(rng) if rng.random() < 0.5 else _bales(rng)
        boxes += [box.moved(R, at) for box in parts]
    return boxes


def _flag(rng: Random) -> list[Box]:
    """Return a tall flag on a pole."""
    high = rng.uniform(2.4, 3.4)
    cloth = partial(race.lettered, colour=race.PAINTS[int(rng.integers(len(race.PAINTS)))])
    return [
        Box(np.array([0.0, 0.0, 0.5 * high]), np.array([0.02, 0.02, 0.5 * high]), _NOTHING, pixels_per_m=100.0),
        Box(np.array([0.32, 0.0, 0.56 * high]), np.array([0.3, 0.008, 0.42 * high]), cloth, cloth, pixels_per_m=150.0),
        Box(np.array([0.0, 0.0, 0.03]), np.array([0.22, 0.22, 0.03]), _NOTHING, pixels_per_m=100.0),
    ]


def _bales(rng: Random) -> list[Box]:
    """Return a few bales of straw, stacked."""
    straw = partial(race.bale, colour=textures.vary(rng, _STRAW, 0.08))
    half = np.array([0.45, 0.24, 0.2])
    boxes = [Box(np.array([x, 0.0, half[2]]), half, straw, pixels_per_m=110.0) for x in (-0.47, 0.47)]
    if rng.random() < 0.6:
        boxes.append(Box(np.array([rng.uniform(-0.2, 0.2), 0.0, 3.0 * half[2]]), half, straw, pixels_per_m=110.0))
    return boxes


def _fence(rng: Random) -> list[Surface]:
    """Return the banners around the field, seen from inside."""
    x, y = _FENCE_M
    high = 1.05
    corners = np.array([[-x, y], [x, y], [x, -y], [-x, -y], [-x, y]])
    boards: list[Surface] = []
    for a, b in pairwise(corners):
        count = round(float(np.linalg.norm(b - a)) / 4.0)
        posts = np.linspace(a, b, count + 1)
        for p, q in pairwise(posts):
            right = np.array([*(q - p), 0.0])
            boards.append(
                Face(np.array([*p, high]), right, np.array([0.0, 0.0, -high]), race.banner, pixels_per_m=96.0)
            )
    return boards


def _stand(rng: Random) -> list[Box]:
    """Return a stand with spectators along the north or the south side, under a roof."""
    seats = partial(race.crowd, colour=race.PAINTS[int(rng.integers(len(race.PAINTS)))])
    plain, cloth = partial(textures.plain, colour=(172, 170, 164)), partial(race.tarpaulin, colour=(232, 230, 224))
    wide, at, north = 12.0, _FENCE_M[1] + 2.0, rng.random() < 0.5
    boxes = []
    for row in range(6):
        centre = np.array([0.0, at + 0.9 * row, 0.45 + 0.225 * row])
        half = np.array([wide, 0.45, 0.45 + 0.225 * row])
        boxes.append(Box(centre, half, plain, pixels_per_m=24.0))
        people = np.array([0.0, at + 0.9 * row, 2.0 * half[2] + 0.42])
        boxes.append(Box(people, np.array([wide - 0.3, 0.02, 0.42]), plain, seats, pixels_per_m=44.0))
    back = at + 5.2
    boxes += [
        Box(np.array([x, back, 2.8]), np.array([0.08, 0.08, 2.8]), plain, pixels_per_m=32.0)
        for x in np.linspace(-wide, wide, 6)
    ]
    boxes.append(Box(np.array([0.0, back + 0.15, 3.4]), np.array([wide, 0.04, 1.2]), cloth, cloth, pixels_per_m=40.0))
    boxes.append(Box(np.array([0.0, at + 2.4, 5.7]), np.array([wide + 0.6, 3.4, 0.07]), cloth, pixels_per_m=20.0))
    valance = np.array([wide + 0.6, 0.03, 0.3])
    boxes.append(Box(np.array([0.0, at - 1.02, 5.45]), valance, race.banner, race.banner, pixels_per_m=60.0))
    # so far it looks along −y from the north; a box's front is its +y side
    turned = [replace(box, centre=-box.centre * [1.0, 1.0, -1.0]) for box in boxes]
    return [box.moved(turn_z(np.pi) if north else np.eye(3), np.zeros(3)) for box in turned]


def _paddock(rng: Random) -> list[Box]:
    """Return tents and containers around the field."""
    boxes: list[Box] = []
    for x in (-1.0, 1.0):
        for y in rng.permutation(np.linspace(-12.0, 12.0, 5))[:4]:
            R, at = turn_z(-0.5 * np.pi * x), np.array([x * (_FENCE_M[0] + rng.uniform(3.5, 5.5)), y, 0.0])
            parts = _tent(rng) if rng.random() < 0.55 else _container(rng)
            boxes += [box.moved(turn_z(rng.uniform(-0.15, 0.15)) @ R, at) for box in parts]
    return boxes


def _tent(rng: Random) -> list[Box]:
    """Return a tent with an open front."""
    colour = (*race.PAINTS, race.WHITE, race.WHITE)[int(rng.integers(len(race.PAINTS) + 2))]
    cloth, words = partial(race.tarpaulin, colour=colour), partial(race.lettered, colour=colour)
    pole = partial(textures.plain, colour=_STEEL)
    boxes = [
        Box(np.array([x, y, 1.15]), np.array([0.03, 0.03, 1.15]), pole, pixels_per_m=60.0)
        for x in (-1.45, 1.45)
        for y in (-1.45, 1.45)
    ]
    c, s = np.cos(0.5), np.sin(0.5)
    for side in (-1.0, 1.0):
        tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, side * s], [0.0, -side * s, c]])
        boxes.append(
            Box(np.array([0.0, 0.78 * side, 2.72]), np.array([1.6, 0.95, 0.02]), cloth, R=tilt, pixels_per_m=50.0)
        )
    boxes.append(Box(np.array([0.0, 1.6, 2.12]), np.array([1.6, 0.015, 0.18]), words, words, pixels_per_m=100.0))
    boxes.append(Box(np.array([0.0, -1.5, 1.1]), np.array([1.5, 0.015, 1.1]), cloth, cloth, pixels_per_m=50.0))
    boxes.append(Box(np.array([0.0, 0.9, 0.72]), np.array([1.2, 0.35, 0.03]), pole, pixels_per_m=80.0))
    boxes.append(Box(np.array([0.0, 1.25, 0.36]), np.array([1.2, 0.01, 0.36]), words, words, pixels_per_m=100.0))
    return boxes


def _container(rng: Random) -> list[Box]:
    """Return a shipping container, along the field."""
    colour = textures.vary(
        rng, ((150, 66, 48), (46, 84, 120), (86, 110, 84), (168, 128, 60))[int(rng.integers(4))], 0.1
    )
    steel = partial(race.container, colour=colour)
    return [Box(np.array([0.0, 0.0, 1.3]), np.array([3.0, 1.22, 1.3]), steel, steel, pixels_per_m=64.0)]


def _trees(rng: Random, toward: Array) -> list[Plant]:
    """Return trees all around, behind everything else."""
    places, _ = outdoors.scattered(rng, (-48.0, -40.0), (48.0, 40.0), 420, np.full(420, 1.3), 0.6)
    outside = np.any(np.abs(places) > _FENCE_M + [9.5, 10.0], axis=1)
    found = []
    for place in places[outside]:
        radius = rng.uniform(0.12, 0.24)
        trunk = rng.uniform(1.6, 2.6)
        plant = plants.tree(rng, radius, trunk + rng.uniform(4.5, 7.0), trunk - 0.6, int(rng.integers(4)), toward, 130)
        found.append(plant.moved(np.eye(3), np.array([*place, -0.05])))
    return found


def _crown(tree: Plant) -> Box:
    """Return an upright box a little smaller than a tree's crown."""
    corners = tree.leaves[0].corners.reshape(-1, 3)
    low, high = np.percentile(corners, [10.0, 90.0], axis=0)
    return Box(0.5 * (low + high), 0.5 * (high - low), _NOTHING)


def _pasture(
    rng: Random, height: int, width: int, colours: tuple[Colour, ...], casting: list[Box], toward: Array
) -> Image:
    """Return the grass around the field, with the shadows of trees."""
    return outdoors.shadowed(nature.distance(rng, height, width, colours), _PASTURE_PX_PER_M, casting, toward)


def _field(
    rng: Random, height: int, width: int, colour: Colour, gates: list[_Gate], casting: list[Box], toward: Array
) -> Image:
    """Return the mown field: lines between the gates, the pad, and the shadows of what stands on it."""
    image = nature.mown(nature.meadow(rng, height, width, colour, _FIELD_PX_PER_M), 2.0 * _FIELD_PX_PER_M)
    for gate in gates:
        _chalk(image, gate)
    outdoors.lay(image, pictures.landing_pad(round(_PAD_M * _FIELD_PX_PER_M)))
    return outdoors.shadowed(image, _FIELD_PX_PER_M, casting, toward)


def _chalk(image: Image, gate: _Gate) -> None:
    """Draw an arrow and a line of chalk under a gate."""
    side = np.array([-gate.ahead[1], gate.ahead[0], 0.0])
    foot = gate.middle * [1.0, 1.0, 0.0]
    strokes = [
        (foot - 1.5 * side, foot + 1.5 * side),
        (foot - 2.4 * gate.ahead, foot - 0.6 * gate.ahead),
        (foot - 0.6 * gate.ahead, foot - 1.1 * gate.ahead + 0.4 * side),
        (foot - 0.6 * gate.ahead, foot - 1.1 * gate.ahead - 0.4 * side),
    ]
    for a, b in strokes:
        (u0, v0), (u1, v1) = (outdoors.on_ground(image, _FIELD_PX_PER_M, p).astype(int).tolist() for p in (a, b))
        cv2.line(image, (u0, v0), (u1, v1), (222, 224, 214), round(0.1 * _FIELD_PX_PER_M), cv2.LINE_AA)


GATES = WorldBuilder("coloured gates on a field, to be raced through in order", layout)
"""The race."""
