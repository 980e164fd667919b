"""Write the pages of the API reference: one Markdown page per package, for mkdocstrings to fill in.

A package that has an ``__all__`` is documented by these names; of any other, all modules are documented.
"""

import argparse
import ast
import importlib
import os
from dataclasses import dataclass
from pathlib import Path

from cli_reference import write_changed

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
    is_package: bool


def read_module(path: Path, name: str) -> Module:
    """Return the description of a module in the file ``path``. Packages are imported, modules are only parsed."""
    is_package = path.name == "__init__.py"
    exported = getattr(importlib.import_module(name), "__all__", None) if is_package else None
    paragraph = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"), path)) or "").split("\n\n")[0]
    return Module(name, " ".join(paragraph.split()), None if exported is None else tuple(exported), is_package)


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


def page(package: Module, modules: list[Module]) -> str:
    """Return the Markdown page of a package."""
    lines = [f"# {package.name}", "", f"::: {package.name}", "    options:"]
    if package.exported:
        lines += ["      members:", *(f"        - {name}" for name in package.exported), ""]
    else:
        lines += ["      members: false", ""]
    if modules:
        lines += ["## Modules", "", "| module | purpose |", "| --- | --- |"]
        lines += [f"| {_link(module, package)} | {module.summary} |" for module in modules] + [""]
    if package.exported is None:
        for module in modules:
            if not module.is_package:
                lines += [f"::: {module.name}", "    options:", "      show_root_heading: true", ""]
    return "\n".join(lines)


def _link(module: Module, package: Module) -> str:
    """Return the name of a module in its package's table, linked to where it is documented, if it is."""
    name = f"`{module.name.removeprefix(f'{package.name}.')}`"
    if module.is_package:
        return f"[{name}]({os.path.relpath(page_name(module.name), Path(page_name(package.name)).parent)})"
    return f"[{name}][{module.name}]" if package.exported is None else name


def page_name(package: str) -> str:
    """Return the file name of a package's page: dronevio.eval.metrics is documented in eval/metrics.md."""
    _, *parts = package.split(".")
    return "/".join([*parts[:1], f"{'.'.join(parts[1:]) or 'index'}.md"])


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
    contents = {page_name(name): page(package, modules) for name, (package, *modules) in found.items()}
    return write_changed(folder, {**contents, "SUMMARY.md": summary(found)})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="Folder of the pages.")
    write(parser.parse_args().folder)
