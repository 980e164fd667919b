"""Off-screen OpenGL: which backend draws, whether it really draws, and what to type if it does not.

MuJoCo chooses its OpenGL by the environment variable MUJOCO_GL when it is imported, and breaks in ugly ways where the
library is missing. This module decides before that (`dronevio.sim` calls `choose_backend` on import), and everything
that draws asks it for its context.
"""

import ctypes
import importlib
import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Protocol

from dronevio.models.errors import GraphicsError

INSTALL_COMMAND = "sudo apt-get install -y libegl1 libgl1-mesa-dri libopengl0"
"""What brings an OpenGL that needs neither a display nor a GPU to Debian and Ubuntu."""

_LIBRARIES = {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
_CHOICES = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw")}
_OFF = ("disable", "disabled", "off", "false", "0")
_PROBE_TIMEOUT_S = 60.0
_PROBE = "from dronevio.sim.cameras.gl import draw_one_frame; draw_one_frame()"


class Context(Protocol):
    """An OpenGL context of MuJoCo's."""

    def make_current(self) -> None:
        """Draw with it from now on, in this thread."""

    def free(self) -> None:
        """Give its memory back."""


@dataclass(frozen=True)
class Backend:
    """What draws off screen."""

    name: str
    """``egl``, ``osmesa``, ``glfw`` or ``cgl``; empty where there is none."""
    problem: str = ""
    """Why there is none."""
    advice: str = ""
    """What to do about it."""


@dataclass(frozen=True)
class GlReport:
    """What came of drawing one frame."""

    works: bool
    """Whether the frame showed what it should."""
    backend: str
    """The backend; empty where there is none."""
    renderer: str = ""
    """The driver's name for what draws, such as ``llvmpipe``."""
    vendor: str = ""
    """Who made the driver."""
    problem: str = ""
    """Why it does not work."""
    advice: str = ""
    """What to do about it."""


def pick_backend(environment: Mapping[str, str], system: str) -> Backend:
    """Return the backend for an environment and an operating system.

    A MUJOCO_GL that the user set is respected. Without one, Linux draws by EGL, else by OSMesa, which need no display;
    macOS by what MuJoCo takes there.

    Args:
        environment: The environment variables.
        system: As `platform.system` calls it.
    """
    wish = environment.get("MUJOCO_GL", "").strip().lower()
    choices = _CHOICES.get(system, ("glfw",))
    if wish in _OFF:
        return Backend("", f"MUJOCO_GL={wish} turns drawing off", "type: unset MUJOCO_GL")
    if wish and wish not in choices:
        return Backend("", f"MUJOCO_GL={wish} is not one of {', '.join(choices)}", "type: unset MUJOCO_GL")
    if wish and not _loads(wish):
        return Backend("", f"MUJOCO_GL={wish}, but its library is not installed", "type: unset MUJOCO_GL")
    if wish or system != "Linux":
        return Backend(wish or choices[0])
    for name in _LIBRARIES:
        if _loads(name):
            return Backend(name)
    return Backend("", "neither EGL nor OSMesa is installed", _advice(system))


def _advice(system: str) -> str:
    """Return what to do where drawing fails."""
    return f"type: {INSTALL_COMMAND}" if system == "Linux" else "install the graphics driver"


def _loads(backend: str) -> bool:
    """Return whether a library of the backend can be loaded; True for those that bring their own."""
    if backend not in _LIBRARIES:
        return True
    for library in _LIBRARIES[backend]:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False


@cache
def choose_backend() -> Backend:
    """Return this process's backend, and set MUJOCO_GL so that MuJoCo can be imported whatever it is."""
    backend = pick_backend(os.environ, platform.system())
    if backend.name in _LIBRARIES:
        os.environ["MUJOCO_GL"] = backend.name
    elif backend.problem:
        os.environ["MUJOCO_GL"] = "disable"  # physics need no OpenGL
    return backend


def create_context(width: int, height: int) -> Context:
    """Return a new OpenGL context for pictures of up to the given size [px], current in this thread.

    Raises:
        GraphicsError: There is none to be had.
    """
    backend = choose_backend()
    if backend.problem:
        raise GraphicsError(_failure(_refused(backend)))
    try:
        return _new_context(backend, width, height)
    except Exception as error:  # drivers and PyOpenGL raise anything from ImportError to AttributeError
        raise GraphicsError(_failure(_broken(backend, f"{type(error).__name__}: {error}"))) from error


def _new_context(backend: Backend, width: int, height: int) -> Context:
    """Return a new current context of a backend, or raise whatever the driver raises."""
    context: Context = importlib.import_module(f"mujoco.{backend.name}").GLContext(width, height)
    context.make_current()
    return context


def draw_one_frame() -> None:
    """Draw a white square on black and print a `GlReport` as JSON: what the probe's process does."""
    import mujoco
    import numpy as np

    backend = choose_backend()
    size = 32
    spec = mujoco.MjSpec()
    spec.add_material(name="white", rgba=[1.0, 1.0, 1.0, 1.0], emission=1.0)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1], material="white")
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    model = spec.compile()
    context = _new_context(backend, size, size)
    drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
    scene, data, camera = mujoco.MjvScene(model, maxgeom=10), mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    camera.distance = 1.0
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    rectangle, image = mujoco.MjrRect(0, 0, size, size), np.zeros((size, size, 3), np.uint8)
    mujoco.mjr_render(rectangle, scene, drawing)
    mujoco.mjr_readPixels(image, None, rectangle, drawing)
    renderer, vendor = _driver_names()
    drawing.free()
    context.free()
    works = bool(image[size // 2, size // 2].min() > 200 and image[0, 0].max() < 50)
    report = GlReport(True, backend.name, renderer, vendor) if works else _broken(backend, "the frame came out wrong")
    print(json.dumps(asdict(report)))  # noqa: T201


def _driver_names() -> tuple[str, str]:
    """Return the current context's renderer and vendor; empty where PyOpenGL cannot ask."""
    try:
        GL = importlib.import_module("OpenGL.GL")
        return GL.glGetString(GL.GL_RENDERER).decode(), GL.glGetString(GL.GL_VENDOR).decode()
    except Exception:  # PyOpenGL raises anything where a library is missing; names are a courtesy
        return "", ""


def probe_gl() -> GlReport:
    """Draw one frame in a process of its own, so that a driver that crashes is survived, and say what came of it."""
    backend = choose_backend()
    if backend.problem:
        return _refused(backend)
    try:
        ran = subprocess.run(
            [sys.executable, "-c", _PROBE],
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT_S,
            check=False,
            env={**os.environ, "LP_NUM_THREADS": "1"},
        )
    except subprocess.TimeoutExpired:
        return _broken(backend, f"no frame after {_PROBE_TIMEOUT_S:.0f} s")
    lines = ran.stdout.strip().splitlines()
    if ran.returncode == 0 and lines:
        return GlReport(**json.loads(lines[-1]))
    if ran.returncode < 0:
        return _broken(backend, f"the driver crashed with {signal.Signals(-ran.returncode).name}")
    return _broken(backend, (ran.stderr.strip().splitlines() or ["it said nothing"])[-1])


def _refused(backend: Backend) -> GlReport:
    """Return the report where no backend can be had."""
    return GlReport(False, "", problem=backend.problem, advice=backend.advice)


def _broken(backend: Backend, problem: str) -> GlReport:
    """Return the report where a backend does not draw."""
    return GlReport(False, backend.name, problem=problem, advice=_advice(platform.system()))


def require_gl() -> GlReport:
    """Return the report of `probe_gl`.

    Raises:
        GraphicsError: No frame could be drawn; the message is one line with the command to type.
    """
    report = probe_gl()
    if not report.works:
        raise GraphicsError(_failure(report))
    return report


def _failure(report: GlReport) -> str:
    """Return what went wrong and what to do, in one line."""
    problem = " ".join(report.problem.split())
    where = f" ({report.backend})" if report.backend else ""
    return f"no off-screen OpenGL{where}: {problem}; {report.advice}"
