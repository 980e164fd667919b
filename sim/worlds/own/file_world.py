"""Worlds from descriptions: their layouts, with floor, walls or sky, obstacles, light, free box and route."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.errors import ConfigError, InputError
from dronevio.sim.appearance import textures_nature
from dronevio.sim.appearance.cutouts import Cutouts, Print
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Paint, Sheet, Surface
from dronevio.sim.appearance.textures import scaled
from dronevio.sim.props.building import ceiling_lamp, hall_faces, landing_mat
from dronevio.sim.worlds import outdoors
from dronevio.sim.worlds.assembly import solid_space_of
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M, Layout, WorldBuilder
from dronevio.sim.worlds.own.bodies import Body
from dronevio.sim.worlds.own.description import Description
from dronevio.sim.worlds.own.flight_space import found_free_box, found_route, route_clearance
from dronevio.sim.worlds.own.looks import LARGEST_SIDE_PX, TEXTURES, Look
from dronevio.sim.worlds.own.placement import placed_obstacles

MOST_SOLIDS = 20_000
"""Largest number of boxes that are solid."""
MOST_QUADS = 500_000
"""Largest number of quadrangles of meshes."""

Random = np.random.Generator

_GROUND_PIXELS, _OBSTACLE_PIXELS = 14e6, 20e6  # of all textures of floor and walls, and of obstacles
_LARGEST_PPM = 160.0
_AROUND_M = 3.0  # ground beyond the bounds with the same texture
_BEYOND_M = 40.0
_BEYOND_PPM = 16.0
_LAMP_SPACING_M, _MOST_LAMPS = 4.0, 4  # along each axis


def file_world(description: Description) -> WorldBuilder:
    """Return the builder of a described world."""
    world = FileWorld(description)
    return WorldBuilder(
        description.text, world.layout, layout_in_daylight=world.layout if description.outdoors else None
    )


@dataclass(frozen=True, eq=False)
class FileWorld:
    """A described world, which draws its layouts."""

    description: Description
    """Its description."""

    def layout(self, rng: Random, light: Random | None = None) -> Layout:
        """Draw the layout.

        Args:
            rng: Generator of the scattered obstacles, and of sun and weather.
            light: Generator of sun and weather; the first one by default.

        Raises:
            ConfigError: The obstacles do not fit, or leave no space to fly; the message names file and field.
        """
        described = self.description
        weather, toward = outdoors.daylight(rng)
        if light is not None:
            weather, toward = outdoors.daylight(light)
        try:
            bodies = self._bodies(rng)
        except InputError as error:
            raise ConfigError(str(error)) from None
        lamps: list[Box] = []
        if described.outdoors:
            shell, lights = self._ground(weather), [outdoors.sunlight(toward)]
        else:
            shell, lamps, lights = self._walls()
        core = tuple(box for body in bodies for box in body.core)
        mat = landing_mat(described.pad_m)
        layout = Layout(
            low=described.low.copy(),
            high=described.high.copy(),
            shell=(*shell, *(sheet for body in bodies for sheet in body.sheets)),
            boxes=(*(box for body in bodies for box in body.boxes), *lamps, mat),
            obstacles=core,
            lights=tuple(lights),
            pad=described.pad_m.copy(),
            free_box=np.zeros((2, 3)),
            route=np.zeros((1, 3)),
            walled=not described.outdoors,
            shading=core,
            filling=tuple(box for body in bodies for box in body.filling),
            prints=_prints(bodies),
        )
        return replace(layout, free_box=self._free_box(layout), route=self._route(layout, rng))

    def _bodies(self, rng: Random) -> list[Body]:
        """Return all bodies at their places.

        Raises:
            InputError: They do not fit, or are too many.
        """
        described = self.description
        placed = placed_obstacles(described, rng)
        model = described.model
        halves = [one.hull.half for one in placed]
        if model is not None:
            boxes = [model.box_of(geom) for geom in model.geoms if geom.kind != "plane"]
            halves += [0.5 * (high - low) for low, high in boxes]
        area = sum(float(8.0 * (x * y + y * z + z * x)) for x, y, z in halves)
        ppm = min(_LARGEST_PPM, float(np.sqrt(_OBSTACLE_PIXELS / max(area, 1e-6))))
        bodies = [one.body(ppm) for one in placed]
        if model is not None:
            bodies += model.bodies(float(described.low[2]), ppm)
        solids = sum(len(body.solids) for body in bodies)
        if solids > MOST_SOLIDS:
            raise InputError(described.path, f"obstacles of {solids} solid boxes", f"at most {MOST_SOLIDS}")
        cutouts = [part for body in bodies for shared in body.prints for part in shared.cutouts]
        cutouts += [part for body in bodies for _, part in body.pasted]
        quads = sum(len(part.corners) for part in cutouts)
        if quads > MOST_QUADS:
            raise InputError(described.path, f"meshes of {quads} triangles in all", f"at most {MOST_QUADS}")
        return bodies

    def _ground(self, weather: outdoors.Weather) -> list[Surface]:
        """Return ground and sky."""
        described = self.description
        low, high, z = described.low[:2] - _AROUND_M, described.high[:2] + _AROUND_M, float(described.low[2])
        ppm = _resolution(high - low)
        floor = Instance("floor")
        ground = Sheet(
            outdoors.flat(tuple(low), tuple(high), z), described.floor.paint(ppm), pixels_per_m=ppm, instance=floor
        )
        wide_low, wide_high = low - _BEYOND_M, high + _BEYOND_M
        colour = TEXTURES["grass"].colour
        tones = tuple(scaled(colour, factor) for factor in (0.7, 0.8, 0.9))

        def pasture(rng: Random, height: int, width: int) -> Image:
            return textures_nature.distance(rng, height, width, tones)

        far_ppm = min(_BEYOND_PPM, LARGEST_SIDE_PX / float((wide_high - wide_low).max()))
        beyond = Sheet(outdoors.flat(tuple(wide_low), tuple(wide_high), z - 0.04), pasture, 0.0, far_ppm, floor)
        middle = np.array([*(0.5 * (low + high)), z])
        radius = max(80.0, float(np.linalg.norm(wide_high - wide_low)) * 0.5)
        sky = outdoors.sky(weather, radius)
        return [ground, beyond, replace(sky, grid=sky.grid + middle)]

    def _walls(self) -> tuple[list[Surface], list[Box], list[AreaLight]]:
        """Return floor, ceiling and walls, and the lamps with their lights."""
        described = self.description
        low, high = described.low, described.high
        length, width, height = (high - low).tolist()
        floor_ppm = _resolution(np.array([length, width]))
        wall_ppm = _resolution(np.array([2.0 * (length + width), height]), longest=max(length, width, height))
        wall = described.walls.paint(wall_ppm)
        faces = hall_faces(
            low,
            high,
            described.floor.paint(floor_ppm),
            described.ceiling.paint(0.5 * floor_ppm),
            [wall] * 4,
            (floor_ppm, wall_ppm, 0.5 * floor_ppm),
        )
        counts = [int(np.clip(round(side / _LAMP_SPACING_M), 1, _MOST_LAMPS)) for side in (length, width)]
        pieces = [
            ceiling_lamp(np.array([x, y, high[2]]), (0.9, 0.3), 3.0)
            for x in low[0] + length * (np.arange(counts[0]) + 0.5) / counts[0]
            for y in low[1] + width * (np.arange(counts[1]) + 0.5) / counts[1]
        ]
        lamps = [box for piece in pieces for box in piece.boxes]
        return list(faces), lamps, [light for piece in pieces for light in piece.lights]

    def _free_box(self, layout: Layout) -> Array:
        """Return the given free box, or one that is found.

        Raises:
            ConfigError: It is not free, or there is none.
        """
        given, where = self.description.free_box_m, self.description.path
        if given is None:
            found = found_free_box(layout.low, layout.high, layout.pad, layout.solids)
            if found is None:
                raise ConfigError(
                    f"{where}: pad_m: the space above the landing pad at {_text(layout.pad[:2])} m is too narrow;"
                    " expected 0.9 m to each side and 2.1 m above it without obstacles"
                )
            return found
        if np.any(np.abs(given.mean(axis=0) - layout.pad)[:2] > 0.01):
            raise ConfigError(
                f"{where}: free_box_m: the centre {_text(given.mean(axis=0)[:2])} m; expected it above the landing pad"
                f" at {_text(layout.pad[:2])} m"
            )
        axes = [np.linspace(a, b, int(np.clip((b - a) / 0.2, 2, 40))) for a, b in zip(*given, strict=True)]
        points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        clearance = solid_space_of(layout).clearance(points)
        worst = int(clearance.argmin())
        if clearance[worst] < -1e-9:
            raise ConfigError(
                f"{where}: free_box_m: {_text(points[worst])} m is not free; expected a box without obstacles"
            )
        return given.copy()

    def _route(self, layout: Layout, rng: Random) -> Array:
        """Return the given route, or one that is found.

        Raises:
            ConfigError: It has too little clearance, or there is none.
        """
        given, where, space = self.description.route_m, self.description.path, solid_space_of(layout)
        if given is None:
            found = found_route(space, layout.pad, rng)
            if found is None:
                raise ConfigError(
                    f"{where}: no closed tour from above the landing pad with {ROUTE_CLEARANCE_M:g} m of clearance;"
                    " expected more space between the obstacles, or a tour in route_m"
                )
            return found
        if np.linalg.norm(given[0, :2] - layout.pad[:2]) > 0.01:
            raise ConfigError(
                f"{where}: route_m: the first point {_text(given[0])} m; expected it above the landing pad at"
                f" {_text(layout.pad[:2])} m"
            )
        clearance = route_clearance(space, given)
        if clearance < ROUTE_CLEARANCE_M:
            raise ConfigError(
                f"{where}: route_m: {clearance:.2f} m of clearance; expected at least {ROUTE_CLEARANCE_M:g} m on all"
                " legs, that from the last to the first point included"
            )
        return given.copy()


def _prints(bodies: Sequence[Body]) -> tuple[Print, ...]:
    """Return the surfaces with shared textures: one for each image."""
    by_image: dict[int, tuple[Look, list[Cutouts]]] = {}
    for look, cutouts in (part for body in bodies for part in body.pasted):
        by_image.setdefault(id(look.image), (look, []))[1].append(cutouts)
    pasted = []
    for look, parts in by_image.values():
        assert look.image is not None
        stretched: Paint = replace(look, repeat_m=None).paint(1.0)
        pasted.append(Print(stretched, look.image.shape[0], look.image.shape[1], tuple(parts)))
    return (*(shared for body in bodies for shared in body.prints), *pasted)


def _resolution(size_m: Array, longest: float | None = None) -> float:
    """Return the resolution of a large surface (2,) [px/m]."""
    return min(
        _LARGEST_PPM,
        LARGEST_SIDE_PX / (float(size_m.max()) if longest is None else longest),
        float(np.sqrt(_GROUND_PIXELS / np.prod(size_m))),
    )


def _text(numbers: Array) -> str:
    """Return numbers as text."""
    return str(np.round(numbers, 2).tolist())
