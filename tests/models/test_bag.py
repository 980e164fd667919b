"""ROS 2 bags: round trip, an independent reader, bags of other programs, and damaged bags."""

import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.defects import DefectKind, count_defects
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.imu_presets import BMI088
from dronevio.models.recordings.bag.file import typestore
from dronevio.models.recordings.bag.messages import camera_info, header, image_message, rig_transforms
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.recording import BagRecording
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.open import open_recording, read_frame_times, read_trajectory
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix
from dronevio.models.state import Trajectory

Make = Callable[..., Any]
T0_NS = 1_700_000_000_123_456_789
STEP_NS = 50_000_000


# --- bags of this package


@pytest.mark.parametrize("images", ["raw", "png"])
@pytest.mark.parametrize(
    ("name", "storage"), [("a.mcap", "mcap"), ("folder", "mcap"), ("a.db3", "sqlite3"), ("old", "sqlite3")]
)
def test_round_trip_is_exact(
    tmp_path: Path, noise_recording: Make, assert_same_recording: Make, name: str, storage: Any, images: Any
) -> None:
    recording = noise_recording()
    calls: list[tuple[int, int]] = []
    write_bag(tmp_path / name, recording, storage, images, lambda *call: calls.append(call), recording.frame_truth)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    assert calls == [(done, 4) for done in range(5)]
    back = open_recording(tmp_path / name)
    assert isinstance(back, BagRecording) and back.complete
    assert back.name == Path(name).stem
    assert_same_recording(back, recording, order=(0, 1, 2, 3, 1, 0, 3, 3, 2))  # also in another order


@pytest.mark.parametrize("rig", RIGS)
def test_round_trip_of_every_rig_is_exact(
    tmp_path: Path, noise_recording: Make, assert_same_recording: Make, rig: str
) -> None:
    recording = replace(noise_recording(rig, sampling="increment"), frame_truth=None)
    write_bag(tmp_path / "a.mcap", recording)
    assert_same_recording(BagRecording.open(tmp_path / "a.mcap"), recording)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_round_trip_of_arbitrary_numbers_is_exact(
    tmp_path_factory: pytest.TempPathFactory, noise_recording: Make, assert_same_recording: Make, data: st.DataObject
) -> None:
    finite = st.floats(allow_nan=False, allow_infinity=False)
    t_ns = np.array(sorted(data.draw(st.sets(st.integers(0, 2**31 * 10**9 - 1), min_size=1, max_size=5))))
    gyro, accel, p, v, b = (data.draw(hnp.arrays(np.float64, (len(t_ns), 3), elements=finite)) for _ in range(5))
    quat_wxyz = np.tile([0.6, 0.0, -0.8, 0.0], (len(t_ns), 1))
    recording = replace(
        noise_recording("euroc"),
        imu=ImuSamples(t_ns, gyro, accel),
        frame_times_ns=t_ns,
        ground_truth=Trajectory(t_ns, p, quat_wxyz, v, b, b),
        frame_truth=None,
    )
    path = tmp_path_factory.getbasetemp() / "any.mcap"
    with np.errstate(over="ignore", invalid="ignore"):  # the twist of velocities of 1e308 m/s
        write_bag(path, recording, overwrite=True)
    assert_same_recording(BagRecording.open(path), recording)


def test_ground_truth_may_lack_velocities_or_be_missing(
    tmp_path: Path, noise_recording: Make, assert_same_recording: Make
) -> None:
    whole = noise_recording()
    poses = Trajectory(whole.ground_truth.t_ns, whole.ground_truth.p_world_imu, whole.ground_truth.quat_wxyz)
    for name, truth in (("poses.mcap", poses), ("none.mcap", None)):
        recording = replace(whole, ground_truth=truth, frame_truth=None)
        write_bag(tmp_path / name, recording)
        assert_same_recording(BagRecording.open(tmp_path / name), recording)
    with pytest.raises(InputError, match="no ground truth"):
        read_trajectory(tmp_path / "none.mcap")


def test_trajectory_and_frame_times_can_be_read_alone(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording()
    write_bag(tmp_path / "bag", recording)
    np.testing.assert_array_equal(read_trajectory(tmp_path / "bag").p_world_imu, recording.ground_truth.p_world_imu)
    np.testing.assert_array_equal(read_frame_times(tmp_path / "bag"), recording.frame_times_ns)


def test_the_first_camera_can_be_selected(tmp_path: Path, noise_recording: Make) -> None:
    write_bag(tmp_path / "a.mcap", noise_recording())
    recording = open_recording(tmp_path / "a.mcap", cameras=1)
    assert len(recording.rig.cameras) == len(recording.frame(0).images) == 1


def test_an_independent_reader_finds_standard_messages(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording()
    write_bag(tmp_path / "bag", recording)
    seen: dict[str, list[Any]] = {}
    with AnyReader([tmp_path / "bag"]) as reader:
        last_ns = 0
        for connection, logged_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert logged_ns >= last_ns
            last_ns = logged_ns
            if hasattr(message, "header"):
                stamp = message.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == logged_ns
            seen.setdefault(connection.topic, []).append(message)
    assert {topic: len(messages) for topic, messages in seen.items()} == {
        "/calibration": 1,
        "/tf_static": 1,
        "/tf": 40,
        "/imu0": 40,
        "/groundtruth/odometry": 40,
        "/groundtruth/velocity": 40,
        "/groundtruth/gyro_bias": 40,
        "/groundtruth/accel_bias": 40,
        **{f"/cam{i}/{what}": 4 for i in (0, 1) for what in ("image_raw", "camera_info")},
    }
    imu, rig, truth = seen["/imu0"][7], recording.rig, recording.ground_truth
    assert imu.orientation_covariance[0] == -1.0  # no orientation
    np.testing.assert_allclose(imu.angular_velocity_covariance[0], 200.0 * rig.imu.gyro_noise_density**2)
    image, info = seen["/cam1/image_raw"][2], seen["/cam1/camera_info"][2]
    assert (image.encoding, image.step, image.height) == ("mono8", 32, 24)
    np.testing.assert_array_equal(image.data.reshape(24, 32), recording.frame(2).images[1])
    np.testing.assert_array_equal(info.k.reshape(3, 3), rig.cameras[1].model.K)
    assert info.distortion_model == "plumb_bob" and tuple(info.d) == (*rig.cameras[1].model.distortion, 0.0)
    odometry = seen["/groundtruth/odometry"][5]
    R = truth.rotations[5]
    v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
    np.testing.assert_allclose(R @ [v.x, v.y, v.z], truth.velocity_m_s[5], atol=1e-12)
    R_next = R @ cv2.Rodrigues(np.array([w.x, w.y, w.z]) * 5e-3)[0]
    np.testing.assert_allclose(R_next, truth.rotations[6], atol=1e-9)
    links = {tf.child_frame_id: tf for tf in (*seen["/tf_static"][0].transforms, *seen["/tf"][5].transforms)}
    T_world_cam1 = pose_of_transform(links["imu0"]) @ pose_of_transform(links["cam1"])
    np.testing.assert_allclose(T_world_cam1, truth.Ts_world_imu[5] @ rig.cameras[1].T_imu_cam, atol=1e-9)
    T_imu_vehicle = pose_of_transform(links["base_link"])
    np.testing.assert_allclose(T_imu_vehicle @ rig.T_vehicle_imu, np.eye(4), atol=1e-12)


def pose_of_transform(stamped: Any) -> Array:
    p, q = stamped.transform.translation, stamped.transform.rotation
    return pose_matrix(matrix_from_quat_wxyz(np.array([q.w, q.x, q.y, q.z])), np.array([p.x, p.y, p.z]))


def test_evo_reads_the_ground_truth(tmp_path: Path, noise_recording: Make) -> None:
    from evo.tools.file_interface import read_bag_trajectory

    recording = noise_recording()
    write_bag(tmp_path / "bag", recording)
    with Reader(tmp_path / "bag") as reader:
        theirs = read_bag_trajectory(reader, "/groundtruth/odometry")
    np.testing.assert_array_equal(theirs.positions_xyz, recording.ground_truth.p_world_imu)
    np.testing.assert_array_equal(theirs.orientations_quat_wxyz, recording.ground_truth.quat_wxyz)


def test_memory_does_not_grow_with_the_recording(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording(frames=60)
    large = replace(recording.rig.cameras[0], model=replace(recording.rig.cameras[0].model, width=752, height=480))
    recording = replace(recording, rig=replace(recording.rig, cameras=(large,)))
    write_bag(tmp_path / "warm.mcap", noise_recording())
    tracemalloc.start()
    try:
        write_bag(tmp_path / "a.mcap", recording)
        back = BagRecording.open(tmp_path / "a.mcap")
        for index in range(60):
            back.frame(index)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (tmp_path / "a.mcap").stat().st_size > 20e6
    assert peak < 12e6


class InterruptedOnceError(Exception):
    pass


def test_writing_is_atomic(tmp_path: Path, noise_recording: Make) -> None:
    class Interrupted:
        """A recording whose third frame raises an exception."""

        def __init__(self, recording: Any) -> None:
            self._recording = recording

        def __getattr__(self, name: str) -> Any:
            return getattr(self._recording, name)

        def frame(self, index: int) -> Any:
            if index == 2:
                raise InterruptedOnceError
            return self._recording.frame(index)

    interrupted: Any = Interrupted(noise_recording())
    for name in ("a.mcap", "bag"):
        with pytest.raises(InterruptedOnceError):
            write_bag(tmp_path / "deep" / name, interrupted)
    assert list((tmp_path / "deep").iterdir()) == []


def test_only_bags_are_replaced_and_only_on_request(
    tmp_path: Path, noise_recording: Make, assert_same_recording: Make
) -> None:
    recording = replace(noise_recording(), frame_truth=None)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "dear.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name in ("a.mcap", "bag"):
        write_bag(tmp_path / name, noise_recording(frames=2))
        with pytest.raises(InputError, match="exists already"):
            write_bag(tmp_path / name, recording)
        write_bag(tmp_path / name, recording, overwrite=True)
        assert_same_recording(BagRecording.open(tmp_path / name), recording)
    for name in ("notes", "file"):
        with pytest.raises(InputError, match="not a bag"):
            write_bag(tmp_path / name, recording, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "bag", "file", "notes"]


@pytest.mark.parametrize("t_ns", [-1, 2**31 * 10**9])
def test_times_outside_the_range_of_ros_are_refused(tmp_path: Path, noise_recording: Make, t_ns: int) -> None:
    imu = ImuSamples(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(ConfigError, match=str(t_ns)):
        write_bag(tmp_path / "a.mcap", replace(noise_recording(), imu=imu))
    assert list(tmp_path.iterdir()) == []


# --- bags of other programs

RIG = replace(rig_named("euroc-stereo"), imu=rig_named("fisheye").imu)


def noise_image(seed: int, *shape: int) -> Image:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


IMAGE = noise_image(3, 480, 752)


def imu_message(t_ns: int, frame: str = "imu_link") -> Any:
    known = np.zeros(9)
    return ros.sensor_msgs__msg__Imu(
        header(t_ns, frame),
        ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0),
        known,
        ros.geometry_msgs__msg__Vector3(0.1, 0.2, 0.3),
        known,
        ros.geometry_msgs__msg__Vector3(0.0, 0.0, 9.81),
        known,
    )


def foreign(frames: int = 3, lag_ns: int = 0, prefix: str = "/camera", infos: bool = True) -> Iterator[Any]:
    """Yield a stereo flight as a driver records it, with later log times and other names of topics and frames."""
    delay_ns = 7_000_000
    static = rig_transforms(RIG, T0_NS)
    for transform in static.transforms:
        transform.header.frame_id = "imu_link"
        transform.child_frame_id += "_optical"
    yield T0_NS, "/tf_static", static
    for k in range(10 * frames):
        yield T0_NS + k * STEP_NS // 10 + delay_ns, "/imu/data", imu_message(T0_NS + k * STEP_NS // 10)
    for k in range(frames):
        for i, camera in enumerate(RIG.cameras):
            t_ns = T0_NS + k * STEP_NS + i * lag_ns
            image = np.roll(IMAGE, 10 * k + i)
            yield t_ns + delay_ns, f"{prefix}{i}/image", image_message(image, t_ns, f"cam{i}_optical", png=False)
            if infos:
                info = camera_info(camera.model, t_ns, f"cam{i}_optical")
                yield t_ns + delay_ns, f"{prefix}{i}/camera_info", info


def save(path: Path, messages: Iterator[Any] | list[Any], little_endian: bool = True, **compression: Any) -> Path:
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for logged_ns, topic, message in messages:
            msgtype = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=typestore())
            raw = typestore().serialize_cdr(message, msgtype, little_endian=little_endian)
            writer.write(connections[topic], logged_ns, raw)
    return path


@pytest.fixture
def noise_yaml(tmp_path: Path) -> Path:
    (tmp_path / "imu.yaml").write_text(imu_yaml(RIG))
    return tmp_path / "imu.yaml"


@pytest.fixture
def chain_yaml(tmp_path: Path) -> Path:
    (tmp_path / "chain.yaml").write_text(camchain_yaml(RIG).replace("rate_hz", "no_rate_hz"))
    return tmp_path / "chain.yaml"


def assert_same_rig(ours: Rig, atol: float) -> None:
    assert ours.imu == RIG.imu
    for a, b in zip(ours.cameras, RIG.cameras, strict=True):
        assert a.model == b.model and a.rate_hz == b.rate_hz
        np.testing.assert_allclose(a.T_imu_cam, b.T_imu_cam, atol=atol)


@pytest.mark.parametrize("little_endian", [True, False])
def test_bags_with_camera_info_and_tf_need_imu_noise_only(
    tmp_path: Path, noise_yaml: Path, little_endian: bool
) -> None:
    path = save(tmp_path / "bag", foreign(), little_endian)
    with pytest.raises(InputError, match="no noise densities"):
        open_recording(path)
    recording = open_recording(path, calibration=[noise_yaml])
    assert_same_rig(recording.rig, 1e-6)  # published rotations are orthonormal up to 1e-6
    np.testing.assert_array_equal(recording.frame_times_ns, T0_NS + STEP_NS * np.arange(3))  # of the headers
    np.testing.assert_array_equal(recording.imu.t_ns, T0_NS + STEP_NS // 10 * np.arange(30))
    np.testing.assert_array_equal(recording.imu.gyro_rad_s[4], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(recording.frame(2).images[1], np.roll(IMAGE, 21))
    assert recording.ground_truth is None


def test_kalibrs_files_complete_the_calibration(tmp_path: Path, noise_yaml: Path, chain_yaml: Path) -> None:
    path = save(tmp_path / "bag", foreign(infos=False))
    with pytest.raises(InputError, match=r"without /camera0/camera_info.*camchain"):
        open_recording(path, calibration=[noise_yaml])
    assert_same_rig(open_recording(path, calibration=[chain_yaml, noise_yaml]).rig, 0.0)
    with pytest.raises(ConfigError, match="for bags"):
        open_recording(tmp_path, topics=BagTopics(imu=("/imu0",)))


def test_all_missing_parts_are_named_at_once(tmp_path: Path) -> None:
    bag = save(tmp_path / "bag", without("/tf_static"))
    with pytest.raises(InputError, match="3 parts are missing") as caught:
        BagRecording.open(bag)
    message = str(caught.value)
    assert "(1) no noise densities of the IMU; expected Kalibr's imu.yaml (--calibration imu.yaml)" in message
    assert "--imu BMI088" in message and message.count(str(bag)) == 1
    assert "(2) no transform from 'imu_link' to 'cam0_optical'" in message and "--calibration camchain.yaml" in message
    without_imu = [each for each in foreign(infos=False) if each[1] != "/imu/data"]
    with pytest.raises(InputError, match=r"4 parts are missing: \(1\) no IMU among.*\(2\) no noise densities.*"):
        BagRecording.open(save(tmp_path / "less", without_imu))


def test_a_named_imu_supplies_unknown_noise(tmp_path: Path) -> None:
    """The rate is that of the samples, which are 5 ms apart."""
    recording = open_recording(save(tmp_path / "bag", foreign()), imu=BMI088)
    assert recording.rig.imu.gyro_noise_density == BMI088.gyro_noise_density
    assert recording.rig.imu.rate_hz == pytest.approx(1e9 / float(np.median(np.diff(recording.imu.t_ns))))
    assert recording.rig.imu.rate_hz != BMI088.rate_hz


def test_images_are_synchronized_within_a_tolerance(tmp_path: Path, noise_yaml: Path) -> None:
    path = save(tmp_path / "bag", foreign(4, lag_ns=300_000))
    recording = BagRecording.open(path, calibration=[noise_yaml])
    np.testing.assert_array_equal(recording.frame_times_ns, T0_NS + STEP_NS * np.arange(4))
    np.testing.assert_array_equal(recording.frame(3).images[1], np.roll(IMAGE, 31))
    with pytest.raises(InputError, match=r"closer in time than 0\.0003 s"):
        BagRecording.open(path, calibration=[noise_yaml], sync_tolerance_s=1e-4)
    gone = [m for m in foreign(4) if m[:2] != (T0_NS + STEP_NS + 7_000_000, "/camera1/image")]
    kept = open_recording(save(tmp_path / "gone", gone), calibration=[noise_yaml])
    np.testing.assert_array_equal(kept.frame_times_ns, T0_NS + STEP_NS * np.array([0, 2, 3]))
    np.testing.assert_array_equal(kept.frame(1).images[1], np.roll(IMAGE, 21))


COLOUR = noise_image(4, 480, 752, 3)


@pytest.mark.parametrize(
    ("encoding", "pixels", "grey"),
    [
        ("mono8", IMAGE, IMAGE),
        ("8UC1", IMAGE, IMAGE),
        ("bgr8", COLOUR, cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)),
        ("rgb8", COLOUR, cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)),
        ("rgba8", np.dstack([COLOUR, IMAGE]), cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_all_eight_bit_encodings_are_read(
    tmp_path: Path,
    noise_yaml: Path,
    chain_yaml: Path,
    encoding: str,
    pixels: Image,
    grey: Image,
    padding: int,
) -> None:
    rows = np.pad(pixels.reshape(480, -1), ((0, 0), (0, padding)))
    message = ros.sensor_msgs__msg__Image(header(T0_NS, "c"), 480, 752, encoding, 0, rows.shape[1], rows.ravel())
    path = save(tmp_path / "bag", [(T0_NS, "/i", message), (T0_NS, "/imu", imu_message(T0_NS))])
    with pytest.raises(InputError, match="1 topics with images, /i, for the 2 cameras"):
        open_recording(path, calibration=[noise_yaml, chain_yaml])
    chosen = BagTopics(images=("/i",))
    np.testing.assert_array_equal(
        open_recording(path, calibration=[noise_yaml, chain_yaml], topics=chosen).frame(0).images[0], grey
    )


@pytest.mark.parametrize("big", [False, True])
def test_images_of_12_bits_fill_the_range(tmp_path: Path, noise_yaml: Path, chain_yaml: Path, big: bool) -> None:
    """Of 16 bits, 12 are used in the topic, if not in each image; the upper eight of these are the grey level."""
    numbers = np.random.default_rng(0).integers(0, 4096, (480, 752)).astype(">u2" if big else "<u2")
    messages: list[Any] = [(T0_NS, "/imu", imu_message(T0_NS))]
    for k, pixels in enumerate((numbers // 16, numbers)):
        t_ns = T0_NS + k * STEP_NS
        data = pixels.astype(numbers.dtype).view(np.uint8).ravel()
        image = ros.sensor_msgs__msg__Image(header(t_ns, "c"), 480, 752, "mono16", int(big), 2 * 752, data)
        messages.append((t_ns, "/i", image))
    path, files = save(tmp_path / "bag", messages), [noise_yaml, chain_yaml]
    for order in ((0, 1), (1, 0)):
        recording = open_recording(path, calibration=files, topics=BagTopics(images=("/i",)))
        found = {k: recording.frame(k).images[0] for k in order}
        np.testing.assert_array_equal(found[0], numbers // 16 // 16)
        np.testing.assert_array_equal(found[1], numbers // 16)


def compressed(data: bytes, form: str = "jpeg") -> Any:
    return ros.sensor_msgs__msg__CompressedImage(header(T0_NS, "c"), form, np.frombuffer(data, np.uint8))


def raw_image(**changes: Any) -> Any:
    message = image_message(IMAGE, T0_NS, "c", png=False)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_raw_images_have_precedence(tmp_path: Path, noise_yaml: Path, chain_yaml: Path) -> None:
    """If a camera has raw and compressed images, the raw ones are read."""
    jpeg = cv2.imencode(".jpg", IMAGE)[1].tobytes()
    imu = (T0_NS, "/imu", imu_message(T0_NS))
    files = [noise_yaml, chain_yaml]
    lossy = [(T0_NS, f"/c{i}/image/compressed", compressed(jpeg)) for i in (0, 1)]
    recording = open_recording(save(tmp_path / "lossy", [imu, *lossy]), calibration=files)
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(recording.frame(0).images[1], decoded)
    both = [imu, *lossy, *((T0_NS, f"/c{i}/image", raw_image()) for i in (0, 1))]
    np.testing.assert_array_equal(
        open_recording(save(tmp_path / "both", both), calibration=files).frame(0).images[1], IMAGE
    )


@pytest.mark.parametrize(
    ("message", "found"),
    [
        (raw_image(encoding="16UC1"), "encoding '16UC1'"),
        (raw_image(encoding="bayer_magic8"), "encoding 'bayer_magic8'"),
        (raw_image(width=751), "751 × 480 px"),
        (raw_image(step=751), "rows of 751"),
        (raw_image(data=IMAGE.ravel()[:-1]), "360959 bytes"),
        (raw_image(encoding="rgb8"), "rows of 752"),
        (compressed(b""), "an empty file"),
        (compressed(b"nonsense"), "data that cannot be decoded"),
        (compressed(cv2.imencode(".png", IMAGE)[1].tobytes()[:-9]), "truncated"),
        (compressed(cv2.imencode(".png", IMAGE[:, 1:])[1].tobytes()), "751 × 480 px"),
    ],
)
def test_unusable_images_are_named(
    tmp_path: Path, noise_yaml: Path, chain_yaml: Path, message: Any, found: str
) -> None:
    path = save(tmp_path / "bag", [(T0_NS, "/i", message), (T0_NS, "/imu", imu_message(T0_NS))])
    recording = open_recording(path, calibration=[noise_yaml, chain_yaml], topics=BagTopics(images=("/i",)))
    with pytest.raises(InputError) as caught:
        recording.frame(0)
    assert caught.value.path == path and found in str(caught.value) and f"/i at {T0_NS} ns" in str(caught.value)


def test_depth_images_are_not_cameras(tmp_path: Path, noise_yaml: Path) -> None:
    depth: Any = image_message(IMAGE[:10, :20], T0_NS, "d", png=False)
    depth.encoding = "16UC1"
    path = save(tmp_path / "bag", [*foreign(), (T0_NS, "/aaa/depth", depth)])
    recording = open_recording(path, calibration=[noise_yaml])
    assert isinstance(recording, BagRecording) and recording.topics.images == ("/camera0/image", "/camera1/image")


def without(topic: str, *more: Any) -> list[Any]:
    return [m for m in foreign() if m[1] != topic] + list(more)


def changed(change: Callable[[Any], None], topic: str) -> list[Any]:
    messages = list(foreign())
    for _, name, message in messages:
        if name == topic:
            change(message)
    return messages


def duplicate_imu() -> Any:
    return T0_NS + 9, "/imu/data", imu_message(T0_NS)


def other_imu() -> Any:
    return T0_NS, "/imu2", imu_message(T0_NS)


def set_nan(message: Any) -> None:
    message.angular_velocity.x = np.nan


def set_no_gyro(message: Any) -> None:
    message.angular_velocity_covariance = np.array([-1.0] + [0.0] * 8)


@pytest.mark.parametrize(
    ("messages", "topics", "found"),
    [
        (without("/imu/data"), None, "no IMU among the topics"),
        ([m for m in foreign() if "/image" not in m[1]], None, "no camera among the topics"),
        (without("", other_imu()), None, "several IMUs, /imu/data, /imu2"),
        (without("/tf_static"), None, "no transform from 'imu_link' to 'cam0_optical'"),
        (without("", duplicate_imu()), None, f"/imu/data: two messages of {T0_NS} ns"),
        (list(foreign()), BagTopics(imu=("/nowhere",)), "no topic /nowhere; expected one of /imu/data"),
        (list(foreign()), BagTopics(imu=("/tf_static",)), "/tf_static with messages of tf2_msgs/msg/TFMessage"),
        (list(foreign()), BagTopics(images=("/camera0/camera_info",)), "with messages of sensor_msgs/msg/CameraInfo"),
        (changed(set_nan, "/imu/data"), None, "non-finite"),
        (changed(set_no_gyro, "/imu/data"), None, "without angular velocity"),
        (changed(lambda m: m.k.fill(0.0), "/camera1/camera_info"), None, "/camera1/camera_info: CameraModel.fx = 0.0"),
        (changed(lambda m: setattr(m, "distortion_model", "magic"), "/camera1/camera_info"), None, "'magic'"),
        (changed(lambda m: setattr(m, "d", np.ones(12)), "/camera1/camera_info"), None, "followed by zeros"),
        (changed(lambda m: setattr(m.transforms[1].transform.rotation, "w", 9.0), "/tf_static"), None, "of length 9"),
    ],
)
def test_errors_name_the_missing_topic(
    tmp_path: Path, noise_yaml: Path, messages: list[Any], topics: BagTopics | None, found: str
) -> None:
    path = save(tmp_path / "bag", messages)
    with pytest.raises(InputError) as caught:
        open_recording(path, calibration=[noise_yaml], topics=topics)
    assert found in str(caught.value) and "\n" not in str(caught.value)


def test_topics_can_be_selected(tmp_path: Path, noise_yaml: Path) -> None:
    path = save(tmp_path / "bag", without("", other_imu()))
    topics = BagTopics(images=("/camera1/image",), imu=("/imu/data",))
    recording = open_recording(path, calibration=[noise_yaml], topics=topics)
    np.testing.assert_array_equal(recording.frame(1).images[0], np.roll(IMAGE, 11))
    np.testing.assert_allclose(recording.rig.cameras[0].T_imu_cam, RIG.cameras[1].T_imu_cam, atol=1e-6)


def poses_of(kind: str, topic: str) -> Iterator[Any]:
    """Yield three poses as messages of a kind, with the velocity (1, 0, 0) in the body frame for odometry."""
    position, q = ros.geometry_msgs__msg__Point(1.0, 2.0, 3.0), ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.6, 0.8)
    pose, covariance = ros.geometry_msgs__msg__Pose(position, q), np.zeros(36)
    twist = ros.geometry_msgs__msg__Twist(
        ros.geometry_msgs__msg__Vector3(1.0, 0.0, 0.0), ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0)
    )
    for k in range(3):
        h = header(T0_NS + k * STEP_NS, "map")
        message: Any
        if kind == "odometry":
            pose_estimate = ros.geometry_msgs__msg__PoseWithCovariance(pose, covariance)
            twist_estimate = ros.geometry_msgs__msg__TwistWithCovariance(twist, covariance)
            message = ros.nav_msgs__msg__Odometry(h, "imu_link", pose_estimate, twist_estimate)
        elif kind == "pose":
            message = ros.geometry_msgs__msg__PoseStamped(h, pose)
        else:
            transform = ros.geometry_msgs__msg__Transform(ros.geometry_msgs__msg__Vector3(1.0, 2.0, 3.0), q)
            message = ros.geometry_msgs__msg__TransformStamped(h, "imu_link", transform)
        yield h.stamp.nanosec, topic, message


@pytest.mark.parametrize("kind", ["odometry", "pose", "transform"])
def test_ground_truth_is_found_by_topic_name(tmp_path: Path, noise_yaml: Path, kind: str) -> None:
    files = [noise_yaml]
    named = save(tmp_path / "named", [*foreign(), *poses_of(kind, "/vicon/drone")])
    truth = open_recording(named, calibration=files).ground_truth
    assert truth is not None
    np.testing.assert_array_equal(truth.p_world_imu[1], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(truth.quat_wxyz[1], [0.8, 0.0, 0.0, 0.6])
    if kind == "odometry":  # whose velocity is in the body frame
        assert truth.velocity_m_s is not None
        np.testing.assert_allclose(truth.velocity_m_s[1], [0.28, 0.96, 0.0])
    else:
        assert truth.velocity_m_s is None
    unknown = save(tmp_path / "unknown", [*foreign(), *poses_of(kind, "/odom")])
    assert open_recording(unknown, calibration=files).ground_truth is None  # may be an estimate
    chosen = open_recording(unknown, calibration=files, topics=BagTopics(truth="/odom"))
    assert chosen.ground_truth is not None and len(chosen.ground_truth) == 3


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE, CompressionMode.STORAGE])
def test_compressed_bags_are_read(tmp_path: Path, noise_yaml: Path, mode: CompressionMode) -> None:
    writer = Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for logged_ns, topic, message in foreign():
            msgtype = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=typestore())
            writer.write(connections[topic], logged_ns, typestore().serialize_cdr(message, msgtype))
    recording = open_recording(tmp_path / "bag", calibration=[noise_yaml])
    np.testing.assert_array_equal(recording.frame(2).images[1], np.roll(IMAGE, 21))


# --- damaged bags


def refused_or_read(path: Path) -> bool:
    """Open a bag and read its frames; return whether it is refused, and check the recording if not."""
    try:
        recording = open_recording(path)
        frames = [recording.frame(index) for index in range(len(recording.frame_times_ns))]
    except InputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return True
    assert all(frame.images[0].shape == (24, 32) for frame in frames)
    assert np.all(np.diff(recording.frame_times_ns) > 0)
    assert np.isfinite(recording.imu.gyro_rad_s).all() and np.isfinite(recording.imu.accel_m_s2).all()
    assert recording.rig.imu.gyro_noise_density > 0.0
    return False


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, noise_recording: Make) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    recording = noise_recording("euroc", frames=2)
    write_bag(folder / "a.mcap", recording)
    write_bag(folder / "a.db3", recording, "sqlite3", "png")
    return folder


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(["a.mcap", "a.db3"]),
    kind=st.sampled_from(["truncate", "flip", "overwrite", "insert"]),
    share=st.floats(0.0, 1.0, exclude_max=True),
    damage=st.binary(min_size=16, max_size=64),
)
def test_damaged_bags_are_refused_or_read(
    scratch: Path, whole: Path, name: str, kind: str, share: float, damage: bytes
) -> None:
    content = bytearray((whole / name).read_bytes())
    where = int(share * len(content))
    if kind == "truncate":
        del content[where:]
    elif kind == "flip":
        content[where] ^= damage[0] or 1
    elif kind == "overwrite":
        content[where : where + len(damage)] = damage
    else:
        content[where:where] = damage
    (scratch / name).write_bytes(content)
    refused = refused_or_read(scratch / name)
    assert refused or kind != "truncate"


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_metadata_is_refused_or_read(
    tmp_path_factory: pytest.TempPathFactory, noise_recording: Make, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp() / "described"
    if not folder.exists():
        write_bag(folder, noise_recording("euroc", frames=2))
        (folder.with_name("described.yaml")).write_bytes((folder / "metadata.yaml").read_bytes())
    text = folder.with_name("described.yaml").read_text()
    start, length = data.draw(st.integers(0, len(text))), data.draw(st.integers(0, 30))
    inserted = data.draw(st.text("ab:[]{},# \n-%\"'&*!../0.1e", max_size=6))
    (folder / "metadata.yaml").write_text(text[:start] + inserted + text[start + length :])
    refused_or_read(folder)


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda p: None, "no such file"),
        (lambda p: p.write_bytes(b""), "seems to be empty"),
        (lambda p: p.write_bytes(b"hello"), "magic is invalid"),
        (lambda p: p.mkdir(), "metadata.yaml"),
        (lambda p: (p.mkdir(), (p / "metadata.yaml").write_text("a: 1")), "key is missing"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, make: Callable[[Path], object], found: str) -> None:
    path = tmp_path / "a.mcap"
    make(path)
    with pytest.raises(InputError) as caught:
        BagRecording.open(path)
    assert found in str(caught.value) and caught.value.path == path


@pytest.mark.parametrize("topic", ["/imu0", "/groundtruth/odometry", "/cam0/image_raw"])
def test_metadata_with_missing_topics_is_refused(tmp_path: Path, noise_recording: Make, topic: str) -> None:
    write_bag(tmp_path / "bag", noise_recording())
    renamed = topic.replace("/", "/vicon_", 1)
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    (tmp_path / "bag" / "metadata.yaml").write_text(text.replace(topic, renamed))
    with pytest.raises(InputError, match="no messages"):
        BagRecording.open(tmp_path / "bag", topics=BagTopics(images=(renamed,) if "image" in topic else ()))


def test_metadata_cannot_refer_outside_its_folder(tmp_path: Path, noise_recording: Make) -> None:
    write_bag(tmp_path / "secret.mcap", noise_recording())
    write_bag(tmp_path / "bag", noise_recording())
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    (tmp_path / "bag" / "metadata.yaml").write_text(text.replace("- bag.mcap", "- ../secret.mcap"))
    with pytest.raises(InputError, match="missing"):
        BagRecording.open(tmp_path / "bag")


def test_folders_without_metadata_are_read(tmp_path: Path, noise_recording: Make, assert_same_recording: Make) -> None:
    recording = replace(noise_recording(), frame_truth=None)
    write_bag(tmp_path / "bag", recording)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert_same_recording(open_recording(tmp_path / "bag"), recording)


def test_damaged_calibration_in_a_bag_is_named(tmp_path: Path, noise_recording: Make) -> None:
    text = ros.std_msgs__msg__String("cam0: [")
    path = save(tmp_path / "bag", [*foreign(), (T0_NS, "/calibration", text)])
    with pytest.raises(InputError, match="bag:/calibration:1"):
        open_recording(path)


def test_images_of_another_size_are_refused(tmp_path: Path, noise_recording: Make) -> None:
    write_bag(tmp_path / "a.mcap", noise_recording("euroc"))
    recording = BagRecording.open(tmp_path / "a.mcap")
    other = replace(recording.rig.cameras[0], model=CameraModel(33, 24, 20.0, 20.0, 16.0, 12.0))
    with pytest.raises(InputError, match="32 × 24"):
        replace(recording, rig=Rig((other,))).frame(0)


def test_defects_of_bags_are_counted_and_survived(tmp_path: Path, noise_yaml: Path) -> None:
    """A sample twice, two in the wrong order, one not finite, an image twice, one missing, one damaged."""
    messages = list(foreign(5))
    imu = [k for k, message in enumerate(messages) if message[1] == "/imu/data"]
    times, topics, contents = (list(column) for column in zip(*messages, strict=True))
    contents[imu[20]], contents[imu[21]] = contents[imu[21]], contents[imu[20]]
    set_nan(contents[imu[9]])
    second = [k for k, topic in enumerate(topics) if topic == "/camera1/image"]
    contents[second[3]].data = contents[second[3]].data[:-1]
    topics[second[1]] = "/elsewhere"
    messages = list(zip(times, topics, contents, strict=True))
    messages += [(T0_NS + 9, "/imu/data", imu_message(T0_NS)), messages[second[0]]]
    path = save(tmp_path / "bag", messages)
    images = ("/camera0/image", "/camera1/image")
    recording = BagRecording.open(path, calibration=[noise_yaml], topics=BagTopics(images=images), repair=True)
    frames = [recording.frame(k) for k in range(5)]
    defects = (*recording.defects, *(defect for frame in frames for defect in frame.defects))
    assert {found.kind: found.count for found in count_defects(defects)} == dict.fromkeys(
        (
            DefectKind.DAMAGED_IMAGE,
            DefectKind.UNPAIRED_IMAGE,
            DefectKind.DUPLICATE_IMAGE_STAMP,
            DefectKind.DUPLICATE_IMU_STAMP,
            DefectKind.UNORDERED_IMU_STAMP,
            DefectKind.NON_FINITE_IMU_SAMPLE,
        ),
        1,
    )
    assert [frame.images[1].size > 0 for frame in frames] == [True, False, True, False, True]
    np.testing.assert_array_equal(frames[4].images[1], np.roll(IMAGE, 41))
    assert len(recording.imu) == 49 and np.all(np.diff(recording.imu.t_ns) > 0)
    with pytest.raises(InputError, match="two messages of"):
        BagRecording.open(path, calibration=[noise_yaml], topics=BagTopics(images=images))
