"""Views: the pinhole images that a camera's image is looked up in.

A renderer draws pinhole images only. A camera whose rays all point well ahead is looked up in a single one, wider and
finer than its own image; one that sees more, in the faces of a cube around it, each cut to what the lens sees of it.
All of them lie side by side in one large image, the atlas, so that one look-up makes the camera's image.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel

Array = npt.NDArray[np.float64]
Lookup = npt.NDArray[np.float32]

MARGIN_PX = 4  # drawn pixels beyond the outermost ray, for the interpolation at the border
_WORTH_A_CUBE = 0.7  # of a single view's pixels: below it, drawing the world several times pays
_NOWHERE_PX = -9.0  # far enough outside the atlas to look up nothing

_RAYS_AT_ONCE = 16384  # some hundred kilobytes: several times as fast as all at once

_X, _Y, _Z = np.eye(3)
_FRONT = np.eye(3)
_CUBE = np.stack(  # right, down and ahead of each face as columns, in the camera frame
    [
        np.stack(axes, axis=1)
        for axes in ((_X, _Y, _Z), (-_Z, _Y, _X), (_Z, _Y, -_X), (_X, -_Z, _Y), (_X, _Z, -_Y), (-_X, _Y, -_Z))
    ]
)


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole image in the atlas."""

    R_cam_view: Array
    """(3, 3) Its right, down and ahead as columns, in the camera frame."""
    f: Array
    """(2,) Focal lengths x, y [px]."""
    c: Array
    """(2,) Principal point x, y in the view [px], pixel centres being integers."""
    column: int
    """Where in the atlas its first column is; all views start at its lowest row."""
    width: int
    """Columns [px]."""
    height: int
    """Rows [px]."""

    def frustum(self, near_m: float) -> tuple[float, float, float, float]:
        """Return the frustum's middle and half width, and its bottom and top, on the near plane [m]."""
        left, top = (-0.5 - self.c) / self.f
        right, bottom = (np.array([self.width, self.height]) - 0.5 - self.c) / self.f
        return near_m * (left + right) / 2.0, near_m * (right - left) / 2.0, -near_m * bottom, -near_m * top

    def rows(self, low: int, high: int) -> "View":
        """Return the part of the view from its row ``low`` to before ``high``, counted from below."""
        above = np.array([0.0, self.height - high])
        return replace(self, c=self.c - above, height=high - low)

    def lookup(self, rays: Array) -> Lookup:
        """Return where in the atlas rays (N, 3) of the camera frame are found (2, N) [px]: column, row from below."""
        right, down, ahead = self.R_cam_view.T @ rays.T
        x, y = right / ahead * self.f[0] + self.c[0], down / ahead * self.f[1] + self.c[1]
        return np.stack([self.column + x, self.height - 1.0 - y]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Views:
    """All that has to be drawn for an image of a camera."""

    views: tuple[View, ...]
    """The pinhole images, side by side."""
    width: int
    """Columns of the atlas [px]."""
    height: int
    """Rows of the atlas [px]."""

    @classmethod
    def around(cls, camera: CameraModel, supersampling: float) -> "Views":
        """Return the views that hold a camera's field of view: a single one, unless a cube's faces are much smaller.

        Args:
            camera: The camera.
            supersampling: Drawn pixels per pixel of the camera's image, along a line, in the middle of a view.
        """
        rays = pixel_rays(camera).reshape(-1, 3)
        rays = rays[np.isfinite(rays[:, 0])]
        cube = cls._side_by_side(_CUBE, rays, supersampling * np.full(2, max(camera.fx, camera.fy)))
        if not np.all(rays[:, 2] > 0.0):
            return cube
        single = cls._side_by_side(_FRONT[None], rays, supersampling * np.array([camera.fx, camera.fy]))
        return cube if cube.pixels < _WORTH_A_CUBE * single.pixels else single

    @classmethod
    def _side_by_side(cls, faces: Array, rays: Array, f: Array) -> "Views":
        """Return the views of faces (F, 3, 3) that rays (N, 3) go through, cut to where they do."""
        views: list[View] = []
        through = _face_of(rays, faces)
        column = 0
        for face, R_cam_view in enumerate(faces):
            in_view = rays[through == face] @ R_cam_view
            if len(in_view):
                drawn = in_view[:, :2] / in_view[:, 2:] * f
                low = np.floor(drawn.min(axis=0)) - MARGIN_PX
                width, height = (np.ceil(drawn.max(axis=0)) + MARGIN_PX - low).astype(int) + 1
                views.append(View(R_cam_view, f, -low, column, int(width), int(height)))
                column += int(width)
        return cls(tuple(views), column, max(view.height for view in views))

    @property
    def pixels(self) -> int:
        """How many pixels are drawn."""
        return sum(view.width * view.height for view in self.views)

    def index_of(self, rays: Array) -> npt.NDArray[np.intp]:
        """Return which of the views rays (…, 3) of the camera frame go through (…); −1 for NaN."""
        return np.where(np.isnan(rays[..., 0]), -1, _face_of(rays, np.stack([v.R_cam_view for v in self.views])))

    def lookup(self, rays: Array) -> tuple[Lookup, Lookup]:
        """Return columns and rows from below (…) of the atlas [px] where rays (…, 3) of the camera frame are found."""
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
    """Return unit rays (across · H, across · W, 3) of a camera's pixels, each divided into ``across`` × ``across``."""
    u, v = ((np.arange(across * size) + 0.5) / across - 0.5 for size in (camera.width, camera.height))
    blocks = np.array_split(v, -(-v.size * u.size // _RAYS_AT_ONCE))
    return np.concatenate([camera.unproject(np.stack(np.meshgrid(u, rows), axis=-1)) for rows in blocks])


def _face_of(rays: Array, faces: Array) -> npt.NDArray[np.intp]:
    """Return for rays (…, 3) the face (…) among (F, 3, 3) that they are most ahead of."""
    return np.asarray(np.argmax(rays @ faces[:, :, 2].T, axis=-1)) if len(faces) > 1 else np.zeros(rays.shape[:-1], int)
