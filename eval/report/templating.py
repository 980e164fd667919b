"""The parts of every page: HTML that needs nothing but itself, on a wide screen and a telephone, by day and night."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

from matplotlib.axes import Axes

from dronevio.eval.report import figures as plots

DASH = "–"
"""What stands where a number is not known."""
_STYLE_SHEET = Path(__file__).parent / "templates" / "report.css"


@dataclass(frozen=True)
class Tile:
    """One number that a reader looks for first."""

    label: str
    """What it is."""
    value: str
    """The number."""
    unit: str
    """Its unit."""
    note: str = ""
    """What else is to be known of it."""
    colour: str = ""
    """Colour of a mark before the label; none where it is empty."""


def document(title: str, introduction: str, sections: Iterable[str], script: str = "") -> str:
    """Return a whole page.

    Args:
        title: What it is about.
        introduction: What stands right below the title.
        sections: The rest, as HTML.
        script: What may run in the page, a program of our own; it must be readable without.
    """
    name, style = escape(title), _STYLE_SHEET.read_text(encoding="utf-8")
    body = "\n".join(filter(None, sections))
    program = f"<script>\n{script}</script>\n" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{name} · dronevio</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n<header><h1>{name}</h1><p>{escape(introduction)}</p></header>\n<main>\n{body}\n</main>\n"
        f"{program}</body>\n</html>\n"
    )


def section(title: str, content: str) -> str:
    """Return a section of HTML content; none where there is no content."""
    if not content:
        return ""
    heading = f"<h2>{escape(title)}</h2>" if title else ""
    return f"<section>{heading}{content}</section>"


def tiles(items: Iterable[Tile], kind: Literal["tiles", "cards"] = "tiles") -> str:
    """Return a row of numbers; cards are wide and share the width of the page."""
    return f'<div class="{kind}">{"".join(map(_tile, items))}</div>'


def figures(drawings: Iterable[str]) -> str:
    """Return drawings, each of which a narrow page puts in a row of its own; nothing where there are none."""
    content = "".join(drawings)
    return f'<div class="figures">{content}</div>' if content else ""


def drawing(height_in: float, draw: Callable[[Axes], None], alt: str = "", width_in: float = 4.8) -> str:
    """Return a drawing as a figure.

    Args:
        height_in: Its height [in].
        draw: Draws into the axes.
        alt: What it shows, behind its title, for those who cannot see it.
        width_in: Its width [in].
    """
    with plots.figure(width_in, height_in) as (fig, axes):
        draw(axes[0])
    title = axes[0].get_title(loc="left")
    return f"<figure>{plots.as_svg(fig, f'{title}: {alt}' if alt else title)}</figure>"


def details(summary: str, content: str, opened: bool = False) -> str:
    """Return HTML content that is folded away until somebody opens it."""
    return f"<details{' open' if opened else ''}><summary>{escape(summary)}</summary>{content}</details>"


def folds(items: Iterable[str]) -> str:
    """Return what is folded away side by side where there is room."""
    return f'<div class="folds">{"".join(items)}</div>'


def settings(content: object) -> str:
    """Return nested settings as a table of dotted names and values."""
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in flat(content))
    return f'<div class="wide"><table class="settings">{rows}</table></div>'


def flat(content: object, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the leaves of nested settings, with dotted names."""
    if isinstance(content, Mapping):
        for name, value in content.items():
            yield from flat(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(content, float):
        yield prefix, f"{content:.6g}"
    elif isinstance(content, Sequence) and any(isinstance(item, Mapping) for item in content):
        for i, item in enumerate(content, start=1):
            yield from flat(item, f"{prefix}.{i}")
    elif isinstance(content, Sequence) and not isinstance(content, str):
        yield prefix, ", ".join(str(item) for item in content) or DASH
    else:
        yield prefix, DASH if content is None else str(content)


def number(value: object, decimals: int, sign: bool = False) -> str:
    """Return a number for people; a dash where there is none."""
    if not isinstance(value, int | float):
        return DASH
    return f"{value:{'+' if sign else ''}.{decimals}f}".replace("-", "−")


def _tile(tile: Tile) -> str:
    mark = f'<span class="mark" style="background:{tile.colour}"></span>' if tile.colour else ""
    return (
        f'<div class="tile"><div class="label">{mark}{escape(tile.label)}</div>'
        f'<div class="value">{escape(tile.value)} <span>{escape(tile.unit)}</span></div>'
        f'<div class="note">{escape(tile.note)}</div></div>'
    )
