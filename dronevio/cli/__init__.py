"""The ``dronevio`` command: it calls the subcommand, and turns errors into one line and an exit code.

Exit codes: 0 success, 1 a check failed, 2 bad input, 130 interrupted, 141 the reader of standard output has gone.
"""

import os
import signal
import sys
from collections.abc import Sequence

from dronevio.cli.dispatch import CommandGroup, Subcommand
from dronevio.models.errors import DronevioError

__all__ = ["COMMANDS", "main"]

COMMANDS = CommandGroup(
    "dronevio",
    "Simulate a quadrotor, estimate its motion from camera and IMU, and evaluate the estimate.",
    {
        "run": Subcommand("dronevio.cli.run", "simulate a flight, estimate its motion, evaluate it and write a report"),
        "fly": Subcommand("dronevio.cli.fly", "simulate a flight and record its sensor data as an EuRoC folder"),
        "estimate": Subcommand("dronevio.cli.estimate", "estimate the trajectory of a recording"),
        "evaluate": Subcommand("dronevio.cli.evaluate", "compute the errors of an estimate against the ground truth"),
        "benchmark": Subcommand("dronevio.cli.benchmark", "run estimators on many flights and tabulate their errors"),
        "compare": Subcommand("dronevio.cli.compare", "compare two benchmarks or two runs statistically"),
        "gate": Subcommand("dronevio.cli.gate", "fail if a benchmark is worse than an earlier one"),
        "sfm": Subcommand("dronevio.cli.sfm", "reconstruct cameras and points from images alone"),
        "dense": Subcommand("dronevio.cli.dense", "compute the surfaces of a scene from the result of sfm"),
        "policy": Subcommand("dronevio.cli.policy", "evaluate, describe and export trained policies"),
        "refly": Subcommand("dronevio.cli.refly", "render images along the recorded trajectory of a real drone"),
        "convert": Subcommand("dronevio.cli.convert", "convert a recording, or export its calibration"),
        "scenarios": Subcommand("dronevio.cli.scenarios", "list the scenarios and the suites"),
        "worlds": Subcommand("dronevio.cli.worlds", "list the worlds, or draw a contact sheet of them"),
        "log": Subcommand("dronevio.cli.log", "write estimates of any program and a recording to a rerun file"),
        "report": Subcommand("dronevio.cli.report", "write a benchmark as HTML, Markdown, LaTeX or CSV"),
        "view": Subcommand("dronevio.cli.view", "open the rerun file of a run"),
        "book": Subcommand("dronevio.book", "run the experiments of a robotics book's section on visual SLAM"),
        "speed": Subcommand("dronevio.cli.speed", "measure the speed of the simulator and of the evaluation"),
        "doctor": Subcommand("dronevio.cli.doctor", "check this machine for the software and drivers that are needed"),
    },
    ("dronevio run", "dronevio run --seed 3 --out runs/third"),
)
"""All subcommands."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        arguments: The words after ``dronevio``; those of this process by default.
    """
    if arguments is None:  # this process is the command's own
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C: no half-written result stays
        for library in ("OMP", "OPENBLAS"):  # read when numpy is imported; spinning threads make small systems slower
            os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    args = list(sys.argv[1:] if arguments is None else arguments)
    try:
        status = _version() if args and args[0] in ("-V", "--version") else COMMANDS.run(args)
        sys.stdout.flush()
        return status
    except DronevioError as error:
        print(f"dronevio: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader has gone, as in `dronevio scenarios | head -3`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains when it ends
        return 141
    except OSError as error:  # a full disk, a file in the way: a traceback would explain nothing
        where = f"{error.filename}: " if error.filename else ""
        print(f"dronevio: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("dronevio: interrupted", file=sys.stderr)
        return 130


def _version() -> int:
    """Print the version of the package."""
    from dronevio import __version__

    print(__version__)
    return 0
