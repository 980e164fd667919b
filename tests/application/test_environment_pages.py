"""The pages of the environments: they are the docstrings, and the docstrings agree with the environments."""

import inspect
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import dronevio.envs  # noqa: F401 registers the environments
from dronevio.sim.envs import Estimation

CHECKOUT = Path(__file__).resolve().parents[2]
IDS = [spec.id for spec in gymnasium.registry.values() if spec.namespace == "dronevio"]

pytestmark = pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="not a checkout")


@pytest.fixture(scope="module")
def pages(script: Any) -> Any:
    """The script that writes the pages."""
    return script("environment_pages")


def section(text: str, title: str) -> str:
    """Return a section of a docstring."""
    return text.partition(f"## {title}\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("environment_id", IDS)
def test_a_page_has_every_line_of_the_docstring(pages: Any, environment_id: str) -> None:
    task = type(pages.environment(environment_id).settings.task)
    lines = inspect.cleandoc(task.__doc__ or "").splitlines()
    shown = pages.page(environment_id).splitlines()
    assert len(lines) > 40
    assert [line for line in lines if pages.linked(line) not in shown] == []


@pytest.mark.parametrize("environment_id", IDS)
def test_documented_observations_are_those_of_the_space(pages: Any, environment_id: str) -> None:
    env, text = pages.environment(environment_id), pages.docstring_of(environment_id)
    rows = re.findall(r"^\| ``(\w+)`` \| (\(.*?\)) (\w+) \|", section(text, "Observation space"), re.MULTILINE)
    spaces = {name: (str(box.shape), str(box.dtype)) for name, box in env.observation_space.spaces.items()}
    assert spaces == {name: (shape, dtype) for name, shape, dtype in rows}
    assert f"``{str(env.action_space).replace('1.0', '1')}``" in text


@pytest.mark.parametrize("environment_id", IDS)
def test_documented_rewards_are_those_of_a_step(pages: Any, environment_id: str) -> None:
    named = re.findall(r"^- ``(\w+)``:", section(pages.docstring_of(environment_id), "Rewards"), re.MULTILINE)
    at_once: dict[str, Any] = {"estimation": Estimation(longest_wait_s=0.0)}  # without images
    with gymnasium.make(environment_id, observations=("position",), **at_once) as env:
        env.reset(seed=0)
        *_, info = env.step(np.zeros(4, np.float32))
    assert named == list(info["reward_terms"])


def test_spaces_in_a_page_are_those_of_the_environment(pages: Any) -> None:
    page = pages.page("dronevio/Hover-v0")
    assert "| time limit | 500 steps, 10 s |" in page
    assert "| action | (4,) | float32 | −1 | 1 |" in page
    assert "| `rate` | (3,) | float32 | −17.45 | 17.45 |" in page
    assert "| `height_m` | `1.2` | Height of the target above the landing pad [m]. |" in page


def test_every_environment_has_a_page_and_a_picture(pages: Any, script: Any, tmp_path: Path) -> None:
    pages.write(tmp_path)
    names = [pages.name_of(environment_id) for environment_id in IDS]
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"index.md", "arguments.md", "SUMMARY.md", *(f"{name.lower()}.md" for name in names)}
    listed = (tmp_path / "SUMMARY.md").read_text(encoding="utf-8")
    for name in names:
        text = (tmp_path / f"{name.lower()}.md").read_text(encoding="utf-8")
        for picture in re.findall(r"\]\((\.\./images/.*?)\)", text):
            assert (CHECKOUT / "docs" / "environments" / picture).resolve().is_file()
        assert f"({name.lower()}.md)" in listed and f"environment-{name.lower()}.jpg" in text
    assert set(script("environment_pictures").SCENES) == set(names)


def test_the_page_of_the_arguments_has_all_fields(pages: Any) -> None:
    page = pages.arguments_page()
    settings = pages.environment("dronevio/Hover-v0").settings
    named = set(vars(settings)) | set(vars(settings.randomization))
    assert [name for name in named if f"| `{name}` |" not in page] == []


def test_the_guide_lists_every_environment(pages: Any) -> None:
    guide = (CHECKOUT / "docs" / "rl.md").read_text(encoding="utf-8")
    for environment_id in IDS:
        chosen = pages.environment(environment_id).settings
        row = next(line for line in guide.splitlines() if line.startswith(f"| `{environment_id}` |"))
        assert row.endswith(f"| `{chosen.action}` | {chosen.task.episode_s:g} s |")
