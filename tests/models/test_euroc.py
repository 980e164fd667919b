"""EuRoC folders: round trip, the spelling of the data set, and refused files."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.recordings.euroc import (
    INCOMPLETE,
    EurocRecording,
    read_euroc_segment_times,
    read_groundtruth,
    write_euroc,
    write_euroc_recording,
)
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, FrameTruth, frame_truth_text
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.recordings.tum import write_tum
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera, euroc_rig
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.state import Trajectory

WIDTH, HEIGHT, FRAMES = 32, 24, 4


def small_rig(cameras: int = 1) -> Rig:
    model = CameraModel(WIDTH, HEIGHT, 20.0 + 1 / 3, 20.1, 15.5, 11.5, (-0.1, 0.01, 1e-4 / 3, -2e-5))
    poses = [EUROC_T_IMU_CAM0 + np.eye(4) * 0, np.eye(4)]
    rig_cameras = tuple(RigCamera(model, poses[i], 20.0) for i in range(cameras))
    return replace(euroc_rig(), cameras=rig_cameras, time_offset_s=-1e-3 / 7, imu=ImuModel("A: strange # name", 100.0))


def motion(n: int = 40, seed: int = 0) -> tuple[ImuSamples, Trajectory]:
    rng = np.random.default_rng(seed)
    t_ns = 1403715273262142976 + 5_000_000 * np.arange(n)
    quat_wxyz = rng.normal(size=(n, 4))
    quat_wxyz /= np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
    imu = ImuSamples(t_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))
    p, v, b_gyro, b_accel = rng.normal(size=(4, n, 3))
    return imu, Trajectory(t_ns, p, quat_wxyz, v, b_gyro, b_accel)


def write_flight(folder: Path, cameras: int = 1) -> Path:
    imu, truth = motion()
    times = imu.t_ns[::10]
    write_euroc(folder, small_rig(cameras), imu, truth, times)
    for i in range(cameras):
        for k, t_ns in enumerate(times):
            image = np.full((HEIGHT, WIDTH), 10 * k + i, np.uint8)
            cv2.imwrite(str(folder / "mav0" / f"cam{i}" / "data" / f"{t_ns}.png"), image)
    return folder


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    return write_flight(tmp_path / "hall-3")


def edit(path: Path, change: Callable[[str], str]) -> None:
    before = path.read_text()
    path.write_text(change(before))
    assert path.read_text() != before


def refused(folder: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        EurocRecording.open(folder)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("cameras", [1, 2])
def test_round_trip_is_exact(tmp_path: Path, cameras: int) -> None:
    imu, truth = motion()
    rig = small_rig(cameras)
    recording: Recording = EurocRecording.open(write_flight(tmp_path / "hall-3", cameras))
    assert recording.name == "hall-3"
    assert recording.rig.imu == rig.imu
    assert recording.rig.time_offset_s == rig.time_offset_s
    np.testing.assert_array_equal(recording.rig.T_vehicle_imu, rig.T_vehicle_imu)
    for ours, theirs in zip(recording.rig.cameras, rig.cameras, strict=True):
        assert ours.model == theirs.model and ours.rate_hz == theirs.rate_hz
        np.testing.assert_array_equal(ours.T_imu_cam, theirs.T_imu_cam)
    assert recording.imu.sampling == "point"
    for name in ("t_ns", "gyro_rad_s", "accel_m_s2"):
        np.testing.assert_array_equal(getattr(recording.imu, name), getattr(imu, name))
    assert recording.ground_truth is not None
    for name in ("t_ns", "p_world_imu", "quat_wxyz", "velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2"):
        np.testing.assert_array_equal(getattr(recording.ground_truth, name), getattr(truth, name))
    np.testing.assert_array_equal(recording.frame_times_ns, imu.t_ns[::10])
    for k in range(FRAMES):
        frame = recording.frame(k)
        assert frame.t_ns == imu.t_ns[10 * k]
        assert [int(image.min()) for image in frame.images] == [10 * k + i for i in range(cameras)]
        assert all(image.shape == (HEIGHT, WIDTH) and image.dtype == np.uint8 for image in frame.images)


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_round_trip_of_arbitrary_numbers_is_exact(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    finite = st.floats(allow_nan=False, allow_infinity=False)
    positive = st.floats(1e-300, 1e300)
    t_ns = np.array(sorted(data.draw(st.sets(st.integers(0, 2**62 - 1), min_size=1, max_size=5))))
    n = len(t_ns)
    p, v, gyro, accel = (data.draw(hnp.arrays(np.float64, (n, 3), elements=finite)) for _ in range(4))
    truth = Trajectory(t_ns, p, np.tile([0.6, 0.0, -0.8, 0.0], (n, 1)), v, gyro, accel)
    numbers = data.draw(st.lists(positive, min_size=7, max_size=7))
    rig = replace(small_rig(), imu=ImuModel(data.draw(st.text(max_size=8)), *numbers))
    folder = tmp_path_factory.getbasetemp() / "any-numbers"
    write_euroc(folder, rig, ImuSamples(t_ns, gyro, accel), truth, t_ns)
    back = EurocRecording.open(folder)
    assert back.rig.imu == rig.imu
    np.testing.assert_array_equal(back.imu.gyro_rad_s, gyro)
    assert back.ground_truth is not None and back.ground_truth.velocity_m_s is not None
    np.testing.assert_array_equal(back.ground_truth.p_world_imu, p)
    np.testing.assert_array_equal(back.ground_truth.velocity_m_s, v)
    np.testing.assert_array_equal(back.frame_times_ns, t_ns)


def test_ground_truth_may_have_poses_only(tmp_path: Path) -> None:
    imu, truth = motion()
    poses = Trajectory(truth.t_ns, truth.p_world_imu, truth.quat_wxyz)
    write_euroc(tmp_path, small_rig(), imu, poses, imu.t_ns[::10])
    back = read_groundtruth(tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    assert back.velocity_m_s is None
    np.testing.assert_array_equal(back.quat_wxyz, truth.quat_wxyz)


@pytest.mark.parametrize("name", RIGS)
def test_round_trip_of_every_rig_is_exact(tmp_path: Path, name: str) -> None:
    """The rigs include fisheyes, rolling shutters, stereo, and IMUs with range and resolution."""
    imu, truth = motion()
    rig = rig_named(name)
    write_euroc(tmp_path, rig, imu, truth, imu.t_ns[::10])
    back = EurocRecording.open(tmp_path).rig
    assert back.imu == rig.imu and back.time_offset_s == rig.time_offset_s
    np.testing.assert_array_equal(back.T_vehicle_imu, rig.T_vehicle_imu)
    for ours, theirs in zip(back.cameras, rig.cameras, strict=True):
        assert (ours.model, ours.rate_hz, ours.readout_s) == (theirs.model, theirs.rate_hz, theirs.readout_s)
        np.testing.assert_array_equal(ours.T_imu_cam, theirs.T_imu_cam)


def frame_truth(imu: ImuSamples) -> FrameTruth:
    rng = np.random.default_rng(1)
    t_ns = imu.t_ns[::10]
    exposed_ns = t_ns + rng.integers(-(10**6), 10**6, len(t_ns))
    return FrameTruth(t_ns, exposed_ns, rng.random(len(t_ns)), rng.random(len(t_ns)), rng.random(len(t_ns)) > 0.5)


def test_round_trip_of_frame_truth_is_exact(tmp_path: Path) -> None:
    imu, truth = motion()
    written = frame_truth(imu)
    write_euroc(tmp_path, small_rig(), imu, truth, written.t_ns, written)
    back = EurocRecording.open(tmp_path).frame_truth
    assert back is not None
    for name in ("t_ns", "exposed_ns", "exposure_s", "gain", "lit"):
        np.testing.assert_array_equal(getattr(back, name), getattr(written, name))


@pytest.mark.parametrize("wrong", ["1.5e3", str(2**62), "x"])
def test_invalid_exposure_times_are_refused(flight: Path, wrong: str) -> None:
    written = frame_truth(motion()[0])
    path = flight / "mav0" / FRAME_TRUTH_FILE
    path.parent.mkdir()
    path.write_text(frame_truth_text(written).replace(str(written.exposed_ns[1]), wrong))
    error = refused(flight)
    assert error.path == path and error.line == 3 and wrong in str(error)


@pytest.mark.parametrize("cameras", [1, 2])
def test_an_incomplete_recording_has_the_frames_that_exist(tmp_path: Path, cameras: int) -> None:
    flight = write_flight(tmp_path / "interrupted", cameras)
    assert EurocRecording.open(flight).complete
    (flight / "mav0" / INCOMPLETE).touch()
    (flight / "mav0" / f"cam{cameras - 1}" / "data" / f"{motion()[0].t_ns[20]}.png").unlink()
    recording = EurocRecording.open(flight)
    assert not recording.complete
    assert len(recording.frame_times_ns) == FRAMES - 1
    assert [int(recording.frame(k).images[0].min()) for k in range(FRAMES - 1)] == [0, 10, 30]
    for image in (flight / "mav0" / "cam0" / "data").iterdir():
        image.unlink()
    assert "incomplete recording without frames" in str(refused(flight))


@pytest.mark.parametrize("cameras", [0, -1, [], [2], [-1], [0, "cam0"], ["left"], "10"])
def test_cameras_that_do_not_exist_are_refused(cameras: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cameras.*; expected"):
        EurocRecording.open(write_flight(tmp_path / "stereo", cameras=2), cameras=cameras)


def test_ground_truth_is_optional(tmp_path: Path) -> None:
    imu, _ = motion()
    write_euroc(tmp_path, small_rig(), imu, None, imu.t_ns[::10])
    assert EurocRecording.open(tmp_path).ground_truth is None
    assert not (tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv").exists()


def test_increments_are_written_as_means_and_read_back(tmp_path: Path) -> None:
    imu, truth = motion()
    write_euroc(tmp_path, small_rig(), imu.increments(), truth, imu.t_ns[::10])
    read = EurocRecording.open(tmp_path).imu
    assert read.sampling == "increment"
    np.testing.assert_allclose(read.gyro_rad_s, imu.increments().gyro_rad_s, atol=1e-9)
    np.testing.assert_allclose(read.accel_m_s2, imu.increments().accel_m_s2, atol=1e-9)


def test_mav0_itself_is_accepted(flight: Path) -> None:
    shutil.rmtree(flight / "mav0" / "state_groundtruth_estimate0")
    (flight / "mav0" / "body.yaml").unlink()
    recording = EurocRecording.open(flight / "mav0")
    assert recording.name == "hall-3"
    assert recording.ground_truth is None
    np.testing.assert_array_equal(recording.rig.T_vehicle_imu, np.eye(4))
    np.testing.assert_array_equal(read_euroc_segment_times(flight)[0], recording.frame_times_ns)


def test_frames_need_an_image_of_every_camera(tmp_path: Path) -> None:
    flight = write_flight(tmp_path / "stereo", cameras=2)
    edit(flight / "mav0" / "cam1" / "data.csv", lambda text: "\n".join(text.split("\n")[:2] + text.split("\n")[3:]))
    recording = EurocRecording.open(flight)
    assert len(recording.frame_times_ns) == FRAMES - 1
    frame = recording.frame(1)
    assert [int(image.min()) for image in frame.images] == [20, 21]
    assert len(EurocRecording.open(flight, cameras=1).frame_times_ns) == FRAMES
    edit(flight / "mav0" / "cam1" / "data.csv", lambda _: "7,7.png\n")
    assert "in common" in str(refused(flight))


def test_the_formatting_of_the_data_set_is_read(flight: Path) -> None:
    """The data set has Windows line ends, and spaces after commas."""
    plain = EurocRecording.open(flight)
    for name in ("cam0/data.csv", "imu0/data.csv", "state_groundtruth_estimate0/data.csv", "imu0/sensor.yaml"):
        edit(flight / "mav0" / name, lambda text: text.replace(",", ", ").replace("\n", "\r\n"))
    recording = EurocRecording.open(flight)
    np.testing.assert_array_equal(recording.imu.accel_m_s2, plain.imu.accel_m_s2)
    np.testing.assert_array_equal(recording.frame_times_ns, plain.frame_times_ns)
    assert recording.image_files == plain.image_files


@pytest.mark.parametrize("name", ["cam0/data.csv", "cam0/sensor.yaml", "imu0/data.csv", "imu0/sensor.yaml"])
def test_missing_files_are_named(flight: Path, name: str) -> None:
    (flight / "mav0" / name).unlink()
    error = refused(flight)
    assert error.path == flight / "mav0" / name and "no such file" in str(error)


def test_other_paths_are_refused(flight: Path, tmp_path: Path) -> None:
    assert "no such folder" in str(refused(tmp_path / "missing"))
    assert "a file" in str(refused(flight / "mav0" / "body.yaml"))
    (tmp_path / "empty").mkdir()
    assert "a folder without mav0" in str(refused(tmp_path / "empty"))
    shutil.rmtree(flight / "mav0" / "cam0")
    assert "no folder cam0" in str(refused(flight))


@pytest.mark.parametrize(
    ("name", "old", "new", "found"),
    [
        ("cam0/sensor.yaml", "pinhole", "cylinder", "camera_model: cylinder"),
        ("cam0/sensor.yaml", "radial-tangential", "magic", "distortion_model: magic"),
        ("cam0/sensor.yaml", "[32, 24]", "[32, 24.5]", "whole pixels"),
        ("cam0/sensor.yaml", "[32, 24]", "[32, 0]", "whole pixels"),
        ("cam0/sensor.yaml", "[20.333333333333332,", "[-20,", "focal lengths"),
        (
            "imu0/sensor.yaml",
            "gyroscope_noise_density: 0.00016968",
            "gyroscope_noise_density: 0.0",
            "a positive number",
        ),
        (
            "imu0/sensor.yaml",
            "gyroscope_noise_density: 0.00016968",
            "gyroscope_noise_density: -1.0",
            "a positive number",
        ),
        ("imu0/sensor.yaml", "gyroscope_noise_density: 0.00016968", "gyroscope_noise_density: .nan", "a positive"),
        ("imu0/sensor.yaml", "accelerometer_random_walk", "accel_walk", "no field accelerometer_random_walk"),
        ("imu0/sensor.yaml", "data: [1.0", "data: [-1.0", "rigid"),
        ("imu0/sensor.yaml", "data: [1.0, 0.0, 0.0, 0.0", "data: [1.0, 0.0, 0.0, 0.1", "identity"),
        ("imu0/data.csv", "1403715273267142976", "1403715273262142976", "after"),
        ("cam0/data.csv", "1403715273312142976,", "1403715273262142976,", "after"),
        ("cam0/data.csv", "1403715273312142976,", "x,", "whole nanoseconds"),
        ("cam0/data.csv", "1403715273312142976,", f"{2**62},", "below 2⁶² ns"),
        ("cam0/data.csv", "1403715273312142976.png", "", "two columns"),
        ("cam0/data.csv", "1403715273312142976.png", "a.png,b.png", "two columns"),
        ("cam0/data.csv", "1403715273312142976.png", "../../../secret.png", "folder data"),
        ("cam0/data.csv", "1403715273312142976.png", "/etc/passwd", "folder data"),
        ("cam0/data.csv", "1403715273312142976.png", "..\\secret.png", "folder data"),
        ("cam0/data.csv", "1403715273312142976.png", "..", "folder data"),
    ],
)
def test_errors_name_file_line_and_cause(flight: Path, name: str, old: str, new: str, found: str) -> None:
    path = flight / "mav0" / name
    before = path.read_text()
    edit(path, lambda text: text.replace(old, new, 1))
    error = refused(flight)
    assert error.path == path
    assert error.line == (None if "no field" in found else before[: before.index(old)].count("\n") + 1)
    assert found in str(error)


def test_intrinsics_outside_their_range_are_an_error_of_the_file(flight: Path) -> None:
    path = flight / "mav0" / "cam0" / "sensor.yaml"
    edit(path, lambda text: text.replace("[20.333333333333332,", "[1e9,", 1))
    error = refused(flight)
    assert error.path == path and "CameraModel.fx = 1000000000.0" in str(error)


@pytest.mark.parametrize("name", ["cam0/data.csv", "imu0/data.csv", "state_groundtruth_estimate0/data.csv"])
def test_truncated_tables_are_refused_or_shorter(flight: Path, name: str) -> None:
    path = flight / "mav0" / name
    content = path.read_bytes()
    whole = EurocRecording.open(flight)
    assert whole.ground_truth is not None
    for end in range(0, len(content), max(1, len(content) // 150)):
        path.write_bytes(content[:end])
        try:
            cut = EurocRecording.open(flight)
        except InputError as error:
            assert error.path == path
            continue
        assert cut.ground_truth is not None
        np.testing.assert_array_equal(cut.frame_times_ns, whole.frame_times_ns[: len(cut.frame_times_ns)])
        np.testing.assert_allclose(cut.imu.accel_m_s2, whole.imu.accel_m_s2[: len(cut.imu)], rtol=1e-12)
        np.testing.assert_array_equal(cut.ground_truth.quat_wxyz, whole.ground_truth.quat_wxyz[: len(cut.ground_truth)])


def test_missing_and_damaged_images_are_named(flight: Path) -> None:
    recording = EurocRecording.open(flight)
    image = recording.image_files[0][2]
    assert image is not None
    image.write_bytes(image.read_bytes()[:-20])
    with pytest.raises(InputError, match="truncated") as caught:
        recording.frame(2)
    assert caught.value.path == image
    image.unlink()
    with pytest.raises(InputError, match="no such file"):
        recording.frame(2)
    assert recording.frame(1).t_ns == recording.frame_times_ns[1]


def test_evo_reads_the_ground_truth(flight: Path) -> None:
    from evo.tools.file_interface import read_euroc_csv_trajectory

    truth = EurocRecording.open(flight).ground_truth
    theirs = read_euroc_csv_trajectory(str(flight / "mav0" / "state_groundtruth_estimate0" / "data.csv"))
    assert truth is not None
    np.testing.assert_array_equal(theirs.positions_xyz, truth.p_world_imu)
    np.testing.assert_array_equal(theirs.orientations_quat_wxyz, truth.quat_wxyz)
    np.testing.assert_allclose(theirs.timestamps, truth.t_ns * 1e-9, atol=1e-6)  # limited by doubles


def test_any_recording_can_be_written(
    tmp_path: Path, noise_recording: Callable[..., Any], assert_same_recording: Callable[..., None]
) -> None:
    recording = noise_recording("fisheye-stereo")
    write_euroc_recording(tmp_path, recording, frame_truth=recording.frame_truth)
    back = EurocRecording.open(tmp_path)
    assert back.complete
    assert_same_recording(back, recording)


def test_the_real_data_set_is_read(data_folder: Path) -> None:
    truth = read_groundtruth(data_folder / "euroc" / "V1_02" / "groundtruth.csv")
    assert len(truth) == 16702
    assert truth.length_m == pytest.approx(75.8913, abs=1e-3)
    camera = data_folder / "euroc" / "V1_01_on_the_ground"
    assert len(read_euroc_segment_times(camera)[0]) == 95


def test_a_tum_file_beside_the_folder_is_the_ground_truth(
    noise_recording: Callable[..., Recording], tmp_path: Path
) -> None:
    recording = noise_recording()
    truth = recording.ground_truth
    assert truth is not None
    folder = tmp_path / "flight"
    write_euroc(folder, recording.rig, recording.imu, None, recording.frame_times_ns)
    with pytest.raises(InputError, match=r"groundtruth\.tum beside mav0"):
        read_trajectory_file(folder)
    assert EurocRecording.open(folder).ground_truth is None
    write_tum(folder / "groundtruth.tum", truth)
    for found in (
        EurocRecording.open(folder).ground_truth,
        read_trajectory_file(folder),
        read_trajectory_file(folder / "mav0"),
    ):
        assert found is not None and found.velocity_m_s is None
        np.testing.assert_array_equal(found.t_ns, truth.t_ns)
        np.testing.assert_array_equal(found.p_world_imu, truth.p_world_imu)
    write_euroc(folder, recording.rig, recording.imu, truth[3:], recording.frame_times_ns)  # the table comes first
    assert len(read_trajectory_file(folder)) == len(truth) - 3
