"""The driver: it pushes the measurements of a recording into an estimator and measures the processor time."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
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

    def __init__(
        self, imu: ImuModel, config: "PreintegrationConfig | None" = None, gravity_m_s2: float = GRAVITY_M_S2
    ) -> None:
        """Start before the first measurement.

        Args:
            imu: Model of the IMU.
            config: Settings of the preintegration.
            gravity_m_s2: Magnitude of gravity [m/s²].
        """
        from dronevio.estimator.imu.forward_propagation import ImuRatePropagator

        self._propagator = ImuRatePropagator(imu, config, gravity_m_s2)
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


class TimedEstimator:
    """An estimator whose estimates and processor times are recorded; implements `Estimator`.

    The time of a frame includes the IMU samples before it, and the states at the IMU's rate that are requested.
    """

    def __init__(self, estimator: Estimator) -> None:
        """Take an estimator before its first measurement, and let OpenCV use one thread in this process."""
        cv2.setNumThreads(1)  # threads would sum floating-point numbers in another order in each run
        self._estimator = estimator
        self._estimates: list[Estimate] = []
        self._cost_s: list[tuple[float, float]] = []
        self._cpu_s, self._wall_s = 0.0, 0.0

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call."""
        with self._timed():
            self._estimator.add_imu(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate for a frame."""
        with self._timed():
            estimate = self._estimator.add_frame(frame)
        self._estimates.append(estimate)
        self._cost_s.append((self._cpu_s, self._wall_s))
        self._cpu_s, self._wall_s = 0.0, 0.0
        return estimate

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU; see `Estimator`."""
        with self._timed():
            return self._estimator.state_at(t_ns)

    @property
    def cpu_ms(self) -> float:
        """Processor time of the newest frame and of the IMU samples before it [ms]."""
        return self._cost_s[-1][0] * 1e3

    @property
    def run(self) -> EstimatorRun:
        """The estimates so far, and their cost."""
        cost_ms = np.array(self._cost_s).reshape(-1, 2) * 1e3
        return EstimatorRun(tuple(self._estimates), cost_ms[:, 0], cost_ms[:, 1])

    @contextmanager
    def _timed(self) -> Iterator[None]:
        """Add the time of the context to that of the next frame."""
        cpu_start, wall_start = time.process_time(), time.perf_counter()
        yield
        self._cpu_s += time.process_time() - cpu_start
        self._wall_s += time.perf_counter() - wall_start


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
    timed = TimedEstimator(estimator)
    frames, total = 0, len(recording.frame_times_ns)
    for measurement in measurements(recording):
        if isinstance(measurement, ImuSamples):
            timed.add_imu(measurement)
            for observer in observers:
                observer.imu(measurement)
        else:
            estimate = timed.add_frame(measurement)
            for observer in observers:
                observer.frame(measurement, estimate, timed.cpu_ms)
            frames += 1
            progress(frames, total)
    return timed.run


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
