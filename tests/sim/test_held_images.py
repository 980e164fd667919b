"""Images of many environments at a rate of their own, by a renderer that counts."""

from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces

from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.held_images import ImageRenderer
from dronevio.sim.envs.sensing.image_flow import ImagePoses

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

    def observe(self, T_world_imu: Array, t_ns: Any = None, previous: ImagePoses | None = None) -> dict[str, Any]:
        self.calls += 1
        self.poses.append(T_world_imu)
        grey = np.full((len(T_world_imu), 1, 1, 1), 100 + 10 * self.texture_seed + self.calls, np.uint8)
        return {"grey": grey, "depth": np.full(grey.shape, 2.0, np.float32)}

    def close(self) -> None:
        self.closed = True


class Shown:
    """Images of three environments, step by step."""

    def __init__(self, period: int) -> None:
        self.sources: list[CountingSource] = []
        self.renderer = ImageRenderer(period, self.source, 0)
        self.images = self.renderer.start(3)

    def source(self, world_seed: int, texture_seed: int) -> CountingSource:
        self.sources.append(CountingSource(texture_seed))
        return self.sources[-1]

    def seen(self, randomized: RandomizedParameters) -> list[int]:
        """Return the grey levels of the images of three environments."""
        poses = np.tile(np.eye(4), (3, 1, 1))
        self.images = self.renderer.renewed(self.images, poses, np.zeros(3, np.int64), randomized)
        levels: list[int] = self.images.images["grey"][:, 0, 0, 0].tolist()
        return levels

    def step(self) -> None:
        self.images = self.images.one_step_later()


def test_images_are_repeated_until_the_next_is_due() -> None:
    shown, randomized = Shown(2), RandomizedParameters.nominal(3, 0)
    assert shown.seen(randomized) == shown.seen(randomized) == [101] * 3
    shown.step()
    shown.images = shown.images.restarted(np.array([False, True, False]))
    assert shown.seen(randomized) == [101, 102, 101]
    shown.step()
    assert shown.seen(randomized) == [103, 102, 103]
    assert [len(poses) for poses in shown.sources[0].poses] == [3, 1, 2]


def test_textures_light_and_mounting_are_those_drawn() -> None:
    shown = Shown(1)
    rotation, translation = np.zeros((3, 3)), np.zeros((3, 3))
    rotation[1], translation[1] = [0.1, 0.0, 0.0], [0.0, 0.02, 0.0]
    randomized = replace(
        RandomizedParameters.nominal(3, 0),
        light=np.array([1.0, 2.0, 9.0]),
        texture_seed=np.array([0, 1, 0]),
        camera_rotation_rad=rotation,
        camera_translation_m=translation,
    )
    assert shown.seen(randomized) == [101, 222, 255]
    assert [source.texture_seed for source in shown.sources] == [0, 1]
    error = shown.sources[1].poses[0][0]
    np.testing.assert_allclose(error[:3, :3], exp_so3(rotation[1]))
    np.testing.assert_allclose(error[:3, 3], translation[1])
    assert shown.images.images["depth"].max() == 2.0
    shown.renderer.close()
    assert all(source.closed for source in shown.sources)


def test_later_images_do_not_change_earlier_ones() -> None:
    shown, randomized = Shown(2), RandomizedParameters.nominal(3, 0)
    shown.seen(randomized)
    shown.step()
    saved = shown.images
    shown.images = shown.images.restarted(EVERY)
    assert shown.seen(randomized) == [102] * 3
    shown.images = saved
    assert shown.seen(randomized) == [101] * 3
