"""World gates: a race course of coloured gates on a mown field, with banners, a grandstand and trees around it."""

from functools import partial

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import pictures, textures
from dronevio.sim.appearance import textures_nature as nature
from dronevio.sim.appearance import textures_race as race
from dronevio.sim.appearance.cutouts import Print
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Paint, Sheet, parts_of
from dronevio.sim.appearance.textures import Colour, scaled
from dronevio.sim.paths.space import Gate
from dronevio.sim.props import fairground, vegetation
from dronevio.sim.props.vegetation import Vegetation
from dronevio.sim.worlds import outdoors
from dronevio.sim.worlds.layout import Layout, WorldBuilder

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
"""Nominal centres of the gates, before random displacements [m]."""
_JITTER_M = np.array([0.7, 0.7, 0.25])
_RUN_M = 1.7  # length of the straight route before and behind a gate
_OPENINGS_M = (1.9, 2.4)
_BAR_M = 0.28  # of a gate's frame
_LOOSE_M = 1.3  # horizontal distance from the route to objects beside it
_FIELD_M = np.array([26.0, 18.0])  # half the mown grass
_FIELD_PX_PER_M = 79.0
_FENCE_M = np.array([23.2, 15.6])  # half of what the banners enclose
_PAD_M = 1.2
_WOODS_M, _PASTURE_PX_PER_M = 66.0, 9.0  # half extent of the surroundings, and their resolution

_GRASSES: tuple[Colour, ...] = ((112, 140, 66), (128, 146, 74), (140, 144, 80), (104, 132, 72))
_LEAVES: tuple[tuple[Colour, ...], ...] = (
    ((84, 116, 52), (100, 128, 58), (72, 104, 52), (112, 130, 66)),
    ((170, 120, 50), (150, 92, 46), (120, 124, 58), (186, 150, 66)),
)
_BARKS: tuple[Colour, ...] = ((120, 98, 76), (104, 90, 76), (140, 128, 116), (112, 86, 64))
_NOTHING: Paint = partial(textures.plain, colour=race.BLACK)


def layout(rng: Random, light: Random | None = None) -> Layout:
    """Draw a race course.

    Args:
        rng: Generator of everything but the light.
        light: Generator of sun and weather; the first one by default.
    """
    weather, toward = outdoors.WEATHERS[int(rng.integers(4))], outdoors.sun(rng)
    if light is not None:
        weather, toward = outdoors.daylight(light)
    gates = _course(rng)
    route = np.vstack([_START_M, *[gate.middle + step * gate.ahead for gate in gates for step in (-_RUN_M, _RUN_M)]])
    colours = [race.PAINTS[int(i)] for i in rng.permutation(len(race.PAINTS))]
    frames: list[Box] = []
    for number, gate in enumerate(gates):
        build = _arch if rng.random() < 0.4 else _square
        frames += build(rng, gate, number + 1, colours[number % len(colours)])
    beside = _beside(rng, route, gates)
    stand, others = fairground.stand(rng, _FENCE_M), fairground.paddock(rng, _FENCE_M)
    trees = _trees(rng, toward)
    casting = [*frames, *beside, *stand, *others]
    floor = Instance("floor")
    ground = Sheet(
        outdoors.flat((-_FIELD_M[0], -_FIELD_M[1]), (_FIELD_M[0], _FIELD_M[1]), 0.0),
        partial(_field, colour=_GRASSES[int(rng.integers(4))], gates=gates, casting=casting, toward=toward),
        1.0,
        _FIELD_PX_PER_M,
        floor,
    )
    grass = _GRASSES[int(rng.integers(4))]
    far = tuple(scaled(grass, f) for f in (0.62, 0.72, 0.82))
    wide = _WOODS_M
    beyond = Sheet(
        outdoors.flat((-wide, -wide), (wide, wide), -0.05),
        partial(_pasture, colours=far, casting=[_crown(tree) for tree in trees], toward=toward),
        1.0,
        _PASTURE_PX_PER_M,
        floor,
    )
    return Layout(
        low=_LOW.copy(),
        high=_HIGH.copy(),
        shell=(
            ground,
            beyond,
            outdoors.sky(weather),
            *fairground.fence(_FENCE_M),
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
        filling=(*stand, *others),
        gates=tuple(gates),
        prints=(
            Print(
                partial(vegetation.bark_image, colours=_BARKS, sun=toward),
                700,
                1024,
                tuple(part for tree in trees for part in tree.wood),
            ),
            Print(
                partial(vegetation.leaf_image, colours=_LEAVES[int(rng.integers(2))]),
                256,
                2048,
                tuple(part for tree in trees for part in tree.leaves),
            ),
        ),
    )


def _course(rng: Random) -> list[Gate]:
    """Return the gates in order, each facing along the route."""
    middles = _GATES_M + rng.uniform(-1.0, 1.0, _GATES_M.shape) * _JITTER_M
    around = np.vstack([_START_M, middles, _START_M])
    way = around[2:] - around[:-2]
    headings = np.arctan2(way[:, 1], way[:, 0])
    openings = rng.uniform(*_OPENINGS_M, len(middles))
    return [Gate(m, float(h), float(o)) for m, h, o in zip(middles, headings, openings, strict=True)]


def _placed(gate: Gate, boxes: list[Box]) -> tuple[Box, ...]:
    """Return boxes of a gate's own frame (y where it is flown, the opening's middle at the origin) in the world."""
    R = rotation_z(gate.heading_rad - 0.5 * np.pi)
    return parts_of(Instance("gate"), [box.moved(R, gate.middle) for box in boxes])


def _square(rng: Random, gate: Gate, number: int, colour: Colour) -> tuple[Box, ...]:
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
    steel = partial(textures.plain, colour=fairground.STEEL)
    if legs > 0.02:
        for s in (-1.0, 1.0):
            foot = np.array([s * (half + bar), 0.0, 0.5 * legs - z])
            boxes.append(Box(foot, np.array([0.045, 0.045, 0.5 * legs]), steel, pixels_per_m=120.0))
    for s in (-1.0, 1.0):
        foot = np.array([s * (half + bar), 0.0, 0.02 - z])
        boxes.append(Box(foot, np.array([0.2, 0.32, 0.02]), steel, pixels_per_m=120.0))
    return _placed(gate, boxes)


def _arch(rng: Random, gate: Gate, number: int, colour: Colour) -> tuple[Box, ...]:
    """Return an inflated arch: two pillars, and segments of an arc over the opening."""
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
        # every other segment is slightly thinner, so that overlapping faces are not coplanar
        thick = bar - 0.004 * (k % 2) - 0.002
        boxes.append(Box(centre, np.array([along, thick, thick]), shown, shown, R=tangent, pixels_per_m=150.0))
    return _placed(gate, boxes)


def _beside(rng: Random, route: Array, gates: list[Gate]) -> list[Box]:
    """Return the objects along the course: flags and straw bales."""
    boxes: list[Box] = []
    taken = np.array([gate.middle[:2] for gate in gates])
    places, _ = outdoors.scattered(rng, _LOW[:2] + 1.2, _HIGH[:2] - 1.2, 240, np.full(240, 0.5), 1.3)
    away = outdoors.distance_to_legs(places, route)
    apart = np.linalg.norm(places[:, None] - taken, axis=2).min(axis=1)
    in_infield = np.all(np.abs(places) < _FREE_BOX_M[1, :2] + 0.9, axis=1)
    for place in places[(away > _LOOSE_M) & (apart > 2.6) & ~in_infield][:34]:
        at, R = np.array([*place, 0.0]), rotation_z(rng.uniform(0.0, 2.0 * np.pi))
        parts = fairground.flag(rng) if rng.random() < 0.5 else fairground.bales(rng)
        boxes += [box.moved(R, at) for box in parts]
    return boxes


def _trees(rng: Random, toward: Array) -> list[Vegetation]:
    """Return trees all around, behind everything else."""
    places, _ = outdoors.scattered(rng, (-48.0, -40.0), (48.0, 40.0), 420, np.full(420, 1.3), 0.6)
    outside = np.any(np.abs(places) > _FENCE_M + [9.5, 10.0], axis=1)
    trees = []
    for place in places[outside]:
        radius = rng.uniform(0.12, 0.24)
        trunk = rng.uniform(1.6, 2.6)
        plant = vegetation.tree(
            rng, radius, trunk + rng.uniform(4.5, 7.0), trunk - 0.6, int(rng.integers(4)), toward, 130
        )
        trees.append(plant.moved(np.eye(3), np.array([*place, -0.05])))
    return trees


def _crown(tree: Vegetation) -> Box:
    """Return an upright box a little smaller than a tree's crown."""
    corners = tree.leaves[0].corners.reshape(-1, 3)
    low, high = np.percentile(corners, [10.0, 90.0], axis=0)
    return Box(0.5 * (low + high), 0.5 * (high - low), _NOTHING)


def _pasture(
    rng: Random, height: int, width: int, colours: tuple[Colour, ...], casting: list[Box], toward: Array
) -> Image:
    """Return the texture of the grass around the field, with the shadows of trees."""
    return outdoors.shadowed(nature.distance(rng, height, width, colours), _PASTURE_PX_PER_M, casting, toward)


def _field(
    rng: Random, height: int, width: int, colour: Colour, gates: list[Gate], casting: list[Box], toward: Array
) -> Image:
    """Return the texture of the mown field: lines between the gates, the landing pad, and shadows."""
    image = nature.mown(nature.meadow(rng, height, width, colour, _FIELD_PX_PER_M), 2.0 * _FIELD_PX_PER_M)
    for gate in gates:
        _chalk(image, gate)
    outdoors.lay(image, pictures.landing_pad(round(_PAD_M * _FIELD_PX_PER_M)))
    return outdoors.shadowed(image, _FIELD_PX_PER_M, casting, toward)


def _chalk(image: Image, gate: Gate) -> None:
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


GATES = WorldBuilder("coloured gates on a field that are flown through in order", layout, layout_in_daylight=layout)
"""The race."""
