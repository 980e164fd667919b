"""Construction of the simulated worlds: geometry, textures and lighting, drawn from a seed."""

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import unknown_name
from dronevio.models.scenery import Scenery, TexturedMesh
from dronevio.sim.appearance.lightmap import bake, daylight
from dronevio.sim.appearance.scenery import paint_pages, painted
from dronevio.sim.paths.space import FlightArea, Space
from dronevio.sim.streams import generator
from dronevio.sim.worlds.assembly import (
    Appearance,
    add_collision_geoms,
    add_moving_geoms,
    assembled,
    assembled_instances,
    instance_quads,
    outline_of,
    seen_surfaces,
    solid_space_of,
    space_of,
)
from dronevio.sim.worlds.corridor import CORRIDOR
from dronevio.sim.worlds.dark import DARK
from dronevio.sim.worlds.drawn_scenery import MAX_PIXELS, cut_pages, drawn_mirror, drawn_pages
from dronevio.sim.worlds.forest import FOREST
from dronevio.sim.worlds.gates import GATES
from dronevio.sim.worlds.hall import HALL
from dronevio.sim.worlds.layout import Layout, Poses, WorldBuilder
from dronevio.sim.worlds.lighting import drawn_layout
from dronevio.sim.worlds.low_texture import LOW_TEXTURE
from dronevio.sim.worlds.mirror import MIRROR
from dronevio.sim.worlds.moving import MOVING
from dronevio.sim.worlds.office import OFFICE, OFFICE_GLASS, OFFICE_NARROW, OFFICE_WHITE
from dronevio.sim.worlds.own.names import FORMS, is_file, is_python, recorded_world
from dronevio.sim.worlds.own.own_worlds import builder_of, complete_name
from dronevio.sim.worlds.repetitive import REPETITIVE
from dronevio.sim.worlds.room import ROOM
from dronevio.sim.worlds.warehouse import WAREHOUSE

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
    "office": OFFICE,
    "office-narrow": OFFICE_NARROW,
    "office-white": OFFICE_WHITE,
    "office-glass": OFFICE_GLASS,
}
"""Builders of the worlds of the package by name. Wherever a name is accepted, so is a world of one's own; see
`resolved_world`."""

_MOVING_PAGE_PX = 1024


@dataclass(frozen=True, eq=False)
class Mover:
    """An object of a world that moves along a path that does not depend on the flight."""

    body: str
    """Name of its mocap body in the specification of the world."""
    poses: Poses
    """Function from times (M,) since the start of the flight [s] to poses T_world_body (M, 4, 4)."""


@dataclass(frozen=True, eq=False)
class World:
    """A world without the drone."""

    name: str
    """Name of the world as `resolved_world` returns it."""
    seed: int
    """Seed of its layout and textures."""
    spec: mujoco.MjSpec
    """Specification to compile, or to attach a drone to: visible geoms in group 0, collision geoms in group 3."""
    outline: Array
    """(L, 2, 3) Line segments of walls and furniture for wireframe drawings [m]."""
    free_box: Array
    """(2, 3) Lower and upper corner of a space free of obstacles [m]; the landing pad is below its centre."""
    space: Space
    """Bounds and obstacles for path planning."""
    pad: Array
    """(3,) Centre of the landing pad on the floor [m]."""
    route: Array
    """(R, 3) Closed tour through the whole world that starts above the landing pad [m]; its straight legs keep 0.6 m of
    clearance."""
    illumination: float = 1.0
    """Illumination relative to a well-lit room; at 1, images are exposed as the textures are painted."""
    movers: tuple[Mover, ...] = ()
    """Moving objects of the world."""


def build_world(
    name: str,
    seed: int,
    texture_seed: int | None = None,
    texture_reduction: int = 1,
    light_seed: int | None = None,
) -> World:
    """Build a world from its name and seed.

    Args:
        name: A key of `WORLDS`, or a world of one's own, see `resolved_world`.
        seed: Seed of layout, textures and light; the same seed gives the same bytes.
        texture_seed: Seed of the textures, by default that of the world. The layout, and with it the colours of the
            objects, does not depend on it.
        texture_reduction: Factor by which the textures are smaller along each axis, at most the gutter between
            textures. A reduced world takes less memory, and suits small images.
        light_seed: Seed of other light, by default the light that belongs to the layout.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    name = resolved_world(name)
    layout, appearance = _painted(name, seed, seed if texture_seed is None else texture_seed, light_seed)
    spec = assembled(layout, appearance if texture_reduction == 1 else appearance.reduced(texture_reduction))
    spec.modelname = f"{recorded_world(name)}-{seed}"
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
        _movers(layout),
    )


def resolved_world(name: str) -> str:
    """Return a name that identifies a world also in other processes, and after its file has changed.

    Args:
        name: A key of `WORLDS`; a file of one's own in YAML or MJCF (``yard.yaml``, ``yard.xml``); or a `WorldBuilder`
            in a Python module (``python:package.module:NAME``).

    Returns:
        The name; that of a world of one's own has the absolute path of the file, and a hash of its content.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    if name in WORLDS:
        return name
    if not (is_file(name) or is_python(name)):
        raise unknown_name("world", name, (*WORLDS, *FORMS))
    return complete_name(name)


def world_builder(name: str) -> WorldBuilder:
    """Return the builder of a world: its description, its difficulty, and the function that draws its layout.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    name = resolved_world(name)
    return WORLDS[name] if name in WORLDS else builder_of(name)


def _layout(name: str, seed: int) -> Layout:
    """Return the layout of a world in its own light, which several functions of this module need one after another.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    return _resolved_layout(resolved_world(name), seed)


@lru_cache(maxsize=4)
def _resolved_layout(name: str, seed: int) -> Layout:
    """Return the layout of a world with a resolved name."""
    return world_builder(name).layout(_generators(seed)[0])


def flight_area(name: str, seed: int) -> FlightArea:
    """Return what a path planner needs of a world, without painting its textures, which takes seconds.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    return _resolved_flight_area(resolved_world(name), seed)


@lru_cache(maxsize=8)
def _resolved_flight_area(name: str, seed: int) -> FlightArea:
    """Return what a path planner needs of a world with a resolved name."""
    layout = _resolved_layout(name, seed)
    return FlightArea(space_of(layout), layout.free_box, layout.pad, layout.route, layout.gates)


def illumination_and_movers(name: str, seed: int, light_seed: int | None = None) -> tuple[float, tuple[Mover, ...]]:
    """Return the illumination and the moving objects of a world, without painting its textures.

    Args:
        name: Name of the world.
        seed: Seed of the layout.
        light_seed: Seed of other light, by default the light that belongs to the layout.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    if light_seed is None:
        layout = _layout(name, seed)
    else:
        layout = drawn_layout(world_builder(name), _generators(seed)[0], _light(light_seed))
    return layout.illumination, _movers(layout)


def collision_spec(name: str, seed: int) -> mujoco.MjSpec:
    """Return the collision geoms of a world, without visible geometry and without painting textures.

    Moving objects are on mocap bodies of the same names as in `build_world`, at their poses at the start of a flight.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    spec, layout = mujoco.MjSpec(), _layout(name, seed)
    add_collision_geoms(spec, layout)
    add_moving_geoms(spec, layout)
    return spec


def solid_space(name: str, seed: int) -> Space:
    """Return the bounds and the static solids of a world: its clearance is the distance of points to what collides.

    In contrast to the space of `flight_area`, furniture is not one box, and the lanes of moving objects are free.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    return _resolved_solid_space(resolved_world(name), seed)


@lru_cache(maxsize=8)
def _resolved_solid_space(name: str, seed: int) -> Space:
    """Return the bounds and the static solids of a world with a resolved name."""
    return solid_space_of(_resolved_layout(name, seed))


def instance_spec(name: str, seed: int) -> mujoco.MjSpec:
    """Return the visible geometry of a world as one geom per object instance, without textures.

    Each geom bears the name of its instance: ``floor``, ``sofa``, ``tree_12``. The same seed gives the same instances
    in the same order. Moving objects are on bodies of the same names as in `build_world`.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    return assembled_instances(_layout(name, seed))


def visible_quads(name: str, seed: int) -> dict[str, Array]:
    """Return the visible static surfaces of a world: the quadrangles (F, 4, 3) of each instance by its name [m].

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    return instance_quads(_layout(name, seed))


def scenery_of(name: str, seed: int, light_seed: int | None = None) -> Scenery:
    """Return the visible surroundings of a world for drawings, with smaller textures.

    Args:
        name: Name of the world.
        seed: Seed of layout, textures and light.
        light_seed: Seed of other light, by default the light that belongs to the layout.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    layout, appearance = _painted(resolved_world(name), seed, seed, light_seed)
    foliage = len(layout.prints)
    cut = cut_pages(appearance.pages[:foliage], layout.low, layout.high)
    meshes = drawn_pages([*(page for page in cut if len(page.vertices)), *appearance.pages[foliage:]])
    if layout.mirror is not None and appearance.mirror is not None:
        meshes = (*meshes, drawn_mirror(layout.mirror, appearance.mirror))
    return Scenery(outline_of(layout), meshes)


def moving_scenery(
    name: str, seed: int, light_seed: int | None = None
) -> tuple[tuple[Mover, tuple[TexturedMesh, ...]], ...]:
    """Return the moving objects of a world, each with its surfaces in the frame of its body.

    Args:
        name: Name of the world.
        seed: Seed of layout, textures and light.
        light_seed: Seed of other light, by default the light that belongs to the layout.

    Raises:
        ConfigError: The world is unknown, or its file is damaged.
    """
    layout, appearance = _painted(resolved_world(name), seed, seed, light_seed)
    surfaces = (drawn_pages(pages, MAX_PIXELS // 10) for pages in appearance.moving_pages)
    return tuple(zip(_movers(layout), surfaces, strict=True))


def _movers(layout: Layout) -> tuple[Mover, ...]:
    """Return the moving objects of a layout."""
    return tuple(Mover(thing.name, thing.poses) for thing in layout.moving)


@lru_cache(maxsize=2)
def _painted(name: str, seed: int, texture_seed: int, light_seed: int | None = None) -> tuple[Layout, Appearance]:
    """Return layout and appearance of a world; cached, since painting takes seconds."""
    drawing, paint = _generators(seed)[0], _generators(texture_seed)[1]
    layout = drawn_layout(world_builder(name), drawing, _light(light_seed))
    surfaces = seen_surfaces(layout)
    standing = len(surfaces) - (layout.mirror is not None)
    faces, floor = surfaces[:standing], surfaces[standing:]
    shading = layout.shading
    if shading is None:
        shading = tuple(box for box in layout.boxes if box.glow == 0.0)
    light = bake(surfaces, shading, layout.lights, layout.scattered)
    pages = paint_pages(faces, light[: len(faces)], paint)
    pages = [shared.page(paint) for shared in layout.prints] + pages  # near to far
    reflecting = [painted(face, light[-1], paint) for face in floor]
    moving_pages = []
    for thing in layout.moving:
        sides = [face for box in thing.boxes for face in box.faces()]
        moving_pages.append(paint_pages(sides, daylight(sides), paint, _MOVING_PAGE_PX))
    return layout, Appearance(pages, moving_pages, reflecting[0] if reflecting else None)


def _generators(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Return the random generators of layout and textures."""
    return generator(seed, "layout"), generator(seed, "paint")


def _light(seed: int | None) -> np.random.Generator | None:
    """Return the random generator of other light; None for the light that belongs to the layout."""
    return None if seed is None else generator(seed, "light")
