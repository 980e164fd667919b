"""The ``dronevio`` command: picks the subcommand, and turns errors into one line and an exit code.

Exit codes: 0 done, 1 a check failed, 2 bad input, 130 interrupted, 141 nobody reads what is printed.
"""

import importlib
import os
import signal
import sys
from collections.abc import Sequence

from dronevio.models.errors import DronevioError

COMMANDS: dict[str, str] = {
    "run": "fly, estimate, score and report: the whole mission",
    "fly": "fly a scenario and write what was sensed as an EuRoC folder",
    "estimate": "estimate the motion of a recording",
    "evaluate": "score an estimate against the truth",
    "benchmark": "run estimators on many flights, and make a table of it",
    "compare": "compare two benchmarks, or two runs",
    "gate": "fail where a benchmark is worse than an earlier one",
    "refly": "render along a path that a real drone has flown",
    "convert": "convert a recording, or write its calibration for another program",
    "scenarios": "list what can be flown",
    "worlds": "list where one can fly, or draw a contact sheet of it",
    "log": "lay estimates of any program over a recording, to look at",
    "report": "show a benchmark as a page, or as tables for a text or a paper",
    "view": "open a run's recording",
    "book": "the experiments of the robotics book's chapter on visual SLAM",
    "speed": "measure how fast this machine is",
    "doctor": "say what this machine has and lacks",
}
"""The subcommands, each a module with a ``main(arguments) -> int``, and what they do.

Modules are imported when they are called: ``dronevio --help`` must not wait for MuJoCo."""

ELSEWHERE = {"book": "dronevio.book"}
"""Modules of the subcommands that are not in this package."""


def usage() -> str:
    """Return the text of ``dronevio --help``."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items())
    return (
        "usage: dronevio COMMAND [OPTIONS]\n\n"
        "Fly a simulated quadrotor, estimate its motion from camera and IMU, score the estimate.\n\n"
        f"commands:\n{rows}\n\n"
        "examples:\n"
        "  dronevio run\n"
        "  dronevio run --seed 3 --out runs/third\n"
        "  dronevio COMMAND --help\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    args = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:  # this process is the command's own
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C: nothing half-written stays
        for library in ("OMP", "OPENBLAS"):  # read when numpy is imported; spinning threads make small systems slower
            os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    if not args or args[0] in ("-h", "--help", "help"):
        print(usage())
        return 0
    if args[0] in ("-V", "--version"):
        from dronevio import __version__

        print(__version__)
        return 0
    if args[0] not in COMMANDS:
        print(f"dronevio: unknown command {args[0]!r}; expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    try:
        command = importlib.import_module(ELSEWHERE.get(args[0], f"dronevio.cli.{args[0]}"))
        status = int(command.main(args[1:]))
        sys.stdout.flush()
        return status
    except DronevioError as error:
        print(f"dronevio: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader has gone, as in `dronevio scenarios | head -3`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains when it ends
        return 141
    except OSError as error:  # a full disk, a file in the way: nothing that a traceback would explain
        where = f"{error.filename}: " if error.filename else ""
        print(f"dronevio: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("dronevio: interrupted", file=sys.stderr)
        return 130
