"""Which cameras of a rig see the same: told by a grid of pixels, put at several depths."""

import numpy as np
import numpy.typing as npt

from dronevio.models.rig import RigCamera
from dronevio.models.rotation import inverse_pose

Array = npt.NDArray[np.float64]

GRID = 12  # pixels each way: a share is told to a percent
DEPTHS_M = (1.0, 3.0, 10.0, 1e6)  # what rooms, halls and the sky have


def shared_view(camera: RigCamera, other: RigCamera) -> float:
    """Return what share of a camera's image another one sees too, over all depths: 0 to 1."""
    model = camera.model
    across, down = (np.linspace(0.0, size - 1.0, GRID) for size in (model.width, model.height))
    bearings = model.unproject(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    bearings = bearings[np.isfinite(bearings).all(axis=1)]
    T_other_camera = inverse_pose(other.T_imu_cam) @ camera.T_imu_cam
    points = np.concatenate([depth * bearings for depth in DEPTHS_M]) @ T_other_camera[:3, :3].T
    pixels = other.model.project(points + T_other_camera[:3, 3])
    with np.errstate(invalid="ignore"):  # NaN is nowhere inside
        inside = np.all((pixels > -0.5) & (pixels < [other.model.width - 0.5, other.model.height - 0.5]), axis=1)
    return float(inside.mean()) if len(inside) else 0.0
