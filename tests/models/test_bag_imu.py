"""IMUs whose accelerometer and gyroscope are on separate topics."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.errors import InputError
from dronevio.models.recordings.bag.file import typestore
from dronevio.models.recordings.bag.messages import header
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.split_imu import interpolated_accel

Make = Callable[..., Any]
IMU = "sensor_msgs/msg/Imu"


def imu_message(t_ns: int, gyro: Any = (0.0, 0.0, 0.0), accel: Any = (0.0, 0.0, 0.0), lacks: str = "") -> Any:
    covariances = {half: np.array([-1.0 if half == lacks else 0.0] + [0.0] * 8) for half in ("gyro", "accel")}
    vector = ros.geometry_msgs__msg__Vector3
    level = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
    return ros.sensor_msgs__msg__Imu(
        header(t_ns, "imu0"),
        level,
        np.zeros(9),
        vector(*gyro),
        covariances["gyro"],
        vector(*accel),
        covariances["accel"],
    )


def save(path: Path, recording: Any, imus: dict[str, list[Any]]) -> Path:
    """Write a recording as a bag with other IMU messages by topic."""
    source = path.with_name("source.mcap")
    write_bag(source, replace(recording, frame_truth=None))
    with Reader(source) as reader, Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for connection, t_ns, raw in reader.messages():
            if connection.topic == "/imu0":
                continue
            if connection.topic not in connections:
                connections[connection.topic] = writer.add_connection(
                    connection.topic, connection.msgtype, typestore=typestore()
                )
            writer.write(connections[connection.topic], t_ns, raw)
        for topic, messages in imus.items():
            added = writer.add_connection(topic, IMU, typestore=typestore())
            for message in messages:
                stamp = message.header.stamp
                writer.write(added, stamp.sec * 10**9 + stamp.nanosec, typestore().serialize_cdr(message, IMU))
    source.unlink()
    return path


def halves(recording: Any, lacks: bool = False) -> tuple[list[Any], list[Any]]:
    """Return messages of a gyroscope at the stamps of the IMU, and of an accelerometer at half of its rate.

    The specific force is linear in time, so that its interpolation is exact.
    """
    t_ns = recording.imu.t_ns
    gyro = [
        imu_message(t, w, lacks="accel" * lacks) for t, w in zip(t_ns.tolist(), recording.imu.gyro_rad_s, strict=True)
    ]
    times = np.arange(t_ns[0] - 3_000_000, t_ns[-1] + 10_000_000, 10_000_000)
    accel = [imu_message(int(t), accel=force(t, t_ns[0]), lacks="gyro" * lacks) for t in times]
    return gyro, accel


def force(t_ns: Any, start_ns: int) -> Any:
    return np.multiply.outer((t_ns - start_ns) * 1e-9, [3.0, -2.0, 1.0]) + [0.1, 0.2, 9.8]


@pytest.mark.parametrize(
    ("topics", "lacks"),
    [
        (("/camera/gyro/sample", "/camera/accel/sample"), False),
        (("/imu/rate", "/imu/force"), False),  # by the halves that are zero
        (("/imu/rate", "/imu/force"), True),  # by the covariances that say so
    ],
)
def test_halves_are_united_at_the_stamps_of_the_gyroscope(
    tmp_path: Path, noise_recording: Make, topics: tuple[str, str], lacks: bool
) -> None:
    recording = noise_recording()
    gyro, accel = halves(recording, lacks)
    path = save(tmp_path / "bag", recording, dict(zip(topics, (gyro, accel), strict=True)))
    chosen = (None, BagTopics(imu=topics), BagTopics(imu=topics[::-1]))
    for read in [open_recording(path, topics=chosen_topics) for chosen_topics in chosen]:
        np.testing.assert_array_equal(read.imu.t_ns, recording.imu.t_ns)
        np.testing.assert_array_equal(read.imu.gyro_rad_s, recording.imu.gyro_rad_s)
        np.testing.assert_allclose(read.imu.accel_m_s2, force(recording.imu.t_ns, recording.imu.t_ns[0]), atol=1e-6)


def test_a_topic_with_both_halves_has_precedence(tmp_path: Path, noise_recording: Make) -> None:
    """As of RealSense cameras that record the united IMU beside its halves."""
    recording = noise_recording()
    gyro, accel = halves(recording)
    both = [imu_message(t, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) for t in recording.imu.t_ns.tolist()]
    topics = {"/camera/gyro/sample": gyro, "/camera/accel/sample": accel, "/camera/imu": both}
    read = open_recording(save(tmp_path / "bag", recording, topics))
    np.testing.assert_array_equal(read.imu.accel_m_s2[5], [4.0, 5.0, 6.0])


def test_missing_halves_are_named(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording()
    gyro, accel = halves(recording, lacks=True)
    only = save(tmp_path / "only", recording, {"/camera/gyro/sample": gyro})
    with pytest.raises(InputError, match="/camera/gyro/sample without an accelerometer; expected two topics"):
        open_recording(only)
    unnamed = save(tmp_path / "unnamed", recording, {"/imu/force": accel})
    with pytest.raises(InputError, match="/imu/force: IMU messages without angular velocity"):
        open_recording(unnamed)
    later = [imu_message(int(t) + 10**12, accel=(0.0, 0.0, 9.8)) for t in recording.imu.t_ns]
    apart = save(tmp_path / "apart", recording, {"/gyro": gyro, "/accel": later})
    with pytest.raises(InputError, match="/gyro and /accel do not overlap in time"):
        open_recording(apart)
    two = save(tmp_path / "two", recording, {"/gyro_a": gyro, "/gyro_b": gyro})
    with pytest.raises(InputError, match="several IMUs, /gyro_a, /gyro_b"):
        open_recording(two)
    with pytest.raises(InputError, match=r"--topics\.imu /gyro_a /gyro_b; expected one IMU, or one gyroscope and one"):
        open_recording(two, topics=BagTopics(imu=("/gyro_a", "/gyro_b")))


def test_nothing_is_invented_in_gaps_of_the_accelerometer() -> None:
    """Samples at 0, 10, 20, 100 and 110 ms: the gap is longer than four intervals of 10 ms."""
    accel_t_ns = np.array([0, 10, 20, 100, 110]) * 1_000_000
    accel = np.outer(np.arange(5.0), [1.0, 0.0, 2.0])
    gyro_t_ns = np.array([-1, 0, 5, 20, 60, 100, 104, 110, 111]) * 1_000_000
    rows, force_at = interpolated_accel(gyro_t_ns, accel_t_ns, accel)
    np.testing.assert_array_equal(rows, [1, 2, 3, 5, 6, 7])
    np.testing.assert_allclose(force_at[:, 0], [0.0, 0.5, 2.0, 3.0, 3.4, 4.0])
    np.testing.assert_allclose(force_at[:, 2], 2.0 * force_at[:, 0])
    shuffled = np.random.default_rng(0).permutation(5)
    again = interpolated_accel(gyro_t_ns, accel_t_ns[shuffled], accel[shuffled])
    np.testing.assert_array_equal(again[1], force_at)
