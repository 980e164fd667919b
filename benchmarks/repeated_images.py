"""Estimate a recording whose images repeat, and compare it with the one from which the copies were removed.

Repetitions: each image twice, each three times, and a camera that stops for a time; with pauses, the copies are removed
from the recording. Frames are counted by their health from the first pose on::

    python benchmarks/repeated_images.py MH_01_easy --cameras 1
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from measuring import NO_POSE, ate_m, frames_of, odometry, opened, print_rows, section_of

from dronevio.models.state import Health

Indices = npt.NDArray[np.int64]

PAUSE_S = 2.0


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


def main(command: RepeatedImagesCommand) -> int:
    """Print the table."""
    recording, truth = opened(command.recording, command.cameras)
    section = section_of(recording, command.frames)
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

        new = np.flatnonzero(shown == index)
        for kind, changed in {"repeated": section.shown(shown), "removed": section.chosen(new)}.items():
            run = odometry(changed)
            bad_ns = [e.t_ns for e in run.estimates if e.health is not Health.TRACKING]
            rows.append(
                {
                    "images": name,
                    "copies": kind,
                    "tracking": str(frames_of(run, Health.TRACKING)),
                    "inertial-only": str(frames_of(run, Health.INERTIAL_ONLY)),
                    "no pose": str(frames_of(run, *NO_POSE)),
                    "tracking again s": f"{(bad_ns[-1] - run.t_ns[0]) * 1e-9 if bad_ns else 0.0:.2f}",
                    "ATE mm": f"{1e3 * ate_m(run, truth):.1f}",
                    "events": "; ".join(text[:40] for _, text in run.warnings[:3]),
                }
            )
    print_rows(f"{recording.name}, {command.cameras} cameras", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(RepeatedImagesCommand, description=__doc__)))
