"""Estimate recordings with wrong measurements or calibration, and show when the odometry notices and what it states.

Each fault is applied to a recording while it is read. A fault is noticed in time if every pose that is published while
"tracking" is within five of its standard deviations, along the least certain axis, of the ground truth, but at least
0.3 m and at most 1 m; position and yaw of the first pose are taken from the ground truth::

    python benchmarks/wrong_inputs.py MH_01_easy --crossed runs/room
    python benchmarks/wrong_inputs.py MH_01_easy --cameras 2 --faults frozen swapped-cameras
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from measuring import NO_POSE, ChangedRecording, frames_of, odometry, opened, print_rows, section_of

from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.output import REPEATED_IMAGES
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import errors_and_sigmas_m
from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import is_tracking
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import CameraFrame, Health, Trajectory

LATE_NS = 500_000_000
SIGMAS, LEAST_M, LARGEST_M = 5.0, 0.3, 1.0
CAMERA_DISAGREES = "contradicts its calibration"
CALIBRATION_DISAGREES = (CAMERA_DISAGREES, Cause.IMPLAUSIBLE_CALIBRATION)


Change = Callable[[ChangedRecording, Recording], ChangedRecording]


def of_images(function: Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.uint8]]) -> Change:
    """Return the fault that changes each image by a function."""
    return lambda recording, _: recording.with_images(function)


def of_order(index_of: Callable[[int, int], int]) -> Change:
    """Return the fault that shows another image, by a function of the index and the number of frames."""

    def changed(recording: ChangedRecording, _: Recording) -> ChangedRecording:
        count = len(recording.frame_times_ns)
        return recording.shown(np.array([index_of(index, count) for index in range(count)]))

    return changed


def of_cameras(function: Callable[[RigCamera], RigCamera]) -> Change:
    """Return the fault that changes the calibration of each camera by a function."""

    def changed(recording: ChangedRecording, _: Recording) -> ChangedRecording:
        return replace(recording, rig=replace(recording.rig, cameras=tuple(map(function, recording.rig.cameras))))

    return changed


def of_imu(gyro: Array, accel: Array) -> Change:
    """Return the fault that multiplies the samples of gyroscope and accelerometer by matrices (3, 3)."""

    def changed(recording: ChangedRecording, _: Recording) -> ChangedRecording:
        imu = recording.imu
        return replace(
            recording, imu=replace(imu, gyro_rad_s=imu.gyro_rad_s @ gyro.T, accel_m_s2=imu.accel_m_s2 @ accel.T)
        )

    return changed


def turned(degrees: float, axis: tuple[float, float, float]) -> Change:
    """Return the fault that turns all cameras about an axis of theirs."""
    T = pose_matrix(exp_so3(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)), np.zeros(3))
    return of_cameras(lambda camera: replace(camera, T_imu_cam=camera.T_imu_cam @ T))


def late(recording: ChangedRecording, _: Recording) -> ChangedRecording:
    """Return a recording whose IMU samples have late time stamps."""
    return replace(recording, imu=replace(recording.imu, t_ns=recording.imu.t_ns + LATE_NS))


def crossed(recording: ChangedRecording, other: Recording) -> ChangedRecording:
    """Return a recording with the IMU of another flight."""
    shift_ns = int(recording.frame_times_ns[0]) - int(other.frame_times_ns[0])
    return replace(recording, imu=replace(other.imu, t_ns=other.imu.t_ns + shift_ns))


def exchanged(recording: ChangedRecording, _: Recording) -> ChangedRecording:
    """Return a recording whose gyroscope is given as the accelerometer, and the reverse."""
    imu = recording.imu
    return replace(recording, imu=replace(imu, gyro_rad_s=imu.accel_m_s2, accel_m_s2=imu.gyro_rad_s))


def swapped(recording: ChangedRecording, _: Recording) -> ChangedRecording:
    """Return a recording whose images are given to the cameras in reverse order."""

    def image_of(index: int) -> CameraFrame:
        frame = recording.image_of(index)
        return replace(frame, images=frame.images[::-1])

    return replace(recording, image_of=image_of)


_EYE, _SWAPPED_AXES = np.eye(3), np.eye(3)[[1, 0, 2]]
FAULTS: Mapping[str, tuple[Change, tuple[str, ...]]] = {
    "none": (lambda recording, _: recording, ()),
    "crossed-flights": (crossed, (Cause.ROTATION_DISAGREES,)),
    "imu-late": (late, (Cause.ROTATION_DISAGREES, Cause.IMPLAUSIBLE_CALIBRATION)),
    "reversed-images": (of_order(lambda index, count: count - 1 - index), (Cause.ROTATION_DISAGREES,)),
    "mirrored-images": (
        of_images(lambda image: np.ascontiguousarray(image[:, ::-1])),
        (Cause.ROTATION_DISAGREES, *CALIBRATION_DISAGREES),
    ),
    "frozen-images": (of_order(lambda index, count: min(index, count // 2)), (REPEATED_IMAGES,)),
    "wrong-lens-model": (
        of_cameras(lambda c: replace(c, model=replace(c.model, distortion=(0.0, 0.0, 0.0, 0.0)))),
        (Cause.ROTATION_DISAGREES, Cause.ACCEL_DISAGREES, *CALIBRATION_DISAGREES),
    ),
    "extrinsics-20-degrees": (turned(20.0, (1.0, 1.0, 1.0)), (Cause.ROTATION_DISAGREES, *CALIBRATION_DISAGREES)),
    "extrinsics-90-degrees": (turned(90.0, (0.0, 0.0, 1.0)), (Cause.ROTATION_DISAGREES, *CALIBRATION_DISAGREES)),
    "swapped-cameras": (swapped, CALIBRATION_DISAGREES),
    "focal-length-20-percent": (
        of_cameras(lambda c: replace(c, model=replace(c.model, fx=1.2 * c.model.fx, fy=1.2 * c.model.fy))),
        (Cause.ROTATION_DISAGREES, *CALIBRATION_DISAGREES),
    ),
    "accelerometer-in-g": (of_imu(_EYE, _EYE / GRAVITY_M_S2), (Cause.FORCE_IS_NOT_GRAVITY,)),
    "gyroscope-in-degrees": (of_imu(np.degrees(1.0) * _EYE, _EYE), (Cause.ROTATION_DISAGREES,)),
    "gyroscope-axes": (of_imu(_SWAPPED_AXES, _EYE), (Cause.ROTATION_DISAGREES,)),
    "swapped-sensors": (exchanged, (Cause.SENSORS_SWAPPED,)),
    "accelerometer-axes": (of_imu(_EYE, _SWAPPED_AXES), (Cause.ACCEL_DISAGREES,)),
}
"""Faults by name, each with the texts of the causes that the odometry may state."""


@dataclass(frozen=True)
class WrongInputsCommand:
    """Estimate a recording with each of the faults, and print a table."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder with ground truth."""
    crossed: Path | None = None
    """Recording whose IMU replaces that of the first; without it, flights are not crossed."""
    cameras: int = 1
    """Number of cameras of the estimator."""
    frames: int = 200
    """Number of frames from the beginning of the recording."""
    faults: tuple[str, ...] = tuple(FAULTS)
    """Names of the faults."""


def late_notice_s(run: EstimatorRun, truth: Trajectory) -> float | None:
    """Return the first time at which a pose is wrong while tracking [s], or None."""
    if len(run.trajectory) < 2 or run.trajectory.covariance is None:
        return None
    true, rows = interpolate(truth, run.trajectory.t_ns)
    estimate = run.trajectory[rows]
    error_m, sigma_m = errors_and_sigmas_m(true, estimate)
    wrong = is_tracking(run, estimate) & (error_m > np.clip(SIGMAS * sigma_m, LEAST_M, LARGEST_M))
    return float((estimate.t_ns[wrong.argmax()] - run.t_ns[0]) * 1e-9) if wrong.any() else None


def row_of(name: str, run: EstimatorRun, truth: Trajectory) -> dict[str, str]:
    """Return the row of a fault: frames by health, whether it was noticed in time, and whether its cause is stated."""
    causes, warnings, wrong_s = FAULTS[name][1], [text for _, text in run.warnings], late_notice_s(run, truth)
    symptoms = ("lost: ", "inconsistent: ")
    stated = [text for text in warnings if not text.startswith(symptoms) and Cause.MOTION_DISAGREES not in text]
    is_right = all(any(cause in text for cause in causes) for text in stated)
    return {
        "fault": name,
        "tracking": str(frames_of(run, Health.TRACKING)),
        "no pose": str(frames_of(run, *NO_POSE)),
        "noticed in time": "yes" if wrong_s is None else f"no, wrong at {wrong_s:.1f} s",
        "cause stated": "no" if not stated else "yes" if is_right else "wrongly",
        "first warning": warnings[0] if warnings else "",
    }


def main(command: WrongInputsCommand) -> int:
    """Estimate the recording with all faults and print the table; return 1 if a fault was not noticed in time."""
    recording, truth = opened(command.recording, command.cameras)
    section = section_of(recording, command.frames)
    other = open_recording(command.crossed, command.cameras) if command.crossed else None
    rows = []
    for name in command.faults:
        if (name == "crossed-flights" and other is None) or (name == "swapped-cameras" and command.cameras < 2):
            continue
        changed = FAULTS[name][0](section, other or recording)
        rows.append(row_of(name, odometry(changed), truth))
    print_rows(f"{recording.name}, {command.frames} frames", rows)
    return int(any(row["noticed in time"] != "yes" for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(WrongInputsCommand, description=__doc__)))
