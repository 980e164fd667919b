"""Recordings that are played faster or slower, as exact similarities: a test of what an estimator takes as constant.

With times multiplied by s and lengths by s², accelerations are unchanged, and so is gravity: the images, played at
another rate, and the IMU, whose angular velocities are divided by s, are those of a flight through a world of another
size. An estimator that is right about durations and scales finds the same path, s² times as large. Quantities scale by
their dimension, L/T² being constant, so that a quantity of the dimension L^a T^b scales with s^(2a + b):

- angular velocities [1/s] with 1/s, velocities [m/s] with s, specific forces with 1;
- white noise of the gyroscope [rad/s/√Hz = rad/√s] with s^(−1/2), of the accelerometer [m/s^(3/2)] with s^(1/2);
- random walk of the gyroscope bias [rad/s^(3/2)] with s^(−3/2), of the accelerometer bias [m/s^(5/2)] with s^(−1/2).

The same follows from the samples: the noise σ of a sample is the density over the square root of its interval, which is
s times as long. A gyroscope bias is an error of the sensor and does not scale with the motion: it is removed before the
division and added again, while what it wanders by is divided. Settings of an estimator do not scale either.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from measuring import ChangedRecording

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel, Times
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.rotation import log_so3
from dronevio.models.state import Trajectory


def similar(recording: Recording, s: float, gyro_bias_rad_s: Array) -> ChangedRecording:
    """Return a recording that takes s times as long, in a world s² times as large.

    Args:
        recording: The recording.
        s: Ratio of the times.
        gyro_bias_rad_s: (3,) Bias of the gyroscope [rad/s].
    """
    start_ns, imu, truth = int(recording.frame_times_ns[0]), recording.imu, recording.ground_truth

    def played(t_ns: Times) -> Times:
        return np.asarray(start_ns + np.rint((t_ns - start_ns) * s).astype(np.int64))

    gyro_rad_s = (imu.gyro_rad_s - gyro_bias_rad_s) / s + gyro_bias_rad_s
    if truth is not None:
        velocity = None if truth.velocity_m_s is None else s * truth.velocity_m_s
        truth = Trajectory(played(truth.t_ns), s**2 * truth.p_world_imu, truth.quat_wxyz, velocity)
    return ChangedRecording(
        f"{recording.name} x{s:.3g}",
        similar_rig(recording.rig, s),
        replace(imu, t_ns=played(imu.t_ns), gyro_rad_s=gyro_rad_s),
        played(recording.frame_times_ns),
        recording.frame,
        truth,
    )


def similar_rig(rig: Rig, s: float) -> Rig:
    """Return the calibration of a recording that takes s times as long, in a world s² times as large."""
    cameras = tuple(
        replace(
            camera, T_imu_cam=_enlarged(camera.T_imu_cam, s), rate_hz=camera.rate_hz / s, readout_s=camera.readout_s * s
        )
        for camera in rig.cameras
    )
    T_vehicle_imu, offset_s = _enlarged(rig.T_vehicle_imu, s), s * rig.time_offset_s
    return Rig(cameras, similar_imu(rig.imu, s), T_vehicle_imu, offset_s)


def similar_imu(imu: ImuModel, s: float) -> ImuModel:
    """Return the model of an IMU whose samples are played s times as slowly; its biases and ranges are kept."""
    return replace(
        imu,
        rate_hz=imu.rate_hz / s,
        gyro_noise_density=imu.gyro_noise_density * s**-0.5,
        gyro_random_walk=imu.gyro_random_walk * s**-1.5,
        accel_noise_density=imu.accel_noise_density * s**0.5,
        accel_random_walk=imu.accel_random_walk * s**-0.5,
        gyro_bandwidth_hz=imu.gyro_bandwidth_hz / s,
        accel_bandwidth_hz=imu.accel_bandwidth_hz / s,
    )


def part_of(recording: Recording, frames: npt.NDArray[np.int64], rate_hz: float | None = None) -> ChangedRecording:
    """Return some frames of a recording, with the IMU from the first of them on.

    Args:
        recording: The recording.
        frames: (M,) Indices of the frames in increasing order.
        rate_hz: Nominal rate of these frames [Hz]; None for that of the recording.
    """
    times_ns, rig = recording.frame_times_ns[frames], recording.rig
    if rate_hz is not None:
        rig = replace(rig, cameras=tuple(replace(camera, rate_hz=rate_hz) for camera in rig.cameras))
    first = max(int(np.searchsorted(recording.imu.t_ns, times_ns[0], side="right")) - 1, 0)

    part = ChangedRecording.of(recording).chosen(frames)
    return replace(part, rig=rig, imu=recording.imu[first:])


def jittered(recording: Recording, sigma_s: float, seed: int = 0) -> ChangedRecording:
    """Return a recording whose frames have time stamps with normally distributed errors [s]."""
    rng = np.random.default_rng(seed)
    times_ns = recording.frame_times_ns
    stamps_ns = times_ns + np.rint(1e9 * sigma_s * rng.standard_normal(len(times_ns))).astype(np.int64)
    return replace(ChangedRecording.of(recording), frame_times_ns=stamps_ns)


def gyro_bias_of(recording: Recording) -> Array:
    """Return the gyroscope bias (3,) of a recording by its ground truth, its median where that has none [rad/s].

    Raises:
        ConfigError: The recording has no ground truth.
    """
    truth = recording.ground_truth
    if truth is None:
        raise ConfigError(f"{recording.name}: no ground truth; expected one, by which the bias is known")
    if truth.gyro_bias_rad_s is not None:
        return np.asarray(truth.gyro_bias_rad_s.mean(axis=0))
    R, t_ns = truth.rotations, truth.t_ns
    rates = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / (np.diff(t_ns) * 1e-9)[:, None]
    middle_ns = t_ns[:-1] + np.diff(t_ns) // 2
    measured = [np.interp(middle_ns, recording.imu.t_ns, axis) for axis in recording.imu.gyro_rad_s.T]
    return np.asarray(np.median(np.column_stack(measured) - rates, axis=0))


def _enlarged(T: Array, s: float) -> Array:
    """Return a transform (4, 4) with lengths s² times as large."""
    enlarged = T.copy()
    enlarged[:3, 3] *= s**2
    return enlarged
