"""Commands called as on the command line, and one flight that all tests share."""

import contextlib
import importlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from dronevio.cli import main


@dataclass(frozen=True)
class Result:
    """The result of a command."""

    folder: Path
    """Folder or file of the result."""
    out: str
    """Text on standard output."""
    err: str
    """Text on standard error."""

    @property
    def document(self) -> dict[str, Any]:
        """JSON document on standard output."""
        document: dict[str, Any] = json.loads(self.out)
        return document


def run_successfully(folder: Path, *arguments: str | Path) -> Result:
    """Run a command, check that it succeeds, and return its result.

    Args:
        folder: Folder or file to which the command writes.
        arguments: The words after ``dronevio``.
    """
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = main([str(argument) for argument in arguments])
    assert status == 0, err.getvalue()
    return Result(folder, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def run_command() -> Callable[..., Result]:
    """The function `run_successfully`."""
    return run_successfully


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The recording of the scenario ``short`` with seed 0, an EuRoC folder that tests must not change."""
    folder = tmp_path_factory.mktemp("flown") / "flight"
    return run_successfully(folder, "fly", "--scenario", "short", "--out", folder, "--json")


@pytest.fixture(scope="session")
def exists() -> Callable[[str], bool]:
    """Tells whether a dotted name is a module, or an attribute of one; fields of dataclasses are attributes, too."""

    def found(name: str) -> bool:
        parts = name.split(".")
        for size in range(len(parts), 0, -1):
            with contextlib.suppress(ModuleNotFoundError):
                value: Any = importlib.import_module(".".join(parts[:size]))
                for attribute in parts[size:]:
                    if attribute in getattr(value, "__dataclass_fields__", ()):
                        return True
                    value = getattr(value, attribute, None)
                return value is not None
        return False

    return found
