"""Walls of glass: frames that are seen, and panes that are solid but not seen.

A clean pane neither tints nor reflects here: cameras, and all depth that is measured by them, pass it. Stripes of light
and dark squares at two heights (DIN 18040-1) make it visible where a wall is marked.
"""

from functools import partial

import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box, parts_of
from dronevio.sim.appearance.textures import plain
from dronevio.sim.props.building import coarse
from dronevio.sim.props.furniture import Piece, block

_PX_PER_M = 112.0
_POST_M, _DEEP_M, _RAIL_M, _HEAD_M = 0.06, 0.16, 0.08, 0.06  # width of posts, depth, heights of lower and upper rail
_BAY_M = 1.3  # widest pane between posts
_PANE_M, _FILM_M = 0.012, 0.016  # thickness of glass, and of glass with stripes
_STRIPE_M, _STRIPES_M = 0.08, (0.55, 1.4)  # side of the squares of stripes, and heights of their middles
_FRAME, _LIGHT, _DARK = (84, 88, 92), (226, 228, 226), (70, 74, 80)


def glazing_frame(width_m: float, height_m: float, is_marked: bool) -> Piece:
    """Return posts and rails around panes, with stripes on the panes or not; its centre is that of its foot.

    Args:
        width_m: Width.
        height_m: Height, the upper rail included.
        is_marked: Whether there are stripes.
    """
    paint = partial(plain, colour=_FRAME)
    bays = int(np.ceil((width_m - _POST_M) / (_BAY_M + _POST_M)))
    posts = np.linspace(-0.5 * (width_m - _POST_M), 0.5 * (width_m - _POST_M), bays + 1)
    bay_m, tall = float(posts[1] - posts[0]) - _POST_M, height_m - _HEAD_M
    boxes = [block(x, 0.0, 0.0, _POST_M, _DEEP_M, tall, paint) for x in posts]
    boxes.append(block(0.0, 0.0, tall, width_m, _DEEP_M, _HEAD_M, paint))
    for x in 0.5 * (posts[1:] + posts[:-1]):
        boxes.append(block(x, 0.0, 0.0, bay_m, _DEEP_M, _RAIL_M, paint))
        bottoms = [z - 0.5 * _STRIPE_M for z in _STRIPES_M if is_marked]
        boxes += [block(x, 0.0, z, bay_m, _FILM_M, _STRIPE_M, _squares) for z in bottoms]
    return Piece(coarse(boxes, _PX_PER_M), width_m, _DEEP_M, height_m).as_instance("glass_frame")


def glazing_pane(width_m: float, height_m: float) -> Piece:
    """Return the glass of such a frame, below its upper rail: solid, and not to be drawn."""
    pane: tuple[Box, ...] = (block(0.0, 0.0, 0.0, width_m, _PANE_M, height_m, partial(plain, colour=_LIGHT)),)
    return Piece(parts_of(Instance("glass"), pane), width_m, _PANE_M, height_m)


def _squares(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a stripe of light and dark squares."""
    dark = (np.arange(width) // max(round(_STRIPE_M * _PX_PER_M), 1)) % 2 == 1
    return np.broadcast_to(np.where(dark[:, None], _DARK, _LIGHT), (height, width, 3)).astype(np.uint8)
