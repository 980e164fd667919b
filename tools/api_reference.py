"""Write the pages of the API reference: one Markdown page per package, for mkdocstrings to fill in.

A package that has an ``__all__`` is documented by these names, and by the other names of those modules that the lessons
of ``dronevio book open`` refer to; of any other package, all modules are documented.
"""

import argparse
import ast
import importlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cli_reference import write_changed
from lessons import named

from dronevio.book.open_lesson import LESSONS, lesson_source

ROOT = Path(__file__).resolve().parents[1] / "dronevio"
EXCLUDED = ("dronevio.cli",)
"""Packages without a page: the commands have a reference of their own."""


@dataclass(frozen=True)
class Module:
    """A module or package, as described by its source."""

    name: str
    """Full name, such as ``dronevio.eval.metrics``."""
    summary: str
    """First sentence of its docstring."""
    exported: tuple[str, ...] | None
    """Names in its ``__all__``, or None where it has none."""
    names: tuple[str, ...]
    """Public classes, functions and constants that its source defines."""
    is_package: bool


def read_module(path: Path, name: str) -> Module:
    """Return the description of a module in the file ``path``. Packages are imported, modules are only parsed."""
    is_package = path.name == "__init__.py"
    exported = getattr(importlib.import_module(name), "__all__", None) if is_package else None
    tree = ast.parse(path.read_text(encoding="utf-8"), path)
    paragraph = (ast.get_docstring(tree) or "").split("\n\n")[0]
    return Module(
        name,
        " ".join(paragraph.split()),
        None if exported is None else tuple(exported),
        tuple(defined for defined in _defined(tree) if not defined.startswith("_")),
        is_package,
    )


def _defined(tree: ast.Module) -> Iterator[str]:
    """Yield the names of the classes, functions and documented constants of a module."""
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name))


def packages(folder: Path = ROOT, name: str = "dronevio") -> dict[str, list[Module]]:
    """Return all public packages below a folder, each with itself first and its public modules after it."""
    if name in EXCLUDED:
        return {}
    modules = [read_module(folder / "__init__.py", name)]
    below: dict[str, list[Module]] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("_"):
            continue
        if path.suffix == ".py":
            modules.append(read_module(path, f"{name}.{path.stem}"))
        elif (path / "__init__.py").is_file():
            inner = packages(path, f"{name}.{path.name}")
            modules += [found[0] for package, found in inner.items() if package == f"{name}.{path.name}"]
            below |= inner
    return {name: modules, **below}


def page(package: Module, modules: list[Module], explained: frozenset[str] = frozenset()) -> str:
    """Return the Markdown page of a package.

    Args:
        package: The package.
        modules: Its modules.
        explained: Full names of the modules that the lessons refer to.
    """
    lines = [f"# {package.name}", "", f"::: {package.name}", "    options:"]
    if package.exported:
        lines += ["      members:", *(f"        - {name}" for name in package.exported), ""]
    else:
        lines += ["      members: false", ""]
    if modules:
        lines += ["## Modules", "", "| module | purpose |", "| --- | --- |"]
        lines += [f"| {_link(module, package, explained)} | {module.summary} |" for module in modules] + [""]
    for module in modules:
        if not module.is_package and (package.exported is None or module.name in explained):
            lines += [f"::: {module.name}", "    options:", "      show_root_heading: true"]
            if package.exported is not None:  # the others are above
                others = [name for name in module.names if name not in package.exported]
                lines += ["      members:", *(f"        - {name}" for name in others)]
            lines.append("")
    return "\n".join(lines)


def _link(module: Module, package: Module, explained: frozenset[str]) -> str:
    """Return the name of a module in its package's table, linked to where it is documented, if it is."""
    name = f"`{module.name.removeprefix(f'{package.name}.')}`"
    if module.is_package:
        return f"[{name}]({os.path.relpath(page_name(module.name), Path(page_name(package.name)).parent)})"
    return f"[{name}][{module.name}]" if package.exported is None or module.name in explained else name


def page_name(package: str) -> str:
    """Return the file name of a package's page: dronevio.eval.metrics is documented in eval/metrics.md."""
    _, *parts = package.split(".")
    return "/".join([*parts[:1], f"{'.'.join(parts[1:]) or 'index'}.md"])


def explained_modules(found: dict[str, list[Module]]) -> frozenset[str]:
    """Return the modules that contain the names to which the lessons refer, unless their packages export them all."""
    names = [name for lesson in LESSONS for name in named(lesson_source(lesson))]
    return frozenset(
        module.name
        for package, *modules in found.values()
        for module in modules
        if any(
            name.startswith(f"{module.name}.") and name.split(".")[-1] not in (package.exported or ()) for name in names
        )
    )


def summary(found: dict[str, list[Module]]) -> str:
    """Return the navigation: the packages as a tree of two levels."""
    lines = [f"* [dronevio]({page_name('dronevio')})"]
    for top in [name for name in found if name.count(".") == 1]:
        lines += [f"* {top}", f"    * [{top}]({page_name(top)})"]
        lines += [
            f"    * [{name.removeprefix(f'{top}.')}]({page_name(name)})" for name in found if name.startswith(f"{top}.")
        ]
    return "\n".join(lines) + "\n"


def write(folder: Path) -> list[Path]:
    """Write the pages of all packages, and SUMMARY.md, which orders them."""
    found = packages()
    explained = explained_modules(found)
    contents = {page_name(name): page(package, modules, explained) for name, (package, *modules) in found.items()}
    return write_changed(folder, {**contents, "SUMMARY.md": summary(found)})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="Folder of the pages.")
    write(parser.parse_args().folder)
