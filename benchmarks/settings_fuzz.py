"""Try extreme settings of the estimator on two seconds of a flight, and print which of them fail.

Every number of the settings is set to -1, 0, NaN, infinity, 1e9 and to the ends of its range, one at a time. Those that
are accepted must process the frames within 60 s of processor time and 2 GB of memory, and without an exception::

    python benchmarks/settings_fuzz.py RECORDING
    python benchmarks/settings_fuzz.py RECORDING --only smoother --from-s 2
"""

import math
import os
import resource
import sys
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import tyro

from dronevio.estimator.config import VioConfig
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.ranges import RangeError, number_fields
from dronevio.models.recordings.open import open_recording
from dronevio.models.state import CameraFrame

WRONG = (-1.0, 0.0, math.nan, math.inf, 1e9)
MAX_CPU_S = 60
MAX_BYTES = 2_000_000_000
FAILED_EXIT_CODE = 3


@dataclass(frozen=True)
class FuzzCommand:
    """Try extreme settings of the estimator on two seconds of a flight."""

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """EuRoC folder or ROS 2 bag."""
    only: tuple[str, ...] = ()
    """Words; only settings are tried whose names contain one of them."""
    from_s: float = 1.0
    """Time of the first frame since the first frame of the recording [s]."""
    duration_s: float = 2.0
    """Length of the section [s]."""
    cameras: int = 1
    """Number of cameras."""


@dataclass(frozen=True)
class Trial:
    """One setting with an extreme value."""

    setting: str
    """Name of the setting."""
    name: str
    """Name of the setting and its value."""
    config: VioConfig | None
    """The settings; None if the value is refused."""


def trials(config: Any, path: tuple[str, ...] = ()) -> Iterator[Trial]:
    """Yield the extreme values of all numbers in the settings, refused ones with None in place of settings."""
    root = VioConfig()
    for number in number_fields(type(config)):
        if number.kind is bool:
            continue
        ends = (number.range.low, number.range.high, number.range.above, number.range.below)
        for value in dict.fromkeys((*WRONG, *(float(end) for end in ends if end is not None))):
            whole = int(value) if number.kind is int and math.isfinite(value) else value
            given = (whole,) * len(getattr(config, number.name)) if number.many else whole
            setting = ".".join((*path, number.name))
            name = f"{setting} = {value:g}"
            try:
                yield Trial(setting, name, changed(root, path, {number.name: given}))
            except RangeError:
                yield Trial(setting, name, None)
    for field in fields(config):
        if is_dataclass(getattr(config, field.name)):
            yield from trials(getattr(config, field.name), (*path, field.name))


def changed(config: Any, path: tuple[str, ...], values: dict[str, Any]) -> Any:
    """Return settings in which fields of the part with a path have other values."""
    if not path:
        return replace(config, **values)
    return replace(config, **{path[0]: changed(getattr(config, path[0]), path[1:], values)})


def survives(config: VioConfig, rig: Any, section: list[ImuSamples | CameraFrame]) -> str:
    """Process a section of a flight in a forked process; return what went wrong, empty if nothing did."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        code = 0
        try:
            os.close(reader)
            resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
            estimator = VisualInertialOdometry(rig, config)
            for measurement in section:
                if isinstance(measurement, ImuSamples):
                    estimator.add_imu(measurement)
                else:
                    estimator.add_frame(measurement)
        except BaseException:
            os.write(writer, traceback.format_exc()[-4000:].encode())
            code = FAILED_EXIT_CODE
        os._exit(code)
    os.close(writer)
    with os.fdopen(reader) as stream:
        text = stream.read()
    _, status, usage = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code == FAILED_EXIT_CODE:
        lines = text.strip().splitlines()
        return f"{lines[-1]} ({next((line.strip() for line in reversed(lines) if 'File ' in line), '')})"
    if code:
        return f"killed by signal {-code} after {usage.ru_utime:.0f} s"
    return f"{usage.ru_maxrss / 1e6:.1f} GB" if usage.ru_maxrss * 1024 > MAX_BYTES else ""


def main(command: FuzzCommand) -> int:
    """Print the settings that fail, and return the exit code: 1 if there are any."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # threads do not survive a fork
    recording = open_recording(command.recording, command.cameras)
    begin_ns = int(recording.frame_times_ns[0] + command.from_s * 1e9)
    end_ns = begin_ns + int(command.duration_s * 1e9)
    section: list[ImuSamples | CameraFrame] = []
    for measurement in measurements(recording):
        t_ns = int(measurement.t_ns[0]) if isinstance(measurement, ImuSamples) else measurement.t_ns
        if t_ns > end_ns:
            break
        if t_ns >= begin_ns - 50_000_000:
            section.append(measurement)
    refused = tried = failed = 0
    settings = set()
    slowest = (0.0, "")
    for trial in trials(VioConfig()):
        if command.only and not any(word in trial.name for word in command.only):
            continue
        settings.add(trial.setting)
        if trial.config is None:
            refused += 1
            continue
        start = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        problem = survives(trial.config, recording.rig, section)
        took = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start
        slowest = max(slowest, (took, trial.name))
        tried += 1
        if problem:
            failed += 1
            print(f"{trial.name}: {problem}", flush=True)
    cv2.setNumThreads(threads)
    print(f"{len(settings)} settings: {refused} values refused, {tried} accepted, of which {failed} failed")
    print(f"slowest: {slowest[1]}, {slowest[0]:.1f} s of processor time")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(FuzzCommand)))
