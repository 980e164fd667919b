"""The report of a run: one page for people, the same numbers for machines, and a picture of the path.

``report.json`` holds, all in SI units unless the name says otherwise, ``null`` where something is not known::

    format         "dronevio-report/1"
    title, command, open_command, seed          as in `RunInfo`
    flight         name, duration_s, frames, path_m, peak_speed_m_s, peak_turn_rate_deg_s
    scores         the fields of `Scores`, statistics as {rmse, mean, median, max}; null without truth
    timing         cpu_ms_mean, cpu_ms_p99, wall_ms_mean, wall_ms_p99 (a frame), real_time_factor
    estimator      poses, first_pose_s (after the first frame), mean_tracks, keyframes, health: {state: frames}
    configuration, versions, machine            as in `RunInfo`
"""

import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics import IDENTITY, ScoredTrajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.drawing import figure, save_png
from dronevio.eval.report.plots import ABOVE, FRONT, draw_path
from dronevio.eval.run import EstimatorRun
from dronevio.models.protocols import Recording
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

FORMAT = "dronevio-report/1"


@dataclass(frozen=True, eq=False)
class Subject:
    """All that a report is about."""

    info: RunInfo
    """Where the run comes from."""
    recording: Recording
    """What was measured."""
    run: EstimatorRun
    """What the estimator made of it."""
    scored: ScoredTrajectory | None
    """Its trajectory beside the truth; None where there is no truth."""
    outline: Array
    """(L, 2, 3) Line segments of the surroundings [m], in the truth's world."""

    @property
    def estimate(self) -> Trajectory:
        """The estimated path, in the truth's world where that is known."""
        return (IDENTITY if self.scored is None else self.scored.alignment).apply(self.run.trajectory)

    @property
    def origin_ns(self) -> int:
        """Time stamp of the first frame [ns]: zero on every time axis."""
        return int(self.recording.frame_times_ns[0])


def write_report(
    folder: Path,
    info: RunInfo,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    outline: Array | None = None,
) -> None:
    """Write ``report.html``, ``report.json`` and ``trajectory.png`` into a folder.

    Args:
        folder: Where to; it exists.
        info: Where the run comes from.
        recording: What was measured.
        run: What the estimator made of it.
        scored: Its trajectory beside the truth; None where there is no truth.
        outline: (L, 2, 3) Line segments of the surroundings [m], in the truth's world.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read.
    """
    from dronevio.eval.report.page import page

    run.check_belongs_to(recording)
    subject = Subject(info, recording, run, scored, np.zeros((0, 2, 3)) if outline is None else outline)
    numbers = report_numbers(subject)
    text = json.dumps(numbers, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    (folder / "report.html").write_text(page(subject, numbers), encoding="utf-8")
    with figure(10.0, 4.6, columns=2) as (fig, axes):
        for ax, side in zip(axes, (ABOVE, FRONT), strict=True):
            draw_path(ax, side, subject.estimate, recording.ground_truth, subject.outline)
    save_png(fig, folder / "trajectory.png")


def report_numbers(subject: Subject) -> dict[str, object]:
    """Return what ``report.json`` holds."""
    info = subject.info
    return {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        "seed": info.seed,
        "flight": _flight(subject),
        "scores": None if subject.scored is None else asdict(subject.scored.scores),
        "timing": _timing(subject.run),
        "estimator": _estimator(subject),
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }


def _flight(subject: Subject) -> dict[str, object]:
    recording = subject.recording
    flown = recording.ground_truth or subject.estimate
    speed = np.linalg.norm(np.zeros((0, 3)) if flown.velocity_m_s is None else flown.velocity_m_s, axis=1)
    turn_rate = np.linalg.norm(recording.imu.gyro_rad_s, axis=1)
    return {
        "name": recording.name,
        "duration_s": float(np.ptp(recording.frame_times_ns)) * 1e-9,
        "frames": len(recording.frame_times_ns),
        "path_m": flown.length_m,
        "peak_speed_m_s": float(speed.max()) if len(speed) else None,
        "peak_turn_rate_deg_s": float(np.degrees(turn_rate.max())) if len(turn_rate) else None,
    }


def _timing(run: EstimatorRun) -> dict[str, object]:
    if not len(run.estimates):
        return dict.fromkeys(("cpu_ms_mean", "cpu_ms_p99", "wall_ms_mean", "wall_ms_p99", "real_time_factor"))
    return {
        "cpu_ms_mean": float(run.cpu_ms.mean()),
        "cpu_ms_p99": float(np.percentile(run.cpu_ms, 99)),
        "wall_ms_mean": float(run.wall_ms.mean()),
        "wall_ms_p99": float(np.percentile(run.wall_ms, 99)),
        "real_time_factor": run.real_time_factor if np.isfinite(run.real_time_factor) else None,
    }


def _estimator(subject: Subject) -> dict[str, object]:
    run = subject.run
    poses = run.trajectory.t_ns
    return {
        "poses": len(poses),
        "first_pose_s": float(poses[0] - subject.origin_ns) * 1e-9 if len(poses) else None,
        "mean_tracks": float(run.n_tracks.mean()) if len(run.estimates) else None,
        "keyframes": sum("keyframe" in estimate.events for estimate in run.estimates),
        "health": dict(Counter(str(estimate.health) for estimate in run.estimates)),
    }
