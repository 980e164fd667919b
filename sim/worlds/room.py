"""World room: a furnished room of eight by six metres."""

import numpy as np

from dronevio.sim.props.room import FREE_BOX_M, SIZE_M, furnished_room
from dronevio.sim.worlds.layout import Layout, WorldBuilder

ROUTE_M = np.array(
    [[0.0, 0.0, 1.2], [2.1, -1.2, 1.0], [2.1, 1.2, 1.7], [0.0, 0.2, 0.9], [-2.1, -1.2, 1.5], [-2.1, 1.2, 1.1]]
)
"""(6, 3) Closed tour through the free box of the room [m]."""


def layout(rng: np.random.Generator) -> Layout:
    """Draw a furnished room."""
    room = furnished_room(rng)
    return Layout(
        low=np.array([-0.5 * SIZE_M[0], -0.5 * SIZE_M[1], 0.0]),
        high=np.array([0.5 * SIZE_M[0], 0.5 * SIZE_M[1], SIZE_M[2]]),
        shell=room.shell,
        boxes=room.boxes,
        obstacles=room.obstacles,
        lights=room.lights,
        pad=np.zeros(3),
        free_box=FREE_BOX_M.copy(),
        route=ROUTE_M.copy(),
    )


ROOM = WorldBuilder("a furnished room with windows, pictures and a rug", layout)
"""The room."""
