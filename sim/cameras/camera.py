"""The camera: what a lens and a sensor make of the world, from a pose.

The renderer knows only ideal pinholes. So wider and finer pinhole images are drawn (`dronevio.sim.cameras.views`), and
every pixel of the real one is looked up where the camera's own model (`CameraModel.unproject`) says that its ray goes:
each as the mean over its area, as a sensor's pixel collects its light, which keeps the image equally sharp from the
middle to the edge of any lens.
"""

from functools import cached_property
from types import TracebackType
from typing import Self

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.sim.cameras.atlas_renderer import NO_MOVERS, AtlasRenderer, MoverPoses, RenderContext
from dronevio.sim.cameras.surfaces import Depth, Flow, Surfaces, depth_rays, optical_flow
from dronevio.sim.cameras.views import Lookup, Views, pixel_rays

Array = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

SUPERSAMPLING = 1.5
"""Drawn pixels per image pixel, along a line."""
LENS_BLUR_PX = 0.35
"""Standard deviation of the lens's blur [px]; with the pixel's area it makes 0.45 px."""
_ACROSS = 2  # samples per image pixel, along a line
_SUPPORT_PX = 3  # rows that the blur reaches
_SAME_SURFACE = 0.02  # inverse_depth that differs by less between neighbours is that of one surface


class OffscreenCamera:
    """Draws what a rig's camera sees of a world, off screen. Close it, or use it as a context."""

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: CameraModel,
        supersampling: float = SUPERSAMPLING,
        context: RenderContext | None = None,
    ) -> None:
        """Prepare to draw.

        Args:
            model: The world alone, compiled: its scenery lights itself.
            camera: Projection and image size.
            supersampling: Drawn pixels per image pixel, along a line, where the lens does not distort.
            context: The world's, shared with other cameras and closed by who made it; one of its own by default.

        Raises:
            GraphicsError: No off-screen OpenGL.
        """
        self.camera = camera
        self.views = Views.around(camera, supersampling)
        """What is drawn for an image."""
        self.geom_names = tuple(str(model.geom(number).name) for number in range(model.ngeom))
        """The world's geoms by their number, as `render_surfaces` gives it."""
        self._context, self._owns_context = context or RenderContext(model), context is None
        self._renderer = AtlasRenderer(model, self.views, self._context)
        self._lookup = self.views.lookup(pixel_rays(camera, _ACROSS))
        self._blur_px = LENS_BLUR_PX * _ACROSS

    def render(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS, rows: slice = slice(None)) -> GreyImage:
        """Return the grey image (H, W) that the camera sees, without noise.

        Args:
            T_world_cam: (4, 4) Pose of the camera.
            mover_poses: Poses (4, 4) of what moves in the world, by name; without one it is where the spec has it.
            rows: Which of the H rows are wanted; the cost is theirs.

        Raises:
            GraphicsError: The camera has been closed.
            ConfigError: There is no such mover.
        """
        first, last, _ = rows.indices(self.camera.height)
        top, end = max(first - _SUPPORT_PX, 0), min(last + _SUPPORT_PX, self.camera.height)
        columns, levels = (part[_ACROSS * top : _ACROSS * end] for part in self._lookup)
        wanted = self._atlas_rows(levels) if end - top < self.camera.height else None
        grey = cv2.cvtColor(self._renderer.colours(T_world_cam, mover_poses, wanted), cv2.COLOR_RGB2GRAY)
        return self._through_lens(grey, (columns, levels))[first - top : last - top]

    def render_rgb(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> GreyImage:
        """Return the same view in colour (H, W, 3), for people."""
        return self._through_lens(self._renderer.colours(T_world_cam, mover_poses), self._lookup)

    def render_surfaces(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> Surfaces:
        """Return depth and geom of what each pixel (H, W) of the same view sees at its middle."""
        inverse_depth, id_colours = self._renderer.surfaces(T_world_cam, mover_poses)
        lookup = self._surface_lookup
        near_m, far_m = self._renderer.near_m, self._renderer.far_m
        return lookup.surfaces(
            lookup.interpolated(inverse_depth), self._renderer.geoms(lookup.nearest(id_colours)), near_m, far_m
        )

    def render_depth(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> Depth:
        """Return the depth (H, W) of the same view [m]: z for ``radtan``, the ray's length for ``equidistant``."""
        return self.render_surfaces(T_world_cam, mover_poses).depth_m

    def render_flow(
        self,
        T_world_cam: Array,
        T_world_cam_next: Array,
        mover_poses: MoverPoses = NO_MOVERS,
        mover_poses_next: MoverPoses = NO_MOVERS,
    ) -> Flow:
        """Return how far what each pixel sees moves in the image (H, W, 2) [px] from one moment to the next.

        See `dronevio.sim.cameras.surfaces.optical_flow`.
        """
        seen = self.render_surfaces(T_world_cam, mover_poses)
        moved = self._renderer.motion_of_geoms(mover_poses, mover_poses_next)
        return optical_flow(self.camera, seen, T_world_cam, T_world_cam_next, moved)

    @cached_property
    def _surface_lookup(self) -> "_SurfaceLookup":
        return _SurfaceLookup(self.views, self.camera)

    def close(self) -> None:
        """Give the graphics memory back; more than once does no harm."""
        if self._owns_context:
            self._context.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _atlas_rows(self, looked_up: Lookup) -> tuple[int, int]:
        """Return the first row of the atlas that is looked up, and the first beyond the last."""
        inside = looked_up[looked_up >= 0.0]
        low, high = float(inside.min(initial=np.inf)), float(inside.max(initial=0.0))
        return max(int(min(low, high)) - 1, 0), min(int(high) + 3, self.views.height)

    def _through_lens(
        self, atlas: npt.NDArray[np.uint8] | cv2.typing.MatLike, lookup: tuple[Lookup, Lookup]
    ) -> GreyImage:
        """Return the image of the drawn views, or of the rows of a lookup-up: distorted, unsharp, each pixel a mean."""
        fine = cv2.remap(atlas, *lookup, cv2.INTER_LINEAR)
        cv2.GaussianBlur(fine, (0, 0), self._blur_px, dst=fine)
        size = (self.camera.width, len(lookup[0]) // _ACROSS)
        return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


class _SurfaceLookup:
    """Appearance up what the pixels' very middles see; no edge is smeared."""

    def __init__(self, views: Views, camera: CameraModel) -> None:
        """Find the four drawn pixels around each ray, and their weights."""
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
        # Depth is z in a view, times this.
        self._stretch = (1.0 / np.sum(ahead * depth_rays(camera)[self._seen], axis=-1)).astype(np.float32)

    def nearest(self, atlas: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return what an atlas (H', W', 3) has nearest to each ray (N, 3)."""
        return np.asarray(atlas.reshape(-1, 3)[self._nearest])

    def interpolated(self, inverse_depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the inverse_depth (N,) at each ray of an atlas of it (H', W').

        On a plane it is affine in the drawn image, so it is interpolated where all four neighbours lie on one surface,
        and taken from the nearest elsewhere.
        """
        flat = inverse_depth.ravel()
        around = flat[self._around]
        least = around.min(axis=0)
        smooth = around.max(axis=0) - least < _SAME_SURFACE * least
        return np.asarray(np.where(smooth, np.sum(self._weights * around, axis=0), flat[self._nearest]))

    def surfaces(
        self, inverse_depth: npt.NDArray[np.float32], geoms: npt.NDArray[np.int32], near_m: float, far_m: float
    ) -> Surfaces:
        """Return what is seen, given inverse_depth (N,) and geom (N,) at each ray."""
        z = 1.0 / (1.0 / far_m + inverse_depth * (1.0 / near_m - 1.0 / far_m))  # reversed: 1 is near
        depth_m, geom = np.full(self._seen.shape, np.nan, np.float32), np.full(self._seen.shape, -1, np.int32)
        depth_m[self._seen] = np.where(geoms >= 0, z * self._stretch, np.inf)
        geom[self._seen] = geoms
        return Surfaces(depth_m, geom)
