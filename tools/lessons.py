"""Execute the lessons of ``dronevio book open``, and write them as notebooks and as pages of the documentation.

Usage::

    tools/lessons.py [NAME ...]            execute lessons, and the changes that are to break them
    tools/lessons.py --pages docs/lessons  write the pages, from lessons that are executed if necessary

An executed lesson is kept in ``build/lessons`` and used again until it, the package or the lock file changes. A lesson
fails if a cell raises an exception or writes to standard error, or if all cells together take more than two minutes.
The section "What to change to see it break" of a lesson contains assignments, such as ``GRAVITY = 9.7``. Each of them
replaces the only assignment to that name, and the changed lesson has to end with an ``AssertionError``.
"""

import argparse
import base64
import hashlib
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from cli_reference import write_changed

from dronevio.book.open_lesson import LESSONS, lesson_source, read_lesson

ROOT = Path(__file__).resolve().parents[1]
EXECUTED = ROOT / "build" / "lessons"
"""Folder of the executed lessons."""
LIMIT_S = 1200.0
"""Duration after which a lesson is taken to hang [s]; on an idle machine it takes a minute at most."""
CHANGES = "## What to change to see it break"
"""Heading of the section whose Python blocks are changes."""
FIGURE = "# Figure: "
"""Beginning of the first line of a cell that draws, before the description of the figure."""


def named(text: str) -> list[str]:
    """Return the dotted names of this package in code spans, in order and once each."""
    return list(dict.fromkeys(re.findall(r"`(dronevio(?:\.\w+)+)`", text)))


def changes(source: str) -> list[str]:
    """Return the assignments in the last section of a lesson, each of which breaks the lesson."""
    _, _, section = source.partition(f"# {CHANGES}\n")
    return re.findall(r"^# ```python\n# (.+)\n# ```$", section, re.MULTILINE)


def changed(source: str, change: str) -> str:
    """Return a lesson in which a change replaces the assignment to the same name.

    Raises:
        ValueError: The lesson does not contain exactly one line that assigns to this name.
    """
    name = change.partition(" = ")[0]
    lines = re.findall(rf"^{name} = .*$", source, re.MULTILINE)
    if len(lines) != 1:
        raise ValueError(f"{len(lines)} assignments to {name!r}; expected one that {change!r} replaces")
    return source.replace(f"\n{lines[0]}\n", f"\n{change}\n", 1)


def execute(name: str) -> Any:
    """Return a lesson with its outputs, from an earlier execution if nothing has changed since.

    Raises:
        CellExecutionError: A cell raises an exception.
        CellTimeoutError: The lesson takes too long.
        RuntimeError: A cell writes to standard error, which belongs on no page.
    """
    import nbformat

    path, digest = EXECUTED / f"{name}.ipynb", _digest(name)
    if path.is_file():
        notebook = nbformat.read(path, as_version=4)
        if notebook.metadata.get("dronevio", {}).get("digest") == digest:
            return notebook
    notebook, start = read_lesson(name), time.monotonic()
    from nbclient import NotebookClient

    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout_func=lambda cell: max(1, int(LIMIT_S - (time.monotonic() - start))),
            resources={"metadata": {"path": folder}},
            extra_arguments=["--log-level=ERROR"],
            coalesce_streams=True,
        )
        client.execute()
    seconds = time.monotonic() - start
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if output.get("name") == "stderr":
                raise RuntimeError(f"lesson {name}: a cell writes to standard error: {output['text']}")
    notebook.metadata["dronevio"] = {"digest": digest, "seconds": seconds}
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, path)
    print(f"lesson {name}: executed in {seconds:.1f} s", flush=True)
    return notebook


def breaks(name: str, change: str) -> bool:
    """Execute a changed lesson as a script, and return whether one of its checks fails."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / f"{name}.py"
        script.write_text(changed(lesson_source(name), change), encoding="utf-8")
        run = subprocess.run(
            [sys.executable, script.name],
            cwd=folder,
            env={**os.environ, "MPLBACKEND": "agg"},
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
    last = run.stderr.strip().rpartition("\n")[2]
    is_broken = run.returncode != 0 and last.startswith("AssertionError")
    verdict = last if is_broken else f"it does NOT break: exit code {run.returncode}, {last!r}"
    print(f"lesson {name}: {change}: {verdict} ({time.monotonic() - start:.1f} s)", flush=True)
    return is_broken


def page(notebook: Any, name: str) -> tuple[str, dict[str, bytes]]:
    """Return an executed lesson as a Markdown page, and its images by their paths relative to that page."""
    title, *rest = notebook.cells
    heading, _, introduction = title.source.partition("\n")
    lines = [heading, "", *_preface(name), _linked(introduction), ""]
    images: dict[str, bytes] = {}
    for cell in rest:
        if cell.cell_type == "markdown":
            lines += [_linked(cell.source), ""]
            continue
        lines += _code(cell)
        for output in cell.outputs:
            lines += _output(output, cell.source, name, images)
    return "\n".join(lines), images


def write_pages(folder: Path) -> list[Path]:
    """Write the pages of all lessons with their images, an overview, and SUMMARY.md, which orders them."""
    contents: dict[str, str | bytes] = {}
    rows = []
    for name, summary in LESSONS.items():
        notebook = execute(name)
        text, images = page(notebook, name)
        title = text.partition("\n")[0].removeprefix("# ")
        rows.append((name, title, summary))
        contents |= {f"{name}.md": text, **images}
    contents["index.md"] = _overview(rows)
    contents["SUMMARY.md"] = "".join(["* [Overview](index.md)\n", *(f"* [{t}]({n}.md)\n" for n, t, _ in rows)])
    return write_changed(folder, contents)


def _digest(name: str) -> str:
    """Return a hash of all that the outputs of a lesson depend on."""
    state = hashlib.sha256(f"{name} {sys.version}".encode())
    lesson = Path("book") / "lessons"
    package = sorted(path for path in _modules(ROOT / "dronevio") if lesson not in path.parents)
    for path in (Path("book/lessons") / f"{name}.py", *package, Path("../uv.lock")):
        content = (ROOT / "dronevio" / path).read_bytes()
        state.update(f"{path} {len(content)} ".encode() + content)
    return state.hexdigest()


def _modules(folder: Path) -> Iterator[Path]:
    """Yield the modules of the package, also those behind links, relative to its folder."""
    for directory, _, files in os.walk(folder, followlinks=True):
        yield from (Path(directory, file).relative_to(folder) for file in files if file.endswith(".py"))


def _preface(name: str) -> list[str]:
    return [
        '!!! note "This page is an executed notebook"',
        "    Work through it with your own changes; in a clone, JupyterLab opens it after this command:",
        "",
        "    ```sh",
        f"    make lesson NAME={name}",
        "    ```",
        "",
    ]


def _overview(rows: list[tuple[str, str, str]]) -> str:
    return "\n".join(
        [
            "# Lessons",
            "",
            "The lessons follow section 7.4, visual SLAM, of F. Dellaert and S. Hutchinson, *Introduction to Robotics",
            "and Perception* ([roboticsbook.org](https://www.roboticsbook.org)). Each goes from the equations to the",
            "functions of this package that implement them, with pictures, exercises and changes that make it fail.",
            "They are Jupyter notebooks: `dronevio book open NAME` copies one out, and the pages here are the same",
            "notebooks, executed.",
            "",
            "| lesson | name | content |",
            "| --- | --- | --- |",
            *(f"| [{title}]({name}.md) | `{name}` | {summary} |" for name, title, summary in rows),
            "",
        ]
    )


def _linked(markdown: str) -> str:
    """Return Markdown in which names of this package in code spans link to their place in the API reference."""
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(
        part if i % 2 else re.sub(r"`(dronevio(?:\.\w+)+)`", r"[`\1`][\1]", part) for i, part in enumerate(parts)
    )


def _code(cell: Any) -> list[str]:
    """Return the source of a code cell; that of a collapsed cell is collapsed here, too."""
    block = ["```python", cell.source, "```", ""]
    if not cell.metadata.get("jupyter", {}).get("source_hidden"):
        return block
    return ['<details class="code" markdown="1"><summary>Code of the figure</summary>', "", *block, "</details>", ""]


def _output(output: Any, source: str, name: str, images: dict[str, bytes]) -> list[str]:
    """Return an output of a cell; an image is added to the images."""
    data = output.get("data", {})
    if "image/png" in data:
        path = f"{name}/{len(images) + 1}.png"
        images[path] = base64.b64decode(data["image/png"])
        first = source.partition("\n")[0]
        description = first.removeprefix(FIGURE) if first.startswith(FIGURE) else ""
        return [f"![{description}]({path}){{ .figure }}", ""]
    text = output.get("text") or data.get("text/plain", "")
    return ["```{ .text .output }", text.rstrip("\n"), "```", ""] if text else []


def unnamed_figures(notebook: Any) -> list[str]:
    """Return the sources of executed cells with an image whose first line does not describe it."""
    return [
        cell.source
        for cell in notebook.cells
        if any("image/png" in output.get("data", {}) for output in cell.get("outputs", []))
        and not cell.source.startswith(FIGURE)
    ]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return 1 if a change does not break its lesson."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="Lessons to execute; all by default.")
    parser.add_argument("--pages", type=Path, help="Folder for the pages of all lessons; changes are not executed.")
    options = parser.parse_args(arguments)
    if options.pages is not None:
        write_pages(options.pages)
        return 0
    names = options.names or list(LESSONS)
    for name in names:
        if found := unnamed_figures(execute(name)):
            raise RuntimeError(f"lesson {name}: a cell draws without a first line {FIGURE!r}: {found[0]}")
    pairs = [(name, change) for name in names for change in changes(lesson_source(name))]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        broken = list(pool.map(lambda pair: breaks(*pair), pairs))
    print(f"{len(names)} lessons executed; {sum(broken)} of {len(pairs)} changes break them")
    return 0 if all(broken) else 1


if __name__ == "__main__":
    sys.exit(main())
