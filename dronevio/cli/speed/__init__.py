"""``dronevio speed``: how fast this machine is at it."""

import importlib
import sys

SUBJECTS: dict[str, str] = {
    "sim": "drawing, flying and recording, by what they should cost",
    "eval": "scoring trajectories, beside evo",
}
"""What can be measured, each a module of this package with a ``main(arguments) -> int``, and what of it."""


def usage() -> str:
    """Return the text of ``dronevio speed --help``."""
    width = max(map(len, SUBJECTS))
    rows = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in SUBJECTS.items())
    return (
        "usage: dronevio speed SUBJECT [OPTIONS]\n\n"
        "Measure how fast this machine is, and print figures with their bounds.\n\n"
        f"subjects:\n{rows}\n\n"
        "examples:\n"
        "  dronevio speed sim\n"
        "  dronevio speed sim --json > figures.json\n"
        "  dronevio speed SUBJECT --help\n"
    )


def main(arguments: list[str]) -> int:
    """Measure what the command line names."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
        return 0
    name = arguments[0]
    if name not in SUBJECTS:
        print(f"dronevio speed: unknown subject {name!r}; expected one of {', '.join(SUBJECTS)}", file=sys.stderr)
        return 2
    return int(importlib.import_module(f"dronevio.cli.speed.{name}").main(arguments[1:]))
