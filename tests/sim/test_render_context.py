"""Cameras that share a render context, and partial images, have the pixels of separate whole images."""

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import GraphicsError
from dronevio.models.rig import EUROC_CAM0
from dronevio.models.rig_presets import TUM_VI_CAMERA
from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.cameras.camera import OffscreenCamera

SMALL = CameraModel(width=96, height=64, fx=60.0, fy=60.0, cx=47.5, cy=31.5)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """Return glowing spheres in all directions."""
    rng = np.random.default_rng(3)
    spec = mujoco.MjSpec()
    for k in range(300):
        glow = spec.add_material(name=f"glow_{k}", emission=1.0, rgba=[*rng.uniform(0.2, 1.0, 3), 1.0])
        direction = rng.standard_normal(3)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.3, 0.0, 0.0],
            pos=2.0 * direction / np.linalg.norm(direction),
            material=glow.name,
        )
    spec.stat.extent = 5.0
    return spec.compile()


@pytest.fixture
def context(model: mujoco.MjModel) -> Iterator[RenderContext]:
    opened = RenderContext(model)
    yield opened
    opened.close()


@pytest.mark.parametrize("camera", [EUROC_CAM0, TUM_VI_CAMERA], ids=["single view", "cube"])
def test_partial_images_equal_the_rows_of_the_image(model: mujoco.MjModel, camera: CameraModel) -> None:
    with OffscreenCamera(model, camera) as offscreen:
        whole = offscreen.render(np.eye(4))
        assert whole.std() > 20.0
        for rows in (slice(0, 40), slice(100, 163), slice(camera.height - 1, camera.height), slice(2, camera.height)):
            T_backward = np.diag([-1.0, 1.0, -1.0, 1.0])
            offscreen.render(T_backward)  # overwrites the graphics memory
            part = offscreen.render(np.eye(4), rows=rows).astype(int)
            assert part.shape == (rows.stop - rows.start, camera.width)
            assert np.abs(part - whole[rows]).max() <= 8  # the outline of a sphere may differ by a fraction of a pixel
            assert np.abs(part - whole[rows]).mean() < 1e-3


def test_cameras_share_a_render_context(model: mujoco.MjModel, context: RenderContext) -> None:
    with OffscreenCamera(model, EUROC_CAM0) as separate:
        expected = separate.render(np.eye(4))
    with (
        OffscreenCamera(model, SMALL, context=context) as small,
        OffscreenCamera(model, EUROC_CAM0, context=context) as offscreen,
    ):
        assert small.render(np.eye(4)).max() > 100
        np.testing.assert_array_equal(offscreen.render(np.eye(4)), expected)
        small.close()
        np.testing.assert_array_equal(offscreen.render(np.eye(4)), expected)
        context.close()
        with pytest.raises(GraphicsError, match="closed"):
            offscreen.render(np.eye(4))


def test_a_bigger_camera_does_not_change_a_smaller_one(model: mujoco.MjModel, context: RenderContext) -> None:
    with OffscreenCamera(model, SMALL, context=context) as small:
        before = small.render(np.eye(4))
        big = replace(SMALL, width=500, height=400, cx=249.5, cy=199.5)
        with OffscreenCamera(model, big, context=context) as offscreen:
            assert offscreen.render(np.eye(4)).shape == (400, 500)
            np.testing.assert_array_equal(small.render(np.eye(4)), before)


def coloured_planes() -> mujoco.MjModel:
    """Return two planes with the same coloured texture, of which the material of the second one is red."""
    spec, rng = mujoco.MjSpec(), np.random.default_rng(4)
    for number, tint in enumerate(([1.0, 1.0, 1.0, 1.0], [1.0, 0.3, 0.3, 1.0])):
        texture = spec.add_texture(name=f"t_{number}", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
        texture.height = texture.width = 64
        texture.data = np.repeat(np.repeat(rng.integers(0, 256, (8, 8, 3), np.uint8), 8, axis=0), 8, axis=1).tobytes()
        material = spec.add_material(name=f"m_{number}", emission=1.0, rgba=tint)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[1.0, 1.0, 1.0],
            pos=[2.0 * number - 1.0, 0.0, 2.0],
            zaxis=[0.0, 0.0, -1.0],
            material=material.name,
        )
    return spec.compile()


def test_grey_textures_give_the_same_grey_images() -> None:
    model = coloured_planes()
    images, colours = [], []
    for grey in (False, True):
        context = RenderContext(model, grey=grey)
        with OffscreenCamera(model, SMALL, context=context) as camera:
            images.append(camera.render(np.eye(4)).astype(int))
            colours.append(camera.render_rgb(np.eye(4)).astype(int))
        context.close()
    assert images[0].std() > 20.0
    assert np.abs(images[1] - images[0]).max() <= 2
    left, right = slice(0, 40), slice(56, 96)
    assert np.ptp(colours[1][:, left], axis=-1).max() == 0
    assert np.ptp(colours[1][:, right], axis=-1).max() > 50  # of a tinted material, the texture keeps its colours
