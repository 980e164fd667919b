"""Show whether the odometry says what its estimates deserve: covariances, and health, on real and on simulated IMUs.

Every recording is estimated with each number of cameras, under conditions that its calibration does not state
(`sensor_conditions.py`), and from several starts. A row has the mean NEES of position and velocity (3 expected), the
largest error while the health is "tracking" in standard deviations along the least certain axis, the frames beyond 5 of
these, and the share of the poses that are not "tracking" although their error is below 3, in total and by cause.
Position and yaw of each first pose are taken from the ground truth; if the flight starts in motion, their covariance is
added to that of the others.

The truth of real flights, those without a `scenario.json`, has errors of its own: one inclination, yaw rate and time
offset of the truth for a whole flight are fitted to its runs from the beginning, printed, and removed. What a truth
resolves (`RESOLVED_M`) is subtracted from the length of an error, and smaller errors do not count.

Runs are kept in a folder, and not repeated while they are there::

    python benchmarks/honesty.py V1_02 MH_04 MH_01_real --out runs/honesty
    python benchmarks/honesty.py MH_04 --every-s 2 --duration-s 10 --out runs/honesty
    python benchmarks/honesty.py --conditions as-is stated-10x stated-tenth half-size --out runs/honesty
"""

import os
import sys
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from kept_runs import KeptRun, joined
from measuring import ChangedRecording, Row, anchored, odometry, print_rows, section_of, with_truth
from sensor_conditions import CONDITIONS
from truth_errors import TruthErrors, fitted, is_exact

from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import consistency, errors_and_sigmas_m
from dronevio.eval.provenance import machine_here, versions_here
from dronevio.models.arrays import Array, Mask
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import is_recording_folder, open_recording
from dronevio.models.state import Health, Trajectory
from dronevio.recording.excerpts import excerpt_of

RESOLVED_M: Mapping[str, float] = {"MH_01_real": 0.01}
"""Errors that the ground truth of a recording does not resolve [m]."""
WRONG_SIGMAS, RIGHT_SIGMAS = 5.0, 3.0
"""Errors beyond which an estimate must not be "tracking", and below which it should be, in standard deviations."""
NEES_ALL, NEES_FLIGHT, MAX_UNTRACKED_PERCENT = (2.0, 4.0), 6.0, 2.0
"""Bounds of the mean NEES over all flights, of that of a flight, and of the right poses that are not "tracking" [%]."""


@dataclass(frozen=True)
class HonestyCommand:
    """Estimate recordings under several conditions and print a table."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Recordings with ground truth, or names of those in the folder; all of the folder by default."""
    folder: Path | None = None
    """Folder of recordings; by default the folder `euroc` of that which the variable DRONEVIO_DATA names, if it is
    set."""
    out: Path = Path("runs/honesty")
    """Folder of the kept runs."""
    cameras: tuple[int, ...] = (1, 2)
    """Numbers of cameras."""
    conditions: tuple[str, ...] = ("as-is",)
    """Names of the conditions; the first of real flights is as-is, by which the truth is corrected."""
    every_s: float | None = None
    """Interval of starts after the first frame, beside the start at the first frame [s]."""
    duration_s: float | None = None
    """Duration of the runs that start later [s]; None to the end."""
    seed: int = 0
    """Seed of the random conditions."""


@dataclass(frozen=True)
class Job:
    """A run that is wanted."""

    path: Path
    """The recording."""
    cameras: int
    """Number of cameras."""
    condition: str
    """Name of the condition."""
    start_s: float = 0.0
    """Time of the start after the first frame [s]."""
    duration_s: float | None = None
    """Duration [s]; None to the end."""

    @property
    def file_name(self) -> str:
        """Name of the file of the run."""
        length = "" if self.duration_s is None else f"-{self.duration_s:g}s"
        return f"{self.path.name}-{self.cameras}-{self.condition}-{self.start_s:g}{length}.npz"


def part_of(recording: Recording, job: Job) -> ChangedRecording:
    """Return the part of a recording that is estimated."""
    begun = excerpt_of(recording, job.start_s)
    times_ns, frames = begun.frame_times_ns, len(begun.frame_times_ns)
    if job.duration_s is not None:
        frames = int(np.searchsorted(times_ns, times_ns[0] + round(1e9 * job.duration_s), side="right"))
    return section_of(begun, frames)


def run_of(job: Job, folder: Path, seed: int) -> KeptRun:
    """Return the run of a job, from its file or by estimating."""
    file = folder / job.file_name
    if not file.exists():
        part = part_of(open_recording(job.path, job.cameras), job)
        rng = np.random.default_rng([seed, zlib.crc32(job.path.name.encode())])
        run = KeptRun.of(odometry(CONDITIONS[job.condition](part, rng)))
        run.save(file)
        print(f"{job.file_name}: {Counter(run.health.tolist())}", file=sys.stderr, flush=True)
    return KeptRun.load(file)


@dataclass(frozen=True, eq=False)
class Scores:
    """Figures of one run or of several, for all poses."""

    position_nees: Array
    """NEES of the positions whose error counts."""
    velocity_nees: Array
    """NEES of the velocities; empty where the truth has none."""
    sigmas: Array
    """Errors in standard deviations; 0 where they do not count."""
    tracking: Mask
    """Whether the health is "tracking", with the shape of `sigmas`."""
    causes: tuple[str, ...]
    """Causes of the health, as many."""
    runs: int = 1
    """Number of runs."""
    starts_s: tuple[float, ...] = ()
    """Times from the first frame to the first pose [s]."""
    lost: int = 0
    """Number of runs that are lost at a frame or have no pose."""

    @classmethod
    def of(cls, run: KeptRun, truth: Trajectory, resolved_m: float) -> "Scores":
        """Return the figures of a run."""
        true, rows = interpolate(truth, run.trajectory.t_ns)
        estimate, frames = run.trajectory[rows], run.rows()[rows]
        if len(estimate) < 2:
            empty = np.zeros(0)
            return cls(empty, empty, empty, empty.astype(bool), (), lost=1)
        estimate = anchored(true, estimate)
        found = consistency(true, estimate)
        length_m = np.linalg.norm(found.position_error_m, axis=1)
        counts = length_m >= resolved_m
        share = np.maximum(1.0 - resolved_m / np.maximum(length_m, 1e-9), 0.0)  # of an error that the truth shows
        error_m, sigma_m = errors_and_sigmas_m(true, estimate)
        return cls(
            (share**2 * found.position_nees)[counts],
            np.zeros(0) if found.velocity_nees is None else found.velocity_nees,
            np.maximum(error_m - resolved_m, 0.0) / sigma_m,
            run.health[frames] == Health.TRACKING,
            tuple(run.cause[frames].tolist()),
            1,
            (float(run.trajectory.t_ns[0] - run.t_ns[0]) * 1e-9,),
            int((run.health == Health.LOST).any()),
        )

    @classmethod
    def together(cls, parts: Sequence["Scores"]) -> "Scores":
        """Return the figures of several runs together."""
        return cls(
            joined([p.position_nees for p in parts]),
            joined([p.velocity_nees for p in parts]),
            joined([p.sigmas for p in parts]),
            np.array([each for p in parts for each in p.tracking], np.bool_),
            tuple(cause for p in parts for cause in p.causes),
            sum(p.runs for p in parts),
            tuple(s for p in parts for s in p.starts_s),
            sum(p.lost for p in parts),
        )

    @property
    def wrong(self) -> int:
        """Number of poses beyond `WRONG_SIGMAS` while tracking."""
        return int(np.sum(self.tracking & (self.sigmas > WRONG_SIGMAS)))

    @property
    def untracked_percent(self) -> float:
        """Share of the poses that are not tracking although they are right [%]."""
        return 100.0 * float(np.mean(~self.tracking & (self.sigmas < RIGHT_SIGMAS))) if len(self.sigmas) else np.nan

    @property
    def keeps_bounds(self) -> bool:
        """Whether the figures are within the bounds of a flight."""
        nees = [float(x.mean()) for x in (self.position_nees, self.velocity_nees) if len(x)]
        is_tracking_right = not self.wrong and self.untracked_percent <= MAX_UNTRACKED_PERCENT
        return is_tracking_right and max(nees, default=0.0) <= NEES_FLIGHT

    def cells(self) -> dict[str, str]:
        """Return the cells of a row."""
        untracked = np.flatnonzero(~self.tracking & (self.sigmas < RIGHT_SIGMAS))
        causes = Counter(self.causes[row].lower() for row in untracked)
        return {
            "runs": str(self.runs),
            "poses": str(len(self.sigmas)),
            "NEES p": f"{self.position_nees.mean():.1f}" if len(self.position_nees) else "–",
            "v": f"{self.velocity_nees.mean():.1f}" if len(self.velocity_nees) else "–",
            "max σ tracking": f"{self.sigmas[self.tracking].max(initial=0.0):.1f}",
            "> 5 σ": str(self.wrong),
            "max σ": f"{self.sigmas.max(initial=0.0):.1f}",
            "untracked < 3 σ": f"{self.untracked_percent:.1f} %",
            "causes": ", ".join(f"{n} {cause}" for cause, n in causes.most_common()),
            "lost": str(self.lost),
            "kept": "yes" if self.keeps_bounds else "no",
        }


def paths_of(command: HonestyCommand) -> Iterator[Path]:
    """Yield the folders of the recordings; those that are missing are named and left out."""
    data = os.environ.get("DRONEVIO_DATA")
    folder = command.folder or (Path(data) / "euroc" if data else None)
    found = sorted(path for path in folder.iterdir() if is_recording_folder(path)) if folder is not None else []
    for path in command.recordings or found:
        place = next((p for p in (path, *((folder / path,) if folder else ())) if is_recording_folder(p)), None)
        if place is None:
            print(f"{path}: no recording, left out", file=sys.stderr)
        else:
            yield place


def jobs_of(path: Path, command: HonestyCommand) -> Iterator[Job]:
    """Yield the runs of a recording, those by which its truth is corrected first."""
    times_ns = open_recording(path, 1).frame_times_ns
    span_s = float(times_ns[-1] - times_ns[0]) * 1e-9 - (command.duration_s or 0.0)
    later = np.arange(command.every_s, span_s, command.every_s).tolist() if command.every_s else []
    for condition in command.conditions:
        for cameras in command.cameras:
            yield Job(path, cameras, condition)
            yield from (Job(path, cameras, condition, start, command.duration_s) for start in later)


def truth_of(path: Path, command: HonestyCommand) -> tuple[Trajectory, TruthErrors | None]:
    """Return the ground truth of a recording, corrected if it is a measured one, and its errors."""
    _, truth = with_truth(open_recording(path, 1))
    jobs = [Job(path, cameras, "as-is") for cameras in command.cameras]
    if is_exact(path):
        return truth, None
    runs = [run_of(job, command.out, command.seed) for job in jobs]
    errors = fitted(truth, [run.trajectory for run in runs if len(run.trajectory) > 2])
    return errors.corrected(truth), errors


def rows_of(path: Path, command: HonestyCommand) -> Iterator[tuple[tuple[str, str], Scores]]:
    """Yield the figures of a recording, with condition and start, and cameras."""
    truth, errors = truth_of(path, command)
    print(f"{path.name}: {'simulated, exact truth' if errors is None else f'truth corrected by {errors}'}")
    groups: dict[tuple[str, str], list[Scores]] = {}
    for job in jobs_of(path, command):
        scores = Scores.of(run_of(job, command.out, command.seed), truth, RESOLVED_M.get(path.name, 0.0))
        begun = "" if job.start_s == 0.0 else ", in the air"
        groups.setdefault((f"{job.condition}{begun}", str(job.cameras)), []).append(scores)
    yield from ((key, Scores.together(parts)) for key, parts in groups.items())


def table_of(found: Iterable[tuple[str, tuple[str, str], Scores]]) -> tuple[list[Row], Scores]:
    """Return the rows of all recordings, and the figures of all together."""
    rows: list[Row] = []
    parts: list[Scores] = []
    for name, (condition, cameras), scores in found:
        rows.append({"flight": name, "condition": condition, "cameras": cameras, **scores.cells()})
        parts.append(scores)
    everything = Scores.together(parts)
    rows.append({"flight": "all", "condition": "", "cameras": "", **everything.cells()})
    return rows, everything


def main(command: HonestyCommand) -> int:
    """Print the tables; return 1 if a bound is not kept."""
    command.out.mkdir(parents=True, exist_ok=True)
    print(f"seed {command.seed}; {', '.join(f'{k} {v}' for k, v in (versions_here() | machine_here()).items())}")
    found = ((path.name, key, scores) for path in paths_of(command) for key, scores in rows_of(path, command))
    rows, everything = table_of(found)
    print_rows("honesty", rows, ("condition", "causes"))
    means = [float(x.mean()) for x in (everything.position_nees, everything.velocity_nees) if len(x)]
    is_kept = all(NEES_ALL[0] <= mean <= NEES_ALL[1] for mean in means)
    is_kept &= all(row["kept"] == "yes" for row in rows[:-1])
    print(f"bounds kept: {'yes' if is_kept else 'no'}")
    return int(not is_kept)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(HonestyCommand, description=__doc__)))
