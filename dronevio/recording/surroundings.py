"""The surroundings of a simulated flight, in the form in which a rerun file shows them."""

from typing import TYPE_CHECKING

import numpy as np

from dronevio.eval.rerun.surroundings import MovingBox, Surroundings

if TYPE_CHECKING:
    from dronevio.models.scenery import Scenery


def surroundings_of(world: str, seed: int, light_seed: int | None = None) -> Surroundings:
    """Return the surfaces of a simulated world and of the objects that move in it.

    Args:
        world: Name of the world.
        seed: Seed of the world.
        light_seed: Seed of other light, by default the light that belongs to the world.

    Raises:
        ConfigError: The world is unknown.
    """
    from dronevio.sim.world import moving_scenery, scenery_of

    boxes = []
    for mover, meshes in moving_scenery(world, seed, light_seed):
        vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float64)
        boxes.append(MovingBox(mover.body, vertices.min(axis=0), vertices.max(axis=0), mover.poses, meshes))
    return surroundings_in(scenery_of(world, seed, light_seed), tuple(boxes))


def surroundings_in(scenery: "Scenery", moving_boxes: tuple[MovingBox, ...] = ()) -> Surroundings:
    """Return the surroundings of a scenery with moving objects."""
    return Surroundings(scenery.outline, moving_boxes, scenery.meshes)
