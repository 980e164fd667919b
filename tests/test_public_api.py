"""The public names of the packages: complete, lazy, and visible to type checkers."""

import ast
import importlib
import subprocess
import sys
import types
from pathlib import Path

import pytest

import dronevio as dv
from dronevio.models.errors import EvaluationError

ROOT = Path(dv.__file__).parent
PACKAGES = sorted(
    ".".join(["dronevio", *path.parent.relative_to(ROOT).parts])
    for folder in (
        "",
        "models",
        "sim",
        "estimator",
        "eval",
        "autonomy",
        "benchmark",
        "book",
        "cli",
        "estimators",
        "inspection",
        "recording",
    )
    for path in (ROOT / folder).glob("__init__.py" if not folder else "**/__init__.py")
)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_says_what_is_public(package: str) -> None:
    module = importlib.import_module(package)
    assert isinstance(module.__all__, list) and len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        assert not isinstance(getattr(module, name), types.ModuleType), name
    assert set(module.__all__) <= set(dir(module))


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_see_the_same_names(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__file__ is not None
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    imported = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    defined |= {
        t.id for node in tree.body if isinstance(node, ast.Assign) for t in node.targets if isinstance(t, ast.Name)
    }
    defined |= {
        node.target.id for node in tree.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    assert set(module.__all__) <= imported | defined


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="module 'dronevio' has no attribute 'fly_away'"):
        dv.fly_away  # noqa: B018


def test_import_loads_nothing() -> None:
    heavy = "{'numpy', 'mujoco', 'gtsam', 'cv2'}"
    code = f"import sys, dronevio; dronevio.__all__, dir(dronevio); print(*{heavy} & set(sys.modules))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.strip() == ""


def test_no_submodule_has_the_name_of_a_function() -> None:
    assert not {path.stem for path in ROOT.iterdir()} & set(dv.__all__)


def test_a_recording_without_truth_cannot_be_a_reference() -> None:
    recording = type("WithoutTruth", (), {"name": "flight", "frame_times_ns": None, "ground_truth": None})()
    with pytest.raises(EvaluationError, match="flight: no ground truth"):
        dv.evaluate(recording, dv.Trajectory.from_states([]))
