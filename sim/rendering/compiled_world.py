"""Compiled worlds: the models, illumination and moving objects that rendering processes load."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco

from dronevio.models.imu import Times
from dronevio.sim.rendering.scene import Scene
from dronevio.sim.world import build_world, instance_spec


@dataclass(frozen=True, eq=False)
class CompiledWorld:
    """A world in files that any process can load and render."""

    model_path: Path
    """File of the compiled model."""
    instances_path: Path
    """File of the model without textures and with one geom per object instance, for segmentation."""
    instance_names: tuple[str, ...]
    """Names of the object instances by the index of their geom."""
    scene: Scene
    """Its light and moving objects during the flight."""


@contextmanager
def compiled_world(world: str, seed: int, t_ns: Times, light_seed: int | None = None) -> Iterator[CompiledWorld]:
    """Build a world and keep it in temporary files during the context.

    Args:
        world: Name of the world.
        seed: Seed of the world.
        t_ns: (N,) Times of the trajectories of moving objects [ns]; the flight starts at the first.
        light_seed: Seed of other light, by default the light that belongs to the layout.

    Raises:
        ConfigError: The world is unknown.
    """
    built = build_world(world, seed, light_seed=light_seed)
    with TemporaryDirectory(prefix="dronevio-") as scratch:
        whole, unpainted = Path(scratch) / "world.mjb", Path(scratch) / "things.mjb"
        mujoco.mj_saveModel(built.spec.compile(), str(whole), None)
        things = instance_spec(world, seed).compile()
        mujoco.mj_saveModel(things, str(unpainted), None)
        names = tuple(str(things.geom(number).name) for number in range(things.ngeom))
        scene = Scene.sampled(built.illumination, built.movers, t_ns, int(t_ns[0]))
        yield CompiledWorld(whole, unpainted, names, scene)
