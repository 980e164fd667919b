"""Estimators by name: ours, baselines, and any program that reads an EuRoC folder and writes a TUM file."""

import re
import resource
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.protocols import Estimator, Recording
from dronevio.models.rig import Rig
from dronevio.models.serialization import to_jsonable
from dronevio.models.state import Trajectory

EXTERNAL = "external:"
"""What a command's line begins with, in place of a name."""
_RECORDING, _OUTPUT = "{recording}", "{output}"
_SENSED = re.compile(r"cam\d+|imu\d+|body\.yaml")  # what a program may see of a recording: all but the truth


@dataclass(frozen=True)
class EstimatorKind:
    """An estimator that runs in this process."""

    description: str
    """What it is, for people."""
    settings: Callable[[], object]
    """Returns its configuration."""
    make: Callable[[Rig], Estimator]
    """Makes one for a rig."""
    cameras: int | None = 1
    """How many cameras it uses; None for all that the recording has, two at least."""


def _vio_settings() -> object:
    from dronevio.estimator.config import VioConfig

    return VioConfig()


def _vio(rig: Rig) -> Estimator:
    from dronevio.estimator.vio import VisualInertialOdometry

    return VisualInertialOdometry(rig)


def _equivariant_settings() -> object:
    from dronevio.estimator.baselines.eqvio import EquivariantConfig

    return EquivariantConfig()


def _equivariant(rig: Rig) -> Estimator:
    from dronevio.estimator.baselines.eqvio import EquivariantOdometry

    return EquivariantOdometry(rig)


def _dead_reckoning_settings() -> object:
    from dronevio.estimator.baselines.dead_reckoning import DeadReckoningConfig

    return DeadReckoningConfig()


def _dead_reckoning(rig: Rig) -> Estimator:
    from dronevio.estimator.baselines.dead_reckoning import DeadReckoning

    return DeadReckoning(rig)


ESTIMATORS: dict[str, EstimatorKind] = {
    "vio": EstimatorKind("ours: one camera and the IMU, a fixed-lag smoother", _vio_settings, _vio),
    "vio-stereo": EstimatorKind("ours: all cameras and the IMU", _vio_settings, _vio, cameras=None),
    "eqvio": EstimatorKind("GTSAM's equivariant filter behind our front end", _equivariant_settings, _equivariant),
    "dead-reckoning": EstimatorKind("the IMU alone, from a rest", _dead_reckoning_settings, _dead_reckoning),
}
"""The estimators that come with the house."""


@dataclass(frozen=True)
class Estimated:
    """What an estimator made of a recording, and what that cost."""

    trajectory: Trajectory
    """The poses that it stands by."""
    cpu_ms_mean: float
    """Processor time a frame, of all threads [ms]; of a program, with its start and its reading of frames."""
    cpu_ms_p99: float | None
    """Its 99th percentile [ms]; None for a program, of which only the whole is known."""
    real_time_factor: float
    """Seconds of flight that are estimated in one second of processor time."""


@dataclass(frozen=True)
class NamedEstimator:
    """An estimator, and what to call it in tables."""

    label: str
    """What to call it."""
    name: str
    """One of `ESTIMATORS`, or ``external:`` and a command with ``{recording}`` and ``{output}``."""

    def settings(self) -> object:
        """Return all that tells it apart from others of its kind, as plain data."""
        if self.name.startswith(EXTERNAL):
            return {"command": shlex.split(self.name.removeprefix(EXTERNAL))}
        return {"estimator": self.name, "config": to_jsonable(ESTIMATORS[self.name].settings())}

    def run(self, path: Path) -> Estimated:
        """Estimate the motion of a recording.

        Args:
            path: An EuRoC folder or a bag; for a program, the former.

        Raises:
            InputError: The recording cannot be read, or what a program wrote.
            EvaluationError: There is not one pose.
            ConfigError: It has too few cameras for the estimator.
            CrashError: A program was killed.
        """
        if self.name.startswith(EXTERNAL):
            return _run_program(shlex.split(self.name.removeprefix(EXTERNAL)), path)
        from dronevio.driver import estimate_recording, require_poses
        from dronevio.models.recordings.open import open_recording

        kind = ESTIMATORS[self.name]
        recording = open_recording(path, kind.cameras)
        if kind.cameras is None and len(recording.rig.cameras) < 2:
            raise ConfigError(f"{path}: one camera; expected two at least for {self.name}")
        run = estimate_recording(recording, kind.make(recording.rig))
        return Estimated(
            require_poses(run, recording),
            float(run.cpu_ms.mean()),
            float(np.percentile(run.cpu_ms, 99.0)),
            run.real_time_factor,
        )


def estimator_named(text: str) -> NamedEstimator:
    """Return an estimator by its name, by ``external:COMMAND``, or by ``LABEL=`` and one of these.

    Raises:
        ConfigError: There is none of that name, or the command has no place for the recording or the output.
    """
    labelled = re.fullmatch(r"([A-Za-z0-9_.+-]+)=(.*)", text, re.DOTALL)
    label, name = labelled.groups() if labelled else (text, text)
    if not name.startswith(EXTERNAL):
        if name not in ESTIMATORS:
            known = ", ".join(ESTIMATORS)
            raise ConfigError(f"unknown estimator {name!r}; expected one of {known}, or {EXTERNAL}COMMAND")
        return NamedEstimator(label, name)
    try:
        words = shlex.split(name.removeprefix(EXTERNAL))
    except ValueError as error:
        raise ConfigError(f"estimator {text!r}: {error}; expected a command line") from None
    missing = [place for place in (_RECORDING, _OUTPUT) if not any(place in word for word in words[1:])]
    if missing:
        raise ConfigError(
            f"estimator {text!r} without {' and '.join(missing)}; expected a command that reads the EuRoC folder"
            f" {_RECORDING} and writes the TUM file {_OUTPUT}"
        )
    return NamedEstimator(label, name)


def _run_program(command: list[str], path: Path) -> Estimated:
    """Run a program on a recording's sensor data, and read what it wrote. No shell takes part in it."""
    from dronevio.eval.benchmark.isolation import CrashError, death
    from dronevio.models.recordings.euroc import EurocRecording
    from dronevio.models.recordings.tum import read_tum

    recording = EurocRecording.open(path, 1)
    with tempfile.TemporaryDirectory(prefix="dronevio-") as place:
        view, output = Path(place) / path.resolve().name, Path(place) / "estimate.tum"
        _show(recording.mav0, view)
        words = [word.replace(_RECORDING, str(view)).replace(_OUTPUT, str(output)) for word in command]
        with tempfile.TemporaryFile() as complaints:
            with _cpu_of_children() as spent:
                try:
                    code = subprocess.run(words, stdout=complaints, stderr=complaints, check=False).returncode
                except OSError as error:
                    raise ConfigError(f"{words[0]}: {error.strerror}; expected a program that can be run") from None
            if code < 0:
                raise CrashError(f"{words[0]} {death(code, complaints)}")
            if code > 0:
                raise EvaluationError(f"{words[0]} {death(code, complaints)}")
        trajectory = read_tum(output)
    return _with_costs(trajectory, recording, spent[0])


def _show(mav0: Path, view: Path) -> None:
    """Make a folder in which only what was sensed of a recording can be seen."""
    (view / "mav0").mkdir(parents=True)
    for entry in mav0.resolve().iterdir():
        if _SENSED.fullmatch(entry.name):
            (view / "mav0" / entry.name).symlink_to(entry)


@contextmanager
def _cpu_of_children() -> Iterator[list[float]]:
    """Give a list that holds, in the end, the processor time of the processes that ran meanwhile [s]."""
    before, spent = resource.getrusage(resource.RUSAGE_CHILDREN), [0.0]
    yield spent
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent[0] = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _with_costs(trajectory: Trajectory, recording: Recording, cpu_s: float) -> Estimated:
    """Return what a program estimated, its processor time shared out among the frames."""
    frames = recording.frame_times_ns
    span_s = float(np.ptp(frames)) * 1e-9
    return Estimated(trajectory, 1e3 * cpu_s / len(frames), None, span_s / max(cpu_s, 1e-3))
