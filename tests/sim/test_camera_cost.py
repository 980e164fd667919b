"""The measured cost of a camera is relative to that of MuJoCo's renderer with the same images."""

import mujoco
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.rig import EUROC_CAM0
from dronevio.models.rig_presets import TUM_VI_CAMERA
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.speed import camera_cost as measured


def emissive_model() -> mujoco.MjModel:
    """Return a model of two spheres, one of them emissive and the other without any light on it."""
    spec = mujoco.MjSpec()
    spec.add_material(name="glow", rgba=[1.0, 1.0, 1.0, 1.0], emission=0.8)
    for x, material in ((-0.5, "glow"), (0.5, "")):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.4, 0, 0], pos=[x, 0.1, 2.0], material=material
        )
    return spec.compile()


@pytest.mark.parametrize("camera", [EUROC_CAM0, TUM_VI_CAMERA])
def test_both_renderers_draw_the_same_images(camera: CameraModel, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[np.ndarray] = []
    original_render = mujoco.Renderer.render

    def recording_render(renderer: mujoco.Renderer) -> np.ndarray:
        drawn.append(original_render(renderer))
        return drawn[-1]

    monkeypatch.setattr(mujoco.Renderer, "render", recording_render)
    small = camera.resized(round(0.25 * camera.width), round(0.25 * camera.height))
    model = emissive_model()
    size_before = model.vis.global_.offwidth, model.vis.global_.offheight
    cost = measured.camera_cost(model, small, np.eye(4)[None])
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == size_before
    assert cost.camera_ms > 0.0
    assert cost.bare_ms > 0.0
    assert cost.ratio == cost.camera_ms / cost.bare_ms
    with OffscreenCamera(model, small) as offscreen:
        atlas = offscreen._renderer.colours(np.eye(4))[::-1]
        views = offscreen.views.views
    assert cost.drawn_pixels == sum(image.shape[0] * image.shape[1] for image in drawn[-len(views) :])
    for view, image in zip(views, drawn[-len(views) :], strict=True):
        ours = atlas[atlas.shape[0] - view.height :, view.column : view.column + view.width]
        np.testing.assert_array_equal(image, ours)
    assert max(image.max() for image in drawn) > 200
