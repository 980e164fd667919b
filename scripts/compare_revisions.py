"""Whether two revisions compute the same: estimates on four recordings, and one simulated flight, to the bit.

Both revisions run on this machine with this environment's packages, on one thread. The base revision flies three
recordings once (one camera, two cameras, a rolling shutter); the fourth is the real flight whose features come with
the gtsam package. The flight of the comparison is flown by each revision itself. What the base computes is kept in the
work folder and computed again only when the recordings, the probe or the packages change::

    python scripts/compare_revisions.py BASE --work FOLDER                       # BASE against HEAD
    python scripts/compare_revisions.py BASE . --work FOLDER --only mono eqvio   # the working tree as it stands
    python scripts/compare_revisions.py BASE BASE --work FOLDER                  # whether results are reproducible

The exit code is 1 where a quantity differs by more than the tolerance. `revision_probe.py` lists the names that it
imports, and `OPTIONS` the options of the command line that are used here, with all of their spellings.
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
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from markdown_tables import table
from revision_differences import ABSENT, Arrays, Difference, differences
from revision_probe import VERSION
from rich.console import Console
from rich.markup import escape
from rich.table import Table

Subject = Literal["mono", "stereo", "rolling", "eqvio", "flight"]

REPOSITORY = Path(__file__).resolve().parents[1]
PROBE = Path(__file__).with_name("revision_probe.py")
WORKING_TREE = "."
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS"), "1")
_ISOLATED = {"PYTHONSAFEPATH": "1", "COLUMNS": "200"}  # no current folder among the imports; options are not wrapped
PACKAGES = ("numpy", "scipy", "gtsam", "opencv-python-headless", "mujoco")

OPTIONS: dict[str, tuple[str, ...]] = {
    "--plan.rest-s": ("--plan.initial-rest-s", "--plan.rest-s"),
    "--plan.stand-s": ("--plan.final-rest-s", "--plan.stand-s"),
}
"""Spellings that an option of ``dronevio fly`` or ``estimate`` has in some revision, where there are several."""

RIGS: dict[Subject, str] = {
    "rolling": """\
cam0:
  camera_model: pinhole
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  distortion_model: radtan
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  resolution: [752, 480]
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.0]
  - [0.0, 0.0, -1.0, 0.0]
  - [1.0, 0.0, 0.0, -0.05]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: 0.012
  rate_hz: 20.0
  readout_s: 0.03
imu0:
  update_rate: 200.0
  gyroscope_noise_density: 0.00016968
  gyroscope_random_walk: 1.9393e-05
  accelerometer_noise_density: 0.002
  accelerometer_random_walk: 0.003
""",
    "flight": """\
cam0:
  camera_model: pinhole
  intrinsics: [229.327, 228.648, 183.61, 124.19]
  distortion_model: radtan
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  resolution: [376, 240]
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.055]
  - [0.0, 0.0, -1.0, 0.0]
  - [1.0, 0.0, 0.0, -0.05]
  - [0.0, 0.0, 0.0, 1.0]
  rate_hz: 20.0
cam1:
  camera_model: pinhole
  intrinsics: [190.0, 190.0, 187.5, 119.5]
  distortion_model: equidistant
  distortion_coeffs: [0.0035, 0.0007, -0.0020, 0.0002]
  resolution: [376, 240]
  T_cam_imu:
  - [0.0, -1.0, 0.0, -0.055]
  - [0.0, 0.0, -1.0, 0.0]
  - [1.0, 0.0, 0.0, -0.05]
  - [0.0, 0.0, 0.0, 1.0]
  rate_hz: 20.0
  readout_s: 0.015
imu0:
  update_rate: 200.0
  gyroscope_noise_density: 0.00016968
  gyroscope_random_walk: 1.9393e-05
  gyro_bias_instability_rad_s: 7.0e-05
  gyro_scale_error: 0.005
  gyro_misalignment_rad: 0.0009
  gyro_g_sensitivity_rad_s_per_m_s2: 2.0e-05
  gyro_range_rad_s: 17.0
  gyro_bandwidth_hz: 330.0
  accelerometer_noise_density: 0.002
  accelerometer_random_walk: 0.003
  accel_bias_instability_m_s2: 0.002
  accel_scale_error: 0.005
  accel_misalignment_rad: 0.0009
  accel_range_m_s2: 170.0
  accel_bandwidth_hz: 330.0
""",
}
"""Rigs as Kalibr writes them. The rolling shutter has a readout of 30 ms and a time offset of 12 ms. The IMU of the
flight has every error of the model except the resolution, whose rounding would hide small changes of the others."""

FLIGHTS: dict[Subject, str] = {
    "mono": "--scenario room-medium --seed 3 --plan.skip-s 3 --plan.tour-s 17"
    " --faults.dark-from-s 4 --faults.dark-for-s 10.5",
    "stereo": "--scenario hall-medium --seed 2 --rig euroc-stereo --plan.shape figure-8 --plan.laps 1"
    " --plan.rest-s 1 --plan.tour-s 6 --plan.landing-s 1.5 --plan.stand-s 0.5"
    " --faults.dropped-frames 0.1 --faults.stamp-jitter-s 0.0005",
    "rolling": "--scenario room-figure-8 --seed 5 --rig {rig} --plan.laps 1"
    " --plan.rest-s 1 --plan.tour-s 6 --plan.landing-s 1.5 --plan.stand-s 0.5"
    " --faults.hidden-time-offset-s 0.006 --faults.hidden-tilt-rad 0.015",
    "flight": "--scenario short --seed 1 --rig {rig} --wind.mean-m-s 2 0 0 --wind.gusts 1"
    " --faults.dropped-frames 0.3 --truth-images depth",
}
"""What is flown. Mono starts in motion and flies in the dark until the odometry is lost; stereo loses frames, and its
stamps jitter; the rolling shutter's clock and mounting differ from its calibration; the flight has wind and depth."""


@dataclass(frozen=True)
class CompareRevisions:
    """Compare what two revisions of this repository compute, and print hashes and largest differences."""

    base: Annotated[str, tyro.conf.Positional]
    """The revision that flies the recordings and whose results are kept."""
    head: Annotated[str, tyro.conf.Positional] = "HEAD"
    """The revision to compare with it; a dot is the working tree with all of its uncommitted changes."""
    work: Path = tyro.MISSING
    """Folder outside the repository for exported code, recordings and results."""
    only: tuple[Subject, ...] = ("mono", "stereo", "rolling", "eqvio", "flight")
    """What to compare: some of the recordings, or the flight."""
    tolerance: float = 0.0
    """Largest difference that passes, in the unit of each quantity; 0 requires equal numbers."""
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
        environment = {
            **os.environ,
            **ONE_THREAD,
            "PYTHONPATH": str(self.code),
            "PYTHONSAFEPATH": "1",
            "COLUMNS": "200",
        }
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, env=environment, cwd=self.code, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{self.name}: {' '.join(command)} failed\n{done.stdout[-2000:]}{done.stderr[-4000:]}")
        return done.stdout

    def dronevio(self, command: str, *arguments: str | Path) -> str:
        """Run a ``dronevio`` command of the revision, its options spelled as this revision spells them."""
        known = self.run("-m", "dronevio.cli", command, "--help")
        if "--help-all" in known:  # earlier revisions print all options with --help
            known = self.run("-m", "dronevio.cli", command, "--help-all")
        return self.run("-m", "dronevio.cli", command, *(spelled(str(word), known) for word in arguments))


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


def fly(revision: Revision, subject: Subject, out: Path) -> None:
    """Fly a recording with a revision."""
    with tempfile.TemporaryDirectory() as scratch:
        rig = Path(scratch) / "camchain.yaml"
        rig.write_text(RIGS.get(subject, ""), encoding="utf-8")
        words = [word.format(rig=rig) for word in FLIGHTS[subject].split()]
        revision.dronevio("fly", *words, "--out", out, "--overwrite", "--json")


def recording_of(base: Revision, subject: Subject, work: Path) -> Path:
    """Return a recording, which the base revision flies where it is missing."""
    key = short_hash(FLIGHTS[subject], RIGS.get(subject, ""))
    folder = made(work / "recordings") / f"{base.name}-{subject}-{key}"
    if not folder.exists():
        fly(base, subject, folder)
    return folder


def compute(revision: Revision, base: Revision, subject: Subject, work: Path, out: Path) -> None:
    """Compute the quantities of a subject with a revision, and write them into a file."""
    with tempfile.TemporaryDirectory(dir=made(work / "scratch")) as name:
        scratch = Path(name)
        probe = ("--code", revision.code, "--out", scratch / "result.npz")
        if subject == "flight":
            fly(revision, subject, scratch / "flight")
            revision.run(PROBE, "flight", scratch / "flight", *probe)
        elif subject == "eqvio":
            revision.run(PROBE, "eqvio", *probe)
        else:
            recording = recording_of(base, subject, work)
            revision.run(PROBE, "estimate", recording, *probe)
            if subject == "stereo":
                add_imu_rate(revision, recording, scratch)
        made(out.parent)
        (scratch / "result.npz").replace(out)


def add_imu_rate(revision: Revision, recording: Path, scratch: Path) -> None:
    """Add what ``dronevio estimate --imu-rate`` writes to the results of a recording."""
    tum = scratch / "imu-rate.tum"
    revision.dronevio("estimate", recording, "--out", scratch / "estimate.tum", "--imu-rate", tum, "--json")
    revision.run(PROBE, "trajectory", tum, "--code", revision.code, "--out", scratch / "imu-rate.npz")
    arrays = {**loaded(scratch / "imu-rate.npz"), **loaded(scratch / "result.npz")}
    np.savez_compressed(scratch / "result.npz", **arrays)  # type: ignore[arg-type]


def kept_result(base: Revision, subject: Subject, work: Path) -> Path:
    """Return the file of the base's results, which are computed where they are missing."""
    versions = " ".join(f"{package} {importlib.metadata.version(package)}" for package in PACKAGES)
    key = short_hash(str(VERSION), FLIGHTS.get(subject, ""), RIGS.get(subject, ""), versions)
    file = work / "results" / base.name / f"{subject}-{key}.npz"
    if not file.exists():
        compute(base, base, subject, work, file)
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


def counted(base: Arrays, head: Arrays) -> str:
    """Return in how many frames either revision has a state; nothing of a flight."""
    if "has state" not in base or "has state" not in head:
        return ""
    counts = [f"{int(arrays['has state'].sum())} of {len(arrays['has state'])}" for arrays in (base, head)]
    return f"frames with a state {counts[0]} and {counts[1]}; "


def main(command: CompareRevisions) -> int:
    """Compare, print and write the table; 1 if a quantity differs by more than the tolerance."""
    work = command.work.resolve()
    if work.is_relative_to(REPOSITORY):
        raise SystemExit(f"--work {command.work}; expected a folder outside {REPOSITORY}")
    base, head = revision_of(command.base, work), revision_of(command.head, work)
    found: list[Difference] = []
    lines: list[str] = []
    for subject in command.only:
        print(f"{subject}: running", file=sys.stderr)
        kept = kept_result(base, subject, work)
        fresh = work / "heads" / f"{head.name}-{short_hash(str(REPOSITORY))}" / f"{subject}.npz"
        started = time.perf_counter()
        compute(head, base, subject, work, fresh)
        arrays = loaded(kept), loaded(fresh)
        found += differences(subject, *arrays)
        lines.append(f"{subject}: {counted(*arrays)}{head.name} took {time.perf_counter() - started:.0f} s")
    failed = [difference for difference in found if not difference.within(command.tolerance)]
    lines.append(f"{len(found) - len(failed)} of {len(found)} quantities agree within {command.tolerance:g}")
    report(command, base, head, [cells(difference, command.tolerance) for difference in found], lines)
    return int(bool(failed))


def report(
    command: CompareRevisions, base: Revision, head: Revision, rows: Sequence[Sequence[str]], lines: Sequence[str]
) -> None:
    """Print the table, and write it as Markdown where that is asked for."""
    headings = ("recording", "quantity", base.name, head.name, "largest difference")
    shown = Table(*headings)
    for row in rows:
        shown.add_row(*map(escape, row), style="red" if row[-1].startswith("DIFFERS") else None)
    console = Console() if sys.stdout.isatty() else Console(width=110)
    console.print(shown)
    console.print("\n".join(lines), markup=False, highlight=False)
    if command.markdown is not None:
        text = "\n".join([table(headings, rows, left=4), "", *(f"- {line}" for line in lines), ""])
        command.markdown.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(CompareRevisions, description=__doc__)))
