"""Measure the time and the accuracy of dynamic initialization: start estimators in the middle of recorded flights.

    python scripts/initialization_accuracy.py FOLDER... [--every-s 3] [--mode stereo]
    python scripts/initialization_accuracy.py MH_01_easy --starts-s 0 0.5 1 1.5 2 --front-ends "" random-30 object-30

The ground truth is that of the recording, or FOLDER/groundtruth.tum, whose positions are differentiated. The scale
after T seconds is that of the causal poses in the two seconds from T on, or from the first pose on if that is later:
the ratio of the estimated to the true displacements from their mean, after alignment of yaw. An initialization is
*excited* if the root mean square of the true acceleration in its first two seconds is 0.5 m/s² or more; with less, the
scale is hardly observable.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from corrupted_tracks import CORRUPTED_FRONT_ENDS
from estimation_tasks import CAMERAS, Mode
from scipy.signal import savgol_filter

from dronevio.driver import estimate_recording
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Trajectory

Array = npt.NDArray[np.float64]

SPAN_S = 2.0
"""Duration over which a scale is measured [s]."""
EARLY_AT_S, LATE_AT_S = 2.0, 10.0
"""Times after the first frame at which the scale is measured [s]."""
EXCITED_M_S2 = 0.5
"""Root mean square of the acceleration from which an initialization is excited [m/s²]."""
TIME_TOLERANCE_NS = 2_000_000
"""Tolerance of the time of a start, because time stamps jitter [ns]."""


@dataclass(frozen=True)
class InitializationCommand:
    """Start estimators in the middle of recorded flights, and print the errors of each initialization."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """EuRoC folders with ground truth."""
    every_s: float = 3.0
    """Time between two initializations [s]."""
    starts_s: tuple[float, ...] = ()
    """Times of the initializations after the first frame [s], in place of equal intervals; the rest of each recording
    is estimated, up to the given duration."""
    front_ends: tuple[str, ...] = ("",)
    """Names in `corrupted_tracks.CORRUPTED_FRONT_ENDS`; an empty name is the front end of the estimator."""
    duration_s: float = 12.5
    """Duration of the flight after each start that is estimated [s]."""
    mode: Mode = "mono"
    """Cameras of the estimator."""


@dataclass(frozen=True, eq=False)
class RecordingSection:
    """A section of a recording; is a `Recording`."""

    whole: Recording
    """Recording that contains the section."""
    first: int
    """Index of the first frame of the section."""
    count: int
    """Number of frames of the section."""

    @property
    def name(self) -> str:
        """Name of the recording with the time at which the section begins."""
        return f"{self.whole.name} from {(self.frame_times_ns[0] - self.whole.frame_times_ns[0]) * 1e-9:.1f} s"

    @property
    def rig(self) -> Rig:
        """Calibration of the recording."""
        return self.whole.rig

    @property
    def imu(self) -> ImuSamples:
        """IMU samples from 10 ms before the first frame of the section on."""
        return self.whole.imu.after(int(self.frame_times_ns[0]) - 10_000_000)

    @property
    def frame_times_ns(self) -> npt.NDArray[np.int64]:
        """(N,) Time stamps of the frames of the section [ns]."""
        return self.whole.frame_times_ns[self.first : self.first + self.count]

    @property
    def ground_truth(self) -> Trajectory | None:
        """None, because estimators do not need it."""
        return None

    def frame(self, index: int) -> CameraFrame:
        """Return a frame of the section."""
        return self.whole.frame(self.first + index)


@dataclass(frozen=True)
class InitializationMetrics:
    """Metrics of one initialization; NaN for values that are not known."""

    name: str
    """Name of the section."""
    acceleration_m_s2: float
    """Root mean square of the true acceleration in the first two seconds [m/s²]."""
    first_s: float
    """Time from the first frame to the first pose [s]."""
    early_scale: float
    """Relative scale error two seconds after the first frame."""
    late_scale: float
    """Relative scale error ten seconds after the first frame."""
    error_m: float
    """Absolute trajectory error of position after alignment of yaw and position, root mean square [m]."""
    velocity_error_m_s: float
    """Error of the first velocity in the IMU frame [m/s]."""
    velocity_sigma_m_s: float
    """Largest standard deviation of the first velocity according to its covariance [m/s]."""
    later_velocity_error_m_s: float
    """Error of the velocity two seconds after the first pose, after alignment [m/s]."""
    later_speed_m_s: float
    """True speed at that time [m/s]."""

    def row(self) -> str:
        """Return the metrics as a line of the table."""
        return (
            f"{self.name:32s} {self.acceleration_m_s2:6.2f} {self.first_s:6.2f} {100 * self.early_scale:8.1f}"
            f" {100 * self.late_scale:8.1f} {self.error_m:8.3f} {self.velocity_error_m_s:8.3f}"
            f" {self.velocity_sigma_m_s:8.3f} {self.later_velocity_error_m_s:8.3f} {self.later_speed_m_s:8.2f}"
        )

    @property
    def is_accurate(self) -> bool:
        """Whether the velocity two seconds after the first pose is within 5 % or 0.03 m/s of the true one."""
        return self.later_velocity_error_m_s <= max(0.05 * self.later_speed_m_s, 0.03)


HEADER = (
    f"{'initialization':32s} {'m/s²':>6s} {'first':>6s} {'scale2 %':>8s} {'scale10%':>8s} {'ATE m':>8s} {'v err':>8s}"
    f" {'sigma':>8s} {'v2 err':>8s} {'speed':>8s}"
)


def measure(section: RecordingSection, truth: Trajectory, front_end: str = "") -> InitializationMetrics:
    """Estimate a section of a recording and return the metrics of its initialization.

    Args:
        section: The section.
        truth: Ground truth of the whole recording, with velocities.
        front_end: Name in `CORRUPTED_FRONT_ENDS`; empty for the front end of the estimator.
    """
    config = VioConfig()
    tracker = RigTracker(section.rig, config.tracker)
    used = CORRUPTED_FRONT_ENDS[front_end](tracker) if front_end else tracker
    run = estimate_recording(section, VisualInertialOdometry(section.rig, config, used))
    t0 = int(section.frame_times_ns[0])
    beginning = truth[(truth.t_ns >= t0) & (truth.t_ns <= t0 + round(EARLY_AT_S * 1e9))]
    coarse = beginning[:: max(len(beginning) // 20, 1)]
    assert coarse.velocity_m_s is not None, "expected ground truth with velocities"
    rates = np.diff(coarse.velocity_m_s, axis=0) / np.diff(coarse.t_s)[:, None]
    acceleration = float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))
    estimate = run.trajectory
    if len(estimate) < 3 or estimate.velocity_m_s is None or estimate.covariance is None:
        nan = float("nan")
        return InitializationMetrics(section.name, acceleration, nan, nan, nan, nan, nan, nan, nan, nan)
    true, rows = interpolate(truth, estimate.t_ns)
    estimate = estimate[rows]
    assert estimate.velocity_m_s is not None and estimate.covariance is not None and true.velocity_m_s is not None
    alignment = align(true.p_world_imu, estimate.p_world_imu, "yaw")
    difference_m = alignment.positions(estimate.p_world_imu) - true.p_world_imu
    error_m = float(np.sqrt(np.mean(np.sum(difference_m**2, axis=1))))
    t_s = np.asarray((estimate.t_ns - t0) * 1e-9)
    early, late = (scale_error(true, estimate, max(at_s, float(t_s[0])), t_s) for at_s in (EARLY_AT_S, LATE_AT_S))
    v_error = estimate.rotations[0].T @ estimate.velocity_m_s[0] - true.rotations[0].T @ true.velocity_m_s[0]
    sigma = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[0, 6:9, 6:9])[-1]))
    v_error_m_s = float(np.linalg.norm(v_error))
    row = min(int(np.searchsorted(t_s, t_s[0] + SPAN_S)), len(t_s) - 1)
    later = np.linalg.norm(alignment.R_truth_estimate @ estimate.velocity_m_s[row] - true.velocity_m_s[row])
    return InitializationMetrics(
        section.name, acceleration, float(t_s[0]), early, late, error_m, v_error_m_s, sigma,
        float(later), float(np.linalg.norm(true.velocity_m_s[row])),
    )  # fmt: skip


def scale_error(true: Trajectory, estimate: Trajectory, from_s: float, t_s: Array) -> float:
    """Return the relative scale error over `SPAN_S`; NaN with fewer than ten poses.

    Args:
        true: N true poses at the time stamps of the estimate.
        estimate: N estimated poses.
        from_s: Beginning of the time span [s].
        t_s: (N,) Times of the poses [s].
    """
    rows = np.flatnonzero((t_s >= from_s - 1e-3) & (t_s <= from_s + SPAN_S))
    if len(rows) < 10:
        return float("nan")
    a = true.p_world_imu[rows] - true.p_world_imu[rows].mean(axis=0)
    R = align(true.p_world_imu[rows], estimate.p_world_imu[rows], "yaw").R_truth_estimate
    b = (estimate.p_world_imu[rows] - estimate.p_world_imu[rows].mean(axis=0)) @ R.T
    return float((a * b).sum() / (a * a).sum()) - 1.0


def sections(recording: Recording, command: InitializationCommand) -> Iterator[RecordingSection]:
    """Return the sections of a recording at the beginning of which estimators start.

    At equal intervals, the first is one interval after the first frame, and all have the full duration.
    """
    times_ns = recording.frame_times_ns
    rate_hz = 1e9 / float(np.median(np.diff(times_ns)))
    count = round(command.duration_s * rate_hz)
    if command.starts_s:
        starts_ns = times_ns[0] + np.round(1e9 * np.array(command.starts_s)).astype(np.int64)
        for first in np.searchsorted(times_ns, starts_ns - TIME_TOLERANCE_NS).tolist():
            yield RecordingSection(recording, first, min(count, len(times_ns) - first))
    else:
        step = round(command.every_s * rate_hz)
        for first in range(step, len(times_ns) - count, step):
            yield RecordingSection(recording, first, count)


def ground_truth_of(recording: Recording, folder: Path) -> Trajectory:
    """Return the ground truth of a recording with velocities; by local parabolas where only positions are known."""
    truth = recording.ground_truth or read_tum(folder / "groundtruth.tum")
    if truth.velocity_m_s is not None:
        return truth
    step_s = float(np.median(np.diff(truth.t_s)))
    velocity_m_s = savgol_filter(truth.p_world_imu, 11, 2, deriv=1, delta=step_s, axis=0)
    return replace(truth, velocity_m_s=velocity_m_s)


def summary(label: str, errors: Array, bound: float) -> str:
    """Return a line on the distribution of relative scale errors.

    Args:
        label: Beginning of the line.
        errors: (N,) Scale errors; NaN for values that are not known.
        bound: Error for which the share of smaller errors is stated.
    """
    sizes = np.abs(errors[np.isfinite(errors)])
    if len(sizes) == 0:
        return f"{label}: none"
    return (
        f"{label}: {len(sizes)} initializations, median {100 * np.median(sizes):.2f} %, 90 % within"
        f" {100 * np.percentile(sizes, 90):.1f} %, largest {100 * sizes.max():.1f} %;"
        f" {100 * np.mean(sizes <= bound):.0f} % within {100 * bound:g} %"
    )


def print_summary(every: Sequence[InitializationMetrics], duration_s: float) -> None:
    """Print the distribution of the metrics over all initializations of a given duration [s]."""
    excited = [each for each in every if each.acceleration_m_s2 >= EXCITED_M_S2]
    for label, some in (("all", every), ("excited", excited)):
        print(summary(f"scale after {EARLY_AT_S:g} s, {label}", np.array([each.early_scale for each in some]), 0.05))
        print(summary(f"scale after {LATE_AT_S:g} s, {label}", np.array([each.late_scale for each in some]), 0.01))
    started = [each for each in every if np.isfinite(each.first_s)]
    print(f"not initialized within {duration_s:g} s: {len(every) - len(started)}")
    if not started:
        return
    first_s = np.array([each.first_s for each in started])
    print(f"first pose after {np.median(first_s):.2f} s (median), {first_s.max():.2f} s (latest)")
    accurate = sum(each.is_accurate for each in every)
    print(f"velocity two seconds after the first pose within 5 % or 0.03 m/s: {accurate} of {len(every)}")
    ratio = np.array([each.velocity_error_m_s / each.velocity_sigma_m_s for each in started])
    print(f"error of the first velocity over its sigma: median {np.median(ratio):.2f}, largest {ratio.max():.2f}")


def main(command: InitializationCommand) -> int:
    """Measure all recordings, and print a table and a summary for each front end."""
    for front_end in command.front_ends:
        print(f"front end with wrong tracks: {front_end}" if front_end else "front end of the estimator")
        print(HEADER)
        every: list[InitializationMetrics] = []
        for folder in command.recordings:
            recording = open_recording(folder, CAMERAS[command.mode])
            truth = ground_truth_of(recording, folder)
            for section in sections(recording, command):
                every.append(measure(section, truth, front_end))
                print(every[-1].row(), flush=True)
        print_summary(every, command.duration_s)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(InitializationCommand, description=__doc__)))
