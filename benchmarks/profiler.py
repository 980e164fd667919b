"""Show where the odometry spends its processor time: by stage, and by function, with a thousand samples per second.

    python benchmarks/profiler.py RECORDING --cameras 2

Mean and 99th percentile of the time per frame, and memory, are columns of ``dronevio benchmark``; with ``--laps`` also
those of a flight of many minutes.
"""

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

import tyro
from measuring import table

INTERVAL_S = 0.001
"""Time between two samples of the profiler [s]."""
STAGES: tuple[tuple[str, str, str], ...] = (
    ("stereo matching", "frontend/stereo.py", ""),
    ("KLT", "frontend/klt.py", ""),
    ("corner detection", "frontend/corners.py", ""),
    ("corner detection", "", "cornerMinEigenVal"),
    ("outlier rejection", "frontend/ransac.py", ""),
    ("patch alignment", "frontend/patches.py", ""),
    ("front end, other", "frontend/", ""),
    ("linearization of observations", "backend/reprojection.py", ""),
    ("linear system and marginalization", "backend/linear_system.py", ""),
    ("linear system and marginalization", "backend/marginal_prior.py", ""),
    ("linear system and marginalization", "optimization/linalg.py", ""),
    ("landmarks and triangulation", "backend/landmarks.py", ""),
    ("landmarks and triangulation", "backend/observations.py", ""),
    ("landmarks and triangulation", "backend/triangulation.py", ""),
    ("IMU factors", "backend/factors.py", ""),
    ("smoother, other", "backend/", ""),
    ("online calibration", "calibration/", ""),
    ("preintegration and propagation", "imu/", ""),
    ("preintegration and propagation", "estimator/propagator.py", ""),
)
"""Stage, beginning of the path of a module (its folder and name), and text of a source line. A sample belongs to the
first stage with a matching line on the stack."""
OTHER = "estimator, other"
"""Stage of samples of the estimator that belong to no other stage."""
OUTSIDE = "outside the estimator"
"""Stage of samples outside the estimator, such as of the reading of images."""


@dataclass
class Profile:
    """Processor time by stage and by function."""

    stages: Counter[str] = field(default_factory=Counter)
    """Processor time of each stage [s]."""
    functions: Counter[str] = field(default_factory=Counter)
    """Processor time of each Python function of the estimator, with the C functions that it calls [s]."""

    @contextmanager
    def sampling(self) -> Iterator[None]:
        """Sample the stack about every `INTERVAL_S` until the context ends.

        A sample counts with the processor time since the sample before it. Python handles the signal of the timer when
        a C function returns, so the whole time of the C function counts for its call. The timer is one of wall-clock
        time, because timers of processor time have a resolution of some milliseconds.
        """
        last_s = time.process_time()

        def sample(_: int, frame: FrameType | None) -> None:
            nonlocal last_s
            now_s = time.process_time()
            if frame is not None:
                stage = stage_of(frame)
                self.stages[stage] += now_s - last_s  # type: ignore[assignment]
                if stage != OUTSIDE:
                    self.functions[_function_name(frame)] += now_s - last_s  # type: ignore[assignment]
            last_s = time.process_time()  # without the time of sampling
            signal.setitimer(signal.ITIMER_REAL, INTERVAL_S)  # armed last, so that slow samples do not nest

        previous = signal.signal(signal.SIGALRM, sample)
        signal.setitimer(signal.ITIMER_REAL, INTERVAL_S)
        try:
            yield
        finally:
            signal.signal(signal.SIGALRM, signal.SIG_IGN)  # a last sample would arm the timer again
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, previous)


def stage_of(frame: FrameType) -> str:
    """Return the stage to which a stack belongs."""
    stack = []
    caller: FrameType | None = frame
    while caller is not None:
        line = caller.f_lineno or caller.f_code.co_firstlineno  # the line is None between two lines
        stack.append(_source(caller.f_code.co_filename, line))
        caller = caller.f_back
    for stage, module, words in STAGES:
        if any(name.startswith(module) and words in line for name, line in stack):
            return stage
    return OTHER if any(name == "estimator/odometry.py" for name, _ in stack) else OUTSIDE


@cache
def _source(file: str, number: int) -> tuple[str, str]:
    """Return folder and name of a file, and the source of a line with its neighbours, as calls span several lines."""
    name = "/".join(Path(file).parts[-2:])
    return name, "".join(linecache.getline(file, each) for each in range(max(number - 1, 1), number + 2))


def _function_name(frame: FrameType) -> str:
    name, _ = _source(frame.f_code.co_filename, frame.f_code.co_firstlineno)
    return f"{name}: {frame.f_code.co_qualname}"


@dataclass(frozen=True)
class ProfileCommand:
    """Estimate a recording and print processor time by stage and by function."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder or ROS 2 bag."""
    cameras: int = 1
    """Number of cameras of the estimator."""


def profile_tables(profile: Profile, frames: int) -> str:
    """Return Markdown tables of the estimator's processor time by stage and by function.

    Args:
        profile: The samples.
        frames: Number of frames.
    """
    counted = {name: s for name, s in profile.stages.items() if name != OUTSIDE}
    total_s = sum(counted.values())
    stages = [
        [name, f"{100 * s / total_s:.1f}", f"{1e3 * s / frames:.2f}"]
        for name, s in sorted(counted.items(), key=lambda item: -item[1])
    ]
    functions = [[name, f"{100 * s / total_s:.1f}"] for name, s in profile.functions.most_common(15)]
    return "\n\n".join(
        [
            table(("stage", "share [%]", "ms per frame"), stages),
            table(("function, with the C functions that it calls", "share [%]"), functions),
        ]
    )


def main(command: ProfileCommand) -> int:
    """Profile the odometry on a recording and print the tables."""
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # before NumPy is imported
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimators.driver import estimate_recording
    from dronevio.models.recordings.open import open_recording

    recording, profile = open_recording(command.recording, command.cameras), Profile()
    with profile.sampling():
        run = estimate_recording(recording, VisualInertialOdometry(recording.rig))
    print(profile_tables(profile, len(run.estimates)))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(ProfileCommand, description=__doc__)))
