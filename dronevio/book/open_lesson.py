"""``dronevio book open``: the lessons, scripts of this package that are copied out as Jupyter notebooks.

A lesson is a Python script in Jupytext's percent format, ``dronevio/book/lessons/NAME.py``.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dronevio.cli.terminal import command_line, parse, print_table
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.extras import install_command

if TYPE_CHECKING:
    from nbformat import NotebookNode

LESSONS = {
    "imu": "IMU factors: preintegration, the factor graph, its covariance, the drift, a camera (section 7.4.1)",
    "sfm": "structure from motion: features, matches, triangulation, resection, bundle adjustment (section 7.4.2)",
    "dense": "multi-view stereo: plane sweep, semi-global matching, consistency, fusion, mesh (section 7.4.2)",
    "odometry": "visual-inertial odometry: each part of the estimator on five frames of a flight (section 7.4.3)",
    "slam": "visual SLAM: one loop by hand, from the first similar image to the corrected pose graph (section 7.4.3)",
    "explore": "exploration: depth image, map, path and trajectory, up to a flight through a door (section 7.4.3)",
}
"""The lessons with their summaries, in the order in which they are read."""

KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}
"""Kernel that executes the notebooks."""


@dataclass(frozen=True)
class OpenCommand:
    """Copy a lesson on section 7.4 of the book out as a Jupyter notebook, or list the lessons.

    Each lesson goes from the equations of the book to the functions of this package, step by step, with pictures,
    exercises and changes that make it fail. It requires JupyterLab and Jupytext, which the extra book installs.

    Examples:
      dronevio book open
      dronevio book open imu
      dronevio book open imu --lab
      dronevio book open imu --out lessons/first.ipynb --overwrite
    """

    lesson: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = None
    """Name of the lesson; without a name, the lessons are listed."""
    out: Path | None = None
    """Notebook to write, NAME.ipynb in the current folder by default, or a folder for it."""
    overwrite: bool = False
    """Replace an existing notebook, with all changes that were made in it."""
    lab: bool = False
    """Open the notebook in JupyterLab, which serves it to browsers on this machine. An existing one is opened as it
    is."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(OpenCommand, arguments, "book open")
    if command.lesson is None:
        print_table("Lessons", ("name", "content"), list(LESSONS.items()), left=("content",))
        print(f"open one: {command_line('book', 'open', 'NAME')}")
        return 0

    from dronevio.cli.output_files import atomic_file, require_free

    target, lab = _target(command.lesson, command.out), find_spec("jupyterlab") is not None
    notebook = read_lesson(command.lesson)
    import nbformat

    if command.lab and not lab:
        raise ConfigError(f"--lab without JupyterLab; expected it installed: {install_command('book')}")
    if not (command.lab and target.exists() and not command.overwrite):
        require_free(target, command.overwrite)
        with atomic_file(target) as partial:
            nbformat.write(notebook, partial)
    print(f"notebook: {target}")
    if command.lab:
        as_root = ["--allow-root"] if os.geteuid() == 0 else []  # as in containers
        server = [sys.executable, "-m", "jupyterlab", "--ip=127.0.0.1", *as_root, str(target)]
        return subprocess.run(server, check=False).returncode
    again = command_line("book", "open", command.lesson, *(["--out", str(target)] if command.out else []))
    print(f"open it:  {again} --lab" if lab else f"to open it, install JupyterLab: {install_command('book')}")
    return 0


def lesson_source(name: str) -> str:
    """Return the script of a lesson.

    Raises:
        ConfigError: There is no lesson with this name.
    """
    if name not in LESSONS:
        raise unknown_name("lesson", name, LESSONS)
    return (files("dronevio.book") / "lessons" / f"{name}.py").read_text(encoding="utf-8")


def read_lesson(name: str) -> "NotebookNode":
    """Return a lesson as a notebook without outputs.

    Raises:
        ConfigError: There is no lesson with this name, or Jupytext is not installed.
    """
    source = lesson_source(name)
    try:
        import jupytext
    except ImportError:
        raise ConfigError(f"a notebook needs Jupytext; expected it installed: {install_command('book')}") from None
    notebook: NotebookNode = jupytext.reads(source, fmt="py:percent")
    notebook.metadata = {"kernelspec": KERNEL, "language_info": {"name": "python"}}
    return notebook


def _target(name: str, out: Path | None) -> Path:
    """Return the notebook file to write.

    Raises:
        ConfigError: The file has another suffix.
    """
    if out is None or out.is_dir():
        return (out or Path()) / f"{name}.ipynb"
    if out.suffix != ".ipynb":
        raise ConfigError(f"--out {out}; expected a folder, or a file with the suffix .ipynb")
    return out
