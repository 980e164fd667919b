"""The driver that pushes a recording through an estimator, frame by frame, and times it."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Estimator, Recording, measurements
from dronevio.models.state import CameraFrame, Estimate, NavState, Trajectory

if TYPE_CHECKING:
    from dronevio.estimator.imu.preintegration import PreintegrationConfig


class Watcher(Protocol):
    """Hears what an estimator is given and what it answers, while it runs."""

    def imu(self, samples: ImuSamples) -> None:
        """Hear of IMU samples."""

    def frame(self, frame: CameraFrame, answer: Estimate, cpu_ms: float) -> None:
        """Hear of a frame, of the answer, and of what it cost with the IMU samples before it [ms]."""


class ImuRateListener:
    """Watches an estimator, and dead-reckons its newest state to every IMU sample, as a live system would."""

    def __init__(self, imu: ImuModel, config: "PreintegrationConfig | None" = None) -> None:
        """Begin before the first measurement.

        Args:
            imu: The IMU.
            config: How it is preintegrated.
        """
        from dronevio.estimator.imu.forward_propagation import ImuRatePropagator

        self._propagator = ImuRatePropagator(imu, config)
        self._states: list[NavState] = []

    def imu(self, samples: ImuSamples) -> None:
        """Hear of IMU samples."""
        self._states += self._propagator.add_imu(samples)

    def frame(self, frame: CameraFrame, answer: Estimate, cpu_ms: float) -> None:
        """Hear of a frame and of the answer."""
        self._propagator.correct(answer)

    @property
    def trajectory(self) -> Trajectory:
        """A pose for each sample since the first state; each was known when its sample came."""
        return Trajectory.from_states(self._states)


def estimate_recording(
    recording: Recording, estimator: Estimator, progress: Progress = silent, watchers: Sequence[Watcher] = ()
) -> EstimatorRun:
    """Push all measurements of a recording into an estimator, in time order, on one thread.

    Each answer is taken before the next frame is read, so it is causal. Reading a frame from disk is not timed, nor is
    what watchers do.

    Raises:
        InputError: A frame cannot be read.
    """
    cv2.setNumThreads(1)  # one core is what is promised, and threads would not add up in the same order every time
    estimates: list[Estimate] = []
    cpu_ms: list[float] = []
    wall_ms: list[float] = []
    total = len(recording.frame_times_ns)
    cpu_s, wall_s = 0.0, 0.0
    for measurement in measurements(recording):
        cpu_start, wall_start = time.process_time(), time.perf_counter()
        if isinstance(measurement, ImuSamples):
            estimator.add_imu(measurement)
        else:
            estimates.append(estimator.add_frame(measurement))
        cpu_s += time.process_time() - cpu_start
        wall_s += time.perf_counter() - wall_start
        if isinstance(measurement, ImuSamples):
            for watcher in watchers:
                watcher.imu(measurement)
        else:  # a frame is done, with the IMU before it
            for watcher in watchers:
                watcher.frame(measurement, estimates[-1], cpu_s * 1e3)
            cpu_ms.append(cpu_s * 1e3)
            wall_ms.append(wall_s * 1e3)
            cpu_s, wall_s = 0.0, 0.0
            progress(len(estimates), total)
    return EstimatorRun(tuple(estimates), np.array(cpu_ms), np.array(wall_ms))


def require_poses(run: EstimatorRun, recording: Recording) -> Trajectory:
    """Return the trajectory of a run.

    Raises:
        EvaluationError: The estimator never got so far as a pose.
    """
    trajectory = run.trajectory
    if len(trajectory) == 0:
        report = run.estimates[-1].health_report if run.estimates else None
        why = f" ({report.reason})" if report is not None else ""
        raise EvaluationError(
            f"{recording.name}: no pose after {len(run.estimates)} frames{why}; expected a recording in which the drone"
            " stands still for a second, or moves with parallax, before a textured scene"
        )
    return trajectory
