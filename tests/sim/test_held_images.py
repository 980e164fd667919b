"""Images of many environments at a rate of their own, by a renderer that counts."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.rotation import exp_so3
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.held_images import HeldImages

Array = npt.NDArray[np.float64]
EVERY = np.ones(3, np.bool_)


class CountingSource:
    """Renderer whose images show its number of calls; implements `CameraObservation`."""

    def __init__(self, texture_seed: int) -> None:
        self.texture_seed, self.calls, self.closed = texture_seed, 0, False
        self.poses: list[Array] = []

    def spaces(self) -> dict[str, spaces.Box]:
        return {
            "grey": spaces.Box(0, 255, (1, 1, 1), np.uint8),
            "depth": spaces.Box(0.0, 9.0, (1, 1, 1), np.float32),
        }

    def observe(self, T_world_imu: Array, t_ns: Any = None) -> dict[str, Any]:
        self.calls += 1
        self.poses.append(T_world_imu)
        grey = np.full((len(T_world_imu), 1, 1, 1), 100 + 10 * self.texture_seed + self.calls, np.uint8)
        return {"grey": grey, "depth": np.full(grey.shape, 2.0, np.float32)}

    def close(self) -> None:
        self.closed = True


def held(period: int) -> tuple[HeldImages, list[CountingSource]]:
    sources: list[CountingSource] = []

    def source(seed: int) -> CountingSource:
        sources.append(CountingSource(seed))
        return sources[-1]

    return HeldImages(3, period, source, 0), sources


def seen(images: HeldImages, randomized: RandomizedParameters) -> list[int]:
    """Return the grey levels of the images of three environments."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    levels: list[int] = images.observe(poses, np.zeros(3, np.int64), randomized)["grey"][:, 0, 0, 0].tolist()
    return levels


def test_images_are_repeated_until_the_next_is_due() -> None:
    images, sources = held(2)
    randomized = RandomizedParameters.nominal(3, 0)
    assert seen(images, randomized) == seen(images, randomized) == [101] * 3
    images.step()
    images.reset(np.array([False, True, False]))
    assert seen(images, randomized) == [101, 102, 101]
    images.step()
    assert seen(images, randomized) == [103, 102, 103]
    assert [len(poses) for poses in sources[0].poses] == [3, 1, 2]


def test_textures_light_and_mounting_are_those_drawn() -> None:
    images, sources = held(1)
    rotation, translation = np.zeros((3, 3)), np.zeros((3, 3))
    rotation[1], translation[1] = [0.1, 0.0, 0.0], [0.0, 0.02, 0.0]
    randomized = replace(
        RandomizedParameters.nominal(3, 0),
        light=np.array([1.0, 2.0, 9.0]),
        texture_seed=np.array([0, 1, 0]),
        camera_rotation_rad=rotation,
        camera_translation_m=translation,
    )
    assert seen(images, randomized) == [101, 222, 255]
    assert [source.texture_seed for source in sources] == [0, 1]
    error = sources[1].poses[0][0]
    np.testing.assert_allclose(error[:3, :3], exp_so3(rotation[1]))
    np.testing.assert_allclose(error[:3, 3], translation[1])
    assert images.observe(np.tile(np.eye(4), (3, 1, 1)), np.zeros(3, np.int64), randomized)["depth"].max() == 2.0
    images.close()
    assert all(source.closed for source in sources)


def test_saved_images_can_be_restored() -> None:
    images, _ = held(2)
    randomized = RandomizedParameters.nominal(3, 0)
    seen(images, randomized)
    images.step()
    saved = images.save()
    images.reset(EVERY)
    assert seen(images, randomized) == [102] * 3
    images.restore(saved)
    assert seen(images, randomized) == [101] * 3
