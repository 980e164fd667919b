"""Rendering of single frames: exposure over the motion of a camera, noise, and the brightness of the scene."""

import zlib
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rig import RigCamera
from dronevio.sim.cameras.atlas_renderer import MoverPoses, RenderContext
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.exposure import Exposure
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.cameras.shutter import Poses, Shutter
from dronevio.sim.rendering.scene import Scene
from dronevio.sim.streams import generator

GreyImage = npt.NDArray[np.uint8]

_THUMBNAIL_PX = 8  # image pixels per pixel of a thumbnail along each axis
_NEAR_PERCENTILE = 25  # percentile of the depths: nearer surfaces fill a quarter of the image


@dataclass(frozen=True)
class FrameExposure:
    """True time, exposure and light of a frame."""

    middle_ns: int
    """True middle of the exposure of the middle row, on the IMU clock [ns]."""
    exposure: Exposure
    """Exposure time and gain."""
    lit: bool
    """Whether light reaches the camera."""


class Thumbnail:
    """Renderer of images of 1/8 of the width and height of a camera's images, for brightness and depth."""

    def __init__(self, camera: CameraModel, model: mujoco.MjModel, context: RenderContext) -> None:
        """Create the renderer.

        Args:
            camera: Projection and image size of the camera.
            model: The compiled world.
            context: Graphics memory of the world.
        """
        self._camera = OffscreenCamera(model, thumbnail(camera), supersampling=1.0, context=context)

    def histogram(self, T_world_cam: Array, movers: MoverPoses) -> Array:
        """Return the fraction of the pixels on each grey level (256,), in a well-lit world at nominal exposure.

        Args:
            T_world_cam: (4, 4) Pose of the camera.
            movers: Poses of moving objects.
        """
        image = self._camera.render(T_world_cam, movers)
        return np.bincount(image.ravel(), minlength=256) / image.size

    def nearest_m(self, T_world_cam: Array, movers: MoverPoses) -> float:
        """Return the depth of near surfaces [m]; infinite if there are none.

        Args:
            T_world_cam: (4, 4) Pose of the camera.
            movers: Poses of moving objects.
        """
        depth = self._camera.render_depth(T_world_cam, movers)
        depth = depth[np.isfinite(depth)]
        return float(np.percentile(depth, _NEAR_PERCENTILE)) if depth.size else np.inf


class FrameRenderer:
    """Renderer of the frames of one camera, with shutter and image sensor."""

    def __init__(
        self, camera: RigCamera, imaging: Imaging, model: mujoco.MjModel, context: RenderContext, margin_px: int
    ) -> None:
        """Create the renderers of a camera.

        Args:
            camera: The true camera.
            imaging: Noise and vignetting of its image sensor.
            model: The compiled world.
            context: Graphics memory of the world, which several renderers may share.
            margin_px: Margin of the key images around the image [px]; see `Shutter`.
        """
        self._imaging, self._readout_s = imaging, camera.readout_s
        self._pixels = zlib.crc32(repr(camera.model).encode() + camera.T_imu_cam.tobytes())
        self._shutter = Shutter(camera, margin_px)
        self._camera = OffscreenCamera(model, self._shutter.drawn, context=context)
        self.thumbnail = Thumbnail(camera.model, model, context)
        """Renderer of small images of the camera."""

    def render(self, frame: FrameExposure, poses: Poses, scene: Scene, rng: np.random.Generator) -> GreyImage:
        """Return the grey image (H, W) of a frame.

        Args:
            frame: Time, exposure and light of the frame.
            poses: Poses of the camera during the frame.
            scene: Light and moving objects during the frame.
            rng: Generator of the noise of this frame and camera; see `image_noise`.
        """
        middle_ns, exposure = frame.middle_ns, frame.exposure

        def pose(t_ns: int) -> Array:
            return np.asarray(poses(np.array([t_ns]))[0])

        def view(t_ns: int, rows: slice) -> GreyImage:
            return self._camera.render(pose(t_ns), scene.movers_at(t_ns), rows)

        half_ns = round(0.5e9 * (exposure.time_s + self._readout_s))
        T_world_cam = pose(middle_ns)
        swept_rad = scene.angle_swept_rad(middle_ns - half_ns, middle_ns + half_ns, T_world_cam[:3, 3])
        nearest_m = self.thumbnail.nearest_m(T_world_cam, scene.movers_at(middle_ns))
        plan = self._shutter.plan(poses, middle_ns, exposure.time_s, nearest_m, swept_rad)
        light = self._shutter.expose(plan, poses, view)
        irradiance = scene.illumination * float(frame.lit)
        return self._imaging.digitize(light, irradiance, exposure.time_s, exposure.gain, rng, self._pixels)


def image_noise(seed: int, frame: int, camera: int) -> np.random.Generator:
    """Return the generator of the noise of one image.

    Args:
        seed: Seed of the flight.
        frame: Index of the frame in the flight.
        camera: Number of the camera.
    """
    return generator(seed, "images", frame, camera)


def thumbnail(model: CameraModel) -> CameraModel:
    """Return a camera with the same field of view and an image of 1/8 of the width and height."""
    width, height = (max(size // _THUMBNAIL_PX, 1) for size in (model.width, model.height))
    return model.resized(width, height)
