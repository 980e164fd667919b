"""Whether two revisions compute the same, to the bit; or, where arithmetic changes, whether accuracy stays the same.

Both revisions run on this machine with this environment's packages, on one thread. Each case of `CASES` compares what
the revisions compute: estimates on recordings that the base flies once, or flights, environments and policies that each
revision simulates itself. What the base computes is kept in the work folder and computed again only when the recording,
the probe or the packages change::

    python tools/compare_revisions.py BASE --work FOLDER                       # BASE against HEAD
    python tools/compare_revisions.py BASE . --work FOLDER --only mono eqvio   # the working tree as it stands
    python tools/compare_revisions.py BASE BASE --work FOLDER                  # whether results are reproducible
    python tools/compare_revisions.py BASE . --work FOLDER --paired            # the accuracy of the odometry

The exit code is 1 where a quantity differs: in any bit, or by more than the tolerance if one is given. With
``--paired``, both revisions estimate 32 short flights of the base, with one camera and with two. The exit code is 1
where the upper 95 % bound (one-sided, Student's t on the logarithms) of the geometric mean of the ratios of their
absolute trajectory errors, new to base, exceeds 1.02. A flight that only the new revision loses counts as infinitely
bad; one that the base loses has a ratio of 1. `revision_probe.py` lists the names that it imports, and
`OPTIONS` the options of the command line that are used here, with all of their spellings.
"""

import hashlib
import importlib.metadata
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from revision_cases import CASES, RIGS, Case, Flight, paired_flights
from revision_differences import ABSENT, Arrays, Difference, differences, mean_ratio, paired_ratios
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

REPOSITORY = Path(__file__).resolve().parents[1]
PROBE = Path(__file__).with_name("revision_probe.py")
WORKING_TREE = "."
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS"), "1")
_ISOLATED = {"PYTHONSAFEPATH": "1", "COLUMNS": "200"}  # no current folder among the imports; options are not wrapped
MAX_RATIO = 1.02
"""Largest upper bound of the mean ratio of errors that passes."""
PACKAGES = ("numpy", "scipy", "gtsam", "opencv-python-headless", "mujoco")

OPTIONS: dict[str, tuple[str, ...]] = {
    "--plan.rest-s": ("--plan.initial-rest-s", "--plan.rest-s"),
    "--plan.stand-s": ("--plan.final-rest-s", "--plan.stand-s"),
}
"""Spellings that an option of ``dronevio fly`` or ``estimate`` has in some revision, where there are several."""


@dataclass(frozen=True)
class CompareRevisions:
    """Compare what two revisions of this repository compute, and print hashes and largest differences."""

    base: Annotated[str, tyro.conf.Positional]
    """The revision that flies the recordings and whose results are kept."""
    head: Annotated[str, tyro.conf.Positional] = "HEAD"
    """The revision to compare with it; a dot is the working tree with all of its uncommitted changes."""
    work: Path = tyro.MISSING
    """Folder outside the repository for exported code, recordings and results."""
    only: tuple[str, ...] = tuple(CASES)
    """Cases to compare; all by default."""
    paired: bool = False
    """Compare the accuracy of the odometry on many flights instead of the cases."""
    tolerance: float = 0.0
    """Largest difference that passes, in the unit of each quantity; 0 requires the same bits."""
    markdown: Path | None = None
    """File for the table in Markdown."""


@dataclass(frozen=True)
class Revision:
    """The code of a revision."""

    name: str
    """First twelve digits of the commit, or ``worktree``."""
    code: Path
    """Folder that holds the package."""

    def run(self, *arguments: str | Path) -> str:
        """Run Python with the revision's package, on one thread, and return what it prints.

        Raises:
            SystemExit: The process failed.
        """
        environment = {**os.environ, **ONE_THREAD, **_ISOLATED, "PYTHONPATH": str(self.code)}
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, env=environment, cwd=self.code, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{self.name}: {' '.join(command)} failed\n{done.stdout[-2000:]}{done.stderr[-4000:]}")
        return done.stdout

    def dronevio(self, command: str, *arguments: str | Path) -> None:
        """Run a ``dronevio`` command of the revision, its options spelled as this revision spells them."""
        known = self.options(command)
        self.run("-m", "dronevio.cli", command, *(spelled(str(word), known) for word in arguments))

    @cache  # noqa: B019 there are two revisions
    def options(self, command: str) -> str:
        """Return the help text with all options of a command."""
        known = self.run("-m", "dronevio.cli", command, "--help")
        if "--help-all" not in known:  # earlier revisions print all options with --help
            return known
        return self.run("-m", "dronevio.cli", command, "--help-all")


def spelled(word: str, known: str) -> str:
    """Return an option as a revision spells it; other words as they are.

    Args:
        word: An option or a value.
        known: The help text of the revision's command.

    Raises:
        SystemExit: The command has no such option under any of its known names.
    """
    if not word.startswith("--"):
        return word
    names = OPTIONS.get(word, (word,))
    for name in names:
        if re.search(rf"(?<![\w-]){re.escape(name)}(?![\w.-])", known):
            return name
    raise SystemExit(f"no option {' or '.join(names)}; add its new name to OPTIONS in {__file__}")


def revision_of(text: str, work: Path) -> Revision:
    """Return a revision, with its code exported into the work folder.

    Raises:
        SystemExit: There is no such revision, or its code is not what Python imports.
    """
    if text == WORKING_TREE:
        revision = Revision("worktree", REPOSITORY)
    else:
        commit = git("rev-parse", "--verify", f"{text}^{{commit}}").decode().strip()
        revision = Revision(commit[:12], work / "exports" / commit[:12])
        if not revision.code.exists():
            export(commit, revision.code)
    revision.run(PROBE, "check", "--code", revision.code)
    return revision


def export(commit: str, folder: Path) -> None:
    """Write the files of a commit into a folder, which appears when it is complete."""
    with tempfile.TemporaryDirectory(dir=made(folder.parent)) as scratch:
        with tarfile.open(fileobj=io.BytesIO(git("archive", "--format=tar", commit))) as archive:
            archive.extractall(Path(scratch) / "code", filter="data")
        with suppress(OSError):  # another process has made the folder meanwhile
            (Path(scratch) / "code").rename(folder)


def git(*arguments: str) -> bytes:
    """Return what a git command prints.

    Raises:
        SystemExit: The command failed, such as for a revision that does not exist.
    """
    done = subprocess.run(["git", *arguments], cwd=REPOSITORY, capture_output=True, check=False)
    if done.returncode:
        raise SystemExit(f"git {' '.join(arguments)}: {done.stderr.decode().strip()}")
    return done.stdout


def made(folder: Path) -> Path:
    """Return a folder, which is made where it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def fly(revision: Revision, flight: Flight, out: Path) -> None:
    """Fly a recording with a revision."""
    with tempfile.TemporaryDirectory() as scratch:
        words = flight.options.split()
        if flight.rig:
            rig = Path(scratch) / "camchain.yaml"
            rig.write_text(RIGS[flight.rig], encoding="utf-8")
            words += ["--rig", str(rig)]
        revision.dronevio("fly", *words, "--out", out, "--overwrite", "--json")


def recording_of(base: Revision, flight: Flight, work: Path) -> Path:
    """Return a recording, which the base revision flies where it is missing."""
    folder = made(work / "recordings") / f"{base.name}-{short_hash(flight.options, RIGS.get(flight.rig, ''))}"
    if not folder.exists():
        with tempfile.TemporaryDirectory(dir=made(work / "scratch")) as scratch:  # it appears when it is complete
            fly(base, flight, Path(scratch) / folder.name)
            (Path(scratch) / folder.name).rename(folder)
    return folder


def compute(revision: Revision, base: Revision, case: Case, work: Path, out: Path) -> None:
    """Compute the quantities of a case with a revision, and write them into a file."""
    with tempfile.TemporaryDirectory(dir=made(work / "scratch")) as scratch:
        paths: list[Path] = []
        if case.flight is not None and case.by_each:
            paths = [Path(scratch) / "flight"]
            fly(revision, case.flight, paths[0])
        elif case.flight is not None:
            paths = [recording_of(base, case.flight, work)]
        probe(revision, case.probe, paths, out)


def probe(revision: Revision, what: str, paths: Sequence[Path], out: Path) -> None:
    """Run the probe inside a revision; its file appears when it is complete."""
    part = made(out.parent) / f"part-{os.getpid()}-{out.name}"
    print(revision.run(PROBE, what, *paths, "--code", revision.code, "--out", part), end="", file=sys.stderr)
    part.replace(out)


def file_of(base: Revision, name: str, work: Path, *contents: str) -> Path:
    """Return the file for results of the base, which depend on the probe, the packages and some more contents."""
    versions = " ".join(f"{package} {importlib.metadata.version(package)}" for package in PACKAGES)
    return work / "results" / base.name / f"{name}-{short_hash(PROBE.read_text(), *contents, versions)}.npz"


def kept_result(base: Revision, name: str, work: Path) -> Path:
    """Return the file of the base's results, which are computed where they are missing."""
    case = CASES[name]
    file = file_of(base, name, work, repr(case), RIGS.get(case.flight.rig, "") if case.flight else "")
    if not file.exists():
        compute(base, base, case, work, file)
    return file


def loaded(file: Path) -> Arrays:
    """Return all arrays of a file."""
    with np.load(file) as arrays:
        return dict(arrays)


def short_hash(*texts: str) -> str:
    """Return eight digits of the hash of some texts."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:8]


def cells(difference: Difference, tolerance: float) -> list[str]:
    """Return a row of the table."""
    if difference.identical:
        verdict = "identical"
    elif difference.within(tolerance):
        verdict = f"{difference.largest:.2g}, within the tolerance"
    else:
        verdict = f"DIFFERS: {difference.largest:.3g}"
        verdict += f", {difference.unmatched} in one only" if difference.unmatched else ""
    hashes = [text if text == ABSENT else text[:12] for text in (difference.base_hash, difference.head_hash)]
    return [difference.recording, difference.quantity, *hashes, verdict]


def summary(name: str, found: Sequence[Difference], tolerance: float) -> list[list[str]]:
    """Return the rows of a case: one for all of its quantities that are identical, and one for each other quantity."""
    same = [d for d in found if d.identical]
    hashes = [short_hash(*(getattr(d, side) for d in same)) for side in ("base_hash", "head_hash")]
    rows = [[name, f"{len(same)} quantities", *hashes, "identical"]] if same else []
    return rows + [cells(d, tolerance) for d in found if not d.identical]


def main(command: CompareRevisions) -> int:
    """Compare, print and write the table; 1 if a quantity, or the accuracy, differs by too much."""
    if unknown := [name for name in command.only if name not in CASES]:
        raise SystemExit(f"--only {' '.join(unknown)}; expected some of {', '.join(CASES)}")
    work = command.work.resolve()
    if work.is_relative_to(REPOSITORY):
        raise SystemExit(f"--work {command.work}; expected a folder outside {REPOSITORY}")
    base, head = revision_of(command.base, work), revision_of(command.head, work)
    return compare_errors(command, base, head, work) if command.paired else compare(command, base, head, work)


def compare(command: CompareRevisions, base: Revision, head: Revision, work: Path) -> int:
    """Compare the quantities of all cases; 1 if one differs by more than the tolerance."""
    found: list[Difference] = []
    rows: list[list[str]] = []
    lines: list[str] = []
    for name in command.only:
        print(f"{name}: running", file=sys.stderr)
        kept = kept_result(base, name, work)
        fresh = head_file(head, name, work)
        started = time.perf_counter()
        compute(head, base, CASES[name], work, fresh)
        of_case = differences(name, loaded(kept), loaded(fresh))
        found += of_case
        rows += summary(name, of_case, command.tolerance)
        lines.append(f"{name}: {head.name} took {time.perf_counter() - started:.0f} s")
    failed = [difference for difference in found if not difference.within(command.tolerance)]
    lines.append(f"{len(found) - len(failed)} of {len(found)} quantities agree within {command.tolerance:g}")
    report(command, ("case", "quantity", base.name, head.name, "largest difference"), rows, lines)
    return int(bool(failed))


def compare_errors(command: CompareRevisions, base: Revision, head: Revision, work: Path) -> int:
    """Compare the errors of the odometry on many flights; 1 if the bound of their ratio exceeds `MAX_RATIO`."""
    flights = paired_flights()
    names = [name for name, _ in flights]
    recordings = [recording_of(base, flight, work) for _, flight in flights]
    kept = file_of(base, "ate", work, *(recording.name for recording in recordings))
    if not kept.exists():
        probe(base, "ate", recordings, kept)
    fresh = head_file(head, "ate", work)
    probe(head, "ate", recordings, fresh)
    a, b = loaded(kept), loaded(fresh)
    ratios = paired_ratios(a, b)
    mean, bound = mean_ratio(ratios)
    rows = [
        [name, *(f"{1e3 * arrays['ATE [m]'][i]:.3f}" for arrays in (a, b)), f"{ratios[i]:.4f}"]
        for i, name in enumerate(names)
    ]
    verdict = "passes" if bound <= MAX_RATIO else "FAILS"
    lost = int(np.isnan(a["ATE [m]"]).sum()), int(np.isinf(ratios).sum())
    lines = [
        f"{len(ratios)} flights; lost by the base {lost[0]}, by the other revision alone {lost[1]}",
        f"mean ratio {mean:.4f}, upper 95 % bound {bound:.4f}, allowed {MAX_RATIO}: {verdict}",
    ]
    report(command, ("flight", f"{base.name} ATE [mm]", f"{head.name} ATE [mm]", "ratio"), rows, lines)
    return int(not bound <= MAX_RATIO)


def head_file(head: Revision, name: str, work: Path) -> Path:
    """Return the file for results of the other revision."""
    return work / "heads" / f"{head.name}-{short_hash(str(REPOSITORY))}" / f"{name}.npz"


def report(
    command: CompareRevisions, headings: Sequence[str], rows: Sequence[Sequence[str]], lines: Sequence[str]
) -> None:
    """Print the table, and write it as Markdown where that is asked for."""
    shown = Table(*headings)
    for row in rows:
        shown.add_row(*map(escape, row), style="red" if row[-1].startswith("DIFFERS") else None)
    console = Console() if sys.stdout.isatty() else Console(width=110)
    console.print(shown)
    console.print("\n".join(lines), markup=False, highlight=False)
    if command.markdown is not None:
        shown.box = box.MARKDOWN
        with command.markdown.open("w", encoding="utf-8") as file:
            Console(file=file, width=1000).print(shown)
            file.write("\n".join(["", *(f"- {line}" for line in lines), ""]))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(CompareRevisions, description=__doc__)))
