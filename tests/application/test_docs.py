"""The documentation site: its navigation is complete, its examples name what exists, its tables are well formed."""

import contextlib
import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

CHECKOUT = Path(__file__).resolve().parents[2]
DOCS = CHECKOUT / "docs"
GENERATED = ("reference/cli/", "reference/api/")

pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="not a checkout")


def pages() -> list[str]:
    """Return all pages that are written by hand, as the navigation names them."""
    return sorted(
        name
        for name in (path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
        if not name.startswith("reference/")
    )


def navigation() -> list[str]:
    """Return every target that the navigation of the site names."""
    settings = yaml.safe_load((CHECKOUT / "mkdocs.yml").read_text(encoding="utf-8"))

    def targets(entry: Any) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        else:
            for inner in entry if isinstance(entry, list) else entry.values():
                yield from targets(inner)

    return list(targets(settings["nav"]))


def test_navigation_names_every_page_once() -> None:
    assert sorted(navigation()) == sorted([*pages(), *GENERATED])


def exists(name: str) -> bool:
    """Tell whether a dotted name is a module, or an attribute of one."""
    parts = name.split(".")
    for size in range(len(parts), 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            found: object = importlib.import_module(".".join(parts[:size]))
            for attribute in parts[size:]:
                found = getattr(found, attribute, None)
            return found is not None
    return False


@pytest.mark.parametrize("page", pages() if DOCS.is_dir() else [])
def test_python_names_in_pages_exist(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    assert [name for name in re.findall(r"`(dronevio(?:\.\w+)+)", text) if not exists(name)] == []


def test_reference_has_a_page_for_every_command(script: Any, tmp_path: Path) -> None:
    from dronevio.cli import COMMANDS

    reference = script("cli_reference")
    reference.write(tmp_path)
    assert {f"{name}.md" for name in COMMANDS} < {path.name for path in tmp_path.iterdir()}
    assert "`--seed INT`\n:   " in (tmp_path / "fly.md").read_text(encoding="utf-8")


def test_options_in_the_reference_are_those_of_the_help(script: Any) -> None:
    reference = script("cli_reference")
    command = next(c for c in reference.commands() if c.words == ("estimate",))
    listed = {word for group in reference.groups(command.help) for name, _ in group.options for word in name.split()}
    typed = set(re.findall(r"^│ (--[\w.-]+)", command.help, re.MULTILINE))
    assert len(typed) > 100
    assert typed <= {word.rstrip(",") for word in listed}


def test_api_pages_exist_for_every_package(script: Any) -> None:
    packages = script("api_reference").packages()
    folders = {path.parent for path in (CHECKOUT / "dronevio").glob("*/**/__init__.py")}
    names = {".".join(folder.relative_to(CHECKOUT).parts) for folder in folders}
    public = {name for name in names if not name.startswith("dronevio.cli")}
    assert set(packages) == public | {"dronevio"}
