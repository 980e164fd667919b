"""Classes of the user as estimators: where they are found, what is wrong with them, and when runs are repeated."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dronevio.cli import main
from dronevio.estimators.python_estimator import PythonEstimator
from dronevio.estimators.registry import estimator_named
from dronevio.models.errors import ConfigError

WHOLE = """
class Odometry:
    def __init__(self, rig):
        self.rig = rig

    def add_imu(self, samples):
        pass

    def add_frame(self, frame):
        raise NotImplementedError("no estimate today")

def tuned(rig):
    return Odometry(rig)

def nothing(rig):
    return rig

class Half:
    def add_imu(self, samples):
        pass
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package in the current folder; its modules are removed after the test."""
    folder = tmp_path / "user_package"
    folder.mkdir()
    (folder / "__init__.py").write_text("", encoding="utf-8")
    (folder / "whole.py").write_text(WHOLE, encoding="utf-8")
    (folder / "broken.py").write_text("import no_such_package", encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    yield folder
    for name in [name for name in sys.modules if name.startswith("user_package")]:
        del sys.modules[name]


@pytest.mark.parametrize("name", ["Odometry", "tuned"])
def test_classes_and_functions_make_estimators(name: str, package: Path) -> None:
    text = f"python:user_package.whole:{name}"
    assert (estimator_named(text).label, estimator_named(f"mine={text}").label) == (text, "mine")
    rig: Any = object()
    assert vars(PythonEstimator.parse(text).make(rig)) == {"rig": rig}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("python:user_package.whole", "expected python:package.module:Class"),
        ("python:user package:Odometry", "expected python:package.module:Class"),
        ("python:user_package.whole:Odo metry", "expected python:package.module:Class"),
        ("python:no_such_package:Odometry", "No module named 'no_such_package'; expected a module that is installed"),
        ("python:user_package.broken:Odometry", "cannot import user_package.broken: ModuleNotFoundError: No module"),
        ("python:user_package.whole:Missing", "user_package.whole has no class Missing"),
        ("python:user_package.whole:Half", "without add_frame; expected the methods of Estimator"),
    ],
)
def test_what_is_wrong_is_reported_at_once(
    text: str, message: str, package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--scenarios", "short", "--estimators", f"mine={text}", "--out", "rows"]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not Path("rows").exists()


def test_objects_without_methods_are_refused(package: Path) -> None:
    rig: Any = object()
    with pytest.raises(ConfigError, match="without add_imu and add_frame"):
        PythonEstimator.parse("python:user_package.whole:nothing").make(rig)


def test_settings_change_with_any_source_of_the_package(package: Path) -> None:
    estimator = estimator_named("mine=python:user_package.whole:Odometry")
    before = estimator.settings()
    assert estimator.settings() == before
    (package / "helper.py").write_text("GAIN = 2.0", encoding="utf-8")
    assert estimator.settings() != before


def test_settings_of_a_single_module_change_with_it_alone(package: Path) -> None:
    alone = package.parent / "user_package_alone.py"
    alone.write_text(WHOLE, encoding="utf-8")
    estimator = estimator_named("mine=python:user_package_alone:Odometry")
    before = estimator.settings()
    (package / "helper.py").write_text("GAIN = 2.0", encoding="utf-8")
    assert estimator.settings() == before
    alone.write_text(WHOLE + "GAIN = 2.0", encoding="utf-8")
    assert estimator.settings() != before


def test_installed_modules_are_found_before_those_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "colorsys.py").write_text("raise RuntimeError('of the folder')", encoding="utf-8")
    code = (
        "from dronevio.estimators.python_estimator import PythonEstimator;"
        "PythonEstimator('colorsys', 'rgb_to_hsv').load(); print('installed')"
    )
    command = [sys.executable, "-P", "-c", code]  # -P: without the current folder, as the command dronevio
    root = str(Path(__file__).resolve().parents[2])
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env={"PYTHONPATH": root}, check=False)
    assert ended.stdout == "installed\n", ended.stderr
