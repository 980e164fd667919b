"""CameraObservation: what an agent's camera adds to its observations, if it has one."""

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.camera import CameraModel
from dronevio.models.rig import RigCamera
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.world import build_world

Array = npt.NDArray[np.float64]


class CameraObservation(Protocol):
    """Adds entries to an observation."""

    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the spaces of the entries that `observe` adds."""

    def observe(self, T_world_imu: Array) -> dict[str, npt.NDArray[np.uint8]]:
        """Return what is seen from a pose (4, 4) of the IMU."""

    def close(self) -> None:
        """Give back what drawing took."""


class NoCameraObservation:
    """No camera; implements `CameraObservation`."""

    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return nothing."""
        return {}

    def observe(self, T_world_imu: Array) -> dict[str, npt.NDArray[np.uint8]]:
        """Return nothing."""
        return {}

    def close(self) -> None:
        """Do nothing."""


class RenderedObservation:
    """An image of reduced size from a camera of a rig in a world that is built at the first call of `observe`."""

    def __init__(self, mounted: RigCamera, scale: float, world: str, seed: int) -> None:
        """Prepare to look.

        Args:
            mounted: The camera.
            scale: Size of the images, relative to the camera's.
            world: Where: a name that `build_world` knows.
            seed: Draws the world.
        """
        self._model = scaled(mounted.model, scale)
        self._T_imu_cam = mounted.T_imu_cam
        self._world, self._seed = world, seed
        self._camera: OffscreenCamera | None = None

    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of ``image``: grey, (H, W, 1)."""
        return {"image": spaces.Box(0, 255, (self._model.height, self._model.width, 1), np.uint8)}

    def observe(self, T_world_imu: Array) -> dict[str, npt.NDArray[np.uint8]]:
        """Return the ``image`` (H, W, 1) from a pose (4, 4) of the IMU.

        Raises:
            GraphicsError: No off-screen OpenGL.
        """
        if self._camera is None:
            self._camera = OffscreenCamera(build_world(self._world, self._seed).spec.compile(), self._model)
        return {"image": self._camera.render(T_world_imu @ self._T_imu_cam)[..., None]}

    def close(self) -> None:
        """Give the graphics memory back."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


def scaled(camera: CameraModel, scale: float) -> CameraModel:
    """Return a camera with the same view and an image ``scale`` times as wide and high, rounded to whole pixels."""
    width, height = round(camera.width * scale), round(camera.height * scale)
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=(camera.cx + 0.5) * x - 0.5,  # pixel centres are integers: the image starts at −0.5
        cy=(camera.cy + 0.5) * y - 0.5,
    )
