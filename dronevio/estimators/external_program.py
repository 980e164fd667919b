"""Estimators that are programs: they read a copy of the sensor data of an EuRoC folder and write a TUM file.

A program receives a copy without ground truth. Links would lead to the folder with the ground truth. The copy shares
its blocks with the recording where the file system supports it (reflinks of Btrfs, XFS and others).
"""

import hashlib
import re
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from dronevio.models.defects import refuse_defects
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.imu import Times
from dronevio.models.recordings.euroc import EurocRecording
from dronevio.models.state import Trajectory

RECORDING, OUTPUT = "{recording}", "{output}"
"""Words of a command that are replaced by the folder to read and the file to write."""
STAMP_TOLERANCE_NS = 1_000_000
"""Largest difference between the time stamps of a pose and of its frame [ns]."""
MIN_STAMPED_SHARE = 0.5
"""Smallest share of poses that have the time stamp of a frame, or of frames that have a pose. Poses at arbitrary times
reach 0.04 at 20 Hz and 0.4 at 200 Hz."""

_SENSOR_DATA = re.compile(r"cam\d+|imu\d+|body\.yaml")  # entries of a recording without ground truth
_FICLONE = 0x40049409  # request of ioctl_ficlone(2)


@dataclass(frozen=True, eq=False)
class ProgramRun:
    """The result of a program."""

    trajectory: Trajectory
    """Poses that the program wrote."""
    cpu_s: float
    """Processor time of the program and its children [s]."""
    recording: EurocRecording
    """The recording that the program read."""


def run_program(command: Sequence[str], path: Path, pose_offset_s: float = 0.0, strict: bool = False) -> ProgramRun:
    """Run a program, without a shell, on a copy of the sensor data of a recording, and read what it writes.

    Args:
        command: Words of the command line with `RECORDING` and `OUTPUT`.
        path: The recording, an EuRoC folder.
        pose_offset_s: Stated difference of the time stamps of poses and frames [s].
        strict: Whether to refuse a recording with defects.

    Raises:
        InputError: The recording, or the file that the program wrote, cannot be read; or the recording has defects.
        EvaluationError: The program failed, changed the measurements, or wrote poses at other times than those of
            frames.
        ConfigError: The program cannot be started.
        CrashError: The program was killed by a signal.
    """
    from dronevio.eval.benchmark.isolation import CrashError, exit_description
    from dronevio.models.recordings.tum import read_tum

    recording = EurocRecording.open(path, repair=True)
    if strict:
        refuse_defects(path, recording.defects)
    with tempfile.TemporaryDirectory(prefix="dronevio-") as scratch:
        view, output = Path(scratch) / path.resolve().name, Path(scratch) / "estimate.tum"
        files = copy_sensor_data(recording.mav0, view / "mav0")
        words = [word.replace(RECORDING, str(view)).replace(OUTPUT, str(output)) for word in command]
        with tempfile.TemporaryFile() as errors:
            code, cpu_s = _run_timed(words, errors)
            if code < 0:
                raise CrashError(f"{words[0]} {exit_description(code, errors)}")
            if code > 0:
                raise EvaluationError(f"{words[0]} {exit_description(code, errors)}")
        _check_unchanged(files, recording.mav0, view / "mav0", words[0])
        trajectory = read_tum(output)
    offsets_s = (pose_offset_s, pose_offset_s + recording.rig.time_offset_s)  # on the clock of the cameras or the IMU
    check_pose_times(trajectory.t_ns, recording.frame_times_ns, offsets_s, words[0])
    return ProgramRun(trajectory, cpu_s, recording)


def require_program(program: str) -> None:
    """Raise ConfigError if a program, named as on a command line, does not exist or may not be executed."""
    if shutil.which(program) is None:
        if Path(program).is_file() and "/" in program:
            raise ConfigError(f"{program}: it is not executable; expected a program that can be run (chmod +x)")
        raise ConfigError(f"{program}: no such program; expected a program that can be run")


def copy_sensor_data(mav0: Path, target: Path) -> tuple[Path, ...]:
    """Copy the sensor data of a recording, without its ground truth, into a new folder.

    Returns:
        The files that were copied, relative to the folder.
    """
    target.mkdir(parents=True)
    files = tuple(_sensor_files(mav0))
    for file in files:
        (target / file.parent).mkdir(parents=True, exist_ok=True)
        _copy(mav0 / file, target / file)
    return files


def _check_unchanged(files: Sequence[Path], mav0: Path, copy: Path, program: str) -> None:
    """Check that the files of a recording and of its copy are equal and exist after a program has run.

    Raises:
        EvaluationError: The hashes of a file differ, or it is missing.
    """
    for file in files:
        hashes: list[bytes | None] = [None, None]
        for index, folder in enumerate((mav0, copy)):
            with suppress(FileNotFoundError), (folder / file).open("rb") as stream:
                hashes[index] = hashlib.file_digest(stream, "blake2b").digest()
        if hashes[0] != hashes[1] or None in hashes:
            raise EvaluationError(f"{program} changed {file} of the recording; expected that it only reads it")


def check_pose_times(poses_ns: Times, frames_ns: Times, offsets_s: Sequence[float], program: str) -> None:
    """Check that poses have the time stamps of frames, apart from a constant offset.

    Args:
        poses_ns: (N,) Time stamps of the poses, N > 0 [ns].
        frames_ns: (M,) Time stamps of the frames, M > 0 [ns].
        offsets_s: Offsets that are permitted [s].
        program: The program, for the error message.

    Raises:
        EvaluationError: Fewer than half of the poses are within 1 ms of a frame, and fewer than half of the frames
            between the first and the last pose have a pose within 1 ms.
    """
    shares = [_stamped_share(poses_ns - round(offset_s * 1e9), frames_ns) for offset_s in offsets_s]
    if max(shares) >= MIN_STAMPED_SHARE:
        return
    difference_s = float(np.median(poses_ns - frames_ns[_nearest(frames_ns, poses_ns)])) * 1e-9
    raise EvaluationError(
        f"{program} wrote {len(poses_ns)} poses, of which {max(shares):.0%} have the time stamp of a frame within 1 ms;"
        f" the median difference to the nearest frame is {difference_s:+.4f} s; expected poses at the time stamps of"
        " frames, or a constant offset that is stated as external@SECONDS:COMMAND"
    )


def _stamped_share(poses_ns: Times, frames_ns: Times) -> float:
    """Return the share of poses with a frame, or of frames with a pose, within the tolerance, whichever is larger."""
    within = frames_ns[
        (frames_ns >= poses_ns[0] - STAMP_TOLERANCE_NS) & (frames_ns <= poses_ns[-1] + STAMP_TOLERANCE_NS)
    ]
    if not len(within):
        return 0.0
    of_poses = np.abs(poses_ns - frames_ns[_nearest(frames_ns, poses_ns)]) <= STAMP_TOLERANCE_NS
    of_frames = np.abs(within - poses_ns[_nearest(poses_ns, within)]) <= STAMP_TOLERANCE_NS
    return float(max(of_poses.mean(), of_frames.mean()))


def _nearest(times_ns: Times, wanted_ns: Times) -> Times:
    """Return the indices (N,) of the times (M,), increasing, that are nearest to wanted times (N,)."""
    after = np.clip(np.searchsorted(times_ns, wanted_ns), 1, max(len(times_ns) - 1, 1))
    before, after = after - 1, np.minimum(after, len(times_ns) - 1)
    is_after = np.abs(times_ns[after] - wanted_ns) < np.abs(times_ns[before] - wanted_ns)
    return np.asarray(np.where(is_after, after, before))


def _sensor_files(mav0: Path) -> Iterator[Path]:
    """Yield the files of the sensor data of a recording, relative to its folder, in the order of their names."""
    for entry in sorted(mav0.iterdir()):
        if _SENSOR_DATA.fullmatch(entry.name):
            files = [entry] if entry.is_file() else sorted(file for file in entry.rglob("*") if file.is_file())
            yield from (file.relative_to(mav0) for file in files)


def _copy(source: Path, target: Path) -> None:
    """Copy a file; the copy shares the blocks of the source where the file system supports it."""
    with suppress(ImportError, OSError), source.open("rb") as old, target.open("wb") as new:
        import fcntl

        fcntl.ioctl(new.fileno(), _FICLONE, old.fileno())
        return
    shutil.copyfile(source, target)


def _run_timed(words: Sequence[str], output: IO[bytes]) -> tuple[int, float]:
    """Run a program and return its exit code, negative for a signal, and its processor time [s].

    Args:
        words: The command line.
        output: File for everything that the program prints.

    Raises:
        ConfigError: The program cannot be started.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        code = subprocess.run(words, stdout=output, stderr=output, check=False).returncode
    except OSError as error:
        raise ConfigError(f"{words[0]}: {error.strerror}; expected a program that can be run") from None
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return code, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
