"""Camera observations: the images that an environment adds to its observations."""

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
    """Interface of an observation component with images."""

    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the spaces of the entries of `observe`."""

    def observe(self, T_world_imu: Array) -> dict[str, npt.NDArray[np.uint8]]:
        """Return the entries at a pose T_world_imu (4, 4)."""

    def close(self) -> None:
        """Release the resources of rendering."""


class NoCameraObservation:
    """No images; implements `CameraObservation`."""

    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return no entries."""
        return {}

    def observe(self, T_world_imu: Array) -> dict[str, npt.NDArray[np.uint8]]:
        """Return no entries."""
        return {}

    def close(self) -> None:
        """Do nothing."""


class RenderedObservation:
    """An image of reduced size from a camera of a rig in a world that is built at the first call of `observe`."""

    def __init__(self, mounted: RigCamera, scale: float, world: str, seed: int) -> None:
        """Define camera and world.

        Args:
            mounted: The camera and its mounting on the rig.
            scale: Width of the images relative to that of the camera.
            world: Name of the world.
            seed: Seed of the world.
        """
        self._model = scaled(mounted.model, scale)
        self._T_imu_cam = mounted.T_imu_cam
        self._world, self._seed = world, seed
        self._camera: OffscreenCamera | None = None

    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of ``image``: a grey image (H, W, 1)."""
        return {"image": spaces.Box(0, 255, (self._model.height, self._model.width, 1), np.uint8)}

    def observe(self, T_world_imu: Array) -> dict[str, npt.NDArray[np.uint8]]:
        """Return the ``image`` (H, W, 1) at a pose T_world_imu (4, 4).

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        if self._camera is None:
            self._camera = OffscreenCamera(build_world(self._world, self._seed).spec.compile(), self._model)
        return {"image": self._camera.render(T_world_imu @ self._T_imu_cam)[..., None]}

    def close(self) -> None:
        """Release the graphics memory."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


def scaled(camera: CameraModel, scale: float) -> CameraModel:
    """Return a camera with the same field of view and an image of ``scale`` times the size, in whole pixels."""
    width, height = round(camera.width * scale), round(camera.height * scale)
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=(camera.cx + 0.5) * x - 0.5,  # pixel centres are at integers, so the image starts at −0.5
        cy=(camera.cy + 0.5) * y - 0.5,
    )
