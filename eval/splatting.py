"""Pictures of dense points: each point is drawn as a square of its size, and near points cover distant ones."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image

BACKGROUND = (18, 21, 26)
"""Colour where there is no point; that of the 3D view in the rerun viewer."""
_MAX_SIDE_PX = 9  # of the square of a point
_NEAR_SHARE = 0.02  # of the median depth of the points, below which they are not drawn
_AMBIENT = 0.2  # brightness of surfaces that are opposite to the light


@dataclass(frozen=True, eq=False)
class ViewCamera:
    """A pinhole camera that looks at a scene."""

    position: Array
    """(3,) Position in the world frame."""
    axes: Array
    """(3, 3) Unit vectors right, down and forward in the world frame, as rows."""
    field_of_view_rad: float
    """Vertical field of view [rad]."""
    width: int
    """Number of columns of the picture [px]."""
    height: int
    """Number of rows of the picture [px]."""

    @classmethod
    def looking_at(
        cls, position: Array, target: Array, up: Array, field_of_view_rad: float, width: int, height: int
    ) -> "ViewCamera":
        """Return a camera at a position (3,) that looks at a target (3,) with an up direction (3,)."""
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward])
        return cls(position, axes, field_of_view_rad, width, height)

    @property
    def focal_px(self) -> float:
        """Focal length [px]."""
        return float(0.5 * self.height / np.tan(0.5 * self.field_of_view_rad))

    def faces(self, points: Array, normals: Array) -> npt.NDArray[np.bool_]:
        """Return which points (N,) of surfaces with outward normals (N, 3) face the camera."""
        return np.asarray(np.einsum("ij,ij->i", self.position - points, normals) > 0.0)


def splat(camera: ViewCamera, points: Array, colours: Image, size: float) -> Image:
    """Return a picture (H, W, 3) of points.

    Args:
        camera: The camera.
        points: (N, 3) Points in the world frame.
        colours: (N, 3) Their colours.
        size: Side of the squares in the unit of the world frame; each covers at least one pixel.
    """
    picture = np.empty((camera.height, camera.width, 3), np.uint8)
    picture[:] = BACKGROUND
    in_camera = (points - camera.position) @ camera.axes.T
    ahead = in_camera[:, 2] > 0.0
    if not ahead.any():
        return picture
    ahead &= in_camera[:, 2] > _NEAR_SHARE * np.median(in_camera[ahead, 2])
    in_camera, colours = in_camera[ahead], colours[ahead]
    order = np.argsort(-in_camera[:, 2], kind="stable")  # the last one assigned to a pixel is the nearest
    in_camera, colours = in_camera[order], colours[order]
    side = np.clip(np.ceil(camera.focal_px * size / in_camera[:, 2]), 1, _MAX_SIDE_PX).astype(np.int64)
    centre = camera.focal_px * in_camera[:, :2] / in_camera[:, 2:] + 0.5 * np.array([camera.width, camera.height])
    first = np.floor(centre - 0.5 * (side[:, None] - 1)).astype(np.int64)
    rows, pixels = [], []
    for dy in range(int(side.max())):
        for dx in range(int(side.max())):
            u, v = first[:, 0] + dx, first[:, 1] + dy
            drawn = (np.maximum(dx, dy) < side) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            rows.append(np.flatnonzero(drawn))
            pixels.append((v * camera.width + u)[drawn])
    row, pixel = np.concatenate(rows), np.concatenate(pixels)
    nearest = np.full(camera.height * camera.width, -1, np.int64)
    np.maximum.at(nearest, pixel, row)
    covered = nearest >= 0
    picture.reshape(-1, 3)[covered] = colours[nearest[covered]]
    return picture


def shaded(normals: Array, camera: ViewCamera) -> Image:
    """Return grey colours (N, 3) of a surface with normals (N, 3), lit from the upper left of a camera."""
    right, down, forward = camera.axes
    light = -forward - 0.5 * right - 0.7 * down
    light /= np.linalg.norm(light)
    brightness = _AMBIENT + (1.0 - _AMBIENT) * (0.5 + 0.5 * normals @ light) ** 2  # not constant in the shade
    return np.repeat(np.round(235.0 * brightness)[:, None], 3, axis=1).astype(np.uint8)
