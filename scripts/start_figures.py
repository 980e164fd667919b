"""How well and how soon the odometry starts: joins flights in motion, every few seconds, and prints a table.

    uv run python scripts/start_figures.py FOLDER... [--every-s 3] [--mode stereo]

The scale after T seconds is that of the causal poses told in the two seconds from then on (or from the first pose,
where that is later): the ratio of the estimated to the true displacements about their mean, after alignment in yaw. A
start is *excited* if the true acceleration over its first two seconds is 0.5 m/s² or more; less hardly tells a scale.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.driver import estimate_recording
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Trajectory

Array = npt.NDArray[np.float64]

SPAN_S = 2.0  # over which a scale is measured [s]
EARLY_S, LATE_S = 2.0, 10.0  # when the scale is measured, from the first frame on [s]
EXCITED_M_S2 = 0.5  # root mean square of the acceleration from which a flight tells its scale [m/s²]


@dataclass(frozen=True, eq=False)
class Joined:
    """A recording that begins later than it did, and ends earlier: the `Recording` protocol."""

    whole: Recording
    first: int
    count: int

    @property
    def name(self) -> str:
        """What to call it."""
        return f"{self.whole.name} from {(self.frame_times_ns[0] - self.whole.frame_times_ns[0]) * 1e-9:.0f} s"

    @property
    def rig(self) -> Rig:
        """The calibration."""
        return self.whole.rig

    @property
    def imu(self) -> ImuSamples:
        """The IMU from a little before the first frame on."""
        return self.whole.imu.after(int(self.frame_times_ns[0]) - 10_000_000)

    @property
    def frame_times_ns(self) -> npt.NDArray[np.int64]:
        """Time stamps of the frames [ns]."""
        return self.whole.frame_times_ns[self.first : self.first + self.count]

    @property
    def ground_truth(self) -> Trajectory | None:
        """None: nothing needs it."""
        return None

    def frame(self, index: int) -> CameraFrame:
        """Return a frame."""
        return self.whole.frame(self.first + index)


@dataclass(frozen=True)
class Start:
    """How one start went; NaN where there is no figure."""

    name: str
    acceleration_m_s2: float
    first_s: float
    early: float
    late: float
    error_m: float
    velocity_error_m_s: float
    velocity_sigma_m_s: float

    def row(self) -> str:
        """Return a line of the table."""
        return (
            f"{self.name:32s} {self.acceleration_m_s2:6.2f} {self.first_s:6.2f} {100 * self.early:8.1f}"
            f" {100 * self.late:8.1f} {self.error_m:8.3f} {self.velocity_error_m_s:8.3f} {self.velocity_sigma_m_s:8.3f}"
        )


HEADER = (
    f"{'start':32s} {'m/s²':>6s} {'first':>6s} {'scale2 %':>8s} {'scale10%':>8s} {'ATE m':>8s} {'v err':>8s}"
    f" {'sigma':>8s}"
)


def measure(joined: Joined, truth: Trajectory) -> Start:
    """Estimate a joined flight, and compare."""
    run = estimate_recording(joined, VisualInertialOdometry(joined.rig))
    t0 = int(joined.frame_times_ns[0])
    early = truth[(truth.t_ns >= t0) & (truth.t_ns <= t0 + round(EARLY_S * 1e9))]
    coarse = early[:: max(len(early) // 20, 1)]
    assert coarse.velocity_m_s is not None, "a truth without velocities"
    rates = np.diff(coarse.velocity_m_s, axis=0) / np.diff(coarse.t_s)[:, None]
    acceleration = float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))
    found = run.trajectory
    if len(found) < 3 or found.velocity_m_s is None or found.covariance is None:
        nan = float("nan")
        return Start(joined.name, acceleration, nan, nan, nan, nan, nan, nan)
    true, rows = interpolate(truth, found.t_ns)
    found = found[rows]
    assert found.velocity_m_s is not None and found.covariance is not None and true.velocity_m_s is not None
    fit = align(true.p_world_imu, found.p_world_imu, "yaw")
    error_m = float(np.sqrt(np.mean(np.sum((fit.positions(found.p_world_imu) - true.p_world_imu) ** 2, axis=1))))
    t_s = np.asarray((found.t_ns - t0) * 1e-9)
    early_scale, late_scale = (scale_error(true, found, max(at_s, float(t_s[0])), t_s) for at_s in (EARLY_S, LATE_S))
    v_error = found.rotations[0].T @ found.velocity_m_s[0] - true.rotations[0].T @ true.velocity_m_s[0]
    sigma = float(np.sqrt(np.linalg.eigvalsh(found.covariance[0, 6:9, 6:9])[-1]))
    v_error_m_s = float(np.linalg.norm(v_error))
    return Start(joined.name, acceleration, float(t_s[0]), early_scale, late_scale, error_m, v_error_m_s, sigma)


def scale_error(true: Trajectory, found: Trajectory, from_s: float, t_s: Array) -> float:
    """Return the scale of what was told in a span, relative to the truth, less one."""
    rows = np.flatnonzero((t_s >= from_s - 1e-3) & (t_s <= from_s + SPAN_S))
    if len(rows) < 10:
        return float("nan")
    a = true.p_world_imu[rows] - true.p_world_imu[rows].mean(axis=0)
    R = align(true.p_world_imu[rows], found.p_world_imu[rows], "yaw").R_truth_estimate
    b = (found.p_world_imu[rows] - found.p_world_imu[rows].mean(axis=0)) @ R.T
    return float((a * b).sum() / (a * a).sum()) - 1.0


def starts(folder: Path, cameras: int, every_s: float, for_s: float) -> Iterator[Start]:
    """Measure a flight's starts, the first at one interval after its first frame."""
    recording = open_recording(folder, cameras)
    truth = recording.ground_truth
    assert truth is not None, f"{folder} has no truth to compare with"
    rate_hz = 1e9 / float(np.median(np.diff(recording.frame_times_ns)))
    count = round(for_s * rate_hz)
    for first in range(round(every_s * rate_hz), len(recording.frame_times_ns) - count, round(every_s * rate_hz)):
        yield measure(Joined(recording, first, count), truth)


def summary(label: str, errors: Array, wanted: float) -> str:
    """Return a line about some scale errors."""
    known = np.abs(errors[np.isfinite(errors)])
    if len(known) == 0:
        return f"{label}: none"
    return (
        f"{label}: {len(known)} starts, median {100 * np.median(known):.2f} %, 90 % within"
        f" {100 * np.percentile(known, 90):.1f} %, worst {100 * known.max():.1f} %;"
        f" {100 * np.mean(known <= wanted):.0f} % within {100 * wanted:g} %"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="EuRoC folders with their truth")
    parser.add_argument("--every-s", type=float, default=3.0, help="time between starts [s]")
    parser.add_argument("--for-s", type=float, default=12.5, help="how much of the flight is estimated [s]")
    parser.add_argument("--mode", choices=("mono", "stereo"), default="mono", help="how many cameras are used")
    arguments = parser.parse_args()
    print(HEADER)
    done: list[Start] = []
    for folder in arguments.folders:
        for start in starts(folder, {"mono": 1, "stereo": 2}[arguments.mode], arguments.every_s, arguments.for_s):
            print(start.row(), flush=True)
            done.append(start)
    excited = [s for s in done if s.acceleration_m_s2 >= EXCITED_M_S2]
    for label, some in (("all", done), ("excited", excited)):
        print(summary(f"scale after {EARLY_S:g} s, {label}", np.array([s.early for s in some]), 0.05))
        print(summary(f"scale after {LATE_S:g} s, {label}", np.array([s.late for s in some]), 0.01))
    first_s = np.array([s.first_s for s in done])
    print(f"first pose after {np.nanmedian(first_s):.2f} s (median), {np.nanmax(first_s):.2f} s (latest)")
    print(f"no start within {arguments.for_s:g} s: {int(np.isnan(first_s).sum())}")
    z = np.array([s.velocity_error_m_s / s.velocity_sigma_m_s for s in done])
    print(f"first velocity error over its sigma: median {np.nanmedian(z):.2f}, largest {np.nanmax(z):.2f}")


if __name__ == "__main__":
    main()
