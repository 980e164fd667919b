"""The ``dronevio`` command: it calls the subcommand, and turns errors into one line and an exit code.

Exit codes: 0 success, 1 a check failed, 2 bad input, 3 the drone collided (``run``, ``fly``, ``explore``), 70 a defect
in dronevio, 130 interrupted, 141 the reader of standard output has gone.
"""

import os
import shlex
import signal
import sys
import traceback
from collections.abc import Sequence

from dronevio.cli.dispatch import CommandGroup, Subcommand
from dronevio.models.errors import DEFECT, DefectError, DronevioError

__all__ = ["COMMANDS", "DEFECT_EXIT_CODE", "main", "report_defect"]

DEBUG = "--debug"
"""Argument of every command that shows the traceback of a defect."""
DEFECT_EXIT_CODE = 70
"""Exit code after a defect of dronevio itself, as in ``sysexits.h``."""

COMMANDS = CommandGroup(
    "dronevio",
    "Simulate a quadrotor, estimate its motion from camera and IMU, and evaluate the estimate.",
    {
        "run": Subcommand(
            "dronevio.cli.commands.run", "simulate a flight, estimate its motion, evaluate it and write a report"
        ),
        "fly": Subcommand(
            "dronevio.cli.commands.fly", "simulate a flight and record its sensor data as an EuRoC folder"
        ),
        "inspect": Subcommand("dronevio.cli.commands.inspect", "tell what a recording holds and what is wrong with it"),
        "estimate": Subcommand("dronevio.cli.commands.estimate", "estimate the trajectory of a recording"),
        "evaluate": Subcommand(
            "dronevio.cli.commands.evaluate", "compute the errors of an estimate against the ground truth"
        ),
        "benchmark": Subcommand(
            "dronevio.cli.commands.benchmark", "run estimators on many flights and tabulate their errors"
        ),
        "compare": Subcommand("dronevio.cli.commands.compare", "compare two benchmarks or two runs statistically"),
        "gate": Subcommand("dronevio.cli.commands.gate", "fail if a benchmark is worse than an earlier one"),
        "sfm": Subcommand("dronevio.cli.commands.sfm", "reconstruct cameras and points from images alone"),
        "dense": Subcommand("dronevio.cli.commands.dense", "compute the surfaces of a scene from the result of sfm"),
        "map": Subcommand(
            "dronevio.cli.commands.map", "map what is free and occupied along a recording, and its surfaces"
        ),
        "explore": Subcommand(
            "dronevio.cli.commands.explore", "fly to a goal through an unknown world on the drone's own estimate"
        ),
        "settings": Subcommand("dronevio.cli.commands.settings", "list all settings of a command with their ranges"),
        "policy": Subcommand("dronevio.cli.commands.policy", "evaluate, describe and export trained policies"),
        "refly": Subcommand(
            "dronevio.cli.commands.refly", "render images along the recorded trajectory of a real drone"
        ),
        "convert": Subcommand("dronevio.cli.commands.convert", "convert a recording, or export its calibration"),
        "scenarios": Subcommand("dronevio.cli.commands.scenarios", "list the scenarios and the suites"),
        "worlds": Subcommand("dronevio.cli.commands.worlds", "list the worlds, or draw a contact sheet of them"),
        "vehicles": Subcommand("dronevio.cli.commands.vehicles", "describe the vehicles, or check one of your own"),
        "log": Subcommand(
            "dronevio.cli.commands.log", "write estimates of any program and a recording to a rerun file"
        ),
        "report": Subcommand("dronevio.cli.commands.report", "write a benchmark as HTML, Markdown, LaTeX or CSV"),
        "view": Subcommand("dronevio.cli.commands.view", "open the rerun file of a run"),
        "book": Subcommand("dronevio.book", "run the experiments of a robotics book's section on visual SLAM"),
        "speed": Subcommand("dronevio.cli.commands.speed", "measure the speed of the simulator and of the evaluation"),
        "completion": Subcommand(
            "dronevio.cli.commands.completion", "print a script that lets a shell complete commands and options"
        ),
        "doctor": Subcommand(
            "dronevio.cli.commands.doctor", "check this machine for the software and drivers that are needed"
        ),
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
    debug = DEBUG in args
    args = [word for word in args if word != DEBUG]
    try:
        status = _version() if args and args[0] in ("-V", "--version") else COMMANDS.run(args)
        sys.stdout.flush()
        return status
    except DronevioError as error:
        if isinstance(error.__cause__, DefectError):  # an incomplete result whose reason is a dead worker
            return report_defect(str(error), args, debug)
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
    except MemoryError as error:
        print(f"dronevio: not enough memory{f': {error}' if str(error) else ''}", file=sys.stderr)
        return 2
    except Exception as error:
        if _follows_interrupt(error):
            print("dronevio: interrupted", file=sys.stderr)
            return 130
        if debug:
            traceback.print_exc()
        what = f"{error}" if isinstance(error, DefectError) else f"{type(error).__name__}: {error}"
        return report_defect(what, args, debug)


def _follows_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is one of ending after Ctrl-C, which a viewer has received, too."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def report_defect(what: str, arguments: Sequence[str], debug: bool = False) -> int:
    """Print on one line that dronevio has a defect, and what to report; return the exit code for defects.

    Args:
        what: What happened.
        arguments: The words after ``dronevio``.
        debug: Whether the traceback has been printed.
    """
    from dronevio import __version__

    hint = "the traceback above" if debug else f"the traceback, which {DEBUG} shows"
    command = shlex.join(["dronevio", *arguments])
    print(
        f"dronevio: {DEFECT}: {' '.join(what.split())}; please report this line, {hint}, and the input of"
        f" `{command}` (version {__version__})",
        file=sys.stderr,
    )
    return DEFECT_EXIT_CODE


def _version() -> int:
    """Print the version of the package."""
    from dronevio import __version__

    print(__version__)
    return 0
