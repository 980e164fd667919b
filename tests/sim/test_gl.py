"""The choice of an OpenGL backend, and the error messages without one."""

import json
import os
import platform
import subprocess
import sys

import pytest

from dronevio.models.errors import GraphicsError
from dronevio.sim.cameras import gl
from dronevio.sim.cameras.gl import INSTALL_COMMAND, pick_backend, probe_gl, require_gl


def test_a_probe_image_is_rendered() -> None:
    report = require_gl()
    assert report.works
    assert report.backend in ("egl", "osmesa", "cgl", "glfw")
    assert report.problem == report.advice == ""


def test_mujoco_gl_selects_the_backend() -> None:
    assert pick_backend({"MUJOCO_GL": "glfw"}, "Linux").name == "glfw"
    assert pick_backend({"MUJOCO_GL": " CGL "}, "Darwin").name == "cgl"


@pytest.mark.parametrize("value", ["bogus", "off", "cgl"])
def test_an_unusable_backend_is_named(value: str) -> None:
    backend = pick_backend({"MUJOCO_GL": value}, "Linux")
    assert backend.name == ""
    assert f"MUJOCO_GL={value}" in backend.problem
    assert "unset MUJOCO_GL" in backend.advice


def test_linux_prefers_egl_then_osmesa(monkeypatch: pytest.MonkeyPatch) -> None:
    for present, expected in (({"egl", "osmesa"}, "egl"), ({"osmesa"}, "osmesa"), (set(), "")):
        monkeypatch.setattr(gl, "_loads", lambda name, present=present: name in present)
        backend = pick_backend({}, "Linux")
        assert backend.name == expected
    assert INSTALL_COMMAND in backend.advice


def test_macos_uses_cgl() -> None:
    assert pick_backend({}, "Darwin").name == "cgl"


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import os; os.abort()", "SIGABRT"),
        ("raise AttributeError('no eglQueryString')", "no eglQueryString"),
        ("import time; time.sleep(60)", "no frame after"),
        ("", "no error message"),
    ],
)
def test_a_failing_driver_is_reported(monkeypatch: pytest.MonkeyPatch, code: str, message: str) -> None:
    monkeypatch.setattr(gl, "_PROBE", code)
    monkeypatch.setattr(gl, "_PROBE_TIMEOUT_S", 2.0)
    report = probe_gl()
    assert not report.works
    assert message in report.problem
    with pytest.raises(GraphicsError) as caught:
        require_gl()
    assert "\n" not in str(caught.value)
    assert message in str(caught.value)


def run_cli(arguments: list[str], **variables: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line with environment variables added."""
    return subprocess.run(
        [sys.executable, "-m", "dronevio.cli", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **variables},
        check=False,
        timeout=60,
    )


def test_an_unknown_backend_is_reported_in_one_line() -> None:
    ran = run_cli(["fly", "--scenario", "short"], MUJOCO_GL="bogus")
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert len(ran.stderr.strip().splitlines()) == 1
    assert "MUJOCO_GL=bogus" in ran.stderr


@pytest.mark.skipif(platform.system() != "Linux", reason="hides the drivers from Linux's EGL")
def test_missing_drivers_are_reported_with_a_remedy() -> None:
    ran = run_cli(["fly", "--scenario", "short"], MUJOCO_GL="egl", __EGL_VENDOR_LIBRARY_FILENAMES="/dev/null")
    assert ran.returncode == 2
    assert len(ran.stderr.strip().splitlines()) == 1
    assert INSTALL_COMMAND in ran.stderr


def test_physics_does_not_need_opengl() -> None:
    code = "import dronevio.sim, mujoco; mujoco.mj_step(m := mujoco.MjSpec().compile(), mujoco.MjData(m))"
    environment = {**os.environ, "MUJOCO_GL": "bogus"}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert ran.returncode == 0, ran.stderr


def test_doctor_reports_what_is_missing() -> None:
    healthy = run_cli(["doctor", "--json"])
    assert healthy.returncode == 0
    found = json.loads(healthy.stdout)
    assert found["gl"]["works"] is True
    assert found["packages"]["mujoco"]
    assert found["cores"] >= 1
    assert list(found["caches"]) == ["recordings", "worlds", "pictures"]
    assert found["caches"]["recordings"]["limit_gb"] > 0.0
    broken = run_cli(["doctor", "--json"], MUJOCO_GL="bogus")
    assert broken.returncode == 2
    assert "unset MUJOCO_GL" in json.loads(broken.stdout)["advice"]


FORK = """
import os
from dronevio.models.errors import GraphicsError
from dronevio.sim.cameras.gl import create_context

before = {before}
if before:
    create_context(8, 8)
if (child := os.fork()) == 0:
    try:
        create_context(8, 8)
        print("created", flush=True)
    except GraphicsError as error:
        print(error, flush=True)
    os._exit(0)
os.waitpid(child, 0)
if before:
    create_context(8, 8)  # the parent can go on
"""
"""Program that creates a context in a forked process, before or after the parent has created one."""


@pytest.mark.skipif(platform.system() != "Linux", reason="EGL is Linux's")
@pytest.mark.parametrize(("before", "message"), [(False, "created"), (True, 'context": "spawn"')])
def test_forks_after_rendering_are_refused(before: bool, message: str) -> None:
    command = [sys.executable, "-c", FORK.format(before=before)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert ran.returncode == 0, ran.stderr
    assert message in ran.stdout


@pytest.mark.parametrize(("chosen", "expected"), [({}, "brilinear"), ({"GALLIVM_PERF": "nopt"}, "nopt")])
def test_blending_of_textures_is_set_before_rendering(chosen: dict[str, str], expected: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "GALLIVM_PERF"} | chosen
    code = "import os, dronevio.sim; print(os.environ['GALLIVM_PERF'])"
    ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == expected
