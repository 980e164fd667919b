"""One flight for all tests of the door, flown once."""

import contextlib
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
    """What a command left, and what it printed."""

    folder: Path
    out: str
    err: str

    @property
    def document(self) -> dict[str, Any]:
        """What was printed, as JSON."""
        return json.loads(self.out)


def carry_out(folder: Path, *arguments: str | Path) -> Result:
    """Run a command that is expected to do well and to leave its result in a folder."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = main([str(argument) for argument in arguments])
    assert status == 0, err.getvalue()
    return Result(folder, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def do() -> Callable[..., Result]:
    """Carries out a command: takes the folder that it writes to, and the command line."""
    return carry_out


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The short flight of seed 0: an EuRoC folder. Look at it, do not write into it."""
    folder = tmp_path_factory.mktemp("flown") / "flight"
    return carry_out(folder, "fly", "--scenario", "short", "--out", folder, "--json")
