"""The driver: it pushes the measurements of a recording into an estimator and measures the processor time."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from dronevio.estimator.threads import single_threaded
from dronevio.eval.run import EstimatorRun
from dronevio.models.defects import Defect, DefectKind, defects_of
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples, Times
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
    Meanwhile, linear algebra and OpenCV use one thread.
    """

    def __init__(self, estimator: Estimator) -> None:
        """Take an estimator before its first measurement."""
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
        self._estimates.append(replace(estimate, map_correction=None))
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
        with single_threaded():
            yield
        self._cpu_s += time.process_time() - cpu_start
        self._wall_s += time.perf_counter() - wall_start


def estimate_recording(
    recording: Recording, estimator: Estimator, progress: Progress = silent, observers: Sequence[RunObserver] = ()
) -> EstimatorRun:
    """Push all measurements of a recording into an estimator, in the order of time, on one thread.

    Each estimate is taken before the next frame is read, so it is causal. The processor time contains neither the
    reading of images nor the work of observers. The defects of the recording are events of the estimates: each is an
    event of the first frame at or after it, and those of consecutive frames one event of the first.

    Args:
        recording: The measurements.
        estimator: The estimator, before its first measurement.
        progress: Called with the number of processed frames.
        observers: Receive the measurements and the estimates.

    Raises:
        InputError: An image cannot be read.
    """
    timed, known = TimedEstimator(estimator), defects_of(recording)
    kinds_at, before = _kinds_by_frame(recording.frame_times_ns, known), frozenset[DefectKind]()
    estimates: list[Estimate] = []
    damaged: list[Defect] = []
    total = len(recording.frame_times_ns)
    for measurement in measurements(recording):
        if isinstance(measurement, ImuSamples):
            timed.add_imu(measurement)
            for observer in observers:
                observer.imu(measurement)
        else:
            damaged += measurement.defects
            kinds = kinds_at.get(len(estimates), frozenset()) | {defect.kind for defect in measurement.defects}
            estimate = _with_events(timed.add_frame(measurement), kinds - before)
            estimates.append(replace(estimate, map_correction=None))
            before = kinds
            for observer in observers:
                observer.frame(measurement, estimate, timed.cpu_ms)
            progress(len(estimates), total)
    return replace(timed.run, estimates=tuple(estimates), defects=(*known, *damaged))


def _kinds_by_frame(frame_times_ns: Times, defects: Sequence[Defect]) -> dict[int, frozenset[DefectKind]]:
    """Return the kinds of defects by the index of the first frame (M,) at or after each, or of the last frame."""
    rows = np.searchsorted(frame_times_ns, [defect.t_ns for defect in defects])
    kinds: dict[int, frozenset[DefectKind]] = {}
    for row, defect in zip(np.minimum(rows, len(frame_times_ns) - 1).tolist(), defects, strict=True):
        kinds[row] = kinds.get(row, frozenset()) | {defect.kind}
    return kinds


def _with_events(estimate: Estimate, kinds: frozenset[DefectKind]) -> Estimate:
    """Return an estimate with an event for each kind of defect."""
    if not kinds:
        return estimate
    return replace(estimate, events=(*estimate.events, *(str(kind) for kind in DefectKind if kind in kinds)))


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
