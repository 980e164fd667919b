"""A contact sheet: a world seen from a dozen places, for people to judge it at a glance."""

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.rig import EUROC_CAM0
from dronevio.models.rotation import pose_matrix
from dronevio.sim.camera import OffscreenCamera
from dronevio.sim.solids import turn_z
from dronevio.sim.textures import Image
from dronevio.sim.world import World

Array = npt.NDArray[np.float64]

_COLUMNS = 4
_VIEWS = 12
_R_LEVEL_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along x, upright


def viewpoints(free_box: Array) -> Array:
    """Return camera poses (12, 4, 4) in a space (2, 3): ten around its middle at changing height, two on the floor."""
    low, high = free_box
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    poses = []
    for number in range(_VIEWS):
        heading = 2.0 * np.pi * number / (_VIEWS - 2)
        from_floor = number >= _VIEWS - 2
        height = low[2] + (0.1 if from_floor else (0.35, 0.6, 0.9)[number % 3] * (high[2] - low[2]))
        back = 0.0 if from_floor else 0.75
        p = np.array(
            [middle[0] - back * half[0] * np.cos(heading), middle[1] - back * half[1] * np.sin(heading), height]
        )
        pitch = 0.0 if from_floor else (-0.15, 0.0, 0.4)[number % 3]
        c, s = np.cos(pitch), np.sin(pitch)
        tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])  # down for a positive pitch
        poses.append(pose_matrix(turn_z(heading) @ _R_LEVEL_CAM @ tilt, p))
    return np.stack(poses)


def contact_sheet(world: World, camera: CameraModel = EUROC_CAM0, colour: bool = True) -> Image:
    """Return twelve views of a world as one picture (H, W, 3), in colour or as the camera sees it.

    Raises:
        GraphicsError: No off-screen OpenGL.
    """
    with OffscreenCamera(world.spec.compile(), camera) as eye:
        poses = viewpoints(world.free_box)
        if colour:
            views = [eye.render_rgb(T) for T in poses]
        else:
            views = [np.asarray(cv2.cvtColor(eye.render(T), cv2.COLOR_GRAY2RGB), dtype=np.uint8) for T in poses]
    rows = [np.hstack(views[k : k + _COLUMNS]) for k in range(0, _VIEWS, _COLUMNS)]
    return np.vstack(rows)
