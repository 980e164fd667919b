"""What is installed, be it a checkout or a wheel; and, in a checkout, how the rooms hang together."""

import importlib.metadata
import re
import tomllib
from importlib.resources import files
from pathlib import Path

import mujoco
import pytest

import dronevio
from dronevio.sim.cameras.gl import INSTALL_COMMAND

ROOMS = ("estimator", "eval", "models", "sim")
CHECKOUT = Path(__file__).resolve().parents[2]

in_checkout = pytest.mark.skipif(not (CHECKOUT / "Makefile").exists(), reason="not a checkout")


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_is_there(room: str) -> None:
    assert (files("dronevio") / room / "__init__.py").is_file()


def test_types_are_promised() -> None:
    assert (files("dronevio") / "py.typed").is_file()


def test_models_of_the_drone_are_there_and_load() -> None:
    models = sorted(path for path in (files("dronevio") / "models" / "mjcf").iterdir() if path.name.endswith(".xml"))
    assert models
    for model in models:
        assert mujoco.MjModel.from_xml_path(str(model)).nbody > 1


def test_command_is_installed_with_the_package() -> None:
    assert importlib.metadata.version("dronevio") == dronevio.__version__
    [command] = importlib.metadata.entry_points(group="console_scripts", name="dronevio")
    assert command.load() is not None


@in_checkout
@pytest.mark.parametrize("room", ROOMS)
def test_rooms_are_relative_links_in_the_door(room: str) -> None:
    link = CHECKOUT / "dronevio" / room
    assert link.is_symlink()
    assert str(link.readlink()) == f"../{room}"
    assert (CHECKOUT / room).is_dir() and not (CHECKOUT / room).is_symlink()


@in_checkout
def test_lock_names_only_the_public_index() -> None:
    hosts = set(re.findall(r"https?://([^/\"]+)", (CHECKOUT / "uv.lock").read_text(encoding="utf-8")))
    assert hosts == {"pypi.org", "files.pythonhosted.org"}


@in_checkout
def test_changelog_knows_this_version() -> None:
    changelog = (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## [{dronevio.__version__}]" in changelog


@in_checkout
def test_lint_bans_importing_a_room_by_its_bare_name() -> None:
    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(settings["tool"]["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"]) == set(ROOMS)


@in_checkout
def test_set_up_installs_what_the_doctor_advises() -> None:
    setup = (CHECKOUT / "scripts" / "setup.sh").read_text(encoding="utf-8")
    installed = re.search(r"^packages=\((.+?)\)", setup, re.MULTILINE)
    assert installed is not None
    assert f"sudo apt-get install -y {installed[1]}" == INSTALL_COMMAND
