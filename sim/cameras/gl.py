"""Off-screen OpenGL: choice of the backend, a test that it renders, and advice if it does not.

MuJoCo selects its OpenGL backend from the environment variable MUJOCO_GL on import, and fails with obscure errors where
the library is missing. This module decides before that (`dronevio.sim` calls `choose_backend` on import), and all
rendering code obtains its context here.
"""

import ctypes
import importlib
import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import TYPE_CHECKING, Protocol

from dronevio.models.errors import GraphicsError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

_SUDO = "" if os.geteuid() == 0 else "sudo "  # containers have a root and no sudo
INSTALL_COMMAND = f"{_SUDO}apt-get install -y libegl1 libgl1-mesa-dri libopengl0"
"""Command that installs an OpenGL without display or GPU on Debian and Ubuntu."""

_LIBRARIES = {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
_CHOICES = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw")}
_OFF = ("disable", "disabled", "off", "false", "0")
_PROBE_TIMEOUT_S = 60.0
_PROBE = "from dronevio.sim.cameras.gl import draw_one_frame; draw_one_frame()"
_FORKED = (
    "this process was forked from one that has rendered, whose graphics driver does not work after a fork; "
    'start processes with the method "spawn" or "forkserver", for example gymnasium.make_vec(…, '
    'vectorization_mode="async", vector_kwargs={"context": "spawn"})'
)


class Context(Protocol):
    """Interface of MuJoCo's OpenGL contexts."""

    def make_current(self) -> None:
        """Make the context current in this thread."""

    def free(self) -> None:
        """Release its memory."""


@dataclass(frozen=True)
class Backend:
    """Off-screen backend, or the reason why there is none."""

    name: str
    """Name of the backend: ``egl``, ``osmesa``, ``glfw`` or ``cgl``; empty if there is none."""
    problem: str = ""
    """Reason why there is no backend."""
    advice: str = ""
    """Remedy for the problem."""


@dataclass(frozen=True)
class GlReport:
    """Result of a test that renders one frame."""

    works: bool
    """Whether the frame was rendered correctly."""
    backend: str
    """Name of the backend; empty if there is none."""
    renderer: str = ""
    """Renderer name of the driver, such as ``llvmpipe``."""
    vendor: str = ""
    """Vendor of the driver."""
    problem: str = ""
    """Reason why rendering failed."""
    advice: str = ""
    """Remedy for the problem."""


def pick_backend(environment: Mapping[str, str], system: str) -> Backend:
    """Return the backend for an environment and an operating system.

    A value of MUJOCO_GL set by the user is respected. Without one, Linux uses EGL or, if that is missing, OSMesa, which
    need no display; macOS uses MuJoCo's default.

    Args:
        environment: The environment variables.
        system: The operating system, as `platform.system` names it.
    """
    wish = environment.get("MUJOCO_GL", "").strip().lower()
    choices = _CHOICES.get(system, ("glfw",))
    if wish in _OFF:
        return Backend("", f"MUJOCO_GL={wish} turns rendering off", "type: unset MUJOCO_GL")
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
    """Return the remedy for a failure of rendering."""
    return f"type: {INSTALL_COMMAND}" if system == "Linux" else "install the graphics driver"


def _loads(backend: str) -> bool:
    """Return whether a library of the backend can be loaded; True for backends that include their own."""
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
    """Return the backend of this process, and set MUJOCO_GL so that MuJoCo can be imported in any case.

    Mesa's software renderer is set to blend two sizes of a texture near the transition between them only, which takes
    an eighth less time. A value of GALLIVM_PERF set by the user is respected.
    """
    backend = pick_backend(os.environ, platform.system())
    os.environ.setdefault("GALLIVM_PERF", "brilinear")  # Mesa reads it when it starts
    if backend.name in _LIBRARIES:
        os.environ["MUJOCO_GL"] = backend.name
    elif backend.problem:
        os.environ["MUJOCO_GL"] = "disable"  # physics does not need OpenGL
    return backend


def create_context(width: int, height: int) -> Context:
    """Return a new OpenGL context for images of up to the given size [px], current in this thread.

    Raises:
        GraphicsError: No context can be created, or this process was forked from one that has created one.
    """
    backend = choose_backend()
    if backend.problem:
        raise GraphicsError(_failure(_refused(backend)))
    check_not_forked()
    try:
        return _new_context(backend, width, height)
    except Exception as error:  # drivers and PyOpenGL raise anything from ImportError to AttributeError
        if (context := _context_after_restart(backend, width, height)) is not None:
            return context
        raise GraphicsError(_failure(_broken(backend, f"{type(error).__name__}: {error}"))) from error


def make_current(context: Context) -> None:
    """Make a context current in this thread.

    Raises:
        GraphicsError: The process was forked after rendering, or the driver refuses, for example because another
            library has closed its connection.
    """
    check_not_forked()
    try:
        context.make_current()
    except Exception as error:  # drivers and PyOpenGL raise anything
        raise _lost(error) from error


def free(context: Context) -> None:
    """Release the memory of a context.

    Raises:
        GraphicsError: The driver refuses, for example because another library has closed its connection.
    """
    try:
        context.free()
    except Exception as error:  # drivers and PyOpenGL raise anything
        raise _lost(error) from error


def _lost(error: Exception) -> GraphicsError:
    """Return the error for a context that the driver refuses."""
    problem = getattr(error, "err", error)  # the message of PyOpenGL lists all arguments
    return GraphicsError(f"the OpenGL context is lost or in use by another thread: {problem}")


def is_usable(context: Context) -> bool:
    """Return whether a context can be made current in this thread, and make it current.

    Raises:
        GraphicsError: The process was forked after rendering.
    """
    check_not_forked()
    try:
        make_current(context)
    except GraphicsError:
        return False
    return True


@cache
def _rendering_process() -> int:
    """Return the process that created the first context; a forked process inherits the answer."""
    return os.getpid()


def check_not_forked() -> None:
    """Check that this process is the one that has created the first context.

    Raises:
        GraphicsError: The process was forked after rendering: the driver would wait forever for its threads, which a
            fork does not copy.
    """
    if _rendering_process() != os.getpid():
        raise GraphicsError(_FORKED)


def _new_context(backend: Backend, width: int, height: int) -> Context:
    """Return a new current context of a backend; errors of the driver are not converted."""
    context: Context = importlib.import_module(f"mujoco.{backend.name}").GLContext(width, height)
    context.make_current()
    return context


def _context_after_restart(backend: Backend, width: int, height: int) -> Context | None:
    """Return a new context after connecting to EGL again; None if that does not help.

    Other libraries may have closed the connection, which a process has only once: SDL does so when it opens a window
    without a display.
    """
    module = sys.modules.get("mujoco.egl")
    if backend.name != "egl" or getattr(module, "EGL_DISPLAY", None) is None:
        return None
    try:
        module.EGL_DISPLAY = None  # type: ignore[union-attr]  # MuJoCo connects when it is None
        return _new_context(backend, width, height)
    except Exception:  # the first error has the better message
        return None


def draw_one_frame() -> None:
    """Render a white square on black and print a `GlReport` as JSON: the work of the test process."""
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
    report = (
        GlReport(True, backend.name, renderer, vendor) if works else _broken(backend, "the rendered frame is wrong")
    )
    print(json.dumps(asdict(report)))  # noqa: T201


def _driver_names() -> tuple[str, str]:
    """Return renderer and vendor of the current context; empty if PyOpenGL cannot query them."""
    try:
        GL = importlib.import_module("OpenGL.GL")
        return GL.glGetString(GL.GL_RENDERER).decode(), GL.glGetString(GL.GL_VENDOR).decode()
    except Exception:  # PyOpenGL raises anything if a library is missing; the names are optional
        return "", ""


def blend_no_mipmaps(textures: Sequence[int]) -> None:
    """Sample 2D textures of the current context from the nearest mipmap only, without blending two of them.

    Rendering with a processor is 20 % faster, and transitions between mipmaps become visible at close range.
    """
    GL = importlib.import_module("OpenGL.GL")
    for texture in textures:
        GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_NEAREST)
    GL.glBindTexture(GL.GL_TEXTURE_2D, 0)


def replace_texture(texture: int, grey: "npt.NDArray[np.uint8]") -> None:
    """Replace the content of a 2D texture of the current context by grey levels.

    Rendering with a processor is 10 % faster with one channel than with three.

    Args:
        texture: Name of the texture.
        grey: (H, W) Contiguous grey levels.
    """
    GL = importlib.import_module("OpenGL.GL")
    GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
    GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
    height, width = grey.shape
    GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_LUMINANCE8, width, height, 0, GL.GL_LUMINANCE, GL.GL_UNSIGNED_BYTE, grey)
    GL.glGenerateMipmap(GL.GL_TEXTURE_2D)
    GL.glBindTexture(GL.GL_TEXTURE_2D, 0)


def read_rgba(image: "npt.NDArray[np.uint8]", low: int) -> None:
    """Read pixels of the current frame buffer from the first column on.

    Args:
        image: (H, W, 4) Contiguous image that receives red, green, blue and alpha; its first row is the lowest one.
        low: Row of the frame buffer of its first row.
    """
    GL = importlib.import_module("OpenGL.GL")
    GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
    GL.glReadPixels(0, low, image.shape[1], image.shape[0], GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, image)


def probe_gl() -> GlReport:
    """Render one frame in a separate process, which protects against crashes of the driver, and report the result."""
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
    return _broken(backend, (ran.stderr.strip().splitlines() or ["no error message"])[-1])


def _refused(backend: Backend) -> GlReport:
    """Return the report for a missing backend."""
    return GlReport(False, "", problem=backend.problem, advice=backend.advice)


def _broken(backend: Backend, problem: str) -> GlReport:
    """Return the report for a backend that failed."""
    return GlReport(False, backend.name, problem=problem, advice=_advice(platform.system()))


def require_gl() -> GlReport:
    """Return the report of `probe_gl`.

    Raises:
        GraphicsError: No frame could be rendered; the message is one line with the remedy.
    """
    report = probe_gl()
    if not report.works:
        raise GraphicsError(_failure(report))
    return report


def _failure(report: GlReport) -> str:
    """Return problem and remedy in one line."""
    problem = " ".join(report.problem.split())
    where = f" ({report.backend})" if report.backend else ""
    return f"no off-screen OpenGL{where}: {problem}; {report.advice}"
