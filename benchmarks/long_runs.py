"""Memory and time per frame of the odometry over long runs: in flight, at rest, never started, and lost for good.

The measurements are made while they are used, so that nothing but the odometry grows: an analytic flight in a room, its
IMU at 200 Hz, and observations of landmarks at 20 Hz in place of images. The time per frame at the end is compared with
that of another odometry that is a quarter as old, frame by frame in turn::

    python benchmarks/long_runs.py                 # 40 minutes of each case
    python benchmarks/long_runs.py --minutes 120 --cases flight
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import numpy.typing as npt
import psutil
import tyro

from dronevio.cli.terminal import print_table
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import rotation_z
from dronevio.models.state import CameraFrame

FRAME_NS, IMU_NS = 50_000_000, 5_000_000
MOVING_S, LOST_AT_S = 2.0, 20.0
MAX_MB_PER_MINUTE, MAX_TIME_RATIO = 0.05, 1.05
COMPARED_MINUTES = 2  # at the end of the run
MEMORY_FRAMES = 200  # between two measurements of the memory


@dataclass(frozen=True)
class Case:
    """What happens during a run."""

    moves: bool
    """Whether the vehicle takes off; otherwise, it stands still."""
    sees: Callable[[float], bool]
    """Function of the time [s] that returns whether landmarks are visible."""


CASES = {
    "flight": Case(True, lambda t_s: True),
    "rest": Case(False, lambda t_s: True),
    "never started": Case(True, lambda t_s: False),
    "lost": Case(True, lambda t_s: t_s < LOST_AT_S),
}


class Landmarks:
    """A `FrontEnd` that observes landmarks in a room with noise, where the vehicle flies in a circle."""

    def __init__(self, rig: Rig, case: Case) -> None:
        """Begin before the first frame of a case."""
        self._camera, self._case, self._rng = rig.cameras[0], case, np.random.default_rng(0)
        sides = self._rng.uniform(-1.0, 1.0, (800, 3))
        sides[np.arange(800), self._rng.integers(0, 2, 800)] = np.where(self._rng.random(800) < 0.5, -1.0, 1.0)
        self._points = sides * [5.0, 5.0, 2.0]
        self._ids = np.full(800, -1, np.int64)
        self._ages = np.zeros(800, np.int64)
        self._pixels = np.zeros((800, 2))
        self._visible = np.zeros(800, np.bool_)
        self._next = 0

    def track(self, frame: CameraFrame, *_: object) -> Observations:
        """Observe the landmarks that have been observed before."""
        t_s = frame.t_ns * 1e-9
        R, p, _ = (values[0] for values in motion(np.array([t_s]), self._case.moves))
        T = self._camera.T_imu_cam
        in_cam = ((self._points - p) @ R - T[:3, 3]) @ T[:3, :3]
        model = self._camera.model
        with np.errstate(divide="ignore", invalid="ignore"):
            near = np.linalg.norm(in_cam[:, :2] / in_cam[:, 2:], axis=1) < 1.0
        self._pixels = model.project(in_cam) + self._rng.normal(0.0, 0.2, (len(in_cam), 2))
        inside = ((self._pixels > 5) & (self._pixels < [model.width - 6, model.height - 6])).all(axis=1)
        self._visible = near & inside & (in_cam[:, 2] > 0.5) & self._case.sees(t_s)
        self._ids[~self._visible] = -1
        self._ages = np.where(self._ids >= 0, self._ages + 1, 0)
        return self._observations()

    def replenish(self, calibration: Calibration | None = None, at_exposure_of: object = None) -> Observations:
        """Observe further landmarks."""
        free = np.flatnonzero(self._visible & (self._ids < 0))[: max(80 - int((self._ids >= 0).sum()), 0)]
        self._ids[free], self._ages[free] = self._next + np.arange(len(free)), 1
        self._next += len(free)
        return self._observations()

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop observing landmarks."""
        self._ids[np.isin(self._ids, ids)] = -1

    def _observations(self) -> Observations:
        rows = np.flatnonzero(self._ids >= 0)
        rows = rows[np.argsort(self._ids[rows])]
        pixels = self._pixels[rows]
        return Observations(self._ids[rows], pixels, self._camera.model.normalize(pixels), self._ages[rows])


def motion(t_s: Array, moves: bool) -> tuple[Array, Array, Array]:
    """Return orientation (N, 3, 3), position (N, 3) [m] and acceleration (N, 3) [m/s²] of the IMU in the world.

    The vehicle stands, and flies in a circle from `MOVING_S` on, to which its phase accelerates within 4 s.
    """
    s = np.maximum(t_s - MOVING_S, 0.0) if moves else np.zeros_like(t_s)
    u = np.minimum(s / 4.0, 1.0)
    phase = 4.0 * (u**3 - 0.5 * u**4) + np.maximum(s - 4.0, 0.0)
    rate, accel = u * u * (3.0 - 2.0 * u), np.where(s < 4.0, 6.0 * u * (1.0 - u) / 4.0, 0.0)
    amplitude, frequency = np.array([1.5, 1.2, 0.4]), np.array([0.8, 1.1, 1.7])
    x = phase[:, None] * frequency
    p = amplitude * np.sin(x)
    a = amplitude * frequency * (accel[:, None] * np.cos(x) - frequency * rate[:, None] ** 2 * np.sin(x))
    yaw = 0.5 * np.sin(0.6 * phase)
    level = euroc_rig().T_vehicle_imu[:3, :3]
    return np.stack([rotation_z(angle) for angle in yaw]) @ level, p, a


def imu_of(t_ns: npt.NDArray[np.int64], moves: bool, rng: np.random.Generator) -> ImuSamples:
    """Return the samples of an IMU with the noise of EuRoC's."""
    t_s, h = t_ns.astype(np.float64) * 1e-9, 1e-4
    R, _, a = motion(t_s, moves)
    ahead, behind = motion(t_s + h, moves)[0], motion(t_s - h, moves)[0]
    W = np.swapaxes(R, 1, 2) @ (ahead - behind) / (2.0 * h)
    gyro = np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)
    accel = np.einsum("nji,nj->ni", R, a + [0.0, 0.0, GRAVITY_M_S2])
    n = gyro.shape
    return ImuSamples(t_ns, gyro + rng.normal(0.0, 2.4e-3, n), accel + rng.normal(0.0, 2.8e-2, n))


def frames(minutes: float, case: Case) -> Iterator[tuple[ImuSamples, CameraFrame]]:
    """Yield each frame with the IMU samples before it."""
    rng, count = np.random.default_rng(1), round(minutes * 60e9) // FRAME_NS
    per_frame, block = FRAME_NS // IMU_NS, 200
    for first in range(0, count, block):
        t_ns = (first * per_frame + np.arange(block * per_frame, dtype=np.int64) + 1) * IMU_NS
        samples = imu_of(t_ns, case.moves, rng)
        for i in range(block):
            part = samples[i * per_frame : (i + 1) * per_frame]
            yield part, CameraFrame(int(part.t_ns[-1]), ())


class Run:
    """An odometry that runs on a case."""

    def __init__(self, case: Case, minutes: float) -> None:
        """Begin before the first frame of a run of some duration [min]."""
        rig = euroc_rig()
        self._vio = VisualInertialOdometry(rig, front_end=Landmarks(rig, case))
        self._frames = frames(minutes, case)
        self._process = psutil.Process()
        self.poses = self.count = 0
        self.cost_ms = np.full(round(minutes * 60e9) // FRAME_NS, np.nan)  # at once, so that it does not grow
        """Processor time of each frame with the IMU samples before it [ms]."""
        self.memory_mb: list[float] = []
        """Memory of the process after every `MEMORY_FRAMES` frames [MB]."""

    def advance(self, count: int) -> None:
        """Estimate the next frames."""
        for samples, frame in islice(self._frames, count):
            start_s = time.process_time()
            self._vio.add_imu(samples)
            self.poses += self._vio.add_frame(frame).state is not None
            self.cost_ms[self.count] = (time.process_time() - start_s) * 1e3
            self.count += 1
            if self.count % MEMORY_FRAMES == 0:
                self.memory_mb.append(self._process.memory_info().rss * 1e-6)


@dataclass(frozen=True)
class Growth:
    """How memory and time per frame grow between the first quarter and the end of a run."""

    mb_per_minute: float
    """Growth of the memory of the process [MB/min]."""
    early_ms: float
    """Median processor time of a frame at the end of the first quarter [ms]."""
    late_ms: float
    """Median processor time of a frame at the end [ms]."""
    slowest_ms: float
    """Longest processor time of a frame after the first quarter [ms]."""
    poses: int
    """Number of frames with a pose."""


def growth_of(case: Case, minutes: float) -> Growth:
    """Run the odometry on a case, and beside its last frames another one that is a quarter as old."""
    count = round(minutes * 60e9) // FRAME_NS
    quarter, compared = count // 4, min(COMPARED_MINUTES * 1200, count // 4)
    old, young = Run(case, minutes), Run(case, minutes)
    old.advance(count - compared)
    late_mb = old.memory_mb[len(old.memory_mb) // 4 :]
    minutes_of = np.arange(len(late_mb)) * MEMORY_FRAMES * FRAME_NS / 60e9
    slope = float(np.polyfit(minutes_of, late_mb, 1)[0])
    young.advance(quarter - compared)
    for _ in range(compared):  # alternately, so that other load on the machine slows both down
        young.advance(1)
        old.advance(1)
    early_ms, late_ms = (float(np.median(run.cost_ms[run.count - compared : run.count])) for run in (young, old))
    return Growth(slope, early_ms, late_ms, float(old.cost_ms[quarter:].max()), old.poses)


@dataclass(frozen=True)
class LongRunsCommand:
    """Run the odometry for a long time, and print how its memory and its time per frame grow."""

    minutes: float = 40.0
    """Simulated time [min], at least 8."""
    cases: tuple[str, ...] = tuple(CASES)
    """Names of the cases."""


def main(command: LongRunsCommand) -> int:
    """Print the table; return 1 if a case grows."""
    grown = {name: growth_of(CASES[name], command.minutes) for name in command.cases}
    rows = [
        (
            name,
            f"{g.poses}",
            f"{g.mb_per_minute:.3f}",
            f"{g.early_ms:.2f}",
            f"{g.late_ms:.2f}",
            f"{g.late_ms / g.early_ms:.2f}",
            f"{g.slowest_ms:.0f}",
        )
        for name, g in grown.items()
    ]
    titles = ("case", "poses", "memory [MB/min]", "first quarter [ms]", "end [ms]", "ratio", "slowest [ms]")
    print_table(f"{command.minutes:g} minutes, frames at 20 Hz", titles, rows)
    return int(
        any(g.mb_per_minute > MAX_MB_PER_MINUTE or g.late_ms > MAX_TIME_RATIO * g.early_ms for g in grown.values())
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(LongRunsCommand, description=__doc__)))
