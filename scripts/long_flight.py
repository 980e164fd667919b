"""A recording flown again and again, what each of its frames costs an estimator, and what that spends its time on."""

import linecache
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import numpy.typing as npt
from measuring import CAMERAS, Mode

from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording, measurements
from dronevio.models.rig import Rig
from dronevio.models.rotation import log_so3
from dronevio.models.state import CameraFrame, Trajectory

TICK_S = 0.001
"""Time between two looks of the profiler."""
STAGES: tuple[tuple[str, str, str], ...] = (
    ("stereo matching", "stereo.py", ""),
    ("stereo matching", "overlap.py", ""),
    ("KLT", "", "calcOpticalFlowPyrLK"),
    ("KLT", "", "buildOpticalFlowPyramid"),
    ("corner detection", "", "cornerMinEigenVal"),
    ("corner detection", "corners.py", ""),
    ("corner detection", "", "cornerSubPix"),
    ("corner detection", "", "goodFeaturesToTrack"),
    ("outlier rejection", "epipolar.py", ""),
    ("patch alignment", "patches.py", ""),
    ("front end, rest", "frontend.py", ""),
    ("front end, rest", "tracker.py", ""),
    ("front end, rest", "rig_tracker.py", ""),
    ("window: sightings to first order", "reprojection.py", ""),
    ("window: solving and marginalizing", "marginal.py", ""),
    ("window: solving and marginalizing", "prior.py", ""),
    ("window: motion to first order, sums", "window.py", ""),
    ("online calibration", "adjustment.py", ""),
    ("online calibration", "calibration.py", ""),
    ("preintegration and propagation", "inertial.py", ""),
    ("preintegration and propagation", "propagation.py", ""),
    ("preintegration and propagation", "covariance.py", ""),
    ("landmarks and triangulation", "landmarks.py", ""),
    ("landmarks and triangulation", "triangulation.py", ""),
    ("landmarks and triangulation", "sightings.py", ""),
    ("smoother, rest", "smoother.py", ""),
)
"""Where time goes: the first whose file is on the stack and whose words are on the line that runs there."""


@dataclass(frozen=True)
class Repeated:
    """A recording flown several times over; is a `Recording`."""

    inner: Recording
    """One lap."""
    laps: int
    """How many."""

    @property
    def name(self) -> str:
        """What to call it."""
        return f"{self.inner.name} × {self.laps}"

    @property
    def rig(self) -> Rig:
        """The calibration."""
        return self.inner.rig

    @property
    def lap_ns(self) -> int:
        """How long a lap is: a frame longer than from the first frame to the last [ns]."""
        t_ns = self.inner.frame_times_ns
        return int(t_ns[-1] - t_ns[0] + np.median(np.diff(t_ns)))

    @property
    def imu(self) -> ImuSamples:
        """All samples; the biases walk on."""
        one, truth = self.inner.imu, self.inner.ground_truth
        first_ns = int(self.inner.frame_times_ns[0])
        first, last = np.searchsorted(one.t_ns, [first_ns, first_ns + self.lap_ns])
        one = one[int(first) : int(last)]
        walked = np.zeros((2, 3))
        if truth is not None and truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None:
            walked = np.array([b[-1] - b[0] for b in (truth.gyro_bias_rad_s, truth.accel_bias_m_s2)])
        laps = range(self.laps)
        return ImuSamples(
            np.concatenate([one.t_ns + lap * self.lap_ns for lap in laps]),
            np.concatenate([one.gyro_rad_s + lap * walked[0] for lap in laps]),
            np.concatenate([one.accel_m_s2 + lap * walked[1] for lap in laps]),
            one.sampling,
        )

    @property
    def frame_times_ns(self) -> npt.NDArray[np.int64]:
        """Time stamps of all frames [ns]."""
        return np.concatenate([self.inner.frame_times_ns + lap * self.lap_ns for lap in range(self.laps)])

    @property
    def ground_truth(self) -> Trajectory | None:
        """Of one lap only, which is enough for what is measured here."""
        return self.inner.ground_truth

    def frame(self, index: int) -> CameraFrame:
        """Return a frame: that of the lap, stamped as it should be."""
        lap, row = divmod(index, len(self.inner.frame_times_ns))
        seen = self.inner.frame(row)
        return CameraFrame(seen.t_ns + lap * self.lap_ns, seen.images)

    def seam(self) -> tuple[float, float]:
        """Return how far the last pose of a lap is from the first of the next [m], [°]."""
        truth = self.inner.ground_truth
        if truth is None:
            return float("nan"), float("nan")
        R = truth.rotations
        turn = log_so3(R[0].T @ R[-1])
        return (
            float(np.linalg.norm(truth.p_world_imu[-1] - truth.p_world_imu[0])),
            float(np.degrees(np.linalg.norm(turn))),
        )


@dataclass
class Profile:
    """What the processor was seen doing: seconds by stage, and by function."""

    stages: Counter[str] = field(default_factory=Counter)
    """Seconds by stage."""
    functions: Counter[str] = field(default_factory=Counter)
    """Seconds by the function that ran, what it calls of C included."""

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Look about every `TICK_S`, and ask how much processor time has passed.

        Python hears of the timer when a call into C returns: then all the time since the last look is that call's. The
        timer is the wall's, as those of processor time tick every few milliseconds only.
        """
        last_s = time.process_time()

        def look(_: int, frame: FrameType | None) -> None:
            nonlocal last_s
            now_s = time.process_time()
            if frame is not None:
                self.stages[stage_of(frame)] += now_s - last_s  # type: ignore[assignment]
                self.functions[_name(frame)] += now_s - last_s  # type: ignore[assignment]
            last_s = time.process_time()  # looking is not counted
            signal.setitimer(signal.ITIMER_REAL, TICK_S)  # only now: looks that are slow must not pile up

        before = signal.signal(signal.SIGALRM, look)
        signal.setitimer(signal.ITIMER_REAL, TICK_S)
        try:
            yield
        finally:
            signal.signal(signal.SIGALRM, signal.SIG_IGN)  # a last look would arm the timer again
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)


def stage_of(frame: FrameType) -> str:
    """Return the stage that a stack belongs to."""
    stack = []
    up: FrameType | None = frame
    while up is not None:
        stack.append(_where(up.f_code.co_filename, up.f_lineno or up.f_code.co_firstlineno))  # None between two lines
        up = up.f_back
    for stage, file, words in STAGES:
        if any((not file or file == name) and words in line for name, line in stack):
            return stage
    return "Python and the rest" if any(name == "vio.py" for name, _ in stack) else "reading, not counted"


@cache
def _where(file: str, number: int) -> tuple[str, str]:
    """Return a file's name, and the source of a line and of the two around it: calls are written over several."""
    return Path(file).name, "".join(linecache.getline(file, each) for each in range(max(number - 1, 1), number + 2))


def _name(frame: FrameType) -> str:
    file, _ = _where(frame.f_code.co_filename, frame.f_code.co_firstlineno)
    return f"{file}: {frame.f_code.co_qualname}"


def rss_mb() -> float:
    """Return the memory that this process holds now [MB]."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def measure(folder: Path, mode: Mode, minutes: float, profile: bool) -> dict[str, Any]:
    """Fly, and return what each frame cost and what memory was held."""
    import cv2

    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.models.recordings.open import open_recording

    cv2.setNumThreads(1)
    inner = open_recording(folder, CAMERAS[mode])
    lap_s = Repeated(inner, 1).lap_ns * 1e-9
    recording = Repeated(inner, max(1, round(60.0 * minutes / lap_s)))
    estimator = VisualInertialOdometry(recording.rig)
    seen, cpu_ms, memory_mb, spent_s, healths = Profile(), [], [], 0.0, Counter[str]()
    keyframes: list[bool] = []
    for measurement in measurements(recording):
        start_s = time.process_time()
        with seen.looking() if profile else _nothing():
            if isinstance(measurement, ImuSamples):
                estimator.add_imu(measurement)
                answer = None
            else:
                answer = estimator.add_frame(measurement)
        spent_s += time.process_time() - start_s
        if answer is None:
            continue
        cpu_ms.append(1e3 * spent_s)
        spent_s = 0.0
        healths[answer.health.value] += 1
        keyframes.append("keyframe" in answer.events)
        if len(cpu_ms) % 100 == 0:
            memory_mb.append(rss_mb())
    return {
        "mode": mode,
        "recording": recording.name,
        "lap_s": lap_s,
        "rate_hz": recording.rig.cameras[0].rate_hz,
        "seam": recording.seam(),
        "cpu_ms": cpu_ms,
        "keyframe": keyframes,
        "memory_mb": memory_mb,
        "health": dict(healths),
        "stages": dict(seen.stages),
        "functions": dict(seen.functions.most_common(15)),
    }


@contextmanager
def _nothing() -> Iterator[None]:
    yield
