"""Estimate a recording with one property altered at a time, and tabulate first pose, error, health and message.

Each alteration (`alterations.ALTERATIONS`) is written as a folder and read as a user's recording would be. Rows can be
kept, to show those of an earlier version beside later ones::

    python benchmarks/altered_recordings.py MH_01_easy --rows before.json     # with an earlier version
    python benchmarks/altered_recordings.py MH_01_easy --before before.json
    python benchmarks/altered_recordings.py MH_01_easy --only vibration "IMU at 100 Hz"
"""

import importlib
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from alterations import ALTERATIONS, Files, read_files, write_files

from dronevio.cli.terminal import print_table
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import errors_and_sigmas_m
from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import is_tracking
from dronevio.models.defects import count_defects, defects_of
from dronevio.models.errors import DronevioError
from dronevio.models.recordings.open import open_recording
from dronevio.models.state import Health


@dataclass(frozen=True)
class Row:
    """The result of one alteration; errors are those of the worst segment."""

    alteration: str
    """Name of the alteration."""
    segments: int
    """Number of segments into which the recording was split; 0 if it was refused."""
    first_pose_s: float | None
    """Time from the first frame to the first pose [s]; None without one."""
    tracking: int
    """Number of frames with the health "tracking"."""
    inertial_only: int
    """Number of frames with the health "inertial-only"."""
    without_pose: int
    """Number of frames without a pose."""
    ate_mm: float | None
    """Root mean square error after alignment of yaw and position [mm]."""
    sigmas: float | None
    """Largest error while tracking, in standard deviations, with the gauge of the first pose."""
    speed_m_s: float
    """Largest speed of a pose [m/s]."""
    message: str
    """First warning, defect or error that a user sees."""


def row_of(name: str, files: Files, folder: Path) -> Row:
    """Write an altered recording, estimate it, and return the row."""
    write_files(files, folder)
    try:
        recording = open_recording(folder, repair=True)
        runs = [estimate_recording(each, VisualInertialOdometry(each.rig)) for each in segments_of(recording)]
    except DronevioError as error:
        return Row(name, 0, None, 0, 0, 0, None, None, 0.0, f"refused: {error}".replace(str(folder), "FOLDER"))
    except Exception as error:
        return Row(name, 0, None, 0, 0, 0, None, None, 0.0, f"DEFECT: {type(error).__name__}: {error}")
    counts = Counter(estimate.health for run in runs for estimate in run.estimates)
    scores = [score_of(run, files, segment) for segment, run in enumerate(runs)]
    ates_mm = [ate for ate, _ in scores if ate is not None]
    sigmas = [sigma for _, sigma in scores if sigma is not None]
    first = next((e.t_ns for e in runs[0].estimates if e.state is not None), None)
    speeds = [float(np.linalg.norm(e.state.velocity_m_s)) for run in runs for e in run.estimates if e.state is not None]
    return Row(
        name,
        len(runs),
        None if first is None else (first - int(runs[0].t_ns[0])) * 1e-9,
        counts[Health.TRACKING],
        counts[Health.INERTIAL_ONLY],
        sum(counts[health] for health in (Health.INITIALIZING, Health.LOST)),
        max(ates_mm) if len(ates_mm) == len(runs) else None,
        max(sigmas, default=None),
        max(speeds, default=0.0),
        message_of(runs, recording).replace(str(folder), "FOLDER"),
    )


def segments_of(recording: Any) -> Sequence[Any]:
    """Return the segments of a recording; versions without them have one."""
    try:
        module = importlib.import_module("dronevio.models.recordings.segments")
    except ModuleNotFoundError:
        return (recording,)
    return list(module.segments_of(recording))


def score_of(run: EstimatorRun, files: Files, segment: int) -> tuple[float | None, float | None]:
    """Return the ATE [mm] and the largest error while tracking, in standard deviations; None without poses."""
    poses = run.trajectory
    if len(poses) < 3:
        return None, None
    at_truth = replace(poses, t_ns=files.true_t_ns(poses.t_ns, segment))
    true, rows = interpolate(files.truth, at_truth.t_ns)
    if len(rows) < 3:
        return None, None
    estimate, tracking = at_truth[rows], is_tracking(run, poses)[rows]
    aligned = align(true.p_world_imu, estimate.p_world_imu, "yaw").positions(estimate.p_world_imu)
    error_m = np.linalg.norm(aligned - true.p_world_imu, axis=1)
    sigmas = None
    if estimate.covariance is not None and tracking.any():
        of_gauge_m, sigma_m = errors_and_sigmas_m(true, estimate)
        sigmas = float(np.max(of_gauge_m[tracking] / sigma_m[tracking]))
    return float(np.sqrt(np.mean(error_m**2)) * 1e3), sigmas


def message_of(runs: Sequence[EstimatorRun], recording: Any) -> str:
    """Return the first defect of a recording or, without one, the first warning, or the reason of no pose."""
    defects = [defect for each in segments_of(recording) for defect in defects_of(each)]
    texts = [str(count) for count in count_defects(defects)]
    texts += [text for run in runs for _, text in run.warnings]
    if not texts and not any(len(run.trajectory) for run in runs):
        report = runs[0].estimates[-1].health_report
        texts = [report.reason if report is not None else ""]
    return " | ".join(texts[:2])


@dataclass(frozen=True)
class AlteredRecordingsCommand:
    """Estimate a recording with each alteration, and print a table."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder with ``groundtruth.tum``."""
    only: tuple[str, ...] = tuple(ALTERATIONS)
    """Names of the alterations."""
    rows: Path | None = None
    """JSON file to write with the rows."""
    before: Path | None = None
    """JSON file with the rows of an earlier version, which are shown beside the others."""
    markdown: bool = False
    """Print a table in Markdown."""


def cells(row: Row) -> tuple[str, ...]:
    """Return the figures of a row as text."""
    return (
        f"{row.segments}",
        "–" if row.first_pose_s is None else f"{row.first_pose_s:.2f}",
        f"{row.tracking}/{row.inertial_only}/{row.without_pose}",
        "–" if row.ate_mm is None else f"{row.ate_mm:.1f}",
        "–" if row.sigmas is None else f"{row.sigmas:.1f}",
        f"{row.speed_m_s:.1f}",
    )


TITLES = ("segments", "first pose [s]", "tracking/inertial/none", "ATE [mm]", "largest [σ]", "speed [m/s]")


def main(command: AlteredRecordingsCommand) -> int:
    """Print the table; return 1 if a speed is impossible or an input ends in a defect."""
    found = []
    for name in command.only:
        cameras, alteration = ALTERATIONS[name]
        with tempfile.TemporaryDirectory() as folder:
            start_s = time.process_time()
            found.append(row_of(name, alteration(read_files(command.recording, cameras)), Path(folder) / "altered"))
            print(f"{name}: {cells(found[-1])}, {time.process_time() - start_s:.0f} s", file=sys.stderr)
    if command.rows is not None:
        command.rows.write_text(json.dumps([asdict(row) for row in found], indent=1, ensure_ascii=False))
    before = {}
    if command.before is not None:
        before = {each["alteration"]: Row(**each) for each in json.loads(command.before.read_text())}
    nothing = ("",) * len(TITLES)
    titles = ("alteration", *(f"before: {title}" for title in TITLES if before), *TITLES, "message")
    table = [
        (row.alteration, *((cells(before[row.alteration]) if row.alteration in before else nothing) if before else ()),
         *cells(row), row.message)
        for row in found
    ]  # fmt: skip
    if command.markdown:
        print("\n".join(f"| {' | '.join(line)} |" for line in (titles, ("---",) * len(titles), *table)))
    else:
        print_table(f"{command.recording.name}, altered", titles, table)
    return int(any(row.speed_m_s > 20.0 or row.message.startswith("DEFECT") for row in found))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(AlteredRecordingsCommand, description=__doc__)))
