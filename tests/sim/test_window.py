"""Windows show images where there is a display, and say so where there is none; rendering goes on in both cases."""

import os
import shutil
import subprocess
import sys

import pytest

from dronevio.models.errors import GraphicsError
from dronevio.sim.rendering.window import Window, require_display

LINUX_ONLY = pytest.mark.skipif(sys.platform != "linux", reason="displays and EGL are Linux's")

TINY = """
import mujoco, numpy as np
from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.models.camera import CameraModel
spec = mujoco.MjSpec()
spec.add_material(name="white", rgba=[1, 1, 1, 1], emission=1)
spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.5, 0, 0], pos=[0, 0, 2], material="white")
spec.stat.extent = 5
model, camera = spec.compile(), CameraModel(width=48, height=32, fx=40, fy=40, cx=23.5, cy=15.5)
"""
"""Program that defines a model and a camera that sees it."""

SHOW = (
    TINY
    + """
from dronevio.sim.rendering.window import Window
offscreen = OffscreenCamera(model, camera)
image = offscreen.render_rgb(np.eye(4))
window = Window(48, 32, "test", 1000.0)
for _ in range(3):
    window.show(image)
    assert np.array_equal(offscreen.render_rgb(np.eye(4)), image)
window._glfw.make_context_current(window._window)
shown = np.zeros((32, 48, 3), np.uint8)
mujoco.mjr_readPixels(shown, None, window._rectangle, window._drawing)
window._glfw.set_window_should_close(window._window, True)
window.show(image)
window.show(image)
window.close()
assert np.array_equal(offscreen.render_rgb(np.eye(4)), image)
print("shown" if np.array_equal(shown[::-1], image) and image.max() > 200 else shown[::-1].astype(int) - image)
"""
)

LOSE = (
    TINY
    + """
import mujoco.egl
from OpenGL import EGL
from dronevio.models.errors import GraphicsError
from dronevio.sim.rendering.loaded_world import LoadedWorld
from dronevio.sim.rendering.shared import SharedPool
pool = SharedPool()
def rendered(lease):
    return OffscreenCamera(model, camera, context=lease.value.context).render(np.eye(4))
def lease():
    return pool.lease("world", lambda: LoadedWorld(model, 1.0, (), RenderContext(model)))
before = lease()
image = rendered(before)
EGL.eglMakeCurrent(mujoco.egl.EGL_DISPLAY, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)
EGL.eglTerminate(mujoco.egl.EGL_DISPLAY)  # as SDL does when it has opened a window without a display
try:
    rendered(before)
except GraphicsError as error:
    print(error)
assert np.array_equal(rendered(lease()), image)
"""
)


def run(program: str, *launcher: str) -> "subprocess.CompletedProcess[str]":
    """Run a program in a process of its own."""
    command = [*launcher, sys.executable, "-c", program]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=60, env={**os.environ, "LP_NUM_THREADS": "1"}
    )


@LINUX_ONLY
def test_missing_displays_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(GraphicsError, match=r"'human' opens a window.*DISPLAY.*'rgb_array'"):
        require_display()
    with pytest.raises(GraphicsError, match="no display"):
        Window(8, 8, "test", 50.0)


@LINUX_ONLY
def test_unreachable_displays_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(GraphicsError, match="4711"):
        require_display()


@LINUX_ONLY
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="xvfb is not installed")
def test_images_are_shown_while_others_are_rendered() -> None:
    ran = run(SHOW, "xvfb-run", "-a")
    assert ran.stdout == "shown\n", ran.stderr


@LINUX_ONLY
def test_a_lost_connection_does_not_last() -> None:
    ran = run(LOSE)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("the OpenGL context is lost or in use by another thread")
    assert ran.stderr == ""
