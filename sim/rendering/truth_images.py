"""Ground-truth images in standard formats: depth, segmentation, optical flow.

They belong to the middle of the exposure of the middle row of the first camera, with its lens model, but without motion
blur and rolling shutter.

- ``depth0``: 16-bit PNG in millimetres; z for ``radtan`` lenses, the length of the ray for fisheyes; 0
  without a surface or beyond 65.5 m.
- ``seg0``: 16-bit PNG with the number of the visible object instance; 0 without a surface. ``seg0/names.csv`` maps
  numbers to names: after the line ``#number,name`` it has one line for each instance of the world, visible or not, such
  as ``12,sofa`` or ``47,tree_31``. Names are unique: instances of one kind are numbered from 1, gates in the order of
  the course; moving objects have the names of the world (``person_0``). The same world and seed give the same table.
- ``flow0``: 16-bit PNG with the channels u, v, valid, in the format of KITTI's development kit (Menze and Geiger, CVPR
  2015): displacement to the next frame [px] = (value − 2¹⁵) / 64. The last frame has none.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.sim.cameras.surfaces import Flow, Surfaces

Image16 = npt.NDArray[np.uint16]

TruthImage = Literal["depth", "segmentation", "flow"]
"""Kinds of ground-truth images."""
FOLDERS: dict[TruthImage, str] = {"depth": "depth0", "segmentation": "seg0", "flow": "flow0"}
"""Folder of each kind below ``mav0``."""

_MOST = 65535
_FLOW_ZERO, _FLOW_STEPS_PER_PX = 32768.0, 64.0


def depth_image(seen: Surfaces) -> Image16:
    """Return the depth image (H, W) [mm]."""
    millimetres = np.rint(1000.0 * np.nan_to_num(seen.depth_m, nan=0.0, posinf=0.0))
    return np.where(millimetres <= _MOST, millimetres, 0.0).astype(np.uint16)


def segmentation_image(seen: Surfaces) -> Image16:
    """Return the instance numbers (H, W), from 1 on."""
    return (seen.geom + 1).astype(np.uint16)


def names_table(names: tuple[str, ...]) -> str:
    """Return the names of the instance numbers as the text of a table."""
    return "#number,name\n" + "".join(f"{number},{name}\n" for number, name in enumerate(names, 1))


def flow_image(flow: Flow) -> Image16:
    """Return the flow image (H, W, 3) in OpenCV's channel order: valid, v, u as blue, green, red."""
    steps = np.rint(flow * _FLOW_STEPS_PER_PX + _FLOW_ZERO)
    valid = np.all((steps >= 1.0) & (steps <= _MOST), axis=-1, keepdims=True)  # NaN is not
    return np.concatenate([valid, np.where(valid, steps[..., ::-1], 0.0)], axis=-1).astype(np.uint16)
