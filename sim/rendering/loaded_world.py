"""Loaded worlds: compiled worlds in graphics memory, which the environments of a process share."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import mujoco

from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.rendering.shared import Lease, SharedPool
from dronevio.sim.rendering.world_files import compiled
from dronevio.sim.world import Mover, build_world, illumination_and_movers, instance_spec, resolved_world
from dronevio.sim.worlds.own.names import is_file, is_python


@dataclass(frozen=True)
class WorldKey:
    """The arguments of `build_world` that determine a loaded world."""

    name: str
    """Name of the world."""
    seed: int
    """Seed of its layout."""
    texture_seed: int
    """Seed of its textures."""
    texture_reduction: int = 1
    """Factor by which its textures are smaller along each axis; if it is not 1, mipmaps are not blended."""
    light_seed: int | None = None
    """Seed of other light; None for the light that belongs to the layout."""


@dataclass(frozen=True, eq=False)
class LoadedWorld:
    """A world in graphics memory."""

    model: mujoco.MjModel
    """The compiled world."""
    illumination: float
    """Illumination relative to a well-lit world."""
    movers: tuple[Mover, ...]
    """Its moving objects."""
    context: RenderContext
    """Its graphics memory."""

    def usable(self) -> bool:
        """Return whether the graphics memory is neither released nor lost."""
        return self.context.usable()

    def close(self) -> None:
        """Release the graphics memory."""
        self.context.close()


LOADED_WORLDS: SharedPool[LoadedWorld] = SharedPool()
"""All loaded worlds of this process."""


def lease_world(key: WorldKey, grey: bool = False) -> Lease[LoadedWorld]:
    """Return a lease of a loaded world, which is built by the first lease of the process, in seconds.

    Args:
        key: The world.
        grey: Whether its textures are grey in graphics memory; see `RenderContext`.

    Raises:
        ConfigError: The world is unknown.
        GraphicsError: Off-screen OpenGL is not available.
    """
    if is_file(key.name) or is_python(key.name):  # a file may change
        key = replace(key, name=resolved_world(key.name))
    return LOADED_WORLDS.lease((key, grey), partial(_loaded, key, grey))


def lease_instances(name: str, seed: int) -> Lease[LoadedWorld]:
    """Return a lease of a loaded world without textures, with one geom for each object instance.

    Args:
        name: Name of the world.
        seed: Seed of its layout.

    Raises:
        ConfigError: The world is unknown.
        GraphicsError: Off-screen OpenGL is not available.
    """
    name = resolved_world(name)
    return LOADED_WORLDS.lease(("instances", name, seed), partial(_loaded_instances, name, seed))


def instance_model(name: str, seed: int) -> mujoco.MjModel:
    """Return the compiled model of a world without textures, with one geom for each object instance.

    Raises:
        ConfigError: The world is unknown.
    """
    return _instance_model(resolved_world(name), seed)


@lru_cache(maxsize=4)
def _instance_model(name: str, seed: int) -> mujoco.MjModel:
    """Return the model of a world by its resolved name."""
    spec = instance_spec(name, seed)
    _shrink_frame_buffer(spec)
    return spec.compile()


def _loaded_instances(name: str, seed: int) -> LoadedWorld:
    """Load the object instances of a world into graphics memory."""
    model = instance_model(name, seed)
    return LoadedWorld(model, *illumination_and_movers(name, seed), RenderContext(model))


def _loaded(key: WorldKey, grey: bool) -> LoadedWorld:
    """Load a world into graphics memory."""
    model, illumination, movers = _compiled(key)
    context = RenderContext(model, blend_mipmaps=key.texture_reduction == 1, grey=grey)
    return LoadedWorld(model, illumination, movers, context)


@lru_cache(maxsize=2)
def _compiled(key: WorldKey) -> tuple[mujoco.MjModel, float, tuple[Mover, ...]]:
    """Return the compiled model of a world, its illumination and its moving objects."""
    model = _built(key) if is_python(key.name) else compiled(repr(key), partial(_built, key))  # its imports are unknown
    return model, *illumination_and_movers(key.name, key.seed, key.light_seed)


def _built(key: WorldKey) -> mujoco.MjModel:
    """Build and compile a world."""
    world = build_world(key.name, key.seed, key.texture_seed, key.texture_reduction, key.light_seed)
    _shrink_frame_buffer(world.spec)
    return world.spec.compile()


def _shrink_frame_buffer(spec: mujoco.MjSpec) -> None:
    """Make the frame buffer of a world small: it grows to what is rendered, and a small one is faster."""
    size = spec.visual.global_
    size.offwidth = size.offheight = 1
