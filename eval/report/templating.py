"""Pages as HTML: Jinja templates with autoescaping, and the values that they show.

A page is one self-contained file, readable on a wide screen and a telephone, in light and dark mode. All text is
escaped; only plots, style sheets and scripts, which come from this package, are inserted as they are.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from dronevio.eval.metrics.metric import DASH

_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Tile:
    """A number that is shown large."""

    label: str
    """Name of the quantity."""
    value: str
    """The number as text."""
    unit: str
    """Unit of the number."""
    note: str = ""
    """Further explanation in small print."""
    colour: str = ""
    """Colour of a mark before the label; no mark if it is empty."""


def render_page(template: str, title: str, introduction: str, script: str = "", **values: object) -> str:
    """Return a page as HTML.

    Args:
        template: Name of a template that extends ``page.html.j2``.
        title: Title of the page.
        introduction: Text below the title.
        script: Name of a script in the folder of templates; the page must be readable without it. Empty for none.
        **values: Values that the template shows.
    """
    return (
        environment()
        .get_template(template)
        .render(
            title=title,
            introduction=introduction,
            style_sheet=_read("report.css"),
            script=_read(script) if script else "",
            **values,
        )
    )


@cache
def environment() -> Environment:
    """Return the environment of the templates, which escapes every value that is not marked as HTML."""
    env = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    env.filters.update(number=number, flattened=flattened, sort_key=sort_key)
    return env


def flattened(content: object, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the values of nested settings as text, with dotted names."""
    if isinstance(content, Mapping):
        for name, value in content.items():
            yield from flattened(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(content, float):
        yield prefix, f"{content:.6g}"
    elif isinstance(content, Sequence) and any(isinstance(item, Mapping) for item in content):
        for i, item in enumerate(content, start=1):
            yield from flattened(item, f"{prefix}.{i}")
    elif isinstance(content, Sequence) and not isinstance(content, str):
        yield prefix, ", ".join(str(item) for item in content) or DASH
    else:
        yield prefix, DASH if content is None else str(content)


def number(value: object, decimals: int, sign: bool = False) -> str:
    """Return a number with some decimals, or a dash if the value is not a number."""
    if not isinstance(value, int | float):
        return DASH
    return f"{value:{'+' if sign else ''}.{decimals}f}".replace("-", "−")


def sort_key(order: float) -> str:
    """Return the value by which a script sorts a cell."""
    return f"{order:.6g}" if math.isfinite(order) else "Infinity"


def _read(name: str) -> Markup:
    """Return a style sheet or script of the folder of templates."""
    return Markup((_TEMPLATES / name).read_text(encoding="utf-8"))
