"""Estimate a recording with faulty IMU samples, and show what the odometry makes of them.

Each fault is applied to the samples while they are read: outliers, strong vibration, samples left out, clocks that
drift or are offset, a late accelerometer, and scale errors. Position and yaw are aligned for the ATE. Errors in
standard deviations of the faulty run count while it is tracking, with position and yaw of the first pose: those from
the ground truth include what the truth itself contributes, see the row of the clean recording; those from the run with
the clean recording are due to the fault alone. "below 3 σ" is the share of that run's poses at which the faulty run is
tracking with such an error below 3 σ::

    python benchmarks/faulty_imus.py MH_01_easy
    python benchmarks/faulty_imus.py V1_02 --cameras 2 --frames 800 --faults none 100-hz
    python benchmarks/faulty_imus.py V1_02 --count-outliers
"""

import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from measuring import NO_POSE, ChangedRecording, frames_of, odometry, opened, print_rows, section_of

from dronevio.estimator.imu.outliers import outlying_samples
from dronevio.eval.metrics.scores import score
from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import tracking_errors, tracking_sigmas
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.state import Health

Fault = Callable[[ChangedRecording, np.random.Generator], ChangedRecording]

FALSE_RATE_SAMPLES = 10_000
CONSISTENT_SIGMAS = 3.0


def of_imu(function: Callable[[ImuSamples, np.random.Generator], ImuSamples]) -> Fault:
    """Return the fault that changes the samples by a function."""
    return lambda recording, rng: replace(recording, imu=function(recording.imu, rng))


def with_values(samples: ImuSamples, gyro: Array, accel: Array) -> ImuSamples:
    """Return samples with other readings (N, 3)."""
    return replace(samples, gyro_rad_s=gyro, accel_m_s2=accel)


def outliers(count: int, gyro_rad_s: float, accel_m_s2: float) -> Fault:
    """Return the fault that replaces one axis of both sensors by extreme values, in random samples."""

    def changed(samples: ImuSamples, rng: np.random.Generator) -> ImuSamples:
        rows = rng.choice(np.arange(10, len(samples) - 10), count, replace=False)
        gyro, accel = samples.gyro_rad_s.copy(), samples.accel_m_s2.copy()
        for values, size in ((gyro, gyro_rad_s), (accel, accel_m_s2)):
            values[rows, rng.integers(0, 3, count)] = rng.choice([-size, size], count)
        return with_values(samples, gyro, accel)

    return of_imu(changed)


def vibration(frequency_hz: float, phase_walk_rad: float) -> Fault:
    """Return the fault that adds vibration of 15 m/s² and 0.3 rad/s, whose phase performs a random walk."""

    def changed(samples: ImuSamples, rng: np.random.Generator) -> ImuSamples:
        t_s = (samples.t_ns - samples.t_ns[0]) * 1e-9
        walk = np.cumsum(rng.normal(0.0, phase_walk_rad, len(samples)))
        phase = 2.0 * np.pi * (frequency_hz * t_s + rng.random()) + walk
        shake = np.sin(phase)[:, None]
        return with_values(samples, samples.gyro_rad_s + 0.3 * shake, samples.accel_m_s2 + 15.0 * shake)

    return of_imu(changed)


def drift(ppm: float) -> Fault:
    """Return the fault of a clock of the IMU that runs too fast."""

    def changed(samples: ImuSamples, _: np.random.Generator) -> ImuSamples:
        since_ns = samples.t_ns - samples.t_ns[0]
        return replace(samples, t_ns=samples.t_ns[0] + np.rint(since_ns * (1.0 + ppm * 1e-6)).astype(np.int64))

    return of_imu(changed)


def early_stamps(offset_s: float) -> Fault:
    """Return the fault of frames whose time stamps are early."""

    def changed(recording: ChangedRecording, _: np.random.Generator) -> ChangedRecording:
        return replace(recording, frame_times_ns=recording.frame_times_ns - round(offset_s * 1e9))

    return changed


def late_accelerometer(delay_s: float) -> Fault:
    """Return the fault of an accelerometer whose readings are late."""

    def changed(samples: ImuSamples, _: np.random.Generator) -> ImuSamples:
        t_s = (samples.t_ns - samples.t_ns[0]) * 1e-9
        accel = np.stack([np.interp(t_s - delay_s, t_s, axis) for axis in samples.accel_m_s2.T], axis=1)
        return with_values(samples, samples.gyro_rad_s, accel)

    return of_imu(changed)


def gyro_scale(factor: float) -> Fault:
    """Return the fault of a gyroscope with a wrong scale."""
    return of_imu(lambda samples, _: with_values(samples, factor * samples.gyro_rad_s, samples.accel_m_s2))


FAULTS: Mapping[str, Fault] = {
    "none": lambda recording, _: recording,
    **{f"{count}-outliers": outliers(count, 30.0, 150.0) for count in (2, 12, 50)},
    **{f"{count}-small-outliers": outliers(count, 3.0, 20.0) for count in (12, 50)},
    "vibration": vibration(87.0, 0.0),
    "wandering-vibration": vibration(87.0, 0.2),
    "100-hz": of_imu(lambda samples, _: samples[::2]),
    **{f"drift-{ppm}-ppm": drift(ppm) for ppm in (50, 200, 500)},
    "stamps-at-the-start-of-10-ms": early_stamps(0.005),
    **{f"accelerometer-{ms}-ms-late": late_accelerometer(1e-3 * ms) for ms in (2, 5, 10)},
    "gyroscope-1-percent-more": gyro_scale(1.01),
    "gyroscope-1-percent-less": gyro_scale(0.99),
}
"""Faults by name."""


@dataclass(frozen=True)
class FaultyImusCommand:
    """Estimate a recording with each of the faults, and print a table."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder with ground truth."""
    cameras: int = 1
    """Number of cameras of the estimator."""
    frames: int = 200
    """Number of frames from the beginning of the recording."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the random faults."""
    faults: tuple[str, ...] = tuple(FAULTS)
    """Names of the faults."""
    count_outliers: bool = False
    """Whether to count outliers in all samples instead, at the rate of the recording and at half of it."""


def count_outliers(samples: ImuSamples) -> int:
    """Print the outliers that are found in all samples, and return 1 for more than one among `FALSE_RATE_SAMPLES`."""
    parts = {f"every {step}, from {first}": samples[first::step] for step, first in ((1, 0), (2, 0), (2, 1))}
    found = {name: int(outlying_samples(part).sum()) for name, part in parts.items()}
    print_rows(
        "outliers among the samples",
        [{"samples": n, "number": str(len(part)), "outliers": str(found[n])} for n, part in parts.items()],
    )
    return int(any(found[name] * FALSE_RATE_SAMPLES > len(part) for name, part in parts.items()))


def compared(run: EstimatorRun, clean: EstimatorRun | None) -> dict[str, str]:
    """Return the largest error of a run against that with the clean recording, and its share below 3 σ, as cells."""
    errors = None if clean is None or len(run.trajectory) < 1 else tracking_errors(run, clean.trajectory)
    if clean is None or errors is None or not len(errors):
        return {"of clean": "", "below 3 σ": ""}
    share = np.sum(errors < CONSISTENT_SIGMAS) / len(clean.trajectory)
    return {"of clean": f"{errors.max():.1f}", "below 3 σ": f"{100.0 * share:.0f} %"}


def main(command: FaultyImusCommand) -> int:
    """Estimate the recording with all faults and print the table."""
    recording, truth = opened(command.recording, command.cameras)
    if command.count_outliers:
        return count_outliers(recording.imu)
    section, rows, clean_m, clean = section_of(recording, command.frames), [], None, None
    for name in command.faults:
        for seed in command.seeds if re.search("outliers|vibration", name) else command.seeds[:1]:
            changed = FAULTS[name](section, np.random.default_rng(seed))
            run = odometry(changed)
            has_poses = len(run.trajectory) > 2
            ate_m = score(truth, run.trajectory, run.t_ns).ate_m.rmse if has_poses else None
            sigmas = tracking_sigmas(run, truth) if has_poses else None
            clean_m, clean = (ate_m, run) if name == "none" else (clean_m, clean)
            corrections = [t for e in run.estimates for t in e.events if t.startswith("calibration corrected")]
            rows.append(
                {
                    "fault": name if len(command.seeds) == 1 else f"{name}, seed {seed}",
                    "tracking": str(frames_of(run, Health.TRACKING)),
                    "inertial": str(frames_of(run, Health.INERTIAL_ONLY)),
                    "no pose": str(frames_of(run, *NO_POSE)),
                    "ATE [mm]": "" if ate_m is None else f"{1e3 * ate_m:.1f}",
                    "× none": "" if ate_m is None or clean_m is None else f"{ate_m / clean_m:.2f}",
                    "max σ": "" if sigmas is None else f"{sigmas:.1f}",
                    **compared(run, clean if name != "none" else None),
                    "left out": str(run.imu_outliers),
                    "said": (*(text for _, text in run.warnings), *corrections[-1:], "")[0][:60],
                }
            )
    print_rows(f"{recording.name}, {command.frames} frames", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(FaultyImusCommand, description=__doc__)))
