"""Measure the errors of the front end's tracks and stereo matches with respect to the simulator's ground truth.

The front end tracks features in the images of recordings that ``dronevio fly`` wrote. The depth of each new feature is
rendered from the simulated world, so that its true image coordinates in later frames are known to a hundredth of a
pixel. The script prints the distance of the tracks from them by age in frames::

    dronevio fly --scenario hall-medium-v0 --rig euroc-stereo --out flights/hall
    python benchmarks/track_accuracy.py flights/hall
    python benchmarks/track_accuracy.py flights/* --frames 400 --json tracks.json

The world must be static: the motion of objects is not taken into account.
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
from measuring import print_as_made

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.types import Observations
from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.recordings.euroc import EurocRecording
from dronevio.models.recordings.scenario_file import SCENARIO_FILE
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import Trajectory

Depth = npt.NDArray[np.float32]
DepthAt = Callable[[Array], Depth]
"""Maps the pose (4, 4) of the first camera to its depth image (H, W) [m]."""

AGES = (1, 5, 10, 20, 40)
"""Ages of tracks for which errors are printed [frames]."""
MAX_DEPTH_RANGE = 0.02
"""Largest relative range of depth in the neighbourhood of a feature. A feature with a larger range is at an edge, where
its depth is ambiguous."""
OUTLIER_PX = 1.0
"""Error from which a track or match is an outlier [px]."""


@dataclass(frozen=True)
class TrackAccuracyCommand:
    """Measure the errors of tracks and stereo matches on simulated recordings."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `dronevio fly` wrote."""
    frames: int = 400
    """Largest number of frames of each recording."""
    first: int = 60
    """Index of the first frame; drones are stationary before it."""
    every: int = 4
    """Interval at which new features are detected, as on keyframes [frames]."""
    cameras: int = 2
    """Largest number of cameras."""
    json: Path | None = None
    """JSON file for all figures."""


@dataclass(frozen=True)
class AgeErrors:
    """Errors of tracks of one age."""

    age: int
    """Number of frames since the feature was detected."""
    tracks: int
    """Number of tracks that reach this age."""
    median_px: float
    """Median distance from the true image coordinates [px]."""
    p90_px: float
    """90th percentile of this distance [px]."""
    outlier_percent: float
    """Share of the tracks with an error above 1 px [%]."""


@dataclass(frozen=True)
class TrackErrors:
    """Errors of tracks and stereo matches, and processor time, on one recording."""

    name: str
    """Name of the recording."""
    ages: tuple[AgeErrors, ...]
    """Errors of tracks by age."""
    features: float
    """Mean number of features per frame."""
    half_life_frames: float
    """Median age of tracks at their end, without tracks that reach the last frame [frames]."""
    stereo_median_px: float | None
    """Median distance of stereo matches from the true image coordinates; None without matches [px]."""
    stereo_outlier_percent: float | None
    """Share of the matches with an error above 1 px; None without matches [%]."""
    stereo_matched_percent: float | None
    """Share of the features with a match; None for a single camera [%]."""
    track_ms: float
    """Mean processor time of tracking per frame [ms]."""
    replenish_ms: float
    """Mean processor time of detection and stereo matching per frame with new features [ms]."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """True positions of features, indexed by their identity."""

    points: Array
    """(N, 3) Positions in the world frame; NaN for features at edges [m]."""
    first_frame: npt.NDArray[np.int64]
    """(N,) Index of the frame in which each feature was detected; −1 for unused identities."""

    @classmethod
    def none(cls, n: int = 1 << 17) -> "Landmarks":
        """Return arrays for n identities without any feature."""
        return cls(np.full((n, 3), np.nan), np.full(n, -1))


@contextmanager
def depth_of(recording: EurocRecording) -> Iterator[DepthAt]:
    """Yield a function that renders depth images in the world of a recording."""
    os.environ.setdefault("LP_NUM_THREADS", "1")
    from dronevio.sim.cameras.camera import OffscreenCamera
    from dronevio.sim.world import build_world

    scenario = json.loads((recording.mav0.parent / SCENARIO_FILE).read_text(encoding="utf-8"))["scenario"]
    model = build_world(scenario["world"], scenario["world_seed"]).spec.compile()
    with OffscreenCamera(model, recording.rig.cameras[0].model) as camera:
        yield lambda T_world_cam: camera.render_surfaces(T_world_cam).depth_m


def observed_points(camera: CameraModel, depth_m: Depth, pixels: Array) -> Array:
    """Return the points (N, 3) in the camera frame at pixels (N, 2); NaN at edges [m].

    On a plane, the inverse depth is linear in the image coordinates. It is therefore interpolated.

    Args:
        camera: Model of the camera.
        depth_m: (H, W) Depth image [m].
        pixels: (N, 2) Image coordinates [px].
    """
    corner = np.floor(pixels).astype(int)
    dx, dy = np.meshgrid(np.arange(-1, 3), np.arange(-1, 3))
    columns = np.clip(corner[:, 0, None] + dx.ravel(), 0, camera.width - 1)
    rows = np.clip(corner[:, 1, None] + dy.ravel(), 0, camera.height - 1)
    inverse = 1.0 / depth_m[rows, columns].astype(np.float64).reshape(-1, 4, 4)
    flat = np.ptp(inverse, axis=(1, 2)) < MAX_DEPTH_RANGE * inverse.mean(axis=(1, 2))
    fx, fy = (pixels - corner).T
    upper = inverse[:, 1, 1] * (1.0 - fx) + inverse[:, 1, 2] * fx
    lower = inverse[:, 2, 1] * (1.0 - fx) + inverse[:, 2, 2] * fx
    depth = 1.0 / np.where(flat, upper * (1.0 - fy) + lower * fy, np.nan)
    rays = camera.unproject(pixels)
    return np.asarray(rays * (depth / (rays[:, 2] if camera.lens == "radtan" else 1.0))[:, None])


def true_poses(recording: EurocRecording, t_ns: npt.NDArray[np.int64]) -> Trajectory:
    """Return the true poses of the IMU at the exposure of frames with time stamps (N,) [ns]."""
    assert recording.ground_truth is not None
    truth = recording.frame_truth
    exposed = t_ns if truth is None else truth.exposed_ns[np.searchsorted(truth.t_ns, t_ns)]
    poses, rows = interpolate(recording.ground_truth, exposed)
    assert len(rows) == len(t_ns)
    return poses


def measure(
    recording: EurocRecording, front_end: FrontEnd, depth_at: DepthAt, frames: Sequence[int], every: int
) -> TrackErrors:
    """Run a front end over frames of a recording and compare its tracks with the ground truth.

    Args:
        recording: The recording.
        front_end: The front end before its first frame.
        depth_at: Renders depth images of the world.
        frames: Indices of consecutive frames.
        every: Interval at which new features are detected [frames].
    """
    times = recording.frame_times_ns[list(frames)]
    poses = true_poses(recording, times)
    bias = np.zeros((len(times), 3)) if poses.gyro_bias_rad_s is None else poses.gyro_bias_rad_s
    main, R_imu_cam = recording.rig.cameras[0], recording.rig.cameras[0].T_imu_cam[:3, :3]
    buffer, landmarks = ImuBuffer(), Landmarks.none()
    buffer.add(recording.imu)
    buffer.take_until(int(times[0]))
    ages, errors, counts, stereo, matched, last_age = [], [], [], [], [], np.zeros(len(landmarks.first_frame), np.int64)
    track_s, replenish_s = [], []
    for row, k in enumerate(frames):
        frame = recording.frame(k)
        R_cur_prev = R_imu_cam.T @ buffer.take_until(frame.t_ns).rotation(bias[row]).T @ R_imu_cam
        T_world_imu = poses.Ts_world_imu[row]
        T_world_cam = T_world_imu @ main.T_imu_cam
        start = time.process_time()
        observed = front_end.track(frame, R_cur_prev)
        track_s.append(time.process_time() - start)
        counts.append(len(observed))
        if row % every == 0:
            start = time.process_time()
            observed = front_end.replenish()
            replenish_s.append(time.process_time() - start)
        in_main = observed.camera == 0
        known = in_main & (landmarks.first_frame[observed.ids] >= 0)
        ids = observed.ids[known]
        last_age[ids] = row - landmarks.first_frame[ids]
        T_cam_world = inverse_pose(T_world_cam)
        expected = main.model.project(landmarks.points[ids] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        ages.append(last_age[ids])
        errors.append(np.linalg.norm(observed.pixels[known] - expected, axis=1))
        if row % every:
            continue
        points = observed_points(main.model, depth_at(T_world_cam), observed.pixels[in_main])
        points = points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
        ids = observed.ids[in_main]
        new = landmarks.first_frame[ids] < 0
        landmarks.points[ids[new]], landmarks.first_frame[ids[new]] = points[new], row
        if len(recording.rig.cameras) > 1:
            stereo.append(_match_errors(recording, observed, points, T_world_imu))
            matched.append(len(observed.matches) / max(len(observed), 1))
    age, error = np.concatenate(ages), np.concatenate(errors)
    finite = np.isfinite(error)
    ended = (last_age > 0) & (landmarks.first_frame + last_age < len(frames) - 1)
    match_px = np.concatenate(stereo) if stereo else np.zeros(0)
    match_px = match_px[np.isfinite(match_px)]
    return TrackErrors(
        recording.name,
        tuple(_at_age(a, error[finite & (age == a)]) for a in AGES),
        float(np.mean(counts)),
        float(np.median(last_age[ended])) if ended.any() else float("nan"),
        float(np.median(match_px)) if len(match_px) else None,
        float(100.0 * np.mean(match_px > OUTLIER_PX)) if len(match_px) else None,
        float(100.0 * np.mean(matched)) if matched else None,
        1e3 * float(np.mean(track_s)),
        1e3 * float(np.mean(replenish_s)),
    )


def _match_errors(recording: EurocRecording, observed: Observations, points: Array, T_world_imu: Array) -> Array:
    """Return the distances (M,) of matches of features of the first camera from their true image coordinates [px]."""
    of_main = observed.ids[observed.camera == 0]
    errors = []
    for j in np.unique(observed.matches.camera):
        chosen = (observed.matches.camera == j) & np.isin(observed.matches.ids, of_main)
        camera = recording.rig.cameras[j]
        T_cam_world = inverse_pose(T_world_imu @ camera.T_imu_cam)
        matched = points[np.searchsorted(of_main, observed.matches.ids[chosen])]
        expected = camera.model.project(matched @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        xy = observed.matches.xy[chosen]
        errors.append(np.linalg.norm(camera.model.project(np.column_stack([xy, np.ones(len(xy))])) - expected, axis=1))
    return np.concatenate(errors) if errors else np.zeros(0)


def _at_age(age: int, error_px: Array) -> AgeErrors:
    if not len(error_px):
        return AgeErrors(age, 0, float("nan"), float("nan"), float("nan"))
    outliers = 100.0 * float(np.mean(error_px > OUTLIER_PX))
    return AgeErrors(age, len(error_px), float(np.median(error_px)), float(np.quantile(error_px, 0.9)), outliers)


def row_of(errors: TrackErrors) -> dict[str, str]:
    """Return the row of a recording."""
    e, stereo = errors, "–"
    if e.stereo_median_px is not None:
        stereo = f"{e.stereo_median_px:.3f} / {e.stereo_outlier_percent:.1f} % / {e.stereo_matched_percent:.0f} %"
    return {
        "recording": e.name,
        **{f"{a.age} frames": f"{a.median_px:.3f} / {a.p90_px:.2f} / {a.outlier_percent:.1f} %" for a in e.ages},
        "features": f"{e.features:.0f}",
        "half-life": f"{e.half_life_frames:.0f}",
        "stereo": stereo,
        "ms": f"{e.track_ms:.1f} + {e.replenish_ms:.1f}",
    }


def main(command: TrackAccuracyCommand) -> int:
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
        "Errors of tracks by age: median / 90th percentile [px] / share above 1 px. Errors of stereo matches: median\n"
        "[px] / share above 1 px / share of the features with a match. Processor time: tracking + detection and\n"
        "stereo matching.\n"
    )
    print_as_made(map(row_of, rows))
    if command.json is not None:
        command.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(TrackAccuracyCommand, description=__doc__)))
