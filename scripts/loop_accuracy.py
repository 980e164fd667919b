"""Accuracy of visual SLAM on recordings of simulated flights that revisit places, as a Markdown table.

Odometry, online path and final path are each aligned by yaw and position over the whole flight. Their RMSE is that of
the frames later than 2 s after the first revisit, by the true poses and surfaces of the world. A loop is wrong if its
relative pose is farther from the true one than 5 cm, 2 % of the median depth and 1°::

    .venv/bin/python scripts/loop_accuracy.py recordings/room-laps recordings/hall-laps --cameras 1 2
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import tyro
from markdown_tables import table, text

from dronevio.driver import estimate_recording, require_poses
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.map_results import map_results
from dronevio.eval.metrics import ScoredTrajectory, score_trajectory
from dronevio.eval.metrics.revisits import (
    Revisits,
    Views,
    find_revisits,
    revisit_recall,
    right_loops,
    true_relative_poses,
)
from dronevio.models.imu import Times
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import inverse_pose
from dronevio.models.slam_map import SlamMap
from dronevio.true_views import recording_views

Array = npt.NDArray[np.float64]

AFTER_S = 2.0
"""Time after the first revisit from which on frames count [s]."""


@dataclass(frozen=True)
class LoopAccuracyCommand:
    """Measure what the loops of visual SLAM do to the accuracy."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings of simulated flights."""
    cameras: tuple[int, ...] = (1,)
    """Numbers of cameras that the estimator uses."""


@dataclass(frozen=True)
class LoopQuality:
    """How well an estimator recognizes places in one flight."""

    loops: int
    """Number of loops that the map accepts."""
    wrong: int
    """Number of them whose relative pose is wrong."""
    recall: float
    """Share of the revisiting keyframes with a right loop within 1 s; NaN without revisits."""
    first_revisit_ns: int | None
    """Time of the first keyframe that revisits a place [ns]; None without revisits."""


def nearest_frames(t_ns: Times, frame_times_ns: Times) -> Times:
    """Return the recorded time stamps (K,) of the frames nearest to times (K,) by the clock of the IMU [ns]."""
    after = np.clip(np.searchsorted(frame_times_ns, t_ns), 1, len(frame_times_ns) - 1)
    before = frame_times_ns[after - 1]
    return np.where(t_ns - before < frame_times_ns[after] - t_ns, before, frame_times_ns[after])


def loop_quality(slam_map: SlamMap, views: Views, revisits: Revisits, camera: RigCamera) -> LoopQuality:
    """Return the quality of the accepted loops of a map.

    Args:
        slam_map: The map.
        views: The true views of its keyframes.
        revisits: The revisits among them.
        camera: The camera of the views with its mounting.
    """
    closed = ~slam_map.rejected
    then, now = slam_map.loops[closed].T
    claimed = inverse_pose(camera.T_imu_cam) @ slam_map.Ts_then_now[closed] @ camera.T_imu_cam
    right = right_loops(claimed, true_relative_poses(views, now, then), views.median_depth_m[now])
    recall = revisit_recall(views.t_ns, revisits.revisiting, views.t_ns[now[right]])
    rows = np.flatnonzero(revisits.revisiting)
    first_ns = int(slam_map.t_ns[rows[0]]) if len(rows) else None
    return LoopQuality(len(now), int(np.sum(~right)), recall, first_ns)


def rmse_after_m(scored: ScoredTrajectory, from_ns: int | None) -> float:
    """Return the RMSE of the position from a time on, or of all frames without one; NaN without such frames [m]."""
    errors_m = scored.translation_error_m
    if from_ns is not None:
        errors_m = errors_m[scored.truth.t_ns >= from_ns]
    return float(np.sqrt(np.mean(errors_m**2))) if len(errors_m) else math.nan


def measured(folder: Path, cameras: int) -> Sequence[str]:
    """Return the cells of the row of a recording with a number of cameras.

    Raises:
        InputError: The folder holds no recording of a simulated flight.
        EvaluationError: The estimator has no pose.
    """
    recording = open_recording(folder, cameras)
    slam = VisualSlam(recording.rig)
    run = estimate_recording(recording, slam)
    run = replace(run, map=slam.final_map())
    truth, results = recording.ground_truth, map_results(run, recording)
    odometry = require_poses(run, recording)
    assert truth is not None and results is not None
    assert results.scored_online is not None and results.scored_final is not None
    views = recording_views(folder, nearest_frames(results.map.t_ns, recording.frame_times_ns))
    quality = loop_quality(results.map, views, find_revisits(views), recording.rig.cameras[0])
    from_ns = None if quality.first_revisit_ns is None else quality.first_revisit_ns + round(AFTER_S * 1e9)
    scored = (
        score_trajectory(truth, odometry, recording.frame_times_ns),
        results.scored_online,
        results.scored_final,
    )
    rmse = [rmse_after_m(each, from_ns) for each in scored]
    ratios = [value / rmse[0] for value in rmse[1:]]
    return (
        f"`{folder.name}`",
        str(cameras),
        *(text(1e3 * value, ".1f") for value in rmse),
        *(text(ratio, ".2f") for ratio in ratios),
        str(quality.loops),
        str(quality.wrong),
        text(100.0 * quality.recall, ".0f"),
    )


HEADINGS = (
    "flight",
    "cameras",
    "odometry [mm]",
    "online [mm]",
    "final [mm]",
    "online ratio",
    "final ratio",
    "loops",
    "wrong loops",
    "recall [%]",
)


def main(command: LoopAccuracyCommand) -> None:
    """Print the table."""
    print(table(HEADINGS, [measured(folder, n) for folder in command.recordings for n in command.cameras]))


if __name__ == "__main__":
    main(tyro.cli(LoopAccuracyCommand, description=__doc__))
