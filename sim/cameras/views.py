"""Views: the pinhole images from which the image of a camera is looked up.

A renderer produces pinhole images only. The image of a camera whose rays all point well ahead is looked up in a single
view, wider and finer than the image itself; that of a camera with a larger field of view in the faces of a cube around
it, each cropped to the field of view. All views lie side by side in one image, the atlas, so that one look-up composes
the image of the camera.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel

Lookup = npt.NDArray[np.float32]

MARGIN_PX = 4  # rendered pixels beyond the outermost ray, for interpolation at the border
_WORTH_A_CUBE = 0.7  # of the pixels of a single view: below it, rendering a cube is faster
_NOWHERE_PX = -9.0  # outside the atlas

_RAYS_AT_ONCE = 16384  # block size that fits into the cache

_X, _Y, _Z = np.eye(3)
_FRONT = np.eye(3)
_CUBE = np.stack(  # right, down and ahead of each face as columns, in the camera frame
    [
        np.stack(axes, axis=1)
        for axes in ((_X, _Y, _Z), (-_Z, _Y, _X), (_Z, _Y, -_X), (_X, -_Z, _Y), (_X, _Z, -_Y), (-_X, _Y, -_Z))
    ]
)


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole view in the atlas."""

    R_cam_view: Array
    """(3, 3) Orientation of the view: its right, down and forward axes as columns, in the camera frame."""
    f: Array
    """(2,) Focal lengths x, y [px]."""
    c: Array
    """(2,) Principal point x, y in the view [px]; pixel centres are integers."""
    column: int
    """First column of the view in the atlas; all views start at its lowest row."""
    width: int
    """Width of the view [px]."""
    height: int
    """Height of the view [px]."""

    def frustum(self, near_m: float) -> tuple[float, float, float, float]:
        """Return centre and half width, bottom and top of the frustum on the near plane [m]."""
        left, top = (-0.5 - self.c) / self.f
        right, bottom = (np.array([self.width, self.height]) - 0.5 - self.c) / self.f
        return near_m * (left + right) / 2.0, near_m * (right - left) / 2.0, -near_m * bottom, -near_m * top

    def rows(self, low: int, high: int) -> "PinholeView":
        """Return the part of the view from row ``low`` to before ``high``, counted from below."""
        above = np.array([0.0, self.height - high])
        return replace(self, c=self.c - above, height=high - low)

    def lookup(self, rays: Array) -> Lookup:
        """Return the positions (2, N) of rays (N, 3) of the camera frame in the atlas: column, row from below [px]."""
        right, down, ahead = self.R_cam_view.T @ rays.T
        x, y = right / ahead * self.f[0] + self.c[0], down / ahead * self.f[1] + self.c[1]
        return np.stack([self.column + x, self.height - 1.0 - y]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Views:
    """All views that the image of a camera requires."""

    views: tuple[PinholeView, ...]
    """The views, side by side."""
    width: int
    """Width of the atlas [px]."""
    height: int
    """Height of the atlas [px]."""

    @classmethod
    def around(cls, camera: CameraModel, supersampling: float) -> "Views":
        """Return the views of a camera's field of view: a single one, unless the faces of a cube have far fewer pixels.

        Args:
            camera: The camera.
            supersampling: Rendered pixels per image pixel along each axis, at the centre of a view.
        """
        rays = pixel_rays(camera).reshape(-1, 3)
        rays = rays[np.isfinite(rays[:, 0])]
        cube = cls._side_by_side(_CUBE, rays, supersampling * np.full(2, max(camera.central_focal_px)))
        if not np.all(rays[:, 2] > 0.0):
            return cube
        single = cls._side_by_side(_FRONT[None], rays, supersampling * np.array(camera.central_focal_px))
        return cube if cube.pixels < _WORTH_A_CUBE * single.pixels else single

    @classmethod
    def _side_by_side(cls, faces: Array, rays: Array, f: Array) -> "Views":
        """Return the views of faces (F, 3, 3) that rays (N, 3) intersect, cropped to these rays."""
        views: list[PinholeView] = []
        through = _face_of(rays, faces)
        column = 0
        for face, R_cam_view in enumerate(faces):
            in_view = rays[through == face] @ R_cam_view
            if len(in_view):
                drawn = in_view[:, :2] / in_view[:, 2:] * f
                low = np.floor(drawn.min(axis=0)) - MARGIN_PX
                width, height = (np.ceil(drawn.max(axis=0)) + MARGIN_PX - low).astype(int) + 1
                views.append(PinholeView(R_cam_view, f, -low, column, int(width), int(height)))
                column += int(width)
        return cls(tuple(views), column, max(view.height for view in views))

    @property
    def pixels(self) -> int:
        """Number of rendered pixels."""
        return sum(view.width * view.height for view in self.views)

    def index_of(self, rays: Array) -> npt.NDArray[np.intp]:
        """Return the index of the view (…) of rays (…, 3) in the camera frame; −1 for NaN."""
        return np.where(np.isnan(rays[..., 0]), -1, _face_of(rays, np.stack([v.R_cam_view for v in self.views])))

    def lookup(self, rays: Array) -> tuple[Lookup, Lookup]:
        """Return columns and rows from below (…) in the atlas [px] of rays (…, 3) in the camera frame."""
        where = np.full((2, rays.size // 3), _NOWHERE_PX, np.float32)
        for block in np.array_split(np.arange(rays.size // 3), -(-rays.size // (3 * _RAYS_AT_ONCE))):
            some = rays.reshape(-1, 3)[block[0] : block[-1] + 1]
            through = self.index_of(some)
            for index, view in enumerate(self.views):
                mine = np.flatnonzero(through == index)
                where[:, block[0] + mine] = view.lookup(some[mine])
        columns, rows = where.reshape(2, *rays.shape[:-1])
        return columns, rows


def pixel_rays(camera: CameraModel, across: int = 1) -> Array:
    """Return unit rays (across · H, across · W, 3) of a camera, each pixel divided into ``across`` × ``across``."""
    u, v = ((np.arange(across * size) + 0.5) / across - 0.5 for size in (camera.width, camera.height))
    blocks = np.array_split(v, -(-v.size * u.size // _RAYS_AT_ONCE))
    return np.concatenate([camera.unproject(np.stack(np.meshgrid(u, rows), axis=-1)) for rows in blocks])


def _face_of(rays: Array, faces: Array) -> npt.NDArray[np.intp]:
    """Return the index (…) of the face among (F, 3, 3) whose axis is closest to each ray (…, 3)."""
    return np.asarray(np.argmax(rays @ faces[:, :, 2].T, axis=-1)) if len(faces) > 1 else np.zeros(rays.shape[:-1], int)
