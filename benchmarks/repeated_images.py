"""Estimate a recording whose images repeat, and compare it with the one from which the copies were removed.

Repetitions: each image twice, each three times, and a camera that stops for a time; with pauses, the copies are removed
from the recording. Frames are counted by their health from the first pose on::

    python benchmarks/repeated_images.py MH_01_easy --cameras 1
"""

import sys
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tyro
from time_offsets import ate_m
from wrong_inputs import ChangedRecording, section_of

from dronevio.cli.terminal import print_table
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.state import CameraFrame, Health

Indices = npt.NDArray[np.int64]

PAUSE_S = 2.0


def frame_at(section: ChangedRecording, rows: Indices, index: int) -> CameraFrame:
    """Return the frame of a recording in the row (N,) of an index."""
    return section.image_of(int(rows[index]))


@dataclass(frozen=True)
class RepeatedImagesCommand:
    """Estimate a recording with repeated images, and without them, and print a table."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder with ground truth."""
    cameras: int = 1
    """Number of cameras of the estimator."""
    frames: int = 200
    """Number of frames from the beginning of the recording."""
    frozen_s: tuple[float, ...] = (3.0, 4.0, 5.0)
    """Times at which the camera stops for two seconds [s]."""


def every(count: int) -> Callable[[Indices, float], Indices]:
    """Return the function that shows each image a number of times."""
    return lambda index, _: index - index % count


def frozen(start_s: float) -> Callable[[Indices, float], Indices]:
    """Return the function that shows one image for two seconds."""

    def shown(index: Indices, rate_hz: float) -> Indices:
        first, last = round(start_s * rate_hz), round((start_s + PAUSE_S) * rate_hz)
        return np.where((index > first) & (index < last), first, index)

    return shown


def recompressed(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return an image that was compressed once more."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


def main(command: RepeatedImagesCommand) -> int:
    """Print the table."""
    recording = open_recording(command.recording, command.cameras)
    section, truth = section_of(recording, command.frames), recording.ground_truth
    if truth is None:
        raise SystemExit(f"{command.recording}: no ground truth; expected a recording with the true motion")
    index = np.arange(len(section.frame_times_ns))
    rate_hz = section.rig.cameras[0].rate_hz
    cases: Mapping[str, Callable[[Indices, float], Indices]] = {
        "none": every(1),
        "twice": every(2),
        "three times": every(3),
        **{f"frozen at {s:g} s": frozen(s) for s in command.frozen_s},
    }
    rows = []
    for name, function in cases.items():
        shown = function(index, rate_hz)

        def encoded(i: int, shown: Indices = shown) -> CameraFrame:
            frame = section.image_of(int(shown[i]))
            return frame if shown[i] == i else replace(frame, images=tuple(map(recompressed, frame.images)))

        new = np.flatnonzero(shown == index)
        removed = replace(
            section,
            frame_times_ns=section.frame_times_ns[new],
            image_of=partial(frame_at, section, new),
        )
        variants = {"repeated": replace(section, image_of=partial(frame_at, section, shown)), "removed": removed}
        for kind, changed in variants.items():
            rows.append((name, kind, *_row(changed, truth)))
    titles = ("images", "copies", "tracking", "inertial-only", "no pose", "tracking again s", "ATE mm", "events")
    print_table(f"{recording.name}, {command.cameras} cameras", titles, rows)
    return 0


def _row(changed: ChangedRecording, truth: object) -> tuple[str, ...]:
    run = estimate_recording(changed, VisualInertialOdometry(changed.rig))
    counts = Counter(e.health for e in run.estimates)
    bad = [e.t_ns for e in run.estimates if e.health is not Health.TRACKING]
    again_s = (bad[-1] - run.t_ns[0]) * 1e-9 if bad else 0.0
    return (
        str(counts[Health.TRACKING]),
        str(counts[Health.INERTIAL_ONLY]),
        str(counts[Health.INITIALIZING] + counts[Health.LOST]),
        f"{again_s:.2f}",
        f"{1e3 * ate_m(run, truth):.1f}",  # type: ignore[arg-type]
        "; ".join(text[:40] for _, text in run.warnings[:3]),
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(RepeatedImagesCommand, description=__doc__)))
