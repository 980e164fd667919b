"""Measure tracks on real and simulated recordings against the epipolar geometry of the true poses, and their images.

No depth is needed, only images, calibration and a true path, so that real recordings can be compared with simulated
ones. OpenCV's pyramidal Lucas-Kanade tracker with corners of Shi and Tomasi, as most programs use it, is the reference
for the front end::

    python benchmarks/image_realism.py MH_01_easy flights/refly-room
    python benchmarks/image_realism.py MH_01_easy --frames 100 --json realism.json

Residuals are distances from the epipolar line of the first view. They are printed with respect to the given true poses,
and after a correction of these poses that the tracks of both trackers agree on: the difference is the error of the true
poses. See ``benchmarks/epipolar_tracks.py``.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tyro
from epipolar_tracks import (
    AGES,
    MIN_BASELINE_M,
    REFINEMENT_AGES,
    TrackTable,
    ViewPairs,
    constant_offsets,
    refined_poses,
    residuals_px,
    survival,
    view_pairs,
)
from image_properties import LEVELS, ImageProperties, image_properties
from measuring import table, text

from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array, Image
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import log_so3
from dronevio.models.state import CameraFrame, Trajectory
from dronevio.sim.cameras.interpolation import interpolated_poses

FEATURES = 187
"""Number of features of the reference, that of the front end's grid on an image of 752 × 480."""
SPACING_PX = 22
"""Smallest distance between the corners of the reference [px], that of the front end."""
_WINDOW_PX, _LEVELS, _QUALITY = 21, 3, 0.01


@dataclass(frozen=True)
class RealismCommand:
    """Print Markdown tables of tracks and image properties of recordings."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings with ground truth, the first of two cameras being evaluated."""
    frames: int = 400
    """Largest number of frames of each recording."""
    first: int = 0
    """Index of the first frame."""
    every: int = 4
    """Interval at which new features are detected, as on keyframes [frames]."""
    json: Path | None = None
    """JSON file for all figures."""


@dataclass(frozen=True)
class AgeResiduals:
    """Residuals of tracks of one age."""

    age: int
    """Number of frames since the feature was detected."""
    pairs: int
    """Number of tracks."""
    survival_percent: float
    """Share of the features that are tracked for so long [%]."""
    true_median_px: float
    """Median residual with the given true poses [px]."""
    true_p95_px: float
    """95th percentile of the residual with the given true poses [px]."""
    median_px: float
    """Median residual with corrected poses [px]."""
    p95_px: float
    """95th percentile of the residual with corrected poses [px]."""
    over_1_percent: float
    """Share of the residuals with corrected poses above 1 px [%]."""
    over_3_percent: float
    """Share of the residuals with corrected poses above 3 px [%]."""


@dataclass(frozen=True)
class StereoResiduals:
    """Residuals of stereo matches."""

    matched_percent: float
    """Share of the features with a match [%]."""
    median_px: float
    """Median distance from the epipolar line by the calibration [px]."""
    p95_px: float
    """95th percentile of this distance [px]."""
    over_1_percent: float
    """Share of the distances above 1 px [%]."""


@dataclass(frozen=True)
class TrackerFigures:
    """Figures of one tracker on one recording."""

    tracker: str
    """Name of the tracker."""
    features: float
    """Mean number of features per frame."""
    ages: tuple[AgeResiduals, ...]
    """Residuals by age."""
    stereo: StereoResiduals | None
    """Residuals of stereo matches; None with one camera."""


@dataclass(frozen=True)
class Truth:
    """Errors of the true poses, as far as tracks and gyroscope show them."""

    time_offset_ms: float
    """Constant time offset of the true poses with respect to the images [ms]."""
    rotation_deg: float
    """Constant rotation of the camera with respect to its calibration [°]."""
    correction_deg: float
    """Root mean square of the change of the orientation's correction between frames [°]."""
    correction_mm: float
    """Root mean square of the change of the position's correction between frames [mm]."""
    gyro_deg: float
    """Root mean square of the disagreement of true rotation and gyroscope between frames [°]."""


@dataclass(frozen=True)
class Figures:
    """All figures of one recording."""

    name: str
    """Name of the recording."""
    truth: Truth
    """Errors of the true poses."""
    trackers: tuple[TrackerFigures, ...]
    """Figures of the trackers."""
    images: ImageProperties
    """Properties of the images of the first camera."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """What a tracker observed."""

    table: TrackTable
    """Observations of the first camera."""
    stereo_first: Array
    """(M, 3) Bearings of features in the first camera."""
    stereo_second: Array
    """(M, 3) Bearings of their matches in the second camera."""
    detected: int
    """Number of features for which a match was searched."""


@dataclass(frozen=True, eq=False)
class Section:
    """Frames of a recording with their true poses."""

    recording: Recording
    """The recording of the frames."""
    frames: tuple[CameraFrame, ...]
    """The frames in time order."""
    truth: Trajectory
    """True poses of the IMU at the frames."""

    @property
    def rows(self) -> int:
        """Number of poses of a frame: 1 with a global shutter, the rows of the image with a rolling shutter."""
        camera = self.recording.rig.cameras[0]
        return camera.model.height if camera.readout_s else 1

    @property
    def Ts_world_cam(self) -> Array:
        """(F, 4, 4) True poses of the first camera at the exposures of the frames, or of all of their rows."""
        camera, truth = self.recording.rig.cameras[0], self.recording.ground_truth
        if self.rows == 1:
            return np.asarray(self.truth.Ts_world_imu @ camera.T_imu_cam)
        assert truth is not None
        delay_ns = np.rint(1e9 * camera.readout_s * np.linspace(-0.5, 0.5, self.rows)).astype(np.int64)
        return np.asarray(interpolated_poses(truth, (self.truth.t_ns[:, None] + delay_ns).ravel()) @ camera.T_imu_cam)

    @property
    def interval_s(self) -> float:
        """Interval of the frames [s]."""
        return float(np.median(np.diff(self.truth.t_s)))


def section_of(folder: Path, first: int, count: int) -> Section:
    """Return frames of a recording with their true poses."""
    recording = open_recording(folder, 2)
    times_ns = recording.frame_times_ns[first : first + count]
    if recording.ground_truth is None:
        raise SystemExit(f"{folder}: no ground truth; expected a recording with the true motion")
    truth, rows = interpolate(recording.ground_truth, times_ns)
    return Section(recording, tuple(recording.frame(first + int(row)) for row in rows), truth)


def rotations(section: Section) -> tuple[list[Array], float]:
    """Return the IMU's rotations R_cur_prev (3, 3) by the gyroscope, and their disagreement with the truth [rad].

    The gyroscope's bias is the constant that agrees best with the true rotations. The disagreement is the root mean
    square over intervals between frames; that of the first frame is the identity.
    """
    buffer, t_ns, R = ImuBuffer(), section.truth.t_ns, section.truth.Ts_world_imu[:, :3, :3]
    buffer.add(section.recording.imu)
    buffer.take_until(int(t_ns[0]))
    taken = [buffer.take_until(int(t)) for t in t_ns[1:]]
    true = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    dt_s = np.diff(t_ns)[:, None] * 1e-9
    bias = np.zeros(3)
    for _ in range(2):
        measured = np.stack([increments.rotation(bias) for increments in taken])
        errors = log_so3(np.swapaxes(true, 1, 2) @ measured)
        bias = bias + np.median(errors / dt_s, axis=0)
    disagreement = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    return [np.eye(3), *(increments.rotation(bias).T for increments in taken)], disagreement


def front_end_tracks(section: Section, Rs_cur_prev: Sequence[Array], every: int) -> Tracked:
    """Return what the front end observes with the rotations of the IMU."""
    rig = section.recording.rig
    R_imu_cam = rig.cameras[0].T_imu_cam[:3, :3]
    tracker, rows, image_rows, left, right, detected = RigTracker(rig, TrackerConfig()), [], [], [], [], 0
    for k, (frame, R) in enumerate(zip(section.frames, Rs_cur_prev, strict=True)):
        observed = tracker.track(frame, R_imu_cam.T @ R @ R_imu_cam)
        if k % every == 0:
            observed = tracker.replenish()
        main = observed.camera == 0
        bearings = unit(observed.xy)
        rows.append((observed.ids[main], k, bearings[main]))
        image_rows.append(np.rint(observed.pixels[main, 1]))
        second = observed.matches.camera == 1
        if k % every == 0 and len(rig.cameras) > 1:
            matched = np.searchsorted(observed.ids, observed.matches.ids[second])
            left.append(bearings[matched])
            right.append(unit(observed.matches.xy[second]))
            detected += int(main.sum())
    table = table_of(rows) if section.rows == 1 else rolling_table_of(rows, image_rows, section.rows)
    return Tracked(table, stacked(left), stacked(right), detected)


def reference_tracks(section: Section, every: int) -> Tracked:
    """Return what OpenCV's Lucas-Kanade tracker observes without prediction, outlier rejection or templates."""
    if section.rows > 1:
        raise SystemExit(f"{section.recording.name}: a rolling shutter; expected a global shutter for the reference")
    cameras = section.recording.rig.cameras
    options = {"winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": _LEVELS}
    pixels, ids, previous, following = np.zeros((0, 2), np.float32), np.zeros(0, np.int64), None, 0
    rows, left, right, detected = [], [], [], 0
    for k, frame in enumerate(section.frames):
        image = frame.images[0]
        if previous is not None and len(pixels):
            pixels, found = lucas_kanade(previous, image, pixels, options)
            pixels, ids = pixels[found], ids[found]
        if k % every == 0:
            new = new_corners(image, pixels)
            pixels, ids = np.vstack([pixels, new]), np.append(ids, np.arange(following, following + len(new)))
            following += len(new)
            if len(cameras) > 1:
                matches, found = lucas_kanade(image, frame.images[1], pixels, options)
                left.append(cameras[0].model.unproject(pixels[found].astype(np.float64)))
                right.append(cameras[1].model.unproject(matches[found].astype(np.float64)))
                detected += len(pixels)
        rows.append((ids, k, cameras[0].model.unproject(pixels.astype(np.float64))))
        previous = image
    return Tracked(table_of(rows), stacked(left), stacked(right), detected)


def lucas_kanade(
    image: Image, following: Image, pixels: npt.NDArray[np.float32], options: dict[str, object]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the pixels (N, 2) in the following image, and which of them are found inside it."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(image, following, pixels[:, None], None, **options)  # type: ignore[call-overload]
    moved = moved[:, 0]
    inside = np.all((moved >= 0.0) & (moved <= np.array(image.shape[::-1]) - 1), axis=1)
    return moved, (found.ravel() > 0) & inside


def new_corners(image: Image, pixels: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the best corners (N, 2) of an image that are not close to given pixels."""
    mask = np.full(image.shape, 255, np.uint8)
    for x, y in np.rint(pixels).astype(int).tolist():
        cv2.circle(mask, (x, y), SPACING_PX, 0, -1)
    missing = FEATURES - len(pixels)
    found = cv2.goodFeaturesToTrack(image, missing, _QUALITY, SPACING_PX, mask=mask) if missing > 0 else None
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def unit(xy: Array) -> Array:
    """Return unit bearings (N, 3) of normalized image coordinates (N, 2)."""
    rays = np.column_stack([xy, np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def stacked(parts: Sequence[Array]) -> Array:
    """Return arrays of bearings as one."""
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def table_of(rows: Sequence[tuple[npt.NDArray[np.int64], int, Array]]) -> TrackTable:
    """Return the observations (identities, frame, bearings) of all frames as a table."""
    bearings = np.concatenate([b for _, _, b in rows])
    ids, frame = np.concatenate([i for i, _, _ in rows]), np.concatenate([np.full(len(i), k) for i, k, _ in rows])
    seen = np.isfinite(bearings).all(axis=1)
    return TrackTable(ids[seen], frame[seen], bearings[seen], len(rows))


def rolling_table_of(
    rows: Sequence[tuple[npt.NDArray[np.int64], int, Array]], image_rows: Sequence[Array], count: int
) -> TrackTable:
    """Return the observations of all frames of a rolling shutter as a table.

    Args:
        rows: Identities, frame and bearings of the observations of each frame.
        image_rows: Row of the image of each observation [px], in the same order.
        count: Number of rows of the image.
    """
    seen = np.isfinite(np.concatenate([b for _, _, b in rows])).all(axis=1)
    image_row = np.clip(np.concatenate(image_rows), 0, count - 1).astype(np.int64)
    return replace(table_of(rows), row=image_row[seen], rows=count)


def measure(section: Section, every: int) -> Figures:
    """Return all figures of a section of a recording."""
    Rs_cur_prev, gyro_rad = rotations(section)
    found = {
        "front end": front_end_tracks(section, Rs_cur_prev, every),
        "OpenCV KLT": reference_tracks(section, every),
    }
    poses, focal_px = section.Ts_world_cam, section.recording.rig.cameras[0].model.fx
    used = [view_pairs(tracked.table, REFINEMENT_AGES) for tracked in found.values()]
    both = used[0].joined(used[1])
    offset_s, rotation = constant_offsets(poses, both, focal_px, section.interval_s)
    refined, corrections = refined_poses(poses, both, focal_px)
    steps = np.diff(corrections, axis=0)
    turn_rad, shift_m = (float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in (steps[:, :3], steps[:, 3:]))
    truth = Truth(
        1e3 * offset_s,
        float(np.degrees(np.linalg.norm(rotation))),
        float(np.degrees(turn_rad)),
        1e3 * shift_m,
        float(np.degrees(gyro_rad)),
    )
    trackers = tuple(
        TrackerFigures(
            name,
            tracked.table.features_per_frame,
            by_age(tracked.table, poses, refined, focal_px),
            stereo_residuals(section, tracked),
        )
        for name, tracked in found.items()
    )
    images = [frame.images[0] for frame in section.frames]
    return Figures(section.recording.name, truth, trackers, image_properties(images, section.interval_s))


def by_age(
    tracks: TrackTable, poses: Array, refined: Array, focal_px: float, ages: tuple[int, ...] = AGES
) -> tuple[AgeResiduals, ...]:
    """Return the residuals of tracks by age, with true poses and with corrected ones."""
    pairs = view_pairs(tracks, ages)
    given, corrected = (np.abs(residuals_px(Ts, pairs, focal_px)) for Ts in (poses, refined))
    rows = []
    for age in ages:
        chosen = (pairs.ages == age) & np.isfinite(given) & np.isfinite(corrected)
        true, own = given[chosen], corrected[chosen]
        if not len(own):
            rows.append(AgeResiduals(age, 0, 100.0 * survival(tracks, age), *[float("nan")] * 6))
            continue
        rows.append(
            AgeResiduals(
                age,
                len(own),
                100.0 * survival(tracks, age),
                float(np.median(true)),
                float(np.percentile(true, 95)),
                float(np.median(own)),
                float(np.percentile(own, 95)),
                100.0 * float(np.mean(own > 1.0)),
                100.0 * float(np.mean(own > 3.0)),
            )
        )
    return tuple(rows)


def stereo_residuals(section: Section, tracked: Tracked) -> StereoResiduals | None:
    """Return the residuals of stereo matches by the calibration, or None without matches."""
    if not len(tracked.stereo_first):
        return None
    cameras = section.recording.rig.cameras
    count = len(tracked.stereo_first)
    pairs = ViewPairs(np.zeros(count, np.int64), np.ones(count, np.int64), tracked.stereo_first, tracked.stereo_second)
    residual = np.abs(residuals_px(np.stack([c.T_imu_cam for c in cameras[:2]]), pairs, cameras[1].model.fx))
    residual = residual[np.isfinite(residual)]
    return StereoResiduals(
        100.0 * count / max(tracked.detected, 1),
        float(np.median(residual)),
        float(np.percentile(residual, 95)),
        100.0 * float(np.mean(residual > 1.0)),
    )


def track_rows(every: Sequence[Figures]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of tracks."""
    for figures in every:
        for tracker in figures.trackers:
            for row in tracker.ages:
                yield (
                    figures.name,
                    tracker.tracker,
                    str(row.age),
                    str(row.pairs),
                    text(row.survival_percent, ".0f"),
                    f"{text(row.true_median_px)} / {text(row.true_p95_px, '.2f')}",
                    f"{text(row.median_px)} / {text(row.p95_px, '.2f')}",
                    text(row.over_1_percent, ".1f"),
                    text(row.over_3_percent, ".1f"),
                )


def stereo_rows(every: Sequence[Figures]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of features and stereo matches."""
    for figures in every:
        for tracker in figures.trackers:
            s = tracker.stereo
            stereo = ["–"] * 3
            if s is not None:
                stereo = [f"{s.matched_percent:.0f}", f"{s.median_px:.3f} / {s.p95_px:.2f}", f"{s.over_1_percent:.1f}"]
            yield (figures.name, tracker.tracker, f"{tracker.features:.0f}", *stereo)


def truth_rows(every: Sequence[Figures]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of errors of the true poses."""
    for figures in every:
        t = figures.truth
        yield (
            figures.name,
            text(t.time_offset_ms, ".2f"),
            text(t.rotation_deg),
            text(t.correction_deg),
            text(t.correction_mm, ".2f"),
            text(t.gyro_deg),
        )


def image_rows(every: Sequence[Figures]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of image properties, one for each property."""
    images = [figures.images for figures in every]
    yield ("grey levels, 5 / 25 / 50 / 75 / 95 %", *(" / ".join(f"{v:.0f}" for v in i.percentiles) for i in images))
    yield ("below 10 / above 250 [%]", *(f"{i.dark_percent:.1f} / {i.saturated_percent:.1f}" for i in images))
    yield ("standard deviation of grey levels", *(f"{i.contrast:.0f}" for i in images))
    levels = " / ".join(map(str, LEVELS))
    yield (f"noise at {levels}", *(" / ".join(text(v, ".1f") for v in i.noise) for i in images))
    yield ("of which fixed for each pixel, all levels", *(f"{i.fixed_pattern:.2f}" for i in images))
    yield ("gradient, 50 / 90 / 99 % [1/px]", *(" / ".join(f"{v:.1f}" for v in i.gradient) for i in images))
    yield ("exponent of the power spectrum", *(f"{i.spectral_slope:.2f}" for i in images))
    yield ("blur of edges [px]", *(text(i.edge_blur_px, ".2f") for i in images))
    yield ("exposure by motion blur [ms]", *(text(1e3 * i.exposure_s, ".1f") for i in images))
    yield ("change of brightness, frame to frame, 95 % [%]", *(text(i.gain_change_percent, ".1f") for i in images))
    yield ("change of patches in 10 frames [%]", *(text(i.patch_change_percent, ".1f") for i in images))


def report(every: Sequence[Figures]) -> str:
    """Return the Markdown tables of all recordings."""
    tracks: tuple[str, ...] = (
        "recording",
        "tracker",
        "age",
        "tracks",
        "survival [%]",
        "true poses: median / 95 % [px]",
    )
    tracks = (*tracks, "corrected poses [px]", "> 1 px [%]", "> 3 px [%]")
    stereo = ("recording", "tracker", "features", "matched [%]", "median / 95 % [px]", "> 1 px [%]")
    truth = ("recording", "time offset [ms]", "rotation [°]", "correction [°]", "correction [mm]", "gyroscope [°]")
    parts = (
        f"Epipolar residuals of tracks by age; baselines below {1e3 * MIN_BASELINE_M:.0f} mm are left out.",
        table(tracks, track_rows(every), 2),
        "Features per frame and epipolar residuals of stereo matches by the calibration.",
        table(stereo, stereo_rows(every), 2),
        "Errors of the true poses: constant offsets; change of the corrections and disagreement with the gyroscope\n"
        "between frames.",
        table(truth, truth_rows(every)),
        "Images of the first camera.",
        table(("property", *(figures.name for figures in every)), image_rows(every)),
    )
    return "\n\n".join(parts)


def main(command: RealismCommand) -> int:
    """Measure all recordings and print the tables."""
    cv2.setNumThreads(1)
    every = [measure(section_of(folder, command.first, command.frames), command.every) for folder in command.recordings]
    print(report(every))
    if command.json is not None:
        command.json.write_text(json.dumps([asdict(figures) for figures in every], indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(RealismCommand, description=__doc__)))
