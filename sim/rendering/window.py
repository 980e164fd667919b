"""Window: images on the screen, in real time.

The window is GLFW's, which MuJoCo depends on. SDL (pygame), on which Gymnasium's wrapper `HumanRendering` depends,
closes the EGL connection of the whole process when there is no display, so that nothing can be rendered afterwards.
"""

import importlib
import os
import platform
import time
import warnings
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import GraphicsError
from dronevio.sim.cameras.gl import choose_backend

_NO_DISPLAY = (
    "render_mode='human' opens a window, and there is no display: {}; "
    "render_mode='rgb_array' returns images without a display"
)


def require_display() -> None:
    """Check that a window can be opened.

    Raises:
        GraphicsError: There is no display.
    """
    if platform.system() == "Linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise GraphicsError(_NO_DISPLAY.format("neither DISPLAY nor WAYLAND_DISPLAY is set"))
    _glfw()


def has_display() -> bool:
    """Return whether a window can be opened."""
    try:
        require_display()
    except GraphicsError:
        return False
    return True


class Window:
    """A window that shows images of one size at a limited rate. Close it after use.

    When the user closes the window, later images are ignored.
    """

    def __init__(self, width: int, height: int, title: str, images_per_s: float) -> None:
        """Open the window.

        Args:
            width: Width of the images [px].
            height: Height of the images [px].
            title: Title of the window.
            images_per_s: Largest number of images per second; faster calls of `show` wait.

        Raises:
            GraphicsError: There is no display.
        """
        require_display()
        self._glfw = glfw = _glfw()
        self._interval_s = 1.0 / images_per_s
        self._shown_s = -np.inf
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        glfw.default_window_hints()
        glfw.window_hint(glfw.RESIZABLE, False)
        glfw.window_hint(glfw.COCOA_RETINA_FRAMEBUFFER, False)
        if choose_backend().name == "egl":  # one thread cannot alternate between GLX and EGL
            glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error below says the same
            self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            raise GraphicsError(_NO_DISPLAY.format(_problem(glfw)))
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)
        self._drawing = mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW, self._drawing)

    def show(self, image: npt.NDArray[np.uint8]) -> None:
        """Show an RGB image (H, W, 3), once the previous one has been visible for its time."""
        if not self._window:
            return
        if self._glfw.window_should_close(self._window):
            self.close()
            return
        time.sleep(max(self._shown_s + self._interval_s - time.monotonic(), 0.0))
        self._glfw.make_context_current(self._window)
        mujoco.mjr_drawPixels(np.ascontiguousarray(image[::-1]).ravel(), None, self._rectangle, self._drawing)
        self._glfw.swap_buffers(self._window)
        self._glfw.poll_events()
        self._shown_s = time.monotonic()

    def close(self) -> None:
        """Close the window; further calls have no effect."""
        if self._window:
            self._glfw.make_context_current(self._window)
            self._drawing.free()
            self._glfw.destroy_window(self._window)
            self._window = None


def _glfw() -> Any:
    """Return the module of GLFW, initialized; it stays so, since MuJoCo may use it, too.

    Raises:
        GraphicsError: GLFW is not installed or does not find a display.
    """
    try:
        glfw = importlib.import_module("glfw")
    except ImportError as error:
        raise GraphicsError(_NO_DISPLAY.format(error)) from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the error below says the same
        ready = glfw.init()
    if not ready:
        raise GraphicsError(_NO_DISPLAY.format(_problem(glfw)))
    return glfw


def _problem(glfw: Any) -> str:
    """Return the last error of GLFW."""
    code, message = glfw.get_error()
    return message.decode(errors="replace") if message else f"GLFW reports error {code}"
