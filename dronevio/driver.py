"""The driver: it pushes the measurements of a recording into an estimator and measures the processor time."""

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


class RunObserver(Protocol):
    """Receives the measurements and the estimates of an estimator while it runs."""

    def imu(self, samples: ImuSamples, /) -> None:
        """Receive IMU samples, after the estimator has processed them."""

    def frame(self, frame: CameraFrame, estimate: Estimate, cpu_ms: float, /) -> None:
        """Receive a frame and its estimate.

        Args:
            frame: The frame.
            estimate: The estimate of the frame.
            cpu_ms: Processor time of the frame and of the IMU samples before it [ms].
        """


class ImuRateObserver:
    """Propagates the newest estimate to every IMU sample, as a system in real time does; a `RunObserver`."""

    def __init__(self, imu: ImuModel, config: "PreintegrationConfig | None" = None) -> None:
        """Start before the first measurement.

        Args:
            imu: Model of the IMU.
            config: Settings of the preintegration.
        """
        from dronevio.estimator.imu.forward_propagation import ImuRatePropagator

        self._propagator = ImuRatePropagator(imu, config)
        self._states: list[NavState] = []

    def imu(self, samples: ImuSamples) -> None:
        """Propagate the newest state to IMU samples."""
        self._states += self._propagator.add_imu(samples)

    def frame(self, frame: CameraFrame, estimate: Estimate, cpu_ms: float) -> None:
        """Replace the newest state by the estimate of a frame."""
        self._propagator.correct(estimate)

    @property
    def trajectory(self) -> Trajectory:
        """Causal poses, one per IMU sample since the first state."""
        return Trajectory.from_states(self._states)


def estimate_recording(
    recording: Recording, estimator: Estimator, progress: Progress = silent, observers: Sequence[RunObserver] = ()
) -> EstimatorRun:
    """Push all measurements of a recording into an estimator, in the order of time, on one thread.

    Each estimate is taken before the next frame is read, so it is causal. The processor time contains neither the
    reading of images nor the work of observers.

    Args:
        recording: The measurements.
        estimator: The estimator, before its first measurement.
        progress: Called with the number of processed frames.
        observers: Receive the measurements and the estimates.

    Raises:
        InputError: An image cannot be read.
    """
    cv2.setNumThreads(1)  # threads would sum floating-point numbers in another order in each run
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
            for observer in observers:
                observer.imu(measurement)
        else:  # a frame is complete, with the IMU samples before it
            for observer in observers:
                observer.frame(measurement, estimates[-1], cpu_s * 1e3)
            cpu_ms.append(cpu_s * 1e3)
            wall_ms.append(wall_s * 1e3)
            cpu_s, wall_s = 0.0, 0.0
            progress(len(estimates), total)
    return EstimatorRun(tuple(estimates), np.array(cpu_ms), np.array(wall_ms))


def require_poses(run: EstimatorRun, recording: Recording) -> Trajectory:
    """Return the trajectory of a run.

    Args:
        run: The run.
        recording: The recording, for the error message.

    Raises:
        EvaluationError: The run has no pose.
    """
    trajectory = run.trajectory
    if len(trajectory) == 0:
        report = run.estimates[-1].health_report if run.estimates else None
        why = f" ({report.reason})" if report is not None else ""
        raise EvaluationError(
            f"{recording.name}: no pose after {len(run.estimates)} frames{why}; expected a recording of a textured"
            " scene in which the drone is stationary for a second, or moves with parallax"
        )
    return trajectory
