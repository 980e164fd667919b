"""The command that installs an extra."""

import json
import sys
from importlib.metadata import PathDistribution
from pathlib import Path

import pytest

from dronevio.models import extras

pytestmark = pytest.mark.usefixtures("installed")


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment with the package, without a clone; returns the folder of its metadata."""
    metadata = tmp_path / "dronevio-1.dist-info"
    metadata.mkdir()
    monkeypatch.setattr(extras, "_UV", tmp_path / "tools" / "uv")
    monkeypatch.setattr(extras, "distribution", lambda _: PathDistribution(metadata))
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    return metadata


def test_extra_of_an_index_is_installed_by_name() -> None:
    assert extras.install_command("book") == "pip install 'dronevio[book]'"


def test_extra_of_a_wheel_is_installed_from_the_wheel(installed: Path) -> None:
    url = "file:///home/user/dronevio-1-py3-none-any.whl"
    (installed / "direct_url.json").write_text(json.dumps({"url": url, "archive_info": {}}), encoding="utf-8")
    assert extras.install_command("book") == f"pip install 'dronevio[book] @ {url}'"


def test_extra_of_a_tool_is_installed_by_uv(tmp_path: Path) -> None:
    (tmp_path / "uv-receipt.toml").touch()
    assert extras.install_command("geo") == "uv tool install 'dronevio[geo]'"
