"""Images of environments: batches, kinds, moving objects, textures, and worlds that environments share."""

import pickle
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rig import EUROC_CAM0, RigCamera
from dronevio.models.rig_presets import TUM_VI_CAMERA, rig_named
from dronevio.models.rotation import pose_matrix
from dronevio.sim.appearance.scenery import reduced_image
from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.envs.sensing.camera_observation import (
    ImageSettings,
    RenderedObservation,
    texture_reduction,
)
from dronevio.sim.rendering import loaded_world
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS, LoadedWorld
from dronevio.sim.world import Mover, build_world

RIG = rig_named("euroc-stereo")
AHEAD = RigCamera(EUROC_CAM0, np.eye(4))
ALL_KINDS = ImageSettings(("grey", "rgb", "depth"), width=32, height=24, depth_max_m=5.0)
WALL_M = 3.0


def poses(x: Any) -> np.ndarray:
    """Return poses (n, 4, 4) that look along z from places on the x axis."""
    T = np.repeat(np.eye(4)[None], np.size(x), axis=0)
    T[:, 0, 3] = x
    return T


def along_x(t_s: np.ndarray) -> np.ndarray:
    """Return poses (M, 4, 4) of an object at a distance of 2 m that moves at 1 m/s to the right."""
    T = poses(t_s)
    T[:, 2, 3] = 2.0
    return T


@pytest.fixture
def tiny_world(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Replaces all worlds by a wall of red and green at z = 3 m from x = −2 to 2 m, and a blue ball that moves."""
    spec = mujoco.MjSpec()
    for name, rgb in (("red", [1, 0, 0]), ("green", [0, 1, 0]), ("blue", [0, 0, 1])):
        spec.add_material(name=name, emission=1.0, rgba=[*rgb, 1.0])
    for name, x in (("red", -1.0), ("green", 1.0)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[1.0, 9.0, 0.5], pos=[x, 0.0, WALL_M + 0.5], material=name
        )
    ball = spec.worldbody.add_body(name="ball", mocap=True, pos=[0.0, 0.0, 2.0])
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.2, 0, 0], material="blue")
    spec.stat.extent = 10.0
    world = spec.compile(), 1.0, (Mover("ball", along_x),)
    monkeypatch.setattr(loaded_world, "_compiled", lambda key: world)
    monkeypatch.setattr(loaded_world, "resolved_world", lambda name: name)
    monkeypatch.setattr(loaded_world, "_loaded_instances", lambda *key: LoadedWorld(*world, RenderContext(world[0])))
    LOADED_WORLDS.clear()
    yield
    LOADED_WORLDS.clear()


@pytest.mark.usefixtures("tiny_world")
def test_batches_equal_single_images() -> None:
    observation = RenderedObservation(AHEAD, "tiny", 0, ALL_KINDS)
    places = np.linspace(-0.5, 0.5, 3)
    batch = observation.observe(poses(places))
    for row, place in enumerate(places):
        single = observation.observe(poses(place))
        assert all(np.array_equal(batch[kind][row], single[kind][0]) for kind in ALL_KINDS.kinds)
    for kind, space in observation.spaces().items():
        assert batch[kind].shape == (3, *space.shape)
        assert all(image in space for image in batch[kind])
    assert {kind: space.dtype.name for kind, space in observation.spaces().items()} == {
        "grey": "uint8",
        "rgb": "uint8",
        "depth": "float32",
    }
    observation.close()


@pytest.mark.usefixtures("tiny_world")
def test_colour_and_depth_are_those_of_the_world() -> None:
    observation = RenderedObservation(AHEAD, "tiny", 0, ALL_KINDS)
    images = observation.observe(poses(0.0), np.array([10**10]))  # the ball is 10 m away
    left, right = images["rgb"][0, 12, 8], images["rgb"][0, 12, 24]
    assert left[0] > 200 and left[1] < 20
    assert right[1] > 200 and right[0] < 20
    assert images["grey"][0, 12, 8, 0] == pytest.approx(0.299 * left[0], abs=2)
    np.testing.assert_allclose(images["depth"][0, 12, 8:24, 0], WALL_M, atol=0.01)
    far = observation.observe(poses(30.0))["depth"]
    assert far.min() == far.max() == 5.0  # nothing in sight
    observation.close()


@pytest.mark.usefixtures("tiny_world")
def test_moving_objects_are_shown_at_their_times() -> None:
    observation = RenderedObservation(AHEAD, "tiny", 0, ALL_KINDS)
    images = observation.observe(poses([0.0, 0.0]), np.array([0, 500_000_000]))
    columns = [int(depth[12].argmin()) for depth in images["depth"]]
    fx = EUROC_CAM0.fitted(32, 24).fx
    assert columns[1] - columns[0] == pytest.approx(fx * 0.5 / 1.85, abs=1.5)
    assert images["depth"].min() == pytest.approx(1.8, abs=0.02)
    assert np.array_equal(observation.observe(poses(0.0))["rgb"][0], images["rgb"][0])  # 0 s by default
    observation.close()


@pytest.mark.usefixtures("tiny_world")
def test_environments_share_a_world() -> None:
    several = [RenderedObservation(camera, "tiny", 0) for camera in (*RIG.cameras, AHEAD)]
    images = [one.observe(poses(0.0))["grey"] for one in several]
    assert len(LOADED_WORLDS) == 1
    assert not np.array_equal(images[0], images[1])  # of the two cameras of the rig
    several[0].close()
    several[0].close()
    assert np.array_equal(several[1].observe(poses(0.0))["grey"], images[1])
    assert np.array_equal(several[0].observe(poses(0.0))["grey"], images[0])  # opens again
    other = RenderedObservation(AHEAD, "tiny", 0, texture_seed=5)
    other.observe(poses(0.0))
    assert len(LOADED_WORLDS) == 2
    for one in (*several, other):
        one.close()


@pytest.mark.usefixtures("tiny_world")
def test_observations_can_be_pickled() -> None:
    observation = RenderedObservation(AHEAD, "tiny", 0)
    image = observation.observe(poses(0.1))["grey"]
    copied = pickle.loads(pickle.dumps(observation))
    assert np.array_equal(copied.observe(poses(0.1))["grey"], image)
    observation.close()
    copied.close()


def test_surfaces_are_those_of_the_painted_world(monkeypatch: pytest.MonkeyPatch) -> None:
    T = pose_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.0, 0.3, 1.2]))

    def of(kinds: tuple[Any, ...]) -> dict[str, np.ndarray]:
        observation = RenderedObservation(AHEAD, "low-texture", 0, ImageSettings(kinds, 64, 64))
        images = observation.observe(T[None])
        observation.close()
        return images

    LOADED_WORLDS.clear()
    with OffscreenCamera(build_world("low-texture", 0).spec.compile(), EUROC_CAM0.fitted(64, 64), 1.5) as camera:
        painted = camera.render_depth(T)
    monkeypatch.setattr(loaded_world, "build_world", pytest.fail)  # nothing is painted
    seen = of(("depth", "segmentation", "flow"))
    np.testing.assert_allclose(seen["depth"][0, ..., 0], np.minimum(painted, 20.0), atol=1e-3)
    for kind in ("depth", "segmentation"):
        assert np.array_equal(of((kind,))[kind], seen[kind])


@pytest.mark.usefixtures("tiny_world")
def test_fisheye_depth_is_bounded() -> None:
    camera = RigCamera(TUM_VI_CAMERA, np.eye(4))
    observation = RenderedObservation(camera, "tiny", 0, ImageSettings(("depth",), 32, 32, 4.0))
    depth = observation.observe(poses(0.0), np.array([10**10]))["depth"][0, :, :, 0]
    assert depth[16, 16] == pytest.approx(WALL_M, rel=0.02)
    assert np.all(np.isfinite(depth))
    assert depth[0, 0] == 4.0  # outside the field of view, or beyond the wall
    observation.close()


def test_texture_seed_changes_textures_only() -> None:
    specs = [build_world("low-texture", 0, seed, 4).spec for seed in (None, 0, 1)]
    textures = [[bytes(texture.data) for texture in spec.textures] for spec in specs]
    vertices = [[np.asarray(mesh.uservert) for mesh in spec.meshes] for spec in specs]
    assert textures[0] == textures[1] and all(a != b for a, b in zip(textures[0], textures[2], strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(vertices[0], vertices[2], strict=True))


def test_reduced_textures_show_the_same() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (40, 84, 3), dtype=np.uint8)
    small = reduced_image(image, 4)
    assert small.shape == (10, 21, 3)
    assert small[2, 3, 1] == pytest.approx(image[8:12, 12:16, 1].mean(), abs=0.51)
    near, far = (EUROC_CAM0.resized(width, width) for width in (64, 640))
    assert (texture_reduction(near), texture_reduction(far)) == (4, 1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kinds": ()}, "kinds"),
        ({"kinds": ("grey", "grey")}, "each once"),
        ({"kinds": ("thermal",)}, "thermal"),
        ({"width": 0}, "width = 0"),
        ({"depth_max_m": -1.0}, "depth_max_m"),
        ({"depth_max_m": np.inf}, "depth_max_m"),
    ],
)
def test_invalid_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ImageSettings(**settings)
