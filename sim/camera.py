"""The camera: what a lens and a sensor make of the world, from a pose.

The renderer knows only the ideal pinhole. So a wider and finer ideal image is drawn, and every pixel of the real one is
looked up where the camera's own model (`CameraModel.normalise`) says that its ray goes.
"""

from dataclasses import dataclass
from types import TracebackType
from typing import Self

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.errors import GraphicsError
from dronevio.sim.gl import Context, create_context

Array = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

SUPERSAMPLING = 1.5
"""Drawn pixels per image pixel, along a line."""
LENS_BLUR_PX = 0.45
"""Standard deviation of the lens's and the pixel's blur [px]."""
_MARGIN_PX = 4  # for the filter and the interpolation at the border


@dataclass(frozen=True)
class ImageNoise:
    """What a sensor adds to the light: noise, and the lens's darker corners.

    The variance grows with the signal, as photons do: σ² = read² + shot² · level / 255 (EMVA standard 1288).
    """

    read_sigma: float = 1.2
    """Noise of a black image [grey levels]."""
    shot_sigma: float = 2.2
    """Noise of a white image beyond it [grey levels]."""
    vignetting: float = 0.18
    """How much darker the furthest corner is, relative."""

    def apply(self, image: GreyImage, rng: np.random.Generator) -> GreyImage:
        """Return a grey image (H, W) as a sensor reads it out."""
        height, width = image.shape
        y, x = np.ogrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
        lens = (1.0 - self.vignetting * (x**2 + y**2) / 2.0).astype(np.float32)
        level = image * lens
        sigma = np.sqrt(self.read_sigma**2 + self.shot_sigma**2 / 255.0 * level)
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(level + sigma * noise), 0.0, 255.0), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class IdealImage:
    """The pinhole image that a camera's image is looked up in."""

    width: int
    """Columns [px]."""
    height: int
    """Rows [px]."""
    f: Array
    """(2,) Focal lengths x, y [px]."""
    c: Array
    """(2,) Principal point x, y [px], pixel centres being integers."""
    lookup: npt.NDArray[np.float32]
    """(H, W, 2) For each pixel of the camera its x, y in this image [px]."""

    @classmethod
    def around(cls, camera: CameraModel, supersampling: float) -> "IdealImage":
        """Return the smallest ideal image that holds a camera's field of view.

        Args:
            camera: The camera.
            supersampling: Pixels of this image per pixel of the camera's, along a line, where the lens does not
                distort.
        """
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.normalise(np.stack([u, v], axis=-1))
        f = supersampling * np.array([camera.fx, camera.fy])
        low = np.floor((rays * f).min(axis=(0, 1))) - _MARGIN_PX
        high = np.ceil((rays * f).max(axis=(0, 1))) + _MARGIN_PX
        width, height = (high - low).astype(int) + 1
        return cls(int(width), int(height), f, -low, (rays * f - low).astype(np.float32))

    def frustum(self, near_m: float) -> tuple[float, float, float, float]:
        """Return the frustum's middle and half width, and its bottom and top, on the near plane [m]."""
        left, top = (-0.5 - self.c) / self.f
        right, bottom = (np.array([self.width, self.height]) - 0.5 - self.c) / self.f
        return near_m * (left + right) / 2.0, near_m * (right - left) / 2.0, -near_m * bottom, -near_m * top


class OffscreenCamera:
    """Draws what a rig's camera sees of a world, off screen. Close it, or use it as a context."""

    def __init__(self, model: mujoco.MjModel, camera: CameraModel, supersampling: float = SUPERSAMPLING) -> None:
        """Prepare to draw.

        Args:
            model: The world alone, compiled: it does not move, and its scenery lights itself.
            camera: Projection and image size.
            supersampling: Drawn pixels per image pixel, along a line, where the lens does not distort.

        Raises:
            GraphicsError: No off-screen OpenGL.
        """
        self.camera = camera
        ideal = IdealImage.around(camera, supersampling)
        self._blur_px = LENS_BLUR_PX * supersampling
        self._near_m, self._far_m = (float(v * model.stat.extent) for v in (model.vis.map.znear, model.vis.map.zfar))
        self._gl: Context | None = create_context(ideal.width, ideal.height)
        self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_resizeOffscreen(ideal.width, ideal.height, self._drawing)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._drawing.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = _lone_scenery(model)
        for view in self._scene.camera:  # one for each eye; MuJoCo draws the mean of both
            view.frustum_near, view.frustum_far = self._near_m, self._far_m
            view.frustum_center, view.frustum_width, view.frustum_bottom, view.frustum_top = ideal.frustum(self._near_m)
        self._rectangle = mujoco.MjrRect(0, 0, ideal.width, ideal.height)
        self._rgb = np.empty((ideal.height, ideal.width, 3), np.uint8)
        self._nearness = np.empty((ideal.height, ideal.width), np.float32)
        rows_up = np.float32(ideal.height - 1) - ideal.lookup[..., 1]  # OpenGL's first row is the lowest
        self._lookup = (np.ascontiguousarray(ideal.lookup[..., 0]), rows_up)

    def render(self, T_world_cam: Array) -> GreyImage:
        """Return the grey image (H, W) that the camera sees from T_world_cam (4, 4), without noise."""
        return self._through_lens(cv2.cvtColor(self._draw(T_world_cam), cv2.COLOR_RGB2GRAY))

    def render_rgb(self, T_world_cam: Array) -> GreyImage:
        """Return the same view in colour (H, W, 3), for people."""
        return self._through_lens(self._draw(T_world_cam))

    def render_depth(self, T_world_cam: Array) -> Depth:
        """Return the depth along the optical axis (H, W) [m]; nearest neighbour, so that no edge is smeared."""
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True  # no textures: twice as fast
        self._look_from(T_world_cam)
        mujoco.mjr_readPixels(None, self._nearness, self._rectangle, self._drawing)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = False
        nearness = cv2.remap(self._nearness, *self._lookup, cv2.INTER_NEAREST)
        inverse = 1.0 / self._far_m + nearness * (1.0 / self._near_m - 1.0 / self._far_m)  # reversed z: 1 is near
        return np.asarray(1.0 / inverse, dtype=np.float32)

    def close(self) -> None:
        """Give the graphics memory back; more than once does no harm."""
        if self._gl is not None:
            self._gl.make_current()
            self._drawing.free()
            self._gl.free()
            self._gl = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _draw(self, T_world_cam: Array) -> GreyImage:
        """Return the ideal image (H', W', 3) from a pose, upside down."""
        self._look_from(T_world_cam)
        mujoco.mjr_readPixels(self._rgb, None, self._rectangle, self._drawing)
        return self._rgb

    def _look_from(self, T_world_cam: Array) -> None:
        """Draw the scene from a pose into the graphics memory.

        Raises:
            GraphicsError: The camera has been closed.
        """
        if self._gl is None:
            raise GraphicsError("the camera has been closed")
        self._gl.make_current()
        for view in self._scene.camera:
            view.pos, view.forward, view.up = T_world_cam[:3, 3], T_world_cam[:3, 2], -T_world_cam[:3, 1]
        mujoco.mjr_render(self._rectangle, self._scene, self._drawing)

    def _through_lens(self, ideal: npt.NDArray[np.uint8] | cv2.typing.MatLike) -> GreyImage:
        """Return the camera's image of an ideal one: a little unsharp, distorted."""
        unsharp = cv2.GaussianBlur(ideal, (0, 0), self._blur_px)
        return np.asarray(cv2.remap(unsharp, *self._lookup, cv2.INTER_LINEAR), dtype=np.uint8)


def _lone_scenery(model: mujoco.MjModel) -> mujoco.MjvScene:
    """Return what is to be drawn: the geoms as they stand, no light but their own."""
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=model.ngeom + 10)
    mujoco.mj_kinematics(model, data)
    view = mujoco.MjvCamera()
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
    scene.nlight = 0
    for effect in ("SHADOW", "REFLECTION", "SKYBOX", "FOG", "HAZE"):
        scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{effect}")] = False
    return scene
