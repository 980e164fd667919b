"""Recordings whose clock steps, whose IMU samples come in bursts, and whose stamps are unset or negative."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dronevio.models.defects import DefectKind
from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.bag.file import typestore
from dronevio.models.recordings.bag.file_order import written_messages
from dronevio.models.recordings.bag.stamps import TopicStamps
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.euroc import EurocRecording, read_euroc_segment_times, write_euroc_recording
from dronevio.models.recordings.open import open_recording, read_frame_times, read_trajectory
from dronevio.models.recordings.segments import segments_of

Make = Callable[..., Any]
FRAMES = 12


def kinds(recording: Any) -> dict[DefectKind, int]:
    return dict(Counter(defect.kind for segment in segments_of(recording) for defect in segment.defects))


def assert_same_measurements(found: Any, original: Any, frames: slice, shift_ns: int = 0) -> None:
    """The segment has frames of the original with their images, and IMU samples with their values."""
    np.testing.assert_array_equal(found.frame_times_ns, original.frame_times_ns[frames] + shift_ns)
    for k, row in enumerate(range(FRAMES)[frames]):
        for image, expected in zip(found.frame(k).images, original.frame(row).images, strict=True):
            np.testing.assert_array_equal(image, expected)
    samples = slice(*(None if row is None else max(10 * row - 2, 0) for row in (frames.start, frames.stop)))
    np.testing.assert_array_equal(found.imu.t_ns, original.imu.t_ns[samples] + shift_ns)
    np.testing.assert_allclose(found.imu.gyro_rad_s, original.imu.gyro_rad_s[samples], rtol=1e-15)


# --- EuRoC folders


def edit(folder: Path, change: Callable[[int, int], int], lists: Sequence[str] = ("imu0", "cam0", "cam1")) -> None:
    """Replace the stamps [ns] of lists by a function of frame number and stamp."""
    for name in lists:
        path = folder / "mav0" / name / "data.csv"
        header, *rows = path.read_text().splitlines(keepends=True)
        edited = []
        for row, text in enumerate(rows):
            stamp, rest = text.split(",", 1)
            frame = (row + 2) // 10 if name == "imu0" else row
            edited.append(f"{change(frame, int(stamp))},{rest}")
        path.write_text("".join([header, *edited]))


@pytest.fixture
def original(noise_recording: Make) -> Any:
    return noise_recording("euroc-stereo", frames=FRAMES)


@pytest.fixture
def folder(tmp_path: Path, original: Any) -> Path:
    write_euroc_recording(tmp_path / "flight", original)
    return tmp_path / "flight"


@pytest.mark.parametrize("change_ns", [-3_013_000_000, -3_000_000_000, -250_000_000, 5_000_000_000])
def test_a_folder_is_split_where_its_clock_steps(folder: Path, original: Any, change_ns: int) -> None:
    edit(folder, lambda frame, t: t + (change_ns if frame >= 6 else 0))
    recording = open_recording(folder, repair=True)
    first, second = segments_of(recording)
    assert_same_measurements(first, original, slice(None, 6))
    assert_same_measurements(second, original, slice(6, None), change_ns)
    assert (first.name, second.name) == ("flight, segment 1 of 2", "flight, segment 2 of 2")
    assert first.later == second.later == () and recording.name == first.name
    assert kinds(recording) == {DefectKind.CLOCK_STEP: 1} and second.defects == ()
    (step,) = first.defects
    change = re.escape(f"{change_ns * 1e-9:+.3f}")
    assert re.search(
        rf"imu0/data.csv:60: \d+ ns after \d+ ns \({change} s\); .*cam0/data.csv:8; .*cam1", step.description
    )
    times = read_euroc_segment_times(folder)
    for segment, found in zip((first, second), times, strict=True):
        np.testing.assert_array_equal(found, segment.frame_times_ns)
        np.testing.assert_array_equal(read_frame_times(folder, found[1:]), found)
    np.testing.assert_array_equal(read_frame_times(folder), times[0])
    if change_ns < 0:
        with pytest.raises(InputError, match=r"data.csv:8: time stamp \d+ ns after"):
            open_recording(folder)
    else:
        assert len(open_recording(folder).frame_times_ns) == FRAMES and open_recording(folder).later == ()


@pytest.mark.parametrize(("lists", "frames"), [(("imu0",), FRAMES), (("cam0", "cam1"), FRAMES)])
def test_a_step_of_one_sensor_is_undone(folder: Path, original: Any, lists: tuple[str, ...], frames: int) -> None:
    edit(folder, lambda frame, t: t - (200_000_000 if frame >= 6 else 0), lists)
    recording = open_recording(folder, repair=True)
    assert recording.later == () and kinds(recording) == {DefectKind.LONE_CLOCK_STEP: len(lists)}
    assert_same_measurements(recording, original, slice(None))
    (only,) = read_euroc_segment_times(folder)
    np.testing.assert_array_equal(only, recording.frame_times_ns)


def test_a_segment_that_cannot_be_used_is_left_out(folder: Path, original: Any) -> None:
    """Between two steps the IMU has no finite sample."""
    edit(folder, lambda frame, t: t + (0 if frame < 4 else 10**12 if frame < 8 else 2 * 10**12))
    table = folder / "mav0" / "imu0" / "data.csv"
    rows = table.read_text().splitlines(keepends=True)
    rows[39:79] = [re.sub(r",[^,]*", ",nan", row, count=1) for row in rows[39:79]]
    table.write_text("".join(rows))
    first, second = segments_of(open_recording(folder, repair=True))
    assert_same_measurements(first, original, slice(None, 4))
    assert_same_measurements(second, original, slice(8, None), 2 * 10**12)
    assert [defect.kind for defect in first.defects] == [DefectKind.CLOCK_STEP]
    assert [defect.kind for defect in second.defects] == [DefectKind.UNUSABLE_SEGMENT]
    assert (
        "segment 2 of 3" in second.defects[0].description and "none of which is finite" in second.defects[0].description
    )


@pytest.mark.parametrize("size", [2, 4, 8, 16])
def test_bursts_are_spread(folder: Path, original: Any, size: int) -> None:
    table = folder / "mav0" / "imu0" / "data.csv"
    header, *rows = table.read_text().splitlines(keepends=True)
    last = [rows[min(row // size * size + size, len(rows)) - 1].split(",", 1)[0] for row in range(len(rows))]
    table.write_text("".join([header, *(f"{t},{row.split(',', 1)[1]}" for t, row in zip(last, rows, strict=True))]))
    recording = EurocRecording.open(folder, repair=True)
    assert_same_measurements(recording, original, slice(None))
    assert kinds(recording) == {DefectKind.IMU_BURST: -(-len(rows) // size)}
    assert f"imu0/data.csv:2: sample at {last[0]} ns" in recording.defects[0].description
    with pytest.raises(InputError, match="time stamps that increase"):
        open_recording(folder)


def test_negative_stamps_cost_nothing(folder: Path, original: Any, tmp_path: Path) -> None:
    """Stamps from −0.3 s on, some of them negative, are those of a recording like any other."""
    shift_ns = -int(original.imu.t_ns[60])
    edit(folder, lambda _, t: t + shift_ns)
    for recording in (open_recording(folder, repair=True), open_recording(folder, 1), open_recording(folder)):
        assert recording.defects == () and recording.later == ()
        np.testing.assert_array_equal(recording.imu.t_ns, original.imu.t_ns + shift_ns)
        np.testing.assert_array_equal(recording.frame_times_ns, original.frame_times_ns + shift_ns)
    edit(folder, lambda frame, t: t - (10**9 if frame >= 6 else 0))
    assert [len(segment.frame_times_ns) for segment in segments_of(open_recording(folder, repair=True))] == [6, 6]


# --- bags


def write_changed(
    path: Path,
    recording: Any,
    plugin: StoragePlugin,
    change: Callable[[int, int, str], tuple[int, int]],
) -> None:
    """Copy a bag of a recording message by message, in its order.

    Args:
        path: Folder of the bag to make.
        recording: Its contents.
        plugin: Storage of the bag.
        change: Returns the stamp of the header and the log time, given frame number, stamp [ns] and topic.
    """
    whole = path.with_suffix(".mcap")
    write_bag(whole, recording)
    with Reader(whole) as reader, Writer(path, version=8, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for connection, t_ns, raw in reader.messages():
            topic, kind = connection.topic, connection.msgtype
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            frame = int(np.searchsorted(recording.frame_times_ns, t_ns + 25_000_000, side="right")) - 1
            if kind in ("sensor_msgs/msg/Imu", "sensor_msgs/msg/Image", "nav_msgs/msg/Odometry"):
                stamp_ns, logged_ns = change(frame, t_ns, topic)
                message: Any = typestore().deserialize_cdr(raw, kind)
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
                writer.write(connections[topic], logged_ns, typestore().serialize_cdr(message, kind))
            elif not topic.startswith("/groundtruth") and topic != "/tf":
                writer.write(connections[topic], t_ns, raw)


def without_bias(recording: Any) -> Any:
    truth = recording.ground_truth
    return replace(
        recording, ground_truth=replace(truth, velocity_m_s=None, gyro_bias_rad_s=None, accel_bias_m_s2=None)
    )


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("change_ns", [-3_013_000_000, -250_000_000, -200_000_000, 5_000_000_000])
@pytest.mark.parametrize("is_log_stepped", [True, False])
def test_a_bag_is_split_in_the_order_in_which_it_was_written(
    tmp_path: Path, original: Any, plugin: StoragePlugin, change_ns: int, is_log_stepped: bool
) -> None:
    """Also where the clock of the computer steps, which makes the log times step."""
    original = without_bias(original)

    def change(frame: int, t_ns: int, topic: str) -> tuple[int, int]:
        stepped_ns = t_ns + (change_ns if frame >= 6 else 0)
        return stepped_ns, stepped_ns if is_log_stepped else t_ns

    write_changed(tmp_path / "bag", original, plugin, change)
    recording = open_recording(tmp_path / "bag", repair=True)
    first, second = segments_of(recording)
    for segment, frames, shift_ns in ((first, slice(None, 6), 0), (second, slice(6, None), change_ns)):
        np.testing.assert_array_equal(segment.frame_times_ns, original.frame_times_ns[frames] + shift_ns)
        for k, row in enumerate(range(FRAMES)[frames]):
            np.testing.assert_array_equal(segment.frame(k).images[1], original.frame(row).images[1])
        assert segment.ground_truth is not None
        p = segment.ground_truth.p_world_imu
        read = read_trajectory(tmp_path / "bag", segment.frame_times_ns).p_world_imu
        np.testing.assert_array_equal(read, p if change_ns < 0 else original.ground_truth.p_world_imu)
        own = (
            original.ground_truth.p_world_imu[: len(p)]
            if shift_ns == 0
            else original.ground_truth.p_world_imu[-len(p) :]
        )
        np.testing.assert_array_equal(p, own)
    assert len(first.imu) + len(second.imu) == len(original.imu)
    np.testing.assert_array_equal(np.vstack([first.imu.gyro_rad_s, second.imu.gyro_rad_s]), original.imu.gyro_rad_s)
    assert kinds(recording) == {DefectKind.CLOCK_STEP: 1}
    assert "/imu0: message 59: " in first.defects[0].description
    np.testing.assert_array_equal(read_frame_times(tmp_path / "bag", second.frame_times_ns), second.frame_times_ns)
    if change_ns < 0:
        with pytest.raises(InputError, match="time stamps of a clock that runs on"):
            open_recording(tmp_path / "bag")


@pytest.mark.parametrize("unset", ["/imu0", "/cam", "/"])
@pytest.mark.parametrize("value_ns", [0, 77])
def test_unset_stamps_are_those_of_the_log(tmp_path: Path, original: Any, unset: str, value_ns: int) -> None:
    def change(_frame: int, t_ns: int, topic: str) -> tuple[int, int]:
        return value_ns if topic.startswith(unset) else t_ns, t_ns

    write_changed(tmp_path / "bag", replace(original, ground_truth=None), StoragePlugin.MCAP, change)
    recording = open_recording(tmp_path / "bag", repair=True)
    assert_same_measurements(recording, original, slice(None))
    count = {"/imu0": 10 * FRAMES, "/cam": 2 * FRAMES, "/": 12 * FRAMES}[unset]
    assert kinds(recording) == {DefectKind.UNSET_STAMP: count}
    assert f": {value_ns} ns in the header, logged at " in recording.defects[0].description
    with pytest.raises(InputError, match=f"two messages of {value_ns} ns"):
        open_recording(tmp_path / "bag")


def times(*t: int) -> Times:
    return np.array(t, dtype=np.int64)


def test_an_unset_stamp_among_others_is_corrected_by_their_delay() -> None:
    second = 10**9
    stamps = TopicStamps.of("/t", times(0, 6 * second, 7 * second), times(8 * second, 9 * second, 10 * second))
    assert stamps.t_ns.tolist() == [5 * second, 6 * second, 7 * second] and stamps.unset.tolist() == [
        True,
        False,
        False,
    ]


def test_a_clock_that_counts_from_zero_is_set() -> None:
    stamps = TopicStamps.of("/t", times(0, 5, 10), times(100, 105, 120))
    assert stamps.t_ns.tolist() == [0, 5, 10] and not stamps.unset.any() and stamps.defects == ()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 2**60), min_size=1, max_size=20, unique=True))
def test_stamps_that_are_set_stay(t: list[int]) -> None:
    stamps = TopicStamps.of("/t", times(*t), times(*reversed(t)))
    assert stamps.t_ns.tolist() == t and not stamps.unset.any()


def test_ros_1_bags_are_read_in_the_order_of_writing(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "std_msgs/msg/String"
    logged = [50, 60, 70, 20, 30, 40, 80]
    with Ros1Writer(tmp_path / "a.bag") as writer:
        one, other = (writer.add_connection(topic, kind, typestore=store) for topic in ("/a", "/b"))
        for k, t_ns in enumerate(logged):
            text = store.types[kind](data=str(k))
            writer.write(other if k == 4 else one, t_ns, store.serialize_ros1(text, kind))
    with Ros1Reader(tmp_path / "a.bag") as reader:
        chosen = [connection for connection in reader.connections if connection.topic == "/a"]
        found = [(t_ns, int(raw[4:])) for _, t_ns, raw in written_messages(reader, chosen)]
        assert found == [(t_ns, k) for k, t_ns in enumerate(logged) if k != 4]
        assert [t_ns for _, t_ns, _ in reader.messages(chosen)] == sorted(t for k, t in enumerate(logged) if k != 4)
