"""What several tests of the simulator use."""

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def example() -> Callable[[str], ModuleType]:
    """Gives a module of examples/rl by name; they belong to no package, and find each other by their names."""
    folder = Path(__file__).resolve().parents[2] / "examples" / "rl"
    if not folder.is_dir():
        pytest.skip("the examples are in the repository, not in the package")

    def load(name: str) -> ModuleType:
        with pytest.MonkeyPatch.context() as patch:
            patch.syspath_prepend(folder)
            return importlib.import_module(name)

    return load
