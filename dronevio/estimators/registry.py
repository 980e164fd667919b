"""The registry of estimators: ours, baselines, classes of the user, and programs that read an EuRoC folder."""

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dronevio.estimators.external_program import OUTPUT, RECORDING, ProgramRun, require_program, run_program
from dronevio.estimators.python_estimator import PythonEstimator
from dronevio.eval.benchmark.cache import code_hash
from dronevio.eval.run import EstimatorRun
from dronevio.models.defects import Defect, refuse_defects
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.protocols import Estimator
from dronevio.models.python_names import PREFIX as PYTHON
from dronevio.models.rig import Rig
from dronevio.models.serialization import to_jsonable
from dronevio.models.state import Trajectory

if TYPE_CHECKING:
    from dronevio.estimator.slam.worker.map_builder import MapCost
    from dronevio.models.slam_map import SlamMap

EXTERNAL = re.compile(r"external(?:@([+-]?(?:\d+\.?\d*|\.\d+)))?:")
"""Prefix of an estimator that is the command line of a program, optionally with the offset of its time stamps [s]."""


@dataclass(frozen=True)
class EstimatorKind:
    """An estimator that runs in this process."""

    description: str
    """Description of the estimator for help texts."""
    settings: Callable[[], object]
    """Function that returns the configuration."""
    make: Callable[[Rig], Estimator]
    """Function that makes the estimator for a rig."""
    cameras: int | None = 1
    """Number of cameras that the estimator uses; None for all cameras of the recording, at least two."""
    has_map: bool = False
    """Whether the poses in the map frame are scored instead of those in the odometry frame."""


def _vio_settings() -> object:
    from dronevio.estimator.config import VioConfig

    return VioConfig()


def _vio(rig: Rig) -> Estimator:
    from dronevio.estimator.odometry import VisualInertialOdometry

    return VisualInertialOdometry(rig)


def _slam_settings() -> object:
    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.slam.config import SlamConfig

    return VioConfig(), SlamConfig()


def _slam(rig: Rig) -> Estimator:
    from dronevio.estimator.slam.visual_slam import VisualSlam

    return VisualSlam(rig)


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
    "vio": EstimatorKind("our fixed-lag smoother with one camera and the IMU", _vio_settings, _vio),
    "vio-stereo": EstimatorKind(
        "our fixed-lag smoother with all cameras and the IMU", _vio_settings, _vio, cameras=None
    ),
    "slam": EstimatorKind(
        "our visual SLAM with one camera and the IMU: the odometry, corrected causally by loops",
        _slam_settings,
        _slam,
        has_map=True,
    ),
    "slam-stereo": EstimatorKind(
        "our visual SLAM with all cameras and the IMU", _slam_settings, _slam, cameras=None, has_map=True
    ),
    "eqvio": EstimatorKind("GTSAM's equivariant filter with our front end", _equivariant_settings, _equivariant),
    "dead-reckoning": EstimatorKind(
        "integration of the IMU alone, initialized while the drone is stationary",
        _dead_reckoning_settings,
        _dead_reckoning,
    ),
}
"""The estimators of this package by name."""


@dataclass(frozen=True)
class Estimated:
    """Estimated trajectory of a recording, and its processor time."""

    trajectory: Trajectory
    """Causal poses of the estimator."""
    cpu_ms_mean: float
    """Mean processor time per frame of all threads, and of the process that builds a map; for a program, start-up and
    reading of images included [ms]."""
    cpu_ms_p99: float | None
    """99th percentile of the processor time per frame, without the process that builds a map; None for a program, whose
    frames are not timed [ms]."""
    real_time_factor: float | None
    """Duration of the flight divided by the processor time."""
    defects: tuple[Defect, ...] = ()
    """Defects of the recording."""
    run: EstimatorRun | None = None
    """The estimates of all frames, with the final map of an estimator that has one; None for a program, which reports
    nothing but poses."""
    map_cost: "MapCost | None" = None
    """Cost of the map beside the frames; None for an estimator without a map."""


@dataclass(frozen=True)
class NamedEstimator:
    """An estimator with its name in tables."""

    label: str
    """Name of the estimator in tables."""
    name: str
    """Key of `ESTIMATORS`, ``python:`` and a class, or ``external:`` and a command with ``{recording}`` and
    ``{output}``."""

    def settings(self) -> object:
        """Return the settings on which the results of the estimator depend, as plain data."""
        if external := EXTERNAL.match(self.name):
            command = {"command": shlex.split(self.name[external.end() :])}
            return {**command, "pose_offset_s": float(external[1])} if external[1] else command
        if self.name.startswith(PYTHON):
            return {"class": self.name, "code": code_hash(*PythonEstimator.parse(self.name).sources())}
        return {"estimator": self.name, "config": to_jsonable(ESTIMATORS[self.name].settings())}

    def require_program(self) -> None:
        """Raise ConfigError if the estimator is a program that cannot be started on this machine."""
        if external := EXTERNAL.match(self.name):
            require_program(shlex.split(self.name[external.end() :])[0])

    def run(self, path: Path, strict: bool = False, start_s: float = 0.0, laps: int = 1) -> Estimated:
        """Estimate the trajectory of a recording.

        Args:
            path: An EuRoC folder or a ROS 2 bag; only the former for a program.
            strict: Whether to refuse a recording with defects.
            start_s: Time after the first frame at which the estimator starts [s]; 0 for a program.
            laps: Number of times that the recording is repeated without a break; 1 for a program.

        Raises:
            InputError: The recording, or the file that a program wrote, cannot be read; or the recording has defects.
            EvaluationError: The estimate has no pose; or a program failed, changed the measurements, or wrote poses at
                other times than those of frames.
            ConfigError: The recording has too few cameras, a class cannot be imported, or a program cannot be started.
            CrashError: A program was killed by a signal.
        """
        if external := EXTERNAL.match(self.name):
            if start_s or laps > 1:
                raise ConfigError(f"{self.label}: a program reads a whole recording once; expected no starts and laps")
            return _of_program(
                run_program(shlex.split(self.name[external.end() :]), path, float(external[1] or 0.0), strict)
            )
        from dronevio.estimators.driver import estimate_recording, require_poses
        from dronevio.models.recordings.open import open_recording
        from dronevio.recording.excerpts import excerpt_of

        own = PythonEstimator.parse(self.name) if self.name.startswith(PYTHON) else None
        kind = None if own else ESTIMATORS[self.name]
        recording = open_recording(path, kind.cameras if kind else None, repair=True)
        if strict:
            refuse_defects(path, recording.defects)
            recording = replace(recording, repair=False)
        if kind and kind.cameras is None and len(recording.rig.cameras) < 2:
            raise ConfigError(f"{path}: one camera; expected two or more for {self.name}")
        make = own.make if own else ESTIMATORS[self.name].make
        excerpt = excerpt_of(recording, start_s, laps)
        estimator = make(excerpt.rig)
        run = estimate_recording(excerpt, estimator)
        trajectory = require_poses(run, excerpt)
        slam_map, cost = _map_and_cost(estimator) if kind and kind.has_map else (None, None)
        run = replace(run, map=slam_map)
        cpu_ms, worker_ms = float(run.cpu_ms.mean()), 0.0 if cost is None else cost.worker_cpu_ms_per_frame
        return Estimated(
            run.map_trajectory if kind and kind.has_map else trajectory,
            cpu_ms + worker_ms,
            float(np.percentile(run.cpu_ms, 99.0)),
            None if run.real_time_factor is None else run.real_time_factor * cpu_ms / (cpu_ms + worker_ms),
            run.defects,
            run,
            cost,
        )


def estimator_named(text: str) -> NamedEstimator:
    """Return an estimator.

    Args:
        text: A name of `ESTIMATORS`, ``python:package.module:Class``, ``external:COMMAND`` or
            ``external@SECONDS:COMMAND``, with or without ``LABEL=`` before it.

    Raises:
        ConfigError: There is no such estimator or class, or the command lacks ``{recording}`` or ``{output}``.
    """
    labelled = re.fullmatch(r"([A-Za-z0-9_.+-]+)=(.*)", text, re.DOTALL)
    label, name = labelled.groups() if labelled else (text, text)
    if name.startswith(PYTHON):
        PythonEstimator.parse(name).load()  # reports what is wrong before anything is simulated
        return NamedEstimator(label, name)
    external = EXTERNAL.match(name)
    if external is None:
        if name not in ESTIMATORS:
            raise unknown_name("estimator", name, (*ESTIMATORS, "python:package.module:Class", "external:COMMAND"))
        return NamedEstimator(label, name)
    try:
        words = shlex.split(name[external.end() :])
    except ValueError as error:
        raise ConfigError(f"estimator {text!r}: {error}; expected a command line") from None
    missing = [place for place in (RECORDING, OUTPUT) if not any(place in word for word in words[1:])]
    if missing:
        raise ConfigError(
            f"estimator {text!r} without {' and '.join(missing)}; expected a command that reads the EuRoC folder"
            f" {RECORDING} and writes the TUM file {OUTPUT}"
        )
    return NamedEstimator(label, name)


def _map_and_cost(estimator: Estimator) -> "tuple[SlamMap | None, MapCost]":
    """Return the final map of visual SLAM and the cost of the map so far, and end its worker process."""
    from dronevio.estimator.slam.visual_slam import VisualSlam

    assert isinstance(estimator, VisualSlam)
    cost = estimator.map_cost  # before the final map, which is not part of the cost of the frames
    slam_map = estimator.final_map()
    estimator.close()
    return slam_map, cost


def _of_program(run: ProgramRun) -> Estimated:
    """Return the estimate of a program, with its processor time divided by the number of frames."""
    frames = run.recording.frame_times_ns
    span_s = float(np.ptp(frames)) * 1e-9
    cost_ms, factor = 1e3 * run.cpu_s / len(frames), span_s / max(run.cpu_s, 1e-3)
    return Estimated(run.trajectory, cost_ms, None, factor, run.recording.defects)
