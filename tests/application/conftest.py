"""Commands called as on the command line, and one flight that all tests and all processes of xdist share."""

import contextlib
import fcntl
import importlib
import io
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import dronevio
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


@contextlib.contextmanager
def one_rendering_process() -> Iterator[None]:
    """Flights of this process are rendered by one other process: each takes seconds to load a world.

    Those of commands in processes of their own, as in a benchmark, are rendered by as many as on the command line.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dronevio.sim.rendering.render.default_workers", lambda units, units_worth_a_worker: 1)
        yield


@pytest.fixture
def single_renderer() -> Iterator[None]:
    """Flights of the test are rendered by one process."""
    with one_rendering_process():
        yield


def run_successfully(folder: Path, *arguments: str | Path) -> Result:
    """Run a command, check that it succeeds, and return its result.

    Args:
        folder: Folder or file to which the command writes.
        arguments: The words after ``dronevio``.
    """
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
        one_rendering_process() if arguments[0] in ("fly", "run", "refly") else contextlib.nullcontext(),
    ):
        status = main([str(argument) for argument in arguments])
    assert status == 0, err.getvalue()
    return Result(folder, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def run_command() -> Callable[..., Result]:
    """The function `run_successfully`."""
    return run_successfully


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The recording of the scenario ``short`` with seed 0, an EuRoC folder that tests must not change.

    The first process of xdist that needs it makes it, and the others wait.
    """
    base = tmp_path_factory.getbasetemp()
    place = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "flown"
    folder, printed = place / "flight", place.with_suffix(".json")
    with place.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not printed.exists():
            place.mkdir(exist_ok=True)
            made = run_successfully(folder, "fly", "--scenario", "short", "--out", folder, "--json")
            printed.write_text(json.dumps([made.out, made.err]), encoding="utf-8")
    return Result(folder, *json.loads(printed.read_text(encoding="utf-8")))


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


@pytest.fixture
def executed() -> Callable[..., list[Any]]:
    """Executes cells in the kernel of a notebook and returns the outputs of each."""
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")

    def execute(*cells: str) -> list[Any]:
        path = f"import sys; sys.path.insert(0, {str(Path(dronevio.__file__).parents[1])!r})"
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code) for code in (path, *cells)])
        nbclient.NotebookClient(notebook, timeout=240, extra_arguments=["--log-level=ERROR"]).execute()
        return [cell.outputs for cell in notebook.cells[1:]]

    return execute
