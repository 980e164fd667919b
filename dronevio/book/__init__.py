"""``dronevio book``: the experiments of section 7.4, visual SLAM, of *Introduction to Robotics and Perception*.

F. Dellaert, S. Hutchinson: Introduction to Robotics and Perception, https://www.roboticsbook.org.
"""

from collections.abc import Sequence

from dronevio.cli.dispatch import CommandGroup, Subcommand

__all__ = ["COMMANDS", "main"]

COMMANDS = CommandGroup(
    "dronevio book",
    "Run the experiments of section 7.4, visual SLAM, of Introduction to Robotics and Perception by Dellaert and\n"
    "Hutchinson (https://www.roboticsbook.org).",
    {
        "open": Subcommand("dronevio.book.open_lesson", "copy a lesson out as a Jupyter notebook, or list the lessons"),
        "imu": Subcommand("dronevio.book.imu", "IMU factors, and a camera that stops their drift (section 7.4.1)"),
        "sfm": Subcommand("dronevio.book.sfm", "bundle adjustment of five photographs (section 7.4.2)"),
        "eqvio": Subcommand("dronevio.book.eqvio", "a real flight: fixed-lag smoother and equivariant filter compared"),
    },
    ("dronevio book open imu", "dronevio book imu", "dronevio book sfm --out villa"),
)
"""The experiments."""


def main(arguments: Sequence[str]) -> int:
    """Run the experiment that the command line names and return its exit code."""
    return COMMANDS.run(arguments)
