"""Cost of the camera model relative to bare rendering, in processor time."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import mujoco
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.sim.cameras.atlas_renderer import disable_lights, set_camera
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.views import PinholeView


@dataclass(frozen=True)
class CameraCost:
    """Processor time per frame of all threads of the process, which must therefore do no other work."""

    camera_ms: float
    """Time of `OffscreenCamera.render`: rendering, conversion to grey, lens model [ms]."""
    bare_ms: float
    """Time of `mujoco.Renderer.render` for the same views, flags and sizes [ms]."""
    drawn_pixels: int
    """Number of pixels that either renders."""

    @property
    def ratio(self) -> float:
        """Ratio of the two times."""
        return self.camera_ms / self.bare_ms


def camera_cost(model: mujoco.MjModel, camera: CameraModel, Ts_world_cam: Array) -> CameraCost:
    """Measure the cost of a camera relative to MuJoCo's renderer, alternating between the two at every pose.

    Args:
        model: The compiled world.
        camera: The camera.
        Ts_world_cam: (M, 4, 4) Camera poses; the first is rendered once more in advance, without measurement.

    Raises:
        GraphicsError: Off-screen OpenGL is not available.
    """
    with OffscreenCamera(model, camera) as rendered, ExitStack() as stack:
        bare = [(view, stack.enter_context(_renderer(model, view))) for view in rendered.views.views]
        spent_s = np.zeros((1 + len(Ts_world_cam), 2))
        for row, T_world_cam in enumerate((Ts_world_cam[0], *Ts_world_cam)):
            start_s = time.process_time()
            rendered.render(T_world_cam)
            between_s = time.process_time()
            _draw_bare(model, bare, T_world_cam)
            spent_s[row] = between_s - start_s, time.process_time() - between_s
        camera_ms, bare_ms = 1e3 * spent_s[1:].mean(axis=0)
        return CameraCost(float(camera_ms), float(bare_ms), rendered.views.pixels)


def _renderer(model: mujoco.MjModel, view: PinholeView) -> mujoco.Renderer:
    """Return MuJoCo's renderer for a view, with the flags of the camera."""
    room = model.vis.global_
    before = room.offwidth, room.offheight
    room.offwidth, room.offheight = view.width, view.height
    try:
        renderer = mujoco.Renderer(model, view.height, view.width)
    finally:
        room.offwidth, room.offheight = before
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    renderer.update_scene(data)
    disable_lights(renderer.scene)
    return renderer


def _draw_bare(model: mujoco.MjModel, bare: Sequence[tuple[PinholeView, mujoco.Renderer]], T_world_cam: Array) -> None:
    """Render all views with MuJoCo's renderer."""
    near_m, far_m = (float(v * model.stat.extent) for v in (model.vis.map.znear, model.vis.map.zfar))
    for view, renderer in bare:
        set_camera(renderer.scene, T_world_cam, view, near_m, far_m)
        renderer.render()
