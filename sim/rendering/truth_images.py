"""What is true of a frame's pixels, as images that every tool reads: depth, segmentation, optical flow.

They belong to the middle of the exposure of the middle row, through the main camera's lens, sharp: no motion blur and
no rolling shutter.

- ``depth0``: 16-bit PNG, millimetres; z for ``radtan`` lenses, the ray's length for ``equidistant`` ones; 0 where
  nothing is seen or it is further than 65.5 m.
- ``seg0``: 16-bit PNG, the number of the thing that is seen; 0 where nothing is. ``seg0/names.csv`` tells what the
  numbers mean: after the line ``#number,name`` there is one for each thing of the world, seen or not, as in
  ``12,sofa`` or ``47,tree_31``. Names are unique: what there are several of are numbered from 1, gates as they are
  flown; what moves is called as in the world (``person_0``). The same world and seed give the same table.
- ``flow0``: 16-bit PNG with the channels u, v, valid, by the convention of KITTI's development kit (Menze and Geiger,
  CVPR 2015): displacement to the next frame [px] = (value − 2¹⁵) / 64. The last frame has none.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.sim.cameras.surfaces import Flow, Surfaces

Image16 = npt.NDArray[np.uint16]

TruthImage = Literal["depth", "segmentation", "flow"]
"""What can be written beside the main camera's frames."""
FOLDERS: dict[TruthImage, str] = {"depth": "depth0", "segmentation": "seg0", "flow": "flow0"}
"""Where each kind goes, below ``mav0``."""

_MOST = 65535
_FLOW_ZERO, _FLOW_STEPS_PER_PX = 32768.0, 64.0


def depth_image(seen: Surfaces) -> Image16:
    """Return depths (H, W) [mm]."""
    millimetres = np.rint(1000.0 * np.nan_to_num(seen.depth_m, nan=0.0, posinf=0.0))
    return np.where(millimetres <= _MOST, millimetres, 0.0).astype(np.uint16)


def segmentation_image(seen: Surfaces) -> Image16:
    """Return the numbers (H, W) of what is seen: 1 and more."""
    return (seen.geom + 1).astype(np.uint16)


def names_table(names: tuple[str, ...]) -> str:
    """Return what the numbers of a segmentation mean, as the text of a table."""
    return "#number,name\n" + "".join(f"{number},{name}\n" for number, name in enumerate(names, 1))


def flow_image(flow: Flow) -> Image16:
    """Return flow (H, W, 3) as OpenCV writes it: valid, v, u, which are blue, green, red."""
    steps = np.rint(flow * _FLOW_STEPS_PER_PX + _FLOW_ZERO)
    valid = np.all((steps >= 1.0) & (steps <= _MOST), axis=-1, keepdims=True)  # NaN is not
    return np.concatenate([valid, np.where(valid, steps[..., ::-1], 0.0)], axis=-1).astype(np.uint16)
