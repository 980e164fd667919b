"""Bags of ROS 1: the same recordings as in ROS 2, messages of other programs, and damaged bags."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.stores import ros1_noetic as ros1

from dronevio.models.errors import InputError
from dronevio.models.image_sets import open_images
from dronevio.models.recordings.bag.file import typestore
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.open import open_recording, read_frame_times, read_trajectory
from dronevio.models.rig_presets import rig_named

Make = Callable[..., Any]
NOETIC = get_typestore(Stores.ROS1_NOETIC)
TRANSFORMS = "tf2_msgs/msg/TFMessage"
NOETIC.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
RIG = rig_named("euroc")
T0_NS = 1_700_000_000_123_456_789
STEP_NS = 5_000_000


def write_ros1(
    path: Path, recording: Any, compression: Writer.CompressionFormat | None = None, images: Any = "raw"
) -> Path:
    """Write a recording as a bag of ROS 1: each message of the bag of ROS 2 in the other serialization."""
    source = path.with_name("source.mcap")
    write_bag(source, recording, "mcap", images, frame_truth=recording.frame_truth)
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with Reader(source) as reader, writer:
        connections = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=NOETIC) for c in reader.connections}
        for connection, t_ns, raw in reader.messages():
            writer.write(connections[connection.topic], t_ns, typestore().cdr_to_ros1(raw, connection.msgtype))
    source.unlink()
    return path


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.LZ4, Writer.CompressionFormat.BZ2])
@pytest.mark.parametrize("images", ["raw", "png"])
def test_bags_of_ros_1_hold_the_same_recording(
    tmp_path: Path, noise_recording: Make, assert_same_recording: Make, compression: Any, images: str
) -> None:
    recording = noise_recording()
    path = write_ros1(tmp_path / "a.bag", recording, compression, images)
    assert_same_recording(open_recording(path), recording, order=(0, 1, 3, 2))
    np.testing.assert_array_equal(read_frame_times(path), recording.frame_times_ns)
    np.testing.assert_array_equal(read_trajectory(path).p_world_imu, recording.ground_truth.p_world_imu)
    assert len(open_images(path)) == 4
    assert_same_recording(open_recording(tmp_path), recording)  # the folder of one bag


def header(t_ns: int, frame: str, seq: int) -> Any:
    return ros1.std_msgs__msg__Header(seq, ros1.builtin_interfaces__msg__Time(*divmod(t_ns, 10**9)), frame)


def foreign(samples: int = 8) -> list[tuple[int, str, Any]]:
    """Return messages as a driver of ROS 1 writes them, with counters in their headers and later log times."""
    vector, known = ros1.geometry_msgs__msg__Vector3, np.zeros(9)
    level = ros1.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
    pose = ros1.geometry_msgs__msg__Transform(vector(0.1, 0.2, 0.3), level)
    static = ros1.geometry_msgs__msg__TransformStamped(header(T0_NS, "/imu", 3), "/camera", pose)
    k = RIG.cameras[0].model
    roi = ros1.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, do_rectify=False)
    transforms: Any = NOETIC.types[TRANSFORMS]
    messages: list[tuple[int, str, Any]] = [(T0_NS, "/tf_static", transforms([static]))]
    for i in range(samples):
        t_ns = T0_NS + i * STEP_NS
        rate, force = vector(0.1, 0.2, 0.01 * i), vector(0.0, 0.0, 9.81)
        imu = ros1.sensor_msgs__msg__Imu(header(t_ns, "imu", 77 + i), level, known, rate, known, force, known)
        messages.append((t_ns + 999, "/imu/data", imu))
    for i in range(2):
        t_ns = T0_NS + 3 * i * STEP_NS
        pixels = np.full((k.height, k.width), 10 * i + 7, np.uint8).ravel()
        image = ros1.sensor_msgs__msg__Image(header(t_ns, "camera", i), k.height, k.width, "mono8", 0, k.width, pixels)
        info = ros1.sensor_msgs__msg__CameraInfo(
            header(t_ns, "camera", i),
            k.height,
            k.width,
            "plumb_bob",
            np.array([*k.distortion, 0.0]),
            k.K.ravel(),
            np.eye(3).ravel(),
            np.zeros(12),
            0,
            0,
            roi,
        )
        messages += [(t_ns + 888, "/cam/image_raw", image), (t_ns + 888, "/cam/camera_info", info)]
    return messages


def save(path: Path, messages: list[tuple[int, str, Any]], kinds: dict[str, str] | None = None) -> Path:
    with Writer(path) as writer:
        connections: dict[str, Any] = {}
        for logged_ns, topic, message in sorted(messages, key=lambda m: m[0]):
            kind = message.__msgtype__
            if topic not in connections:
                named = (kinds or {}).get(topic, kind)
                definition, digest = NOETIC.generate_msgdef(kind)
                connections[topic] = writer.add_connection(topic, named, msgdef=definition, md5sum=digest)
            writer.write(connections[topic], logged_ns, NOETIC.serialize_ros1(message, kind))
    return path


@pytest.fixture
def noise_yaml(tmp_path: Path) -> Path:
    (tmp_path / "imu.yaml").write_text(imu_yaml(RIG))
    return tmp_path / "imu.yaml"


def test_messages_of_drivers_are_read(tmp_path: Path, noise_yaml: Path) -> None:
    """Stamps are those of the headers, behind their counters; names of frames may begin with a slash."""
    recording = open_recording(save(tmp_path / "a.bag", foreign()), calibration=[noise_yaml])
    np.testing.assert_array_equal(recording.imu.t_ns, T0_NS + STEP_NS * np.arange(8))
    np.testing.assert_array_equal(recording.imu.gyro_rad_s[3], [0.1, 0.2, 0.03])
    np.testing.assert_array_equal(recording.frame_times_ns, T0_NS + 3 * STEP_NS * np.arange(2))
    assert (recording.frame(1).images[0] == 17).all()
    assert recording.rig.cameras[0].model == RIG.cameras[0].model
    np.testing.assert_array_equal(recording.rig.cameras[0].T_imu_cam[:3, 3], [0.1, 0.2, 0.3])


def test_transforms_of_old_bags_are_read(tmp_path: Path, noise_yaml: Path) -> None:
    """The type tf/tfMessage has another name in newer distributions, and the same contents."""
    path = save(tmp_path / "a.bag", foreign(), {"/tf_static": "tf/msg/tfMessage"})
    np.testing.assert_array_equal(
        open_recording(path, calibration=[noise_yaml]).rig.cameras[0].T_imu_cam[:3, 3], [0.1, 0.2, 0.3]
    )


def test_a_topic_may_have_several_publishers(tmp_path: Path, noise_yaml: Path) -> None:
    messages = foreign()
    with Writer(tmp_path / "a.bag") as writer:
        connections: dict[tuple[str, int], Any] = {}
        for k, (logged_ns, topic, message) in enumerate(sorted(messages, key=lambda m: m[0])):
            key = (topic, k % 2 if topic == "/imu/data" else 0)
            if key not in connections:
                kind = message.__msgtype__
                definition = NOETIC.generate_msgdef(kind)
                connections[key] = writer.add_connection(
                    topic, kind, msgdef=definition[0], md5sum=definition[1], callerid=f"/node{key[1]}"
                )
            raw = NOETIC.serialize_ros1(message, message.__msgtype__)
            writer.write(connections[key], logged_ns, raw)
    assert len(open_recording(tmp_path / "a.bag", calibration=[noise_yaml]).imu) == 8


# --- damage


def changed(path: Path, change: Callable[[bytes], bytes]) -> Path:
    path.write_bytes(change(path.read_bytes()))
    return path


def without_index(content: bytes) -> bytes:
    at = content.index(b"index_pos=") + len(b"index_pos=")
    return content[:at] + struct.pack("<Q", 0) + content[at + 8 :]


def encrypted(content: bytes) -> bytes:
    """Replace the padding of the first record by a field, as a bag with an encryptor has it."""
    start = len(b"#ROSBAG V2.0\n")
    (size,) = struct.unpack_from("<I", content, start)
    field = b"encryptor=aes"
    header = content[start + 4 : start + 4 + size] + struct.pack("<I", len(field)) + field
    rest = content[start + 4 + size :]
    (padding,) = struct.unpack_from("<I", rest)
    added = len(header) - size
    return (
        content[:start]
        + struct.pack("<I", len(header))
        + header
        + struct.pack("<I", padding - added)
        + rest[4 : 4 + padding - added]
        + rest[4 + padding :]
    )


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda content: b"", "seems to be empty"),
        (lambda content: b"hello", "magic is invalid"),
        (lambda content: content.replace(b"V2.0", b"V1.2"), "version 102 is not supported"),
        (without_index, "not indexed"),
        (encrypted, "encryption 'aes' is not supported"),
        (lambda content: content[: len(content) // 2], "a bag that cannot be read"),
        (lambda content: content[:-9], "a bag that cannot be read"),
        (lambda content: content[:20], "a bag that cannot be read"),
    ],
)
def test_damaged_bags_are_refused(
    tmp_path: Path, noise_recording: Make, change: Callable[[bytes], bytes], found: str
) -> None:
    path = changed(write_ros1(tmp_path / "a.bag", noise_recording("euroc")), change)
    with pytest.raises(InputError) as caught:
        open_recording(path)
    assert found in str(caught.value) and caught.value.path == path and "\n" not in str(caught.value)


def test_bags_with_damaged_bytes_are_refused_or_read(tmp_path: Path, noise_recording: Make) -> None:
    recording = replace(noise_recording("euroc", frames=2), frame_truth=None)
    content = write_ros1(tmp_path / "whole.bag", recording).read_bytes()
    rng, path, refused = np.random.default_rng(0), tmp_path / "a.bag", 0
    for _ in range(150):
        damaged = bytearray(content)
        at = int(rng.integers(13, len(content)))
        damaged[at : at + 4] = rng.bytes(4)
        path.write_bytes(damaged)
        try:
            opened = open_recording(path)
            for index in range(len(opened.frame_times_ns)):
                opened.frame(index)
        except InputError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refused > 10


def test_truncated_messages_are_refused(tmp_path: Path, noise_yaml: Path) -> None:
    """A message of another definition with the same name has another size."""
    messages = foreign()
    string = ros1.std_msgs__msg__Header(1, ros1.builtin_interfaces__msg__Time(1, 2), "imu")
    path = save(tmp_path / "a.bag", [*messages, (T0_NS, "/imu2", string)], {"/imu2": "sensor_msgs/msg/Imu"})
    with pytest.raises(InputError, match="a bag that cannot be read"):
        open_recording(path, calibration=[noise_yaml], topics=BagTopics(imu=("/imu2",)))


def test_kalibrs_files_calibrate_a_bag_of_ros_1(tmp_path: Path, noise_yaml: Path) -> None:
    """As those of EuRoC and UZH-FPV, which hold images and IMU alone."""
    (tmp_path / "chain.yaml").write_text(camchain_yaml(RIG))
    kept = [message for message in foreign() if message[1] in ("/imu/data", "/cam/image_raw")]
    recording = open_recording(save(tmp_path / "a.bag", kept), calibration=[noise_yaml, tmp_path / "chain.yaml"])
    np.testing.assert_array_equal(recording.rig.cameras[0].T_imu_cam, RIG.cameras[0].T_imu_cam)
