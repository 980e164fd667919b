"""Estimate a recording whose frames have late or early time stamps, and show whether the odometry finds the offset.

The true offset t_imu = t_cam + offset is given to the recording and not to the odometry. Each offset is tried from
several starts, since the motion in the first seconds decides how soon it is found::

    python benchmarks/time_offsets.py MH_01_easy --cameras 1

No offset may be adopted where images and IMU do not belong together: with the IMU of other flights, with the images in
reverse order, and where half a second is missing, which is beyond the offsets that are searched for.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from measuring import ChangedRecording, ate_m, first_pose_s, frames_of, odometry, opened, print_rows, section_of
from wrong_inputs import FAULTS, Change

from dronevio.estimator.calibration.calibrator import TIME_OFFSET_FOUND
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.state import Health

FOUND_S = 0.005


@dataclass(frozen=True)
class TimeOffsetsCommand:
    """Estimate a recording with time offsets, from several starts, and print a table."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder with ground truth."""
    cameras: int = 1
    """Number of cameras of the estimator."""
    offsets_ms: tuple[float, ...] = (0.0, 20.0, -20.0, 50.0, -50.0, 100.0, -100.0, 200.0, -200.0)
    """True offsets, t_imu = t_cam + offset [ms]."""
    starts_s: tuple[float, ...] = (0.0, 0.7, 1.4, 2.1, 2.8)
    """Times of the first frames [s]."""
    frames: int = 200
    """Number of frames from the beginning of the recording."""
    crossed: tuple[Path, ...] = ()
    """Files with the IMU samples of other flights, in the format of EuRoC."""


def started(recording: ChangedRecording, start_s: float) -> ChangedRecording:
    """Return a recording without its first frames, and without the IMU samples before them."""
    times_ns = recording.frame_times_ns
    first = int(np.searchsorted(times_ns, times_ns[0] + round(start_s * 1e9)))
    row = int(np.searchsorted(recording.imu.t_ns, times_ns[first]))
    return replace(recording.chosen(np.arange(first, len(times_ns))), imu=recording.imu[max(row - 1, 0) :])


def offset(recording: ChangedRecording, offset_s: float) -> ChangedRecording:
    """Return a recording whose frames are stamped so that t_imu = t_cam + offset [s]."""
    return replace(recording, frame_times_ns=recording.frame_times_ns - round(offset_s * 1e9))


def with_imu_of(path: Path, begin_s: float) -> Change:
    """Return the fault that the IMU is that of another flight, from a time after its beginning on [s]."""

    def changed(recording: ChangedRecording, _: Recording) -> ChangedRecording:
        t_ns = np.loadtxt(path, delimiter=",", comments="#", usecols=0, dtype=np.int64)
        values = np.loadtxt(path, delimiter=",", comments="#", usecols=range(1, 7))
        shift_ns = int(recording.imu.t_ns[0] - t_ns[0]) - round(begin_s * 1e9)
        samples = ImuSamples(t_ns + shift_ns, values[:, :3], values[:, 3:])
        first, last = np.searchsorted(samples.t_ns, recording.imu.t_ns[[0, -1]]).tolist()
        return replace(recording, imu=samples[first:last])

    return changed


def wrong_inputs(command: TimeOffsetsCommand, recording: Recording) -> int:
    """Print how often an offset is adopted where images and IMU do not belong together, and return that number."""
    faults: dict[str, Change] = {name: FAULTS[name][0] for name in ("reversed-images", "imu-late")}
    for path in command.crossed:
        faults |= {f"crossed {path.parent.name} at {s:g} s": with_imu_of(path, s) for s in (10.0, 25.0)}
    rows, total = [], 0
    for name, change in faults.items():
        adopted, tracking, texts = 0, 0, set[str]()
        for start_s in command.starts_s:
            changed = started(change(section_of(recording, command.frames), recording), start_s)
            run = odometry(changed)
            adopted += any(TIME_OFFSET_FOUND in text for e in run.estimates for text in e.events)
            tracking += frames_of(run, Health.TRACKING)
            texts |= {text[:60] for _, text in run.warnings}
        rows.append(
            {
                "fault": name,
                "adopted": f"{adopted} of {len(command.starts_s)}",
                "tracking": str(tracking),
                "warnings": "; ".join(sorted(texts))[:100],
            }
        )
        total += adopted
    print_rows("measurements that do not belong together", rows)
    return total


def main(command: TimeOffsetsCommand) -> int:
    """Print the tables; return 1 if fewer than 90 % of the offsets are found, or one is adopted that does not exist."""
    recording, truth = opened(command.recording, command.cameras)
    rows, good, tried, reference = [], 0, 0, dict[float, float]()
    for offset_ms in command.offsets_ms:
        errors_ms, ates, ratios, first_s, tracking, adopted = [], [], [], [], [], 0
        for start_s in command.starts_s:
            changed = offset(started(section_of(recording, command.frames), start_s), 1e-3 * offset_ms)
            vio = VisualInertialOdometry(changed.rig)
            run = estimate_recording(changed, vio)
            errors_ms.append(1e3 * vio.time_offset_s - offset_ms)
            ates.append(ate_m(run, truth))
            adopted += any(TIME_OFFSET_FOUND in text for e in run.estimates for text in e.events)
            reference.setdefault(start_s, ates[-1])
            ratios.append(ates[-1] / reference[start_s])
            first_s.append(first_pose_s(run))
            poses = sum(e.state is not None for e in run.estimates)
            tracking.append(frames_of(run, Health.TRACKING) / max(poses, 1))
        found = np.abs(errors_ms) <= 1e3 * FOUND_S
        if offset_ms:
            good, tried = good + int(found.sum()), tried + len(found)
        rows.append(
            {
                "offset ms": f"{offset_ms:+.0f}",
                "found": f"{found.sum()} of {len(found)}",
                "adopted": str(adopted),
                "errors ms": " ".join(f"{e:+.1f}" for e in errors_ms),
                "ATE mm": " ".join(f"{1e3 * a:.1f}" for a in ates),
                "ATE ratio": " ".join(f"{r:.2f}" for r in ratios),
                "first pose s": " ".join(f"{s:.1f}" for s in first_s),
                "tracking %": " ".join(f"{100 * t:.0f}" for t in tracking),
            }
        )
    print_rows(f"{recording.name}, {command.cameras} cameras", rows)
    print(f"found within {1e3 * FOUND_S:g} ms: {good} of {tried}")
    wrong = wrong_inputs(command, recording)
    return int((tried > 0 and good < 0.9 * tried) or wrong > 0)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(TimeOffsetsCommand, description=__doc__)))
