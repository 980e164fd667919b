"""The surroundings of a simulated flight, in the form in which a rerun file shows them."""

import numpy as np

from dronevio.eval.rerun.surroundings import MovingBox, Surroundings
from dronevio.sim.world import World


def surroundings_of(world: World) -> Surroundings:
    """Return the outline of a simulated world, and the bounding boxes of the objects that move in it."""
    boxes = []
    for mover in world.movers:
        geoms = world.spec.body(mover.body).geoms
        vertices = np.concatenate([np.reshape(world.spec.mesh(geom.meshname).uservert, (-1, 3)) for geom in geoms])
        boxes.append(MovingBox(mover.body, vertices.min(axis=0), vertices.max(axis=0), mover.poses))
    return Surroundings(world.outline, tuple(boxes))
