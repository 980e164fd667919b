"""Mutation testing: put known faults into the code, one at a time, and check that the tests named beside them fail.

A mutant is a fault that once passed all tests, or that would matter much if it did. Each is applied to a temporary copy
of the checkout, never to the working tree. Run all mutants, or some of them by name::

    .venv/bin/python scripts/mutants.py
    .venv/bin/python scripts/mutants.py covariance-sign-accel-bias-position
    .venv/bin/python scripts/mutants.py --list

The named tests are first run without any mutant, where they must pass. The exit status is 0 if every mutant is killed,
1 if one survives, and 2 if a mutant cannot be evaluated: it does not apply, or its tests fail without it.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

from mutant import Mutant
from mutants_dense import DENSE
from mutants_estimator import ESTIMATOR
from mutants_evaluation import EVALUATION
from mutants_initialization import INITIALIZATION
from mutants_sfm import SFM
from mutants_slam import SLAM

CHECKOUT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 600.0
"""Time limit of a run of the tests [s]."""


class Verdict(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    """A test failed, as it should."""
    SURVIVED = "survived"
    """All tests passed: they do not notice the fault."""
    INVALID = "invalid"
    """The tests could not be run with it, or took too long."""


MUTANTS = (*ESTIMATOR, *INITIALIZATION, *EVALUATION, *SFM, *DENSE, *SLAM)


def copy_checkout(target: Path) -> None:
    """Copy the files of the checkout that git tracks, or would track, to a new folder. Links stay links."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        source, copy = CHECKOUT / name, target / name
        if source.is_symlink() or source.exists():  # a file may be deleted and not yet committed
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy, follow_symlinks=False)


def run_tests(checkout: Path, tests: Sequence[str]) -> Verdict:
    """Run some tests in a copy of the checkout, on one process, up to the first failure."""
    options = ["-x", "-q", "-m", "", "-p", "no:cacheprovider", "-n", "0", "--no-header", "--tb=line"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        finished = subprocess.run(
            command, cwd=checkout, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Verdict.INVALID
    # Status of pytest: 0 if all tests passed, 1 if one failed, and else if they could not be run
    if finished.returncode not in (0, 1):
        print(finished.stdout, finished.stderr, file=sys.stderr)
    return {0: Verdict.SURVIVED, 1: Verdict.KILLED}.get(finished.returncode, Verdict.INVALID)


def evaluate(mutant: Mutant) -> Verdict:
    """Apply a mutant to a copy of the checkout and run its tests there."""
    with tempfile.TemporaryDirectory(prefix="dronevio-mutant-") as folder:
        copy_checkout(Path(folder))
        try:
            mutant.apply(Path(folder))
        except (OSError, ValueError) as error:
            print(error, file=sys.stderr)
            return Verdict.INVALID
        return run_tests(Path(folder), mutant.tests)


def selected(names: Sequence[str]) -> list[Mutant]:
    """Return the mutants of some names, all of them where no name is given.

    Raises:
        SystemExit: There is none of a name.
    """
    unknown = sorted(set(names) - {mutant.name for mutant in MUTANTS})
    if unknown:
        sys.exit(f"mutants: no mutant is called {', '.join(unknown)}; see --list")
    return [mutant for mutant in MUTANTS if not names or mutant.name in names]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(description="Put known faults into a copy of the code and run the tests on it.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="Mutants to run; by default, all.")
    parser.add_argument("--list", action="store_true", help="List the mutants and run nothing.")
    options = parser.parse_args(arguments)
    mutants = selected(options.names)
    width = max(len(mutant.name) for mutant in mutants)
    if options.list:
        for mutant in mutants:
            print(f"{mutant.name:{width}}  {mutant.description}")
        return 0
    with tempfile.TemporaryDirectory(prefix="dronevio-mutant-") as folder:
        copy_checkout(Path(folder))
        tests = sorted({test for mutant in mutants for test in mutant.tests})
        if run_tests(Path(folder), tests) is not Verdict.SURVIVED:
            print("mutants: the tests do not pass without a mutant", file=sys.stderr)
            return 2
    verdicts = []
    print(f"{'mutant':{width}}  {'verdict':8}  {'time [s]':>8}")
    for mutant in mutants:
        start = time.perf_counter()
        verdicts.append(evaluate(mutant))
        print(f"{mutant.name:{width}}  {verdicts[-1]:8}  {time.perf_counter() - start:8.1f}", flush=True)
    print(f"{verdicts.count(Verdict.KILLED)} of {len(verdicts)} killed")
    if Verdict.SURVIVED in verdicts:
        return 1
    return 2 if Verdict.INVALID in verdicts else 0


if __name__ == "__main__":
    sys.exit(main())
