"""Worlds to fly in: textured, lit, drawn from a seed."""

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.sim.appearance.lightmap import bake, daylight
from dronevio.sim.appearance.scenery import paint_pages, painted
from dronevio.sim.paths.space import FlightArea, Space
from dronevio.sim.streams import generator
from dronevio.sim.worlds.assembly import (
    Appearance,
    add_collision_geoms,
    assembled,
    assembled_instances,
    outline_of,
    seen_surfaces,
    space_of,
)
from dronevio.sim.worlds.corridor import CORRIDOR
from dronevio.sim.worlds.dark import DARK
from dronevio.sim.worlds.forest import FOREST
from dronevio.sim.worlds.gates import GATES
from dronevio.sim.worlds.hall import HALL
from dronevio.sim.worlds.layout import Layout, Poses, WorldBuilder
from dronevio.sim.worlds.low_texture import LOW_TEXTURE
from dronevio.sim.worlds.mirror import MIRROR
from dronevio.sim.worlds.moving import MOVING
from dronevio.sim.worlds.repetitive import REPETITIVE
from dronevio.sim.worlds.room import ROOM
from dronevio.sim.worlds.warehouse import WAREHOUSE

Array = npt.NDArray[np.float64]

WORLDS: dict[str, WorldBuilder] = {
    "room": ROOM,
    "corridor": CORRIDOR,
    "warehouse": WAREHOUSE,
    "hall": HALL,
    "forest": FOREST,
    "gates": GATES,
    "low-texture": LOW_TEXTURE,
    "repetitive": REPETITIVE,
    "dark": DARK,
    "mirror": MIRROR,
    "moving": MOVING,
}
"""The worlds that `build_world` knows, by name."""

_MOVING_PAGE_PX = 1024


@dataclass(frozen=True, eq=False)
class Mover:
    """Something in a world that moves by itself, along a path that is known beforehand."""

    body: str
    """Name of its mocap body in the world's spec."""
    poses: Poses
    """Maps times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world."""


@dataclass(frozen=True, eq=False)
class World:
    """A place without the drone."""

    name: str
    """What it is called."""
    seed: int
    """What it was drawn from."""
    spec: mujoco.MjSpec
    """Static geometry, to compile or to attach a drone to: what is seen (group 0) and what is touched (group 3)."""
    outline: Array
    """(L, 2, 3) Line segments of the walls and the furniture, for drawing [m]."""
    free_box: Array
    """(2, 3) Least and greatest corner of the space free of obstacles [m]; the pad is under its middle."""
    space: Space
    """Shell and obstacles: where a drone may fly."""
    pad: Array
    """(3,) Middle of the landing pad, on the floor [m]."""
    route: Array
    """(R, 3) A tour through the whole world [m]: from above the pad, the straight legs between its points, and the one
    from the last back to the first, keep 0.6 m clear of every surface."""
    illumination: float = 1.0
    """Light that falls in, relative to a well lit room; the images of 1 are exposed as painted."""
    movers: tuple[Mover, ...] = ()
    """What moves."""


def build_world(name: str, seed: int) -> World:
    """Build a world.

    Args:
        name: One of `WORLDS`.
        seed: Draws the layout, the patterns and the light; the same seed gives the same bytes.

    Raises:
        ConfigError: There is no such world.
    """
    _require(name)
    layout, appearance = _painted(name, seed)
    spec = assembled(layout, appearance)
    spec.modelname = f"{name}-{seed}"
    return World(
        name,
        seed,
        spec,
        outline_of(layout),
        layout.free_box.copy(),
        space_of(layout),
        layout.pad.copy(),
        layout.route.copy(),
        layout.illumination,
        tuple(Mover(thing.name, thing.poses) for thing in layout.moving),
    )


@lru_cache(maxsize=8)
def flight_area(name: str, seed: int) -> FlightArea:
    """Return where one may fly in a world: what `build_world` says of it, without the seconds of painting.

    Raises:
        ConfigError: There is no such world.
    """
    _require(name)
    layout = WORLDS[name].layout(_generators(seed)[0])
    return FlightArea(space_of(layout), layout.free_box, layout.pad, layout.route)


def collision_spec(name: str, seed: int) -> mujoco.MjSpec:
    """Return what a drone can touch of a world, and nothing that is only seen, without the seconds of painting.

    Raises:
        ConfigError: There is no such world.
    """
    _require(name)
    spec = mujoco.MjSpec()
    add_collision_geoms(spec, WORLDS[name].layout(_generators(seed)[0]))
    return spec


def instance_spec(name: str, seed: int) -> mujoco.MjSpec:
    """Return what is seen of a world without its paint, so without the seconds of painting.

    Each thing is one geom, and its name says what it is: ``floor``, ``sofa``, ``tree_12``. The same seed gives the same
    things in the same order. What moves is on bodies of the same names as in `build_world`.

    Raises:
        ConfigError: There is no such world.
    """
    _require(name)
    return assembled_instances(WORLDS[name].layout(_generators(seed)[0]))


def _require(name: str) -> None:
    """Raise ConfigError unless there is a world of that name."""
    if name not in WORLDS:
        raise ConfigError(f"unknown world {name!r}; expected one of {', '.join(WORLDS)}")


@lru_cache(maxsize=2)
def _painted(name: str, seed: int) -> tuple[Layout, Appearance]:
    """Return the layout of a world and what it appearance like; kept, since painting takes a second or two."""
    drawing, paint = _generators(seed)
    layout = WORLDS[name].layout(drawing)
    surfaces = seen_surfaces(layout)
    standing = len(surfaces) - (layout.mirror is not None)
    faces, floor = surfaces[:standing], surfaces[standing:]
    shading = layout.shading
    if shading is None:
        shading = tuple(box for box in layout.boxes if box.glow == 0.0)
    light = bake(surfaces, shading, layout.lights)
    pages = paint_pages(faces, light[: len(faces)], paint)
    pages = [shared.page(paint) for shared in layout.prints] + pages  # near things first: they hide what is behind
    reflecting = [painted(face, light[-1], paint) for face in floor]
    moving_pages = []
    for thing in layout.moving:
        sides = [face for box in thing.boxes for face in box.faces()]
        moving_pages.append(paint_pages(sides, daylight(sides), paint, _MOVING_PAGE_PX))
    return layout, Appearance(pages, moving_pages, reflecting[0] if reflecting else None)


def _generators(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Return the random numbers of the layout and of the paint."""
    return generator(seed, "layout"), generator(seed, "paint")
