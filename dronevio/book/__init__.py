"""``dronevio book``: the experiments of the robotics book's chapter on visual SLAM."""

import importlib
import sys

EXPERIMENTS: dict[str, str] = {
    "imu": "dead reckoning on a loop as a factor graph (section 7.4.1)",
    "sfm": "five photographs of a villa, bundle-adjusted (section 7.4.2)",
    "eqvio": "a real flight, by our smoother and by GTSAM's equivariant filter",
}
"""The experiments, each a module of this package with a ``main(arguments) -> int``, and what they do."""


def usage() -> str:
    """Return the text of ``dronevio book --help``."""
    width = max(map(len, EXPERIMENTS))
    rows = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in EXPERIMENTS.items())
    return (
        "usage: dronevio book EXPERIMENT [OPTIONS]\n\n"
        "The experiments of the chapter on visual SLAM (7.4) in Dellaert and Hutchinson's Introduction to Robotics\n"
        "(https://www.roboticsbook.org).\n\n"
        f"experiments:\n{rows}\n\n"
        "examples:\n"
        "  dronevio book imu\n"
        "  dronevio book sfm --out villa\n"
        "  dronevio book EXPERIMENT --help\n"
    )


def main(arguments: list[str]) -> int:
    """Run the experiment that the command line names."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
        return 0
    name = arguments[0]
    if name not in EXPERIMENTS:
        print(f"dronevio book: unknown experiment {name!r}; expected one of {', '.join(EXPERIMENTS)}", file=sys.stderr)
        return 2
    return int(importlib.import_module(f"dronevio.book.{name}").main(arguments[1:]))
