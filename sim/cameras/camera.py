"""Camera: rendering of the image of any lens model from a pose.

The renderer supports ideal pinhole projections only. Wider and finer pinhole images are therefore rendered
(`dronevio.sim.cameras.views`), and every pixel of the camera is looked up where the camera model
(`CameraModel.unproject`) projects its ray. Each pixel is the mean over its area, as the pixel of a sensor integrates
light, so that images are equally sharp from the centre to the edge for every lens.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import TracebackType
from typing import Self

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.sim.cameras.atlas_renderer import NO_MOVERS, AtlasRenderer, MoverPoses, RenderContext
from dronevio.sim.cameras.surfaces import Depth, Flow, Surfaces, depth_rays, optical_flow
from dronevio.sim.cameras.views import Lookup, Views, pixel_rays

GreyImage = npt.NDArray[np.uint8]

SUPERSAMPLING = 1.4
"""Rendered pixels per image pixel along each axis."""
LENS_BLUR_PX = 0.35
"""Standard deviation of the blur of the lens [px]; together with the pixel area it is 0.45 px."""
_ACROSS = 2  # samples per image pixel along each axis
_SUPPORT_PX = 3  # rows within the support of the blur
_SAME_SURFACE = 0.02  # relative difference of inverse depth between neighbours on one surface


class OffscreenCamera:
    """Off-screen renderer of the images of a rig's camera. Close it, or use it as a context manager."""

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: CameraModel,
        supersampling: float = SUPERSAMPLING,
        context: RenderContext | None = None,
    ) -> None:
        """Create the renderer and the look-up tables.

        Args:
            model: The compiled world without the drone; its textures contain the lighting.
            camera: Projection and image size.
            supersampling: Rendered pixels per image pixel along each axis, where the lens does not distort.
            context: Graphics memory of the world, shared with other cameras and closed by its creator; a new one by
                default.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        self.camera = camera
        self._tables = _lens_tables(camera, supersampling)
        self.views = self._tables.views
        """Pinhole views from which an image is composed."""
        self.geom_names = tuple(str(model.geom(number).name) for number in range(model.ngeom))
        """Names of the geoms of the world by the index that `render_surfaces` returns."""
        self._context, self._owns_context = context or RenderContext(model), context is None
        self._renderer = AtlasRenderer(model, self.views, self._context)
        self._blur_px = LENS_BLUR_PX * _ACROSS

    def render(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS, rows: slice = slice(None)) -> GreyImage:
        """Return the noise-free grey image (H, W) at a pose.

        Args:
            T_world_cam: (4, 4) Pose of the camera.
            mover_poses: Poses (4, 4) of moving objects by name; objects without one stay at their initial pose.
            rows: Rows of the image to render; the cost is proportional to their number.

        Raises:
            GraphicsError: The camera has been closed.
            ConfigError: A moving object is unknown.
        """
        first, last, _ = rows.indices(self.camera.height)
        top, end = max(first - _SUPPORT_PX, 0), min(last + _SUPPORT_PX, self.camera.height)
        fine_rows = slice(_ACROSS * top, _ACROSS * end)
        columns, levels = (part[fine_rows] for part in self._tables.lookup)
        wanted = self._tables.atlas_rows(fine_rows) if end - top < self.camera.height else None
        grey = self._renderer.grey(T_world_cam, mover_poses, wanted)
        return self._through_lens(grey, (columns, levels))[first - top : last - top]

    def render_rgb(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> GreyImage:
        """Return the RGB image (H, W, 3) at a pose T_world_cam (4, 4)."""
        return self._through_lens(self._renderer.colours(T_world_cam, mover_poses), self._tables.lookup)

    def render_surfaces(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> Surfaces:
        """Return depth and geom at the centre of each pixel (H, W) at a pose T_world_cam (4, 4)."""
        inverse_depth, id_colours = self._renderer.surfaces(T_world_cam, mover_poses)
        lookup = self._surface_lookup
        near_m, far_m = self._renderer.near_m, self._renderer.far_m
        return lookup.surfaces(
            lookup.interpolated(inverse_depth), self._renderer.geoms(lookup.nearest(id_colours)), near_m, far_m
        )

    def render_depth(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> Depth:
        """Return the depth (H, W) [m]: z for ``radtan``, the length of the ray for fisheyes."""
        return self.render_surfaces(T_world_cam, mover_poses).depth_m

    def render_flow(
        self,
        T_world_cam: Array,
        T_world_cam_next: Array,
        mover_poses: MoverPoses = NO_MOVERS,
        mover_poses_next: MoverPoses = NO_MOVERS,
    ) -> Flow:
        """Return the optical flow (H, W, 2) from one pose and time to the next [px].

        See `dronevio.sim.cameras.surfaces.optical_flow`.
        """
        seen = self.render_surfaces(T_world_cam, mover_poses)
        return self.flow(seen, T_world_cam, T_world_cam_next, mover_poses, mover_poses_next)

    def flow(
        self,
        seen: Surfaces,
        T_world_cam: Array,
        T_world_cam_next: Array,
        mover_poses: MoverPoses = NO_MOVERS,
        mover_poses_next: MoverPoses = NO_MOVERS,
    ) -> Flow:
        """Return the optical flow (H, W, 2) of surfaces seen at a pose and time to another one [px]."""
        moved = self._renderer.motion_of_geoms(mover_poses, mover_poses_next)
        return optical_flow(self.camera, seen, T_world_cam, T_world_cam_next, moved)

    @cached_property
    def _surface_lookup(self) -> "_SurfaceLookup":
        return _SurfaceLookup(self.views, self.camera)

    def close(self) -> None:
        """Release the graphics memory; further calls have no effect."""
        if self._owns_context:
            self._context.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _through_lens(self, atlas: npt.NDArray[np.uint8], lookup: tuple[Lookup, Lookup]) -> GreyImage:
        """Return the image from the rendered views: distorted, blurred, each pixel the mean over its area."""
        fine = cv2.remap(atlas, *lookup, cv2.INTER_LINEAR)
        cv2.GaussianBlur(fine, (0, 0), self._blur_px, dst=fine)
        size = (self.camera.width, len(lookup[0]) // _ACROSS)
        return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class _LensTables:
    """Look-up tables of a lens."""

    views: Views
    """Pinhole views from which an image is composed."""
    lookup: tuple[Lookup, Lookup]
    """(2 H, 2 W) Columns and rows of the atlas of each quarter of a pixel [px]."""
    lowest: Lookup
    """(V, 2 H) Lowest row of each view that each row looks up; infinite if it has none [px]."""
    highest: Lookup
    """(V, 2 H) Highest row of each view that each row looks up; −infinite if it has none [px]."""

    def atlas_rows(self, rows: slice) -> list[tuple[int, int]]:
        """Return for each view the first row that some rows look up and the row after the last; 0, 0 without any."""
        lows, highs = (
            self.lowest[:, rows].min(axis=1, initial=np.inf),
            self.highest[:, rows].max(axis=1, initial=-np.inf),
        )
        return [
            (max(int(low) - 1, 0), min(int(high) + 3, view.height)) if high >= low else (0, 0)
            for low, high, view in zip(lows.tolist(), highs.tolist(), self.views.views, strict=True)
        ]


@lru_cache(maxsize=4)  # one rig with two cameras, each with a small image; full tables have 12 MB and take a second
def _lens_tables(camera: CameraModel, supersampling: float) -> _LensTables:
    """Return the look-up tables of a lens."""
    views = Views.around(camera, supersampling)
    columns, levels = views.lookup(pixel_rays(camera, _ACROSS))
    through = [(columns >= view.column) & (columns < view.column + view.width) for view in views.views]
    lowest = np.stack([np.where(seen, levels, np.float32(np.inf)).min(axis=1) for seen in through])
    highest = np.stack([np.where(seen, levels, np.float32(-np.inf)).max(axis=1) for seen in through])
    return _LensTables(views, (columns, levels), lowest, highest)


class _SurfaceLookup:
    """Look-up of surfaces at the centres of the pixels, without blending at edges."""

    def __init__(self, views: Views, camera: CameraModel) -> None:
        """Compute the four rendered pixels around each ray, and their weights."""
        rays = pixel_rays(camera)
        through = views.index_of(rays)
        self._seen = through >= 0
        x, y = (part[self._seen] for part in views.lookup(rays))
        left, low = np.floor(x), np.floor(y)
        dx, dy = x - left, y - low
        corner = low.astype(np.intp) * views.width + left.astype(np.intp)
        self._around = corner + np.array([[0], [1], [views.width], [views.width + 1]])
        self._weights = np.stack([(1 - dx) * (1 - dy), dx * (1 - dy), (1 - dx) * dy, dx * dy])
        self._nearest = np.take_along_axis(self._around, np.argmax(self._weights, axis=0)[None], axis=0)[0]
        ahead = np.stack([view.R_cam_view[:, 2] for view in views.views])[through[self._seen]]
        # Ratio of depth to z in the view.
        self._stretch = (1.0 / np.sum(ahead * depth_rays(camera)[self._seen], axis=-1)).astype(np.float32)

    def nearest(self, atlas: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the pixel of an atlas (H', W', 3) nearest to each ray (N, 3)."""
        return np.asarray(atlas.reshape(-1, 3)[self._nearest])

    def interpolated(self, inverse_depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the inverse depth (N,) at each ray from an atlas (H', W').

        On a plane, inverse depth is affine in the pinhole image. It is interpolated where all four neighbours lie on
        one surface, and taken from the nearest one elsewhere.
        """
        flat = inverse_depth.ravel()
        around = flat[self._around]
        least = around.min(axis=0)
        smooth = around.max(axis=0) - least < _SAME_SURFACE * least
        return np.asarray(np.where(smooth, np.sum(self._weights * around, axis=0), flat[self._nearest]))

    def surfaces(
        self, inverse_depth: npt.NDArray[np.float32], geoms: npt.NDArray[np.int32], near_m: float, far_m: float
    ) -> Surfaces:
        """Return the surfaces from inverse depth (N,) and geom index (N,) at each ray."""
        z = 1.0 / (1.0 / far_m + inverse_depth * (1.0 / near_m - 1.0 / far_m))  # reversed: 1 at the near plane
        depth_m, geom = np.full(self._seen.shape, np.nan, np.float32), np.full(self._seen.shape, -1, np.int32)
        depth_m[self._seen] = np.where(geoms >= 0, z * self._stretch, np.inf)
        geom[self._seen] = geoms
        return Surfaces(depth_m, geom)
