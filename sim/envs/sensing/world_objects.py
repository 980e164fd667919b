"""The objects of a world: what the numbers in segmentation images mean."""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Mask
from dronevio.models.errors import unknown_name
from dronevio.sim.appearance.instances import kind_of
from dronevio.sim.rendering.loaded_world import instance_model

NOTHING = "nothing"
"""Name and kind of the number 0."""


@dataclass(frozen=True)
class WorldObjects:
    """Names and kinds of the N objects of a world, in the order of their numbers in images, from 1 on.

    Walls, floor and sky are objects, too. Moving objects are the last.

    ```python
    objects = env.unwrapped.settings.objects
    is_gate = objects.of_kind("gate")[observation["segmentation"]]  # (H, W, 1), bool
    ```
    """

    names: tuple[str, ...]
    """N + 1 unique names, such as ``sofa`` or ``tree_31``; the first is ``nothing``."""
    kinds: tuple[str, ...]
    """N + 1 kinds, such as ``sofa`` or ``tree``; they are the same in all worlds and for all seeds."""

    def of_kind(self, *kinds: str) -> Mask:
        """Return for each number (N + 1,) whether the object is of one of some kinds.

        Raises:
            ConfigError: The world has no object of a kind.
        """
        for kind in kinds:
            if kind not in self.kinds:
                raise unknown_name("kind of objects", kind, sorted(set(self.kinds)))
        return np.isin(self.kinds, kinds)


def world_objects(world: str, seed: int) -> WorldObjects:
    """Return the objects of a world; the same world and seed give the same numbers.

    Args:
        world: Name of the world.
        seed: Seed of its layout.

    Raises:
        ConfigError: The world is unknown.
    """
    model = instance_model(world, seed)
    names = (NOTHING, *(str(model.geom(number).name) for number in range(model.ngeom)))
    return WorldObjects(names, tuple(kind_of(name) for name in names))
