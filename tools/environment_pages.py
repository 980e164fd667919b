"""Write the pages of the Gymnasium environments: one Markdown page per environment, an index, and one of the arguments.

The page of an environment is the docstring of its task, with its picture, and with tables of the spaces and of the
arguments that are read from the environment itself.
"""

import argparse
import ast
import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from cli_reference import write_changed
from environment_pictures import picture_name

import dronevio.envs  # noqa: F401 registers the environments
from dronevio.models.actions import ActionLimits
from dronevio.sim.envs import settings, single
from dronevio.sim.envs.episodes import actions, options, randomization
from dronevio.sim.envs.sensing import estimation, observations

NAMESPACE = "dronevio"
ARGUMENTS_PAGE = "arguments.md"
SECTIONS: dict[str, ModuleType] = {
    "Actions": actions,
    "Observations": observations,
    "Randomization": randomization,
    "Options of a reset": options,
    "Estimators": estimation,
}
"""Sections of the page of the arguments, and the modules that they document."""
_LONGEST_VALUE = 80


def environment_ids() -> list[str]:
    """Return the ids of all environments of this package in the order of their registration."""
    return [spec.id for spec in gymnasium.registry.values() if spec.namespace == NAMESPACE]


def name_of(environment_id: str) -> str:
    """Return the name in an id: Hover of dronevio/Hover-v0."""
    return gymnasium.spec(environment_id).name


@cache
def environment(environment_id: str) -> Any:
    """Return an environment without its wrappers."""
    return gymnasium.make(environment_id).unwrapped


def docstring_of(environment_id: str) -> str:
    """Return the docstring of the task of an environment."""
    return inspect.cleandoc(type(environment(environment_id).settings.task).__doc__ or "")


def page(environment_id: str) -> str:
    """Return the page of an environment."""
    name, env = name_of(environment_id), environment(environment_id)
    chosen, task = env.settings, env.settings.task
    facts = {
        "make": f'`gymnasium.make("dronevio.envs:{environment_id}")`',
        "time limit": f"{chosen.episode_steps} steps, {task.episode_s:g} s",
        "world": f"`{chosen.world}`",
        "action mode": f"`{chosen.action}`",
        "rates": f"actions {chosen.action_rate_hz:g} Hz, IMU {chosen.imu_rate_hz:g} Hz",
    }
    spaces_table = table(("", "shape", "type", "smallest", "largest"), space_rows(env))
    summary, _, sections = docstring_of(environment_id).partition("\n\n")
    sections = sections.replace("## Action space", f"## Spaces\n\n{spaces_table}\n\n## Action space", 1)
    before, heading, after = sections.partition("## Version history")
    arguments = table(("field", "default", "content"), field_rows(type(task), task))
    picture = f"![A picture of the environment {name} by its chase camera](../images/{picture_name(name)})"
    parts = [f"# {name}", summary, picture, table(("", ""), facts.items()), before.strip(), arguments, heading + after]
    return linked("\n\n".join(parts)) + "\n"


def space_rows(env: Any) -> Iterator[tuple[str, ...]]:
    """Yield a row for the action and for each observation of an environment: name, shape, type and bounds."""
    yield "action", *_box_cells(env.action_space)
    for name in env.settings.observations:  # Gymnasium sorts them by name
        yield f"`{name}`", *_box_cells(env.observation_space[name])


def _box_cells(space: Any) -> tuple[str, ...]:
    """Return shape, type, smallest and largest values of a box."""
    return str(space.shape), str(space.dtype), _bounds(space.low), _bounds(space.high)


def _bounds(values: Any) -> str:
    """Return the different values of an array, in their order."""
    different = dict.fromkeys(f"{value:.4g}" for value in np.ravel(values))
    return ", ".join(different).replace("-", "−")


def field_rows(cls: type, values: Any = None) -> Iterator[tuple[str, ...]]:
    """Yield a row for each field of a dataclass: name, default value and docstring.

    Args:
        cls: The dataclass.
        values: An instance with the default values; by default they are read from the source.
    """
    explained: dict[str, tuple[str, str]] = {}
    for base in reversed([base for base in cls.__mro__ if is_dataclass(base)]):
        explained |= _explained(base)
    for field in fields(cls):
        source, text = explained[field.name]
        value = source if values is None else repr(getattr(values, field.name))
        yield f"`{field.name}`", f"`{value if len(value) <= _LONGEST_VALUE else source}`", text


def _explained(cls: type) -> dict[str, tuple[str, str]]:
    """Return the sources of the default values and the docstrings of the fields that a class itself defines."""
    body = ast.parse(inspect.getsource(cls)).body[0]
    assert isinstance(body, ast.ClassDef)
    explained: dict[str, tuple[str, str]] = {}
    for node, after in zip(body.body, body.body[1:], strict=False):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and isinstance(after, ast.Expr):
            text = " ".join(inspect.cleandoc(ast.literal_eval(after.value)).split())
            explained[node.target.id] = _default(node.value), text
    return explained


def randomization_rows() -> Iterator[tuple[str, ...]]:
    """Yield a row for each field of the randomization: name, default, moderate value and docstring."""
    nothing, moderate = randomization.NOTHING_RANDOM, randomization.MODERATE
    pairs = zip(field_rows(type(nothing), nothing), field_rows(type(moderate), moderate), strict=True)
    for (name, default, text), (_, spread, _) in pairs:
        yield name, default, spread, text


def _default(node: ast.expr | None) -> str:
    """Return the source of the default value of a field."""
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "field":
        return f"{ast.unparse(node.keywords[0].value)}()"
    return "" if node is None else ast.unparse(node)


def table(header: tuple[str, ...], rows: Any) -> str:
    """Return a Markdown table."""
    lines = [" | ".join(header), " | ".join("---" for _ in header)]
    lines += [" | ".join(str(cell).replace("|", "\\|") for cell in row) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)


def arguments_page() -> str:
    """Return the page of what all environments have in common: arguments, actions, observations, options and infos."""
    summary, _, sections = inspect.cleandoc(single.DroneEnv.__doc__ or "").partition("\n\n")
    arguments = table(("argument", "default", "content"), field_rows(settings.EnvironmentSettings))
    before, heading, after = sections.partition("## Time limits")
    parts = ["# Arguments, actions and observations", summary, before.strip(), arguments, heading + after]
    tables = {
        "Actions": table(("field of `ActionLimits`", "default", "content"), field_rows(ActionLimits)),
        "Randomization": table(("field of `Randomization`", "default", "`MODERATE`", "content"), randomization_rows()),
        "Estimators": table(("field of `Estimation`", "default", "content"), field_rows(estimation.Estimation)),
    }
    for title, module in SECTIONS.items():
        parts += [f"## {title}", inspect.cleandoc(module.__doc__ or "")]
        parts += [tables[title]] if title in tables else []
    return linked("\n\n".join(parts), here=ARGUMENTS_PAGE) + "\n"


def index() -> str:
    """Return the page that lists the environments."""
    lines = [
        "# Environments",
        "",
        "All environments are of the class [`DroneEnv`][dronevio.sim.envs.DroneEnv] with different tasks. The "
        f"[arguments]({ARGUMENTS_PAGE}) replace world, vehicle, sensors, action mode, observations and rates of each; "
        "[Train with Gymnasium](../rl.md) explains their use.",
        "",
    ]
    for environment_id in environment_ids():
        name, summary = name_of(environment_id), docstring_of(environment_id).partition("\n\n")[0]
        picture = f"[![{name}](../images/{picture_name(name)}){{ width=320 }}]({name.lower()}.md)"
        lines += [f"## [{name}]({name.lower()}.md)", "", linked(" ".join(summary.split())), "", picture, ""]
    return "\n".join(lines)


def linked(text: str, here: str = "") -> str:
    """Return text in which names of modules of the environments are links to the page of the arguments.

    Args:
        text: Markdown text.
        here: Name of the page on which the text is.
    """
    page_name = "" if here == ARGUMENTS_PAGE else ARGUMENTS_PAGE
    targets: Mapping[str, str] = {
        **{module.__name__: f"{page_name}#{title.lower().replace(' ', '-')}" for title, module in SECTIONS.items()},
        "dronevio.sim.envs.single.DroneEnv": f"{page_name}#arguments",
        "dronevio.sim.envs.settings.EnvironmentSettings": f"{page_name}#arguments",
    }

    def link(found: re.Match[str]) -> str:
        target = targets.get(found[1])
        return f"[{found[0]}]({target})" if target else found[0]

    return re.sub(r"(?<!`)`(dronevio\.[\w.]+)`(?!`)", link, text)


def write(folder: Path) -> list[Path]:
    """Write all pages, and SUMMARY.md, which orders them."""
    names = {name_of(environment_id): page(environment_id) for environment_id in environment_ids()}
    entries = {"Overview": "index.md"} | {name: f"{name.lower()}.md" for name in names}
    entries["Arguments, actions and observations"] = ARGUMENTS_PAGE
    return write_changed(
        folder,
        {
            "index.md": index(),
            ARGUMENTS_PAGE: arguments_page(),
            **{f"{name.lower()}.md": text for name, text in names.items()},
            "SUMMARY.md": "".join(f"* [{title}]({target})\n" for title, target in entries.items()),
        },
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="Folder of the pages.")
    write(parser.parse_args().folder)
