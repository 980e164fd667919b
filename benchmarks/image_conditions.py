"""Measure tracks and odometry on recordings under the conditions of real cameras: light, lens, sensor and compression.

Conditions of the sensor and of files are applied to the images of one recording while they are read: steps of the
exposure, flicker, vignetting, noise of a high gain, JPEG compression, dead pixels and a smudge on the lens. Exposure
times, a rolling shutter and people need renderings of their own, which are compared as recordings::

    dronevio fly --scenario room-medium --seed 131 --rig euroc-stereo --out flights/room-1ms
    python benchmarks/image_conditions.py flights/room-1ms
    python benchmarks/image_conditions.py flights/room-1ms flights/room-15ms --conditions none

The tracks are those of the front end with new features every fourth frame; their residuals are distances from the
epipolar lines of the true poses (``benchmarks/epipolar_tracks.py``). The true poses should be those that the IMU
measured: on the path of a real flight that is re-flown with its recorded IMU, the errors of path and IMU are 2 mm
whatever the images show.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tyro
from epipolar_tracks import REFINEMENT_AGES, refined_poses, view_pairs
from image_realism import Section, Tracked, by_age, front_end_tracks, reference_tracks, rotations, section_of
from measuring import ChangedRecording, odometry, print_as_made, text

from dronevio.eval.metrics.scores import score
from dronevio.models.arrays import Array, Image
from dronevio.models.errors import EvaluationError

Condition = Callable[[Image, int, int], Image]
"""Maps an image (H, W), the index of its frame and the index of its camera to the changed image."""

AGES = (1, 10, 40)
"""Ages of tracks for which the survival is printed [frames]. Residuals are printed for the second of them."""
STEP_FRAMES, STEP_GAINS = 15, (1.0, 1.6, 0.8, 1.3)
"""Number of frames between steps of the exposure, and the factors of the light."""


def scaled(image: Image, factor: float | npt.NDArray[np.float32]) -> Image:
    """Return an image with its light multiplied by a factor, saturated."""
    return np.asarray(np.clip(np.rint(image * np.float32(1.0) * factor), 0, 255), np.uint8)


def exposure_steps(image: Image, index: int, camera: int) -> Image:
    """Return the image of an exposure that changes in steps."""
    return scaled(image, STEP_GAINS[index // STEP_FRAMES % len(STEP_GAINS)])


def flicker(image: Image, index: int, camera: int) -> Image:
    """Return the image under a lamp whose light changes by up to 20 % from frame to frame, as 100 Hz do at 20 Hz."""
    return scaled(image, 1.0 + 0.2 * np.sin(2.0 * np.pi * 0.37 * index))


def vignetted(image: Image, index: int, camera: int) -> Image:
    """Return the image of a lens that loses 70 % of the light in the corners."""
    y, x = np.ogrid[-1.0 : 1.0 : image.shape[0] * 1j, -1.0 : 1.0 : image.shape[1] * 1j]
    return scaled(image, (1.0 - 0.35 * (x**2 + y**2)).astype(np.float32))


def noisy(image: Image, index: int, camera: int) -> Image:
    """Return the image with noise of a standard deviation of 8 grey levels, as at a gain of 16."""
    noise = np.random.default_rng([index, camera]).standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + 8.0 * noise), 0, 255).astype(np.uint8)


def compressed(image: Image, index: int, camera: int) -> Image:
    """Return the image after JPEG compression at quality 70."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


def with_dead_pixels(share: float) -> Condition:
    """Return the condition that a share of the pixels is black or white, the same ones in all frames of a camera."""

    def condition(image: Image, index: int, camera: int) -> Image:
        rng = np.random.default_rng([camera, 1000])
        dead, value = rng.random(image.shape) < share, 255 * rng.integers(0, 2, image.shape, dtype=np.uint8)
        return np.where(dead, value, image)

    return condition


def smudged(image: Image, index: int, camera: int) -> Image:
    """Return the first camera's image with a smudge of a fifth of its width on the lens, which blurs and brightens."""
    height, width = image.shape
    y, x = np.ogrid[:height, :width]
    distance = np.hypot(x - 0.35 * width, y - 0.55 * height) / (0.1 * width)
    weight = np.clip(1.5 - distance, 0.0, 1.0).astype(np.float32) * (camera == 0)
    veil = 0.7 * cv2.GaussianBlur(image.astype(np.float32), (0, 0), 10.0) + 0.3 * 160.0
    return np.asarray(np.clip(np.rint((1.0 - weight) * image + weight * veil), 0, 255), np.uint8)


CONDITIONS: Mapping[str, Condition] = {
    "none": lambda image, index, camera: image,
    "exposure-steps": exposure_steps,
    "flicker": flicker,
    "vignetting": vignetted,
    "noise": noisy,
    "jpeg-70": compressed,
    "dead-pixels-0.01%": with_dead_pixels(1e-4),
    "dead-pixels-0.1%": with_dead_pixels(1e-3),
    "smudge": smudged,
}
"""Changes of images by name."""


@dataclass(frozen=True)
class ConditionsCommand:
    """Measure tracks and odometry on recordings under each condition, and print a table for each."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings with ground truth."""
    frames: int = 600
    """Largest number of frames of each recording."""
    every: int = 4
    """Interval at which new features are detected for the residuals of tracks [frames]."""
    refine_poses: bool = False
    """Whether the true poses are measured ones, for which corrections are estimated from tracks of the unchanged
    images."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Names of the conditions."""


def changed(section: Section, condition: Condition) -> Section:
    """Return a section whose images are changed."""
    frames = tuple(
        replace(frame, images=tuple(condition(image, index, camera) for camera, image in enumerate(frame.images)))
        for index, frame in enumerate(section.frames)
    )
    return replace(section, frames=frames)


def ate_mm(section: Section, cameras: int) -> float:
    """Return the absolute trajectory error of the odometry [mm], with yaw and position aligned; infinite if it fails.

    Args:
        section: The frames, of which only those of the first cameras are used.
        cameras: Number of cameras.
    """
    recording, t_ns = section.recording, section.truth.t_ns
    first, last = np.searchsorted(recording.imu.t_ns, [t_ns[0] - 20_000_000, t_ns[-1] + 50_000_000]).tolist()
    rig = replace(recording.rig, cameras=recording.rig.cameras[:cameras])
    frames = [replace(frame, images=frame.images[:cameras]) for frame in section.frames]
    images = ChangedRecording(recording.name, rig, recording.imu[first:last], t_ns, frames.__getitem__)
    run = odometry(images)
    assert recording.ground_truth is not None
    try:
        return 1e3 * float(score(recording.ground_truth, run.trajectory, t_ns).ate_m.rmse)
    except EvaluationError:
        return float("inf")


def true_poses(section: Section, tracked: Tracked, every: int, refine: bool) -> Array:
    """Return the true poses of the first camera (F, 4, 4), corrected if they are measured ones.

    Args:
        section: Unchanged frames.
        tracked: Tracks of the front end in them.
        every: Interval at which new features of the reference are detected [frames].
        refine: Whether the poses are corrected.
    """
    poses, focal_px = section.Ts_world_cam, section.recording.rig.cameras[0].model.fx
    if not refine:
        return poses
    pairs = [view_pairs(found.table, REFINEMENT_AGES) for found in (tracked, reference_tracks(section, every))]
    return refined_poses(poses, pairs[0].joined(pairs[1]), focal_px)[0]


def row_of(name: str, section: Section, tracked: Tracked, poses: Array) -> dict[str, str]:
    """Return the row of a condition."""
    ages = by_age(tracked.table, poses, poses, section.recording.rig.cameras[0].model.fx, AGES)
    at, cameras = ages[1], len(section.recording.rig.cameras)
    matched = 100.0 * len(tracked.stereo_first) / tracked.detected if tracked.detected else None
    return {
        "condition": name,
        "features": f"{tracked.table.features_per_frame:.0f}",
        "survival of 1, 10, 40 frames [%]": ", ".join(f"{age.survival_percent:.0f}" for age in ages),
        "median / 95 % [px]": f"{text(at.median_px)} / {text(at.p95_px, '.2f')}",
        "> 1 px [%]": text(at.over_1_percent, ".1f"),
        "stereo matches [%]": text(matched, ".0f"),
        "ATE, one camera [mm]": text(ate_mm(section, 1), ".1f"),
        "ATE, two cameras [mm]": text(ate_mm(section, 2), ".1f") if cameras > 1 else "–",
    }


def rows_of(section: Section, command: ConditionsCommand) -> Iterator[dict[str, str]]:
    """Yield the rows of all conditions."""
    Rs_cur_prev, _ = rotations(section)
    tracked = front_end_tracks(section, Rs_cur_prev, command.every)
    poses = true_poses(section, tracked, command.every, command.refine_poses)
    for name in command.conditions:
        images = changed(section, CONDITIONS[name])
        yield row_of(name, images, front_end_tracks(images, Rs_cur_prev, command.every), poses)


def main(command: ConditionsCommand) -> int:
    """Measure all conditions and print the tables."""
    cv2.setNumThreads(1)
    for folder in command.recordings:
        section = section_of(folder, 0, command.frames)
        print(f"{section.recording.name}, {len(section.frames)} frames; residuals at an age of {AGES[1]} frames.\n")
        print_as_made(rows_of(section, command))
        print()
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(ConditionsCommand, description=__doc__)))
