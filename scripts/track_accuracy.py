"""How accurate the front end's tracks and stereo matches are, beside the simulator's truth.

Flies nothing and estimates nothing: follows the images of recordings that ``dronevio fly`` made, and asks the world
they were drawn from how far each feature is. Where that point of the world really goes in the images that follow is
known to a hundredth of a pixel; how far the track is from there, by its age in frames, is what is printed::

    dronevio fly --scenario hall-medium-v0 --rig euroc-stereo --out flights/hall
    python scripts/track_accuracy.py flights/hall
    python scripts/track_accuracy.py flights/* --frames 400 --json tracks.json

The world must stand still: nothing is known of what moves by itself.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tyro

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.types import Observations
from dronevio.eval.metrics.association import interpolate
from dronevio.models.camera import CameraModel
from dronevio.models.recordings.euroc import EurocRecording
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import Trajectory
from dronevio.recorder import SCENARIO_FILE

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]
DepthAt = Callable[[Array], Depth]
"""Maps the pose (4, 4) of the main camera to the depths (H, W) [m] of what its pixels see."""

AGES = (1, 5, 10, 20, 40)
"""Numbers of frames after which tracks are compared."""
FLAT = 0.02
"""Largest relative difference of depth within a feature's neighbourhood; where it is larger, an edge is near and what
moves with the feature is ambiguous."""
OUTLIER_PX = 1.0
"""A track or match that is further off is called wrong."""


@dataclass(frozen=True)
class TrackAccuracy:
    """Measure how accurate tracks and stereo matches are."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `dronevio fly` wrote."""
    frames: int = 400
    """How many frames of each to look at, at most."""
    first: int = 60
    """The first of them; drones stand still before."""
    every: int = 4
    """New features are taken every so many frames, as on keyframes."""
    cameras: int = 2
    """How many cameras to use, at most."""
    json: Path | None = None
    """File for the figures."""


@dataclass(frozen=True)
class AgeFigures:
    """How accurate tracks of one age are."""

    age: int
    """Frames since the feature was first seen."""
    tracks: int
    """How many got so old."""
    median_px: float
    """Median distance from where the landmark is [px]."""
    p90_px: float
    """Its 90th percentile [px]."""
    wrong_percent: float
    """Share of the tracks that are off by more than a pixel [%]."""


@dataclass(frozen=True)
class TrackFigures:
    """How accurate a front end is on one recording."""

    name: str
    """Of the recording."""
    ages: tuple[AgeFigures, ...]
    """Tracks by age."""
    features: float
    """Mean number of features in a frame."""
    half_life_frames: float
    """Median age at which a track ends, of those that have ended [frames]."""
    stereo_median_px: float | None
    """Median distance of stereo matches from where the landmark is [px]."""
    stereo_wrong_percent: float | None
    """Share of the matches that are off by more than a pixel [%]."""
    stereo_matched_percent: float | None
    """Share of the features that were matched [%]."""
    track_ms: float
    """Processor time of following into a frame [ms]."""
    replenish_ms: float
    """Processor time of new features and stereo matches, on a frame that takes them [ms]."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Where in the world features are, by their identity."""

    points: Array
    """(N, 3) Positions in the world [m]; NaN where an edge is near, or nothing is seen."""
    born: npt.NDArray[np.int64]
    """(N,) Frame in which each was first seen; −1 for never."""

    @classmethod
    def none(cls, n: int = 1 << 17) -> "Landmarks":
        """Return room for n identities."""
        return cls(np.full((n, 3), np.nan), np.full(n, -1))


@contextmanager
def depth_of(recording: EurocRecording) -> Iterator[DepthAt]:
    """Give what draws the depths of a recording's world."""
    os.environ.setdefault("LP_NUM_THREADS", "1")
    from dronevio.sim.cameras.camera import OffscreenCamera
    from dronevio.sim.world import build_world

    scenario = json.loads((recording.mav0.parent / SCENARIO_FILE).read_text(encoding="utf-8"))["scenario"]
    model = build_world(scenario["world"], scenario["seed"]).spec.compile()
    with OffscreenCamera(model, recording.rig.cameras[0].model) as eye:
        yield lambda T_world_cam: eye.render_surfaces(T_world_cam).depth_m


def points_seen(camera: CameraModel, depth_m: Depth, pixels: Array) -> Array:
    """Return the points (N, 3) in the camera frame that pixels (N, 2) see; NaN at edges.

    The inverse of the depth is linear in the image on a plane, so that is what is interpolated.
    """
    corner = np.floor(pixels).astype(int)
    across, down = np.meshgrid(np.arange(-1, 3), np.arange(-1, 3))
    columns = np.clip(corner[:, 0, None] + across.ravel(), 0, camera.width - 1)
    rows = np.clip(corner[:, 1, None] + down.ravel(), 0, camera.height - 1)
    around = 1.0 / depth_m[rows, columns].astype(np.float64).reshape(-1, 4, 4)
    flat = np.ptp(around, axis=(1, 2)) < FLAT * around.mean(axis=(1, 2))
    fx, fy = (pixels - corner).T
    upper = around[:, 1, 1] * (1.0 - fx) + around[:, 1, 2] * fx
    lower = around[:, 2, 1] * (1.0 - fx) + around[:, 2, 2] * fx
    depth = 1.0 / np.where(flat, upper * (1.0 - fy) + lower * fy, np.nan)
    rays = camera.unproject(pixels)
    return np.asarray(rays * (depth / (rays[:, 2] if camera.lens == "radtan" else 1.0))[:, None])


def true_poses(recording: EurocRecording, t_ns: npt.NDArray[np.int64]) -> Trajectory:
    """Return where the IMU truly was when frames were exposed."""
    assert recording.ground_truth is not None
    truth = recording.frame_truth
    exposed = t_ns if truth is None else truth.exposed_ns[np.searchsorted(truth.t_ns, t_ns)]
    poses, rows = interpolate(recording.ground_truth, exposed)
    assert len(rows) == len(t_ns)
    return poses


def measure(
    recording: EurocRecording, front_end: FrontEnd, depth_at: DepthAt, frames: Sequence[int], every: int
) -> TrackFigures:
    """Run a front end over frames of a recording and compare it with the truth."""
    times = recording.frame_times_ns[list(frames)]
    poses = true_poses(recording, times)
    bias = np.zeros((len(times), 3)) if poses.gyro_bias_rad_s is None else poses.gyro_bias_rad_s
    main, R_imu_cam = recording.rig.cameras[0], recording.rig.cameras[0].T_imu_cam[:3, :3]
    buffer, landmarks = ImuBuffer(), Landmarks.none()
    buffer.add(recording.imu)
    buffer.take_until(int(times[0]))
    ages, errors, counts, stereo, matched, sightings = [], [], [], [], [], np.zeros(len(landmarks.born), np.int64)
    track_s, replenish_s = [], []
    for row, k in enumerate(frames):
        frame = recording.frame(k)
        R_cur_prev = R_imu_cam.T @ buffer.take_until(frame.t_ns).rotation(bias[row]).T @ R_imu_cam
        T_world_imu = poses.Ts_world_imu[row]
        T_world_cam = T_world_imu @ main.T_imu_cam
        start = time.process_time()
        seen = front_end.track(frame, R_cur_prev)
        track_s.append(time.process_time() - start)
        ours = seen.camera == 0
        ids = seen.ids[ours]
        sightings[ids] = row - landmarks.born[ids]
        T_cam_world = inverse_pose(T_world_cam)
        expected = main.model.project(landmarks.points[ids] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        ages.append(sightings[ids])
        errors.append(np.linalg.norm(seen.pixels[ours] - expected, axis=1))
        counts.append(len(seen))
        if row % every:
            continue
        start = time.process_time()
        seen = front_end.replenish()
        replenish_s.append(time.process_time() - start)
        ours = seen.camera == 0
        points = points_seen(main.model, depth_at(T_world_cam), seen.pixels[ours])
        points = points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
        new = landmarks.born[seen.ids[ours]] < 0
        landmarks.points[seen.ids[ours][new]], landmarks.born[seen.ids[ours][new]] = points[new], row
        if len(recording.rig.cameras) > 1:
            stereo.append(_match_errors(recording, seen, points, T_world_imu))
            matched.append(len(seen.matches) / max(len(seen), 1))
    age, error = np.concatenate(ages), np.concatenate(errors)
    known = np.isfinite(error)
    ended = (sightings > 0) & (landmarks.born + sightings < len(frames) - 1)
    off = np.concatenate(stereo) if stereo else np.zeros(0)
    off = off[np.isfinite(off)]
    return TrackFigures(
        recording.name,
        tuple(_at_age(a, error[known & (age == a)]) for a in AGES),
        float(np.mean(counts)),
        float(np.median(sightings[ended])) if ended.any() else float("nan"),
        float(np.median(off)) if len(off) else None,
        float(100.0 * np.mean(off > OUTLIER_PX)) if len(off) else None,
        float(100.0 * np.mean(matched)) if matched else None,
        1e3 * float(np.mean(track_s)),
        1e3 * float(np.mean(replenish_s)),
    )


def _match_errors(recording: EurocRecording, seen: Observations, points: Array, T_world_imu: Array) -> Array:
    """Return how far matches (M,) of the main camera's features are from where these are now [px]."""
    of_main = seen.ids[seen.camera == 0]
    errors = []
    for j in np.unique(seen.matches.camera):
        chosen = (seen.matches.camera == j) & np.isin(seen.matches.ids, of_main)
        camera = recording.rig.cameras[j]
        T_cam_world = inverse_pose(T_world_imu @ camera.T_imu_cam)
        there = points[np.searchsorted(of_main, seen.matches.ids[chosen])]
        expected = camera.model.project(there @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        xy = seen.matches.xy[chosen]
        errors.append(np.linalg.norm(camera.model.project(np.column_stack([xy, np.ones(len(xy))])) - expected, axis=1))
    return np.concatenate(errors) if errors else np.zeros(0)


def _at_age(age: int, error_px: Array) -> AgeFigures:
    if not len(error_px):
        return AgeFigures(age, 0, float("nan"), float("nan"), float("nan"))
    wrong = 100.0 * float(np.mean(error_px > OUTLIER_PX))
    return AgeFigures(age, len(error_px), float(np.median(error_px)), float(np.quantile(error_px, 0.9)), wrong)


def report(rows: Sequence[TrackFigures]) -> str:
    """Return a Markdown table."""
    headings = ["recording", *(f"{a.age} frames" for a in rows[0].ages), "features", "half-life", "stereo", "ms"]
    lines = [" | ".join(headings), " | ".join([":---"] + ["---:"] * (len(headings) - 1))]
    for row in rows:
        cells = [row.name]
        cells += [f"{a.median_px:.3f} / {a.p90_px:.2f} / {a.wrong_percent:.1f} %" for a in row.ages]
        stereo = "–"
        if row.stereo_median_px is not None:
            stereo = (
                f"{row.stereo_median_px:.3f} / {row.stereo_wrong_percent:.1f} % / {row.stereo_matched_percent:.0f} %"
            )
        cells += [f"{row.features:.0f}", f"{row.half_life_frames:.0f}", stereo]
        cells.append(f"{row.track_ms:.1f} + {row.replenish_ms:.1f}")
        lines.append(" | ".join(cells))
    return "\n".join(f"| {line} |" for line in lines)


def main(command: TrackAccuracy) -> int:
    """Measure all recordings and print a table."""
    cv2.setNumThreads(1)
    rows = []
    for folder in command.recordings:
        recording = EurocRecording.open(folder, command.cameras)
        last = min(command.first + command.frames, len(recording.frame_times_ns))
        with depth_of(recording) as depth_at:
            front_end = RigTracker(recording.rig, TrackerConfig())
            rows.append(measure(recording, front_end, depth_at, range(command.first, last), command.every))
    print(
        "Errors of tracks by age: median / 90th percentile [px] / share beyond 1 px; of stereo matches: median [px] /"
    )
    print(
        "share beyond 1 px / share of the features matched; processor time: following + taking new ones and matching.\n"
    )
    print(report(rows))
    if command.json is not None:
        command.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(TrackAccuracy, description=__doc__)))
