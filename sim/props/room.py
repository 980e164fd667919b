"""Furnished room: walls, windows, furniture and lamps, drawn from a seed."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import pictures, textures
from dronevio.sim.appearance.instances import Instance, single_instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Face, Paint, enclosure, parts_of
from dronevio.sim.appearance.textures import PIXELS_PER_M, Colour, Pattern
from dronevio.sim.props.furniture import FURNITURE, METAL, WOODS, Piece, hung_picture, pick, room_door, window

Random = np.random.Generator

SIZE_M = np.array([8.0, 6.0, 3.5])
"""(3,) Length (x), width (y) and height (z) of the room [m]; the origin is the centre of the floor."""
FREE_BOX_M = np.array([[-2.8, -1.9, 0.0], [2.8, 1.9, 2.4]])
"""(2, 3) Corners of the space free of obstacles [m]."""
PAD_SIZE_M = 0.8
"""Side of the landing pad at the origin [m]."""

_WALLS = ("south", "east", "north", "west")
_USABLE_M = {"south": 7.8, "east": 3.7, "north": 7.8, "west": 3.7}  # the long walls include the corners
_TURNS = {"south": 0.0, "east": 0.5 * np.pi, "north": np.pi, "west": -0.5 * np.pi}
_WALL_COLOURS: tuple[Colour, ...] = (
    (188, 178, 152),
    (158, 176, 166),
    (182, 164, 146),
    (164, 170, 186),
    (194, 172, 136),
)
_WALL_PATTERNS: tuple[Pattern, ...] = (
    textures.wallpaper,
    textures.stripes,
    textures.plaster,
)
_BRICK: Colour = (150, 84, 64)
_BOARDS: Colour = (206, 192, 166)
_PICTURE_CHANCE = 0.85


@dataclass(frozen=True, eq=False)
class Room:
    """A furnished room."""

    shell: tuple[Face, ...]
    """Floor, ceiling and walls."""
    boxes: tuple[Box, ...]
    """Boxes of furniture, pictures, lamps and beams."""
    obstacles: tuple[Box, ...]
    """Collision boxes, one around each piece of furniture."""
    lights: tuple[AreaLight, ...]
    """Area lights of the room."""


def furnished_room(rng: Random) -> Room:
    """Draw a room with furniture along the walls; its middle (`FREE_BOX_M`) is free to fly in."""
    placed: list[Piece] = []
    obstacles: list[Box] = []
    for wall, pieces in _assign(rng).items():
        R = rotation_z(_TURNS[wall])
        to_wall = 0.5 * np.abs(R @ SIZE_M)[1]
        for piece, along in _spread(rng, pieces, _USABLE_M[wall]):
            position = R @ np.array([along, -to_wall, 0.0])
            placed.append(piece.moved(R, position))
            if piece.height_m > 0.0:
                obstacles.append(piece.hull().moved(R, position))
            if piece.picture_above and rng.random() < _PICTURE_CHANCE:
                placed.append(hung_picture(rng, max(piece.height_m + 0.5, 1.65)).moved(R, position))
    placed += [_pendant(rng, x) for x in (-2.0, 0.0, 2.0)]
    boxes = [box for piece in placed for box in piece.boxes]
    lights = [light for piece in placed for light in piece.lights]
    return Room(_shell(rng), (*boxes, *_woodwork(rng)), tuple(obstacles), tuple(lights))


def _assign(rng: Random) -> dict[str, list[Piece]]:
    """Return the pieces of furniture of each wall."""
    bright = str(rng.choice(["south", "north"]))
    walls: dict[str, list[Piece]] = {wall: [] for wall in _WALLS}
    walls[bright] = [window(rng), window(rng)]
    walls[str(rng.choice([wall for wall in _WALLS if wall != bright]))].append(room_door(rng))
    pieces = [make(rng) for make in FURNITURE]
    order = np.argsort([-piece.width_m + rng.uniform(0.0, 0.8) for piece in pieces])  # the widest first, roughly
    for index in order:
        room_left = [_USABLE_M[wall] - sum(p.width_m for p in walls[wall]) for wall in _WALLS]
        fits = [wall for wall, left in zip(_WALLS, room_left, strict=True) if left > pieces[index].width_m]
        if fits:
            walls[str(rng.choice(fits))].append(pieces[index])
    return walls


def _spread(rng: Random, pieces: list[Piece], length_m: float) -> list[tuple[Piece, float]]:
    """Return shuffled pieces, each with the position of its centre along the wall [m]."""
    shuffled = [pieces[i] for i in rng.permutation(len(pieces))]
    widths = np.array([piece.width_m for piece in shuffled])
    gaps = rng.dirichlet(np.full(len(shuffled) + 1, 3.0)) * (length_m - widths.sum())
    starts = -0.5 * length_m + np.cumsum(gaps[:-1]) + np.concatenate([[0.0], np.cumsum(widths)[:-1]])
    return list(zip(shuffled, (starts + 0.5 * widths).tolist(), strict=True))


def _shell(rng: Random) -> tuple[Face, ...]:
    """Return floor, ceiling and walls, seen from inside."""
    x, y, z = np.diag(SIZE_M)
    corner = -0.5 * (x + y)
    walls: list[Paint] = [partial(pattern, colour=pick(rng, _WALL_COLOURS)) for pattern in _WALL_PATTERNS]
    walls.append(partial(textures.bricks, colour=textures.vary(rng, _BRICK, 0.1)))
    paints = [walls[int(i)] for i in rng.permutation(4)]
    boards = partial(textures.planks, colour=_BOARDS, plank_m=0.2)
    faces = (
        Face(corner + y, x, -y, partial(_floor, colour=pick(rng, WOODS))),
        Face(corner + z, x, y, boards),
        Face(corner + x + z, -x, -z, paints[0]),
        Face(corner + x + y + z, -y, -z, paints[1]),
        Face(corner + y + z, x, -z, paints[2]),
        Face(corner + z, y, -z, paints[3]),
    )
    return enclosure(faces)


def _floor(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return the floor: boards or parquet, a rug in the middle, the landing pad on it."""
    pattern = textures.planks if rng.random() < 0.5 else textures.parquet
    image = pattern(rng, height, width, colour)
    cloth = ((150, 52, 44), (52, 78, 120), (70, 96, 70), (150, 110, 60))[int(rng.integers(4))]
    rug_h, rug_w = (int(v * PIXELS_PER_M) for v in (rng.uniform(2.0, 2.6), rng.uniform(3.0, 3.8)))
    _paste(image, textures.rug(rng, rug_h, rug_w, cloth))
    _paste(image, pictures.landing_pad(int(PAD_SIZE_M * PIXELS_PER_M)))
    return image


def _paste(image: Image, patch: Image) -> None:
    """Put a patch on the middle of an image."""
    top, left = (image.shape[0] - patch.shape[0]) // 2, (image.shape[1] - patch.shape[1]) // 2
    image[top : top + patch.shape[0], left : left + patch.shape[1]] = patch


@single_instance
def _pendant(rng: Random, x: float) -> Piece:
    """Return a lamp that hangs from the ceiling."""
    height = rng.uniform(2.75, 2.95)
    shade = partial(textures.lampshade, colour=(240, 224, 190))
    metal = partial(textures.plain, colour=METAL)
    bulb = np.array([x, rng.uniform(-0.5, 0.5), height])
    cord = 0.5 * (SIZE_M[2] - height)
    boxes = (
        Box(bulb, np.array([0.21, 0.21, 0.12]), shade, R=rotation_z(rng.uniform(0.0, 1.5)), glow=0.95),
        Box(bulb + np.array([0.0, 0.0, cord]), np.array([0.012, 0.012, cord]), metal),
    )
    ends = np.array([[0.1, 0.1, 0.0], [-0.1, -0.1, 0.0]])
    return Piece(boxes, 0.42, 0.42, 0.0, lights=(AreaLight(bulb + ends, 1.0),))


def _woodwork(rng: Random) -> tuple[Box, ...]:
    """Return beams under the ceiling, skirting boards and a picture rail."""
    x, y, z = 0.5 * SIZE_M[0], 0.5 * SIZE_M[1], SIZE_M[2]
    dark = partial(textures.wood, colour=pick(rng, WOODS))
    boxes = [Box(np.array([bx, 0.0, z - 0.09]), np.array([0.08, y, 0.09]), dark) for bx in np.linspace(-3.2, 3.2, 5)]
    white = partial(textures.wood, colour=(206, 200, 186))
    for height, half in ((0.05, 0.05), (2.62, 0.03)):
        for s in (-1.0, 1.0):
            boxes.append(Box(np.array([0.0, s * (y - 0.008), height]), np.array([x, 0.008, half]), white))
            boxes.append(Box(np.array([s * (x - 0.008), 0.0, height]), np.array([0.008, y - 0.016, half]), white))
    return parts_of(Instance("woodwork"), boxes)
