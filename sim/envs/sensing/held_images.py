"""Images of many environments at a rate of their own, with mounting errors of the cameras and randomized appearance."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.imu import Times
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.camera_observation import CameraObservation, Images
from dronevio.sim.physics.vehicle_states import Mask

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]


class HeldImages:
    """Images of n environments.

    An image is taken at the start of an episode and every ``period`` steps; in between, the last one is repeated.
    """

    def __init__(
        self, count: int, period: int, make_source: Callable[[int], CameraObservation], texture_seed: int
    ) -> None:
        """Define cameras and rate; nothing is rendered yet.

        Args:
            count: Number n of environments.
            period: Number of steps from one image to the next.
            make_source: Function that returns the renderer of the world with a seed of its textures.
            texture_seed: A seed of textures.
        """
        self._period, self._make_source = period, make_source
        self._sources = {texture_seed: make_source(texture_seed)}
        self._spaces = self._sources[texture_seed].spaces()
        self._age = np.full(count, period, dtype=np.int64)  # steps since the last image
        self._images: Images = {
            name: np.zeros((count, *space.shape), space.dtype) for name, space in self._spaces.items()
        }

    def spaces(self) -> dict[str, spaces.Box]:
        """Return the spaces of the images of one environment."""
        return self._spaces

    def reset(self, mask: Mask) -> None:
        """Demand new images of the environments of a mask (n,)."""
        self._age = np.where(mask, self._period, self._age)

    def step(self) -> None:
        """Count a step."""
        self._age = self._age + 1

    def observe(self, T_world_imu: Array, t_ns: Times, randomized: RandomizedParameters) -> Images:
        """Return the images (n, H, W, C) by name, rendering those that are due.

        Args:
            T_world_imu: (n, 4, 4) Poses of the IMUs.
            t_ns: (n,) Times since the starts of the episodes [ns].
            randomized: Parameters of the episodes: mounting errors, light and textures.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        due = np.flatnonzero(self._age >= self._period)
        for seed in np.unique(randomized.texture_seed[due]).tolist():
            self._render(due[randomized.texture_seed[due] == seed], T_world_imu, t_ns, randomized, self._source(seed))
        self._age[due] = 0
        return {name: image.copy() for name, image in self._images.items()}

    def save(self) -> dict[str, Any]:
        """Return a copy of images and their ages."""
        return {"age": self._age.copy(), "images": {name: image.copy() for name, image in self._images.items()}}

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`."""
        self._age = saved["age"].copy()
        self._images = {name: image.copy() for name, image in saved["images"].items()}

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""
        for source in self._sources.values():
            source.close()

    def _source(self, texture_seed: int) -> CameraObservation:
        """Return the renderer of the world with a seed of its textures."""
        if texture_seed not in self._sources:
            self._sources[texture_seed] = self._make_source(texture_seed)
        return self._sources[texture_seed]

    def _render(
        self, rows: Rows, T_world_imu: Array, t_ns: Times, randomized: RandomizedParameters, source: CameraObservation
    ) -> None:
        """Render the images of some environments."""
        error = pose_matrix(exp_so3(randomized.camera_rotation_rad[rows]), randomized.camera_translation_m[rows])
        for name, image in source.observe(T_world_imu[rows] @ error, t_ns[rows]).items():
            self._images[name][rows] = _lit(image, randomized.light[rows])


def _lit(images: npt.NDArray[Any], light: Array) -> npt.NDArray[Any]:
    """Return images (k, H, W, C) of grey levels or colours at illuminations (k,); others are returned unchanged."""
    if images.dtype != np.uint8 or np.all(light == 1.0):
        return images
    return np.clip(np.rint(images * light[:, None, None, None]), 0.0, 255.0).astype(np.uint8)
