"""Choosing an OpenGL, and surviving the lack of one."""

import json
import os
import platform
import subprocess
import sys

import pytest

from dronevio.models.errors import GraphicsError
from dronevio.sim.cameras import gl
from dronevio.sim.cameras.gl import INSTALL_COMMAND, pick_backend, probe_gl, require_gl


def test_a_frame_is_really_drawn() -> None:
    report = require_gl()
    assert report.works
    assert report.backend in ("egl", "osmesa", "cgl", "glfw")
    assert report.problem == report.advice == ""


def test_a_wish_is_respected() -> None:
    assert pick_backend({"MUJOCO_GL": "glfw"}, "Linux").name == "glfw"
    assert pick_backend({"MUJOCO_GL": " CGL "}, "Darwin").name == "cgl"


@pytest.mark.parametrize("wish", ["bogus", "off", "cgl"])
def test_a_useless_wish_is_named(wish: str) -> None:
    backend = pick_backend({"MUJOCO_GL": wish}, "Linux")
    assert backend.name == ""
    assert f"MUJOCO_GL={wish}" in backend.problem
    assert "unset MUJOCO_GL" in backend.advice


def test_linux_prefers_egl_then_osmesa(monkeypatch: pytest.MonkeyPatch) -> None:
    for present, expected in (({"egl", "osmesa"}, "egl"), ({"osmesa"}, "osmesa"), (set(), "")):
        monkeypatch.setattr(gl, "_loads", lambda name, present=present: name in present)
        backend = pick_backend({}, "Linux")
        assert backend.name == expected
    assert INSTALL_COMMAND in backend.advice


def test_macos_takes_its_own() -> None:
    assert pick_backend({}, "Darwin").name == "cgl"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import os; os.abort()", "SIGABRT"),
        ("raise AttributeError('no eglQueryString')", "no eglQueryString"),
        ("import time; time.sleep(60)", "no frame after"),
        ("", "no error message"),
    ],
)
def test_a_driver_that_fails_is_survived(monkeypatch: pytest.MonkeyPatch, code: str, said: str) -> None:
    monkeypatch.setattr(gl, "_PROBE", code)
    monkeypatch.setattr(gl, "_PROBE_TIMEOUT_S", 2.0)
    report = probe_gl()
    assert not report.works
    assert said in report.problem
    with pytest.raises(GraphicsError) as caught:
        require_gl()
    assert "\n" not in str(caught.value)
    assert said in str(caught.value)


def run_door(arguments: list[str], **variables: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line with environment variables added."""
    return subprocess.run(
        [sys.executable, "-m", "dronevio.cli", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **variables},
        check=False,
        timeout=60,
    )


def test_a_bogus_wish_ends_in_one_line() -> None:
    ran = run_door(["fly", "--scenario", "short"], MUJOCO_GL="bogus")
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert len(ran.stderr.strip().splitlines()) == 1
    assert "MUJOCO_GL=bogus" in ran.stderr


@pytest.mark.skipif(platform.system() != "Linux", reason="hides the drivers from Linux's EGL")
def test_missing_drivers_are_reported_with_a_command_to_type() -> None:
    ran = run_door(["fly", "--scenario", "short"], MUJOCO_GL="egl", __EGL_VENDOR_LIBRARY_FILENAMES="/dev/null")
    assert ran.returncode == 2
    assert len(ran.stderr.strip().splitlines()) == 1
    assert INSTALL_COMMAND in ran.stderr


def test_physics_need_no_opengl() -> None:
    code = "import dronevio.sim, mujoco; mujoco.mj_step(m := mujoco.MjSpec().compile(), mujoco.MjData(m))"
    environment = {**os.environ, "MUJOCO_GL": "bogus"}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert ran.returncode == 0, ran.stderr


def test_the_doctor_says_what_is_missing() -> None:
    healthy = run_door(["doctor", "--json"])
    assert healthy.returncode == 0
    found = json.loads(healthy.stdout)
    assert found["gl"]["works"] is True
    assert found["packages"]["mujoco"]
    assert found["cores"] >= 1
    ill = run_door(["doctor", "--json"], MUJOCO_GL="bogus")
    assert ill.returncode == 2
    assert "unset MUJOCO_GL" in json.loads(ill.stdout)["advice"]
