"""Exports: time stamps since 1970, and IMU samples for programs that hold a sample over the interval before it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.bag.recording import BagRecording
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.euroc import EurocRecording, write_euroc_recording
from dronevio.models.recordings.exported import EPOCH_NS, exported, increments_of_means, interval_means
from dronevio.models.rotation import exp_so3

Make = Callable[..., Any]


def since_start(recording: Any) -> Any:
    """Return a recording whose stamps count from its start, as those of a simulated flight."""
    t0_ns = recording.imu.t_ns[0]
    truth, frames = recording.ground_truth, recording.frame_truth
    return replace(
        recording,
        imu=replace(recording.imu, t_ns=recording.imu.t_ns - t0_ns),
        frame_times_ns=recording.frame_times_ns - t0_ns,
        ground_truth=replace(truth, t_ns=truth.t_ns - t0_ns),
        frame_truth=replace(frames, t_ns=frames.t_ns - t0_ns, exposed_ns=frames.exposed_ns - t0_ns),
    )


def test_stamps_of_simulated_flights_begin_at_the_epoch(tmp_path: Path, noise_recording: Make) -> None:
    flight = since_start(noise_recording())
    export = exported(flight, flight.frame_truth)
    write_euroc_recording(tmp_path / "flight", export, frame_truth=export.frame_truth)
    write_bag(tmp_path / "bag", export, images="png", frame_truth=export.frame_truth)
    for back in (EurocRecording.open(tmp_path / "flight"), BagRecording.open(tmp_path / "bag")):
        assert back.imu.t_ns[0] == EPOCH_NS
        np.testing.assert_array_equal(back.frame_times_ns, flight.frame_times_ns + EPOCH_NS)
        assert back.ground_truth is not None and back.frame_truth is not None
        np.testing.assert_array_equal(back.ground_truth.t_ns, flight.ground_truth.t_ns + EPOCH_NS)
        np.testing.assert_array_equal(back.frame_truth.exposed_ns, flight.frame_truth.exposed_ns + EPOCH_NS)
        frame = back.frame(1)
        assert frame.t_ns == flight.frame_times_ns[1] + EPOCH_NS
        np.testing.assert_array_equal(frame.images[1], flight.frame(1).images[1])
    again = exported(EurocRecording.open(tmp_path / "flight"), None)
    assert again.shift_ns == 0


def test_other_stamps_are_kept(noise_recording: Make) -> None:
    recording = noise_recording()
    assert exported(recording, None).shift_ns == 0
    assert exported(since_start(recording), None, from_epoch=False).shift_ns == 0


def held(samples: ImuSamples, gravity: Array) -> tuple[Array, Array]:
    """Integrate as Basalt does (``IntegratedImuMeasurement::propagateState``): velocity and rotation at the end."""
    R, v = np.eye(3), np.zeros(3)
    dt = np.diff(samples.t_ns, prepend=samples.t_ns[0] - 5_000_000) * 1e-9
    for h, w, a in zip(dt, samples.gyro_rad_s, samples.accel_m_s2, strict=True):
        v = v + (R @ exp_so3(0.5 * h * w) @ a + gravity) * h
        R = R @ exp_so3(h * w)
    return R, v


def test_means_are_integrated_exactly_by_a_held_sample() -> None:
    """On a circle at constant speed the samples turn with the body, and the velocity is known."""
    rate, speed = np.array([0.0, 0.0, 2.0]), 3.0
    t_ns = 5_000_000 * np.arange(201)
    t = t_ns * 1e-9
    accel = np.tile([0.0, 2.0 * speed, 9.81], (201, 1)) + np.outer(np.sin(4.0 * t), [1.0, 0.0, 0.0])
    points = ImuSamples(t_ns, np.tile(rate, (201, 1)), accel)
    means = interval_means(points.increments())
    fine = np.linspace(0.0, 1.0, 200_001)
    world = np.stack([np.cos(2 * fine), np.sin(2 * fine)]) * np.sin(4 * fine)
    world += np.stack([-np.sin(2 * fine), np.cos(2 * fine)]) * 2.0 * speed
    v_true = np.trapezoid(world, fine, axis=1)
    _, v = held(means, np.array([0.0, 0.0, -9.81]))
    _, v_points = held(points[1:], np.array([0.0, 0.0, -9.81]))
    np.testing.assert_allclose(v[:2], v_true, atol=1e-4)
    assert np.linalg.norm(v_points[:2] - v_true) > 3e-3  # a held point is half an interval late
    np.testing.assert_allclose(v[2], 0.0, atol=1e-12)
    np.testing.assert_allclose(increments_of_means(means).accel_m_s2, points.increments().accel_m_s2, atol=1e-12)


def test_means_are_marked_in_folders_and_read_back(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording()
    export = exported(recording, None, "increment")
    assert len(export.imu) == len(recording.imu) - 1
    write_euroc_recording(tmp_path / "flight", export)
    sensor = tmp_path / "flight" / "mav0" / "imu0" / "sensor.yaml"
    assert "\nsampling: increment" in sensor.read_text()
    table = np.loadtxt(sensor.with_name("data.csv"), delimiter=",")
    np.testing.assert_array_equal(table[:, 4:], interval_means(export.imu).accel_m_s2)
    back = EurocRecording.open(tmp_path / "flight").imu
    assert back.sampling == "increment"
    np.testing.assert_array_equal(back.gyro_rad_s, export.imu.gyro_rad_s)
    np.testing.assert_allclose(back.accel_m_s2, export.imu.accel_m_s2, atol=1e-14)
    sensor.write_text(sensor.read_text().replace("sampling: increment", "sampling: often"))
    with pytest.raises(InputError, match="point or increment"):
        EurocRecording.open(tmp_path / "flight")
