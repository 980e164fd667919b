"""``dronevio worlds``: a list of all worlds, or pictures of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table, progress_bars
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class WorldsCommand(Settings):
    """List the worlds in which scenarios take place, or draw a contact sheet of them.

    Pictures of worlds are kept in ~/.cache/dronevio/pictures for the next contact sheet.

    Examples:
      dronevio worlds
      dronevio worlds --json
      dronevio worlds --sheet worlds.png
      dronevio worlds --sheet forest.jpg --world forest --seed 3
      dronevio worlds --sheet yard.png --world yard.yaml
    """

    sheet: Path | None = None
    """Image file for a contact sheet of the worlds; its suffix selects the format."""
    world: str | None = None
    """Name of one world, or a world of your own: a file, such as yard.yaml or yard.xml (MJCF), or
    python:package.module:NAME; all worlds of the package by default."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed from which the worlds are generated."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(WorldsCommand, arguments, "worlds")

    from dronevio.models.errors import ConfigError
    from dronevio.sim.pictures.contact_sheet import require_picture
    from dronevio.sim.world import WORLDS, flight_area, resolved_world, world_builder
    from dronevio.sim.worlds.own.names import recorded_world, shown_world

    if command.seed < 0:
        raise ConfigError(f"seed {command.seed}; expected 0 or more")
    names = tuple(WORLDS) if command.world is None else (resolved_world(command.world),)
    if command.sheet is not None:
        require_picture(command.sheet)
    rows = []
    for name in names:
        place = flight_area(name, command.seed)
        rows.append((world_builder(name), [round(float(v), 2) for v in place.space.high - place.space.low]))
    if command.sheet is not None:
        _draw(command.sheet, names, command.seed, command.printing.json)
    if command.printing.json:
        worlds = [
            {
                "name": recorded_world(name),
                "difficulty": kind.difficulty,
                "size_m": size_m,
                "description": kind.description,
            }
            for name, (kind, size_m) in zip(names, rows, strict=True)
        ]
        sheet = None if command.sheet is None else str(command.sheet)
        print_json({"seed": command.seed, "sheet": sheet, "worlds": worlds})
        return 0
    print_table(
        f"Worlds of seed {command.seed}: length, width and height of the free space",
        ("name", "difficulty", "m", "description"),
        [
            (shown_world(name), kind.difficulty, " × ".join(f"{v:g}" for v in size_m), kind.description)
            for name, (kind, size_m) in zip(names, rows, strict=True)
        ],
        left=("difficulty", "m", "description"),
    )
    return 0


def _draw(path: Path, names: Sequence[str], seed: int, quiet: bool) -> None:
    """Draw the contact sheet of one world, or of several.

    Raises:
        GraphicsError: There is no off-screen OpenGL.
        OSError: The file cannot be written.
    """
    from dronevio.sim.cameras.gl import require_gl
    from dronevio.sim.pictures.contact_sheet import (
        LENS,
        VIEWS,
        VIEWS_EACH,
        contact_sheet,
        sheet_of_worlds,
        write_picture,
    )
    from dronevio.sim.pictures.world_pictures import pictures_of_worlds

    require_gl()
    single = len(names) == 1
    with progress_bars(quiet) as bars:
        pictures = pictures_of_worlds(names, seed, VIEWS if single else VIEWS_EACH, LENS, bars.bar("pictures"))
    write_picture(path, contact_sheet(pictures[0]) if single else sheet_of_worlds(names, pictures))
