"""Images of many environments at a rate of their own, with mounting errors of the cameras and randomized appearance."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.imu import Times
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.camera_observation import CameraObservation, Images
from dronevio.sim.envs.sensing.depth_errors import EXACT, DepthErrors
from dronevio.sim.envs.sensing.image_flow import ImagePoses
from dronevio.sim.physics.vehicle_states import with_rows


@dataclass(frozen=True, eq=False)
class HeldImages:
    """Images of n environments, each of which is shown for some steps."""

    due_in: npt.NDArray[np.int64]
    """(n,) Number of steps until the next image; 0 or less if it is due."""
    images: Images
    """(n, H, W, C) Newest images by name."""
    poses: ImagePoses
    """Their poses and times."""

    def restarted(self, mask: Mask) -> "HeldImages":
        """Return the images at the start of the episodes in a mask (n,), with new ones due there."""
        poses = replace(self.poses, exists=self.poses.exists & ~mask)
        return replace(self, due_in=np.where(mask, 0, self.due_in), poses=poses)

    def one_step_later(self) -> "HeldImages":
        """Return the images after a step."""
        return replace(self, due_in=self.due_in - 1)


class ImageRenderer:
    """Renders the images of environments: one at the start of an episode, and one every ``period`` steps."""

    def __init__(
        self,
        period: int,
        make_source: Callable[[int, int], CameraObservation],
        world_seed: int,
        depth_errors: DepthErrors = EXACT,
        focal_px: Mapping[str, float] | None = None,
    ) -> None:
        """Define cameras and rate; nothing is rendered yet.

        Args:
            period: Number of steps from one image to the next.
            make_source: Function that returns the renderer of the world with a seed, and with a seed of its textures.
            world_seed: Seed of a world.
            depth_errors: Errors of depth images.
            focal_px: Focal lengths of the depth images by name [px].
        """
        self._period, self._make_source = period, make_source
        self._errors, self._focal_px, self._rng = depth_errors, focal_px or {}, np.random.default_rng(0)
        self._sources = {(world_seed, world_seed): make_source(world_seed, world_seed)}
        self.spaces = self._sources[world_seed, world_seed].spaces()
        """Spaces of the images of one environment by name."""

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw the errors of depths from a stream of another generator from now on."""
        if self._errors != EXACT:
            self._rng = rng.spawn(1)[0]

    def save(self) -> dict[str, Any]:
        """Return the state of the random numbers."""
        return dict(self._rng.bit_generator.state)

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`."""
        self._rng.bit_generator.state = saved

    def start(self, count: int) -> HeldImages:
        """Return black images of ``count`` environments, all of them due."""
        black = {name: np.zeros((count, *space.shape), space.dtype) for name, space in self.spaces.items()}
        return HeldImages(np.zeros(count, dtype=np.int64), black, ImagePoses.none(count))

    def renewed(
        self, held: HeldImages, T_world_imu: Array, t_ns: Times, randomized: RandomizedParameters
    ) -> HeldImages:
        """Return the images after those that are due have been rendered.

        Args:
            held: Images of n environments.
            T_world_imu: (n, 4, 4) Poses of the IMUs.
            t_ns: (n,) Times since the starts of the episodes [ns].
            randomized: Parameters of the episodes: mounting errors, light and textures.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        due = np.flatnonzero(held.due_in <= 0)
        if not due.size:
            return held
        error = pose_matrix(exp_so3(randomized.camera_rotation_rad[due]), randomized.camera_translation_m[due])
        now = ImagePoses(T_world_imu[due] @ error, t_ns[due], np.ones(due.size, np.bool_))
        poses = with_rows(held.poses, due, now)
        images = {name: image.copy() for name, image in held.images.items()}
        seeds = np.column_stack([randomized.world_seed, randomized.texture_seed])[due]
        for each in np.unique(seeds, axis=0):
            rows = due[(seeds == each).all(axis=1)]
            rendered = self._rendered(self._source(*each.tolist()), poses.rows(rows), held.poses.rows(rows))
            for name, image in rendered.items():
                images[name][rows] = _lit(image, randomized.light[rows])
        due_in = held.due_in.copy()
        due_in[due] = self._period
        return HeldImages(due_in, images, poses)

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""
        for source in self._sources.values():
            source.close()

    def _source(self, world_seed: int, texture_seed: int) -> CameraObservation:
        """Return the renderer of the world with a seed, and with a seed of its textures."""
        seeds = world_seed, texture_seed
        if seeds not in self._sources:
            self._sources[seeds] = self._make_source(*seeds)
        return self._sources[seeds]

    def _rendered(self, source: CameraObservation, now: ImagePoses, previous: ImagePoses) -> Images:
        """Return the images of some environments, in nominal light."""
        images = source.observe(now.T_world_imu, now.t_ns, previous)
        for name, focal_px in self._focal_px.items():
            farthest_m = float(self.spaces[name].high.flat[0])
            images[name] = self._errors.applied(images[name], focal_px, farthest_m, self._rng)
        return images


def _lit(images: npt.NDArray[Any], light: Array) -> npt.NDArray[Any]:
    """Return images (k, H, W, C) of grey levels or colours at illuminations (k,); others are returned unchanged."""
    if images.dtype != np.uint8 or np.all(light == 1.0):
        return images
    return np.clip(np.rint(images * light[:, None, None, None]), 0.0, 255.0).astype(np.uint8)
