"""The installed package, and the links between the folders of a checkout."""

import importlib.metadata
import json
import re
import tomllib
from importlib.resources import files
from pathlib import Path

import mujoco
import pytest

import dronevio
from dronevio.sim.cameras.gl import INSTALL_COMMAND

SUBPACKAGES = ("estimator", "eval", "models", "sim")
CHECKOUT = Path(__file__).resolve().parents[2]

in_checkout = pytest.mark.skipif(not (CHECKOUT / "Makefile").exists(), reason="not a checkout")


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_every_subpackage_is_installed(name: str) -> None:
    assert (files("dronevio") / name / "__init__.py").is_file()


def test_package_is_marked_as_typed() -> None:
    assert (files("dronevio") / "py.typed").is_file()


def test_vehicle_models_are_installed_and_valid() -> None:
    models = [path for path in (files("dronevio") / "models" / "mjcf").iterdir() if path.name.endswith(".xml")]
    assert models
    for model in models:
        assert mujoco.MjModel.from_xml_path(str(model)).nbody > 1


def test_command_is_installed_with_the_package() -> None:
    assert importlib.metadata.version("dronevio") == dronevio.__version__
    [command] = importlib.metadata.entry_points(group="console_scripts", name="dronevio")
    assert command.load() is not None


@in_checkout
@pytest.mark.parametrize("name", SUBPACKAGES)
def test_subpackages_are_relative_links(name: str) -> None:
    link = CHECKOUT / "dronevio" / name
    assert link.is_symlink()
    assert str(link.readlink()) == f"../{name}"
    assert (CHECKOUT / name).is_dir() and not (CHECKOUT / name).is_symlink()


@in_checkout
def test_lock_names_only_the_public_index() -> None:
    hosts = set(re.findall(r"https?://([^/\"]+)", (CHECKOUT / "uv.lock").read_text(encoding="utf-8")))
    assert hosts == {"pypi.org", "files.pythonhosted.org"}


@in_checkout
def test_changelog_has_this_version() -> None:
    changelog = (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## [{dronevio.__version__}]" in changelog


@in_checkout
def test_lint_bans_imports_of_a_subpackage_by_its_bare_name() -> None:
    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(settings["tool"]["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"]) == set(SUBPACKAGES)


@in_checkout
def test_set_up_installs_the_packages_of_the_doctor() -> None:
    setup = (CHECKOUT / "tools" / "setup.sh").read_text(encoding="utf-8")
    installed = re.search(r"^packages=\((.+?)\)", setup, re.MULTILINE)
    assert installed is not None
    assert f"apt-get install -y {installed[1]}" == INSTALL_COMMAND.removeprefix("sudo ")
    assert f"make python3 {installed[1]} " in (CHECKOUT / "Dockerfile").read_text(encoding="utf-8")


@in_checkout
def test_address_of_the_repository_is_in_one_file() -> None:
    address = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]["Repository"]
    others = [*CHECKOUT.glob("*.*"), *CHECKOUT.glob(".github/workflows/*"), *CHECKOUT.glob("docs/**/*.md")]
    naming = [path.name for path in others if path.is_file() and address.encode() in path.read_bytes()]
    assert naming == ["pyproject.toml"]


@in_checkout
def test_container_of_development_is_a_stage_of_the_dockerfile() -> None:
    folder = CHECKOUT / ".devcontainer"
    container = json.loads((folder / "devcontainer.json").read_text(encoding="utf-8"))
    dockerfile = (folder / container["build"]["dockerfile"]).read_text(encoding="utf-8")
    _, stage = re.split(rf"^FROM \S+ AS {container['build']['target']}$", dockerfile, maxsplit=1, flags=re.MULTILINE)
    assert f"\nUSER {container['remoteUser']}\n" in stage.split("\nFROM ")[0]
