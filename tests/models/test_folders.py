"""Folders of TUM-VI, DSO and KITTI, made in the test, and what the commands do with them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets import open_images
from dronevio.models.imu_presets import BMI088
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.euroc import write_euroc_recording
from dronevio.models.recordings.open import open_recording, read_frame_times, read_trajectory
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

Make = Callable[..., Any]


def calibration(folder: Path, rig: Any) -> tuple[Path, Path]:
    """Write the files of Kalibr, without the keys that Kalibr does not write."""
    chain = folder / "camchain.yaml"
    chain.parent.mkdir(parents=True, exist_ok=True)
    chain.write_text(camchain_yaml(rig).replace("rate_hz", "no_rate_hz"))
    (folder / "imu_config.yaml").write_text(imu_yaml(rig))
    return chain, folder / "imu_config.yaml"


def tum_vi(folder: Path, recording: Any) -> Path:
    """Write an EuRoC folder as TUM-VI exports it: without sensor.yaml, with mocap0 for the ground truth."""
    write_euroc_recording(folder, replace(recording, frame_truth=None))
    for file in folder.rglob("sensor.yaml"):
        file.unlink()
    (folder / "mav0" / "body.yaml").unlink()
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    rows = (truth / "data.csv").read_text().splitlines()
    (folder / "mav0" / "mocap0").mkdir()
    (folder / "mav0" / "mocap0" / "data.csv").write_text(
        "#timestamp [ns], p_RS_R_x [m]\n" + "".join(",".join(row.split(",")[:8]) + "\n" for row in rows[1:])
    )
    (truth / "data.csv").unlink()
    truth.rmdir()
    return folder


def assert_same_rig(ours: Any, theirs: Any) -> None:
    assert ours.imu == theirs.imu and ours.time_offset_s == theirs.time_offset_s
    for a, b in zip(ours.cameras, theirs.cameras, strict=True):
        assert a.model == b.model
        np.testing.assert_allclose(a.T_imu_cam, b.T_imu_cam, atol=1e-12)


@pytest.mark.parametrize("repair", [False, True])
def test_folders_of_tum_vi_take_a_calibration(tmp_path: Path, noise_recording: Make, repair: bool) -> None:
    recording = noise_recording("fisheye-stereo")
    folder = tum_vi(tmp_path / "room1", recording)
    with pytest.raises(InputError, match=r"cam0/sensor\.yaml: no such file; expected that file, or a calibration"):
        open_recording(folder)
    files = calibration(tmp_path / "elsewhere", recording.rig)
    read = open_recording(folder, calibration=files, repair=repair)
    assert_same_rig(read.rig, recording.rig)
    assert read.rig.cameras[0].rate_hz == pytest.approx(20.0)  # of the images
    assert read.name == "room1" and read.defects == ()
    np.testing.assert_array_equal(read.imu.gyro_rad_s, recording.imu.gyro_rad_s)
    np.testing.assert_array_equal(read.frame(2).images[1], recording.frame(2).images[1])
    assert read.ground_truth is not None
    np.testing.assert_array_equal(read.ground_truth.p_world_imu, recording.ground_truth.p_world_imu)
    np.testing.assert_array_equal(read_trajectory(folder).t_ns, recording.ground_truth.t_ns)
    np.testing.assert_array_equal(read_frame_times(folder), recording.frame_times_ns)


def test_calibration_files_in_exports_of_tum_vi_are_found(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording("fisheye-stereo")
    folder = tum_vi(tmp_path / "room1", recording)
    calibration(folder / "dso", recording.rig)
    assert_same_rig(open_recording(folder).rig, recording.rig)
    assert_same_rig(open_recording(folder / "mav0").rig, recording.rig)
    assert len(open_images(folder)) == len(recording.frame_times_ns)


def test_basalts_calibration_is_taken_for_folders(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording("fisheye-stereo")
    folder = tum_vi(tmp_path / "room1", recording)
    file = tmp_path / "calibration.json"
    written = CONFIGURATIONS["basalt"](recording.rig, recording.frame_times_ns, recording.imu)
    file.write_text(next(text for name, text in written.items() if "calib" in name))
    read = open_recording(folder, calibration=[file]).rig
    for a, b in zip(read.cameras, recording.rig.cameras, strict=True):
        np.testing.assert_allclose(a.model.distortion[:2], b.model.distortion[:2])
        np.testing.assert_allclose(a.T_imu_cam, b.T_imu_cam, atol=1e-9)


def test_a_calibration_replaces_that_of_a_folder(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording()
    write_euroc_recording(tmp_path / "flight", replace(recording, frame_truth=None))
    moved = replace(recording.rig, time_offset_s=0.0125)
    files = calibration(tmp_path, moved)
    assert open_recording(tmp_path / "flight", calibration=files).rig.time_offset_s == 0.0125
    only_cameras = open_recording(tmp_path / "flight", calibration=files[:1], imu=BMI088)
    assert only_cameras.rig.imu.gyro_noise_density == BMI088.gyro_noise_density
    assert only_cameras.rig.imu.rate_hz == pytest.approx(200.0)  # of the samples
    with pytest.raises(InputError, match="no noise densities of the IMU; expected Kalibr's imu"):
        open_recording(tmp_path / "flight", calibration=files[:1])
    one = replace(moved, cameras=moved.cameras[:1])
    chain, imu = calibration(tmp_path / "one", one)
    with pytest.raises(InputError, match=r"1 cameras, without cam1 of .*; expected the calibration of all"):
        open_recording(tmp_path / "flight", calibration=[chain, imu])
    assert len(open_recording(tmp_path / "flight", 1, [chain, imu]).rig.cameras) == 1
    with pytest.raises(InputError, match="without cam1"):
        open_recording(tmp_path / "flight", ["cam1"], [chain, imu])
    with pytest.raises(ConfigError, match="topics are for bags"):
        open_recording(tmp_path / "flight", topics=BagTopics(imu=("/imu0",)))


# --- DSO


def dso(folder: Path, recording: Any, by_number: bool = False) -> Path:
    """Write a recording in the format of DSO, with names that are times, or numbers."""
    for camera in range(len(recording.rig.cameras)):
        images = folder / f"cam{camera}" / "images"
        images.mkdir(parents=True)
        rows = ["# name, time [s], exposure [ms]"]
        for k, t_ns in enumerate(recording.frame_times_ns.tolist()):
            name = f"{k:05d}" if by_number else f"{t_ns}"
            cv2.imwrite(str(images / f"{name}.png"), recording.frame(k).images[camera])
            rows.append(f"{name} {t_ns // 10**9}.{t_ns % 10**9:09d} 4.5")
        (folder / f"cam{camera}" / "times.txt").write_text("\n".join(rows) + "\n")
    values = np.hstack([recording.imu.gyro_rad_s, recording.imu.accel_m_s2]).tolist()
    lines = [f"{t} {' '.join(map(repr, row))}\n" for t, row in zip(recording.imu.t_ns.tolist(), values, strict=True)]
    (folder / "imu.txt").write_text("# timestamp[ns] w a\n" + "".join(lines))
    truth = recording.ground_truth
    poses = np.hstack([truth.p_world_imu, truth.quat_wxyz]).tolist()
    lines = [f"{t},{','.join(map(repr, row))}\n" for t, row in zip(truth.t_ns.tolist(), poses, strict=True)]
    (folder / "gt_imu.csv").write_text("# timestamp[ns],tx,ty,tz,qw,qx,qy,qz\n" + "".join(lines))
    return folder


@pytest.mark.parametrize("layout", ["euroc", "kalibr", "dso", "bag", "bag-kalibr"])
@pytest.mark.parametrize("chosen", [["cam1"], [1, 0], ("1", "cam0")])
def test_cameras_are_chosen(tmp_path: Path, noise_recording: Make, layout: str, chosen: list[int | str]) -> None:
    """A rig of chosen cameras sees what they see in the whole rig, at the same times of the IMU."""
    recording = noise_recording("fisheye-stereo")
    first, second = recording.rig.cameras
    second = replace(second, model=replace(second.model, fx=second.model.fx + 1.0))
    recording = replace(recording, rig=replace(recording.rig, cameras=(first, replace(second, time_offset_s=0.002))))
    path = tmp_path / "flight"
    if layout in ("euroc", "kalibr"):
        write_euroc_recording(path, recording)
    elif layout == "dso":
        calibration(dso(path, recording, by_number=False), recording.rig)
    else:
        path = path.with_suffix(".mcap")
        write_bag(path, recording)
    files = calibration(tmp_path / "files", recording.rig) if "kalibr" in layout else ()
    whole, some = open_recording(path, None, files), open_recording(path, chosen, files)
    indices = [1] if len(chosen) == 1 else [1, 0]
    assert some.rig.cameras[0].time_offset_s == 0.0 and whole.rig.cameras[1].time_offset_s == 0.002
    for index, camera in zip(indices, some.rig.cameras, strict=True):
        of_whole = whole.rig.cameras[index]
        assert camera.model == of_whole.model
        np.testing.assert_array_equal(camera.T_imu_cam, of_whole.T_imu_cam)
        np.testing.assert_allclose(
            some.rig.time_offset_s + camera.time_offset_s, whole.rig.time_offset_s + of_whole.time_offset_s, atol=1e-12
        )
    np.testing.assert_array_equal(some.frame_times_ns, whole.frame_times_ns)
    for image, index in zip(some.frame(2).images, indices, strict=True):
        np.testing.assert_array_equal(image, whole.frame(2).images[index])
    if not files:
        images = open_images(path, cameras=chosen, frames=3)
        assert {name.partition("/")[0] for name in images.names} == {f"cam{index}" for index in indices}
        np.testing.assert_array_equal(images.read(0), some.frame(0).images[0])


@pytest.mark.parametrize("by_number", [False, True])
@pytest.mark.parametrize("repair", [False, True])
def test_folders_of_dso_are_read(tmp_path: Path, noise_recording: Make, by_number: bool, repair: bool) -> None:
    recording = noise_recording("fisheye-stereo")
    folder = dso(tmp_path / "dso", recording, by_number)
    with pytest.raises(InputError, match="no calibration; expected one of Kalibr or Basalt"):
        open_recording(folder)
    calibration(folder, recording.rig)
    read = open_recording(folder, repair=repair)
    assert_same_rig(read.rig, recording.rig)
    np.testing.assert_array_equal(read.imu.accel_m_s2, recording.imu.accel_m_s2)
    np.testing.assert_array_equal(read.frame_times_ns, recording.frame_times_ns)
    np.testing.assert_array_equal(read_frame_times(folder), recording.frame_times_ns)
    np.testing.assert_array_equal(read_trajectory(folder).quat_wxyz, recording.ground_truth.quat_wxyz)
    np.testing.assert_array_equal(read.frame(3).images[1], recording.frame(3).images[1])
    assert len(open_images(folder, frames=2)) == 2
    assert len(open_recording(folder, 1).rig.cameras) == 1


def test_missing_images_of_dso_are_defects(tmp_path: Path, noise_recording: Make) -> None:
    recording = noise_recording("fisheye-stereo")
    folder = dso(tmp_path / "dso", recording)
    files = calibration(folder, recording.rig)
    next(iter(sorted((folder / "cam1" / "images").iterdir()))).unlink()
    (defect,) = open_recording(folder, calibration=files, repair=True).defects
    assert "cam1/times.txt:2: no file images/" in defect.description
    for row, found in (("x y", "'x y'"), ("../../secret 1.0 2", "file name '../../secret'")):
        (folder / "cam0" / "times.txt").write_text(f"{row}\n")
        with pytest.raises(InputError, match=found):
            open_recording(folder)


# --- KITTI

K, BASELINE_M = (70.0, 71.0, 16.0, 12.0), 0.54
R_VELO_IMU, R_CAM_VELO = exp_so3(np.array([0.01, -0.02, 0.03])), np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) * 1.0
T_VELO_IMU = pose_matrix(R_VELO_IMU, np.array([-0.8, 0.3, -0.7]))
T_CAM_VELO = pose_matrix(R_CAM_VELO, np.array([0.1, -0.07, -0.27]))
R_RECT = exp_so3(np.array([0.005, 0.01, -0.004]))


def words(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values).ravel())


def images(folder: Path, count: int, digits: int, seed: int, size: tuple[int, int] = (24, 32)) -> None:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:0{digits}d}.png"), rng.integers(0, 256, size, dtype=np.uint8))


def projection(shift_m: float) -> Any:
    fx, fy, cx, cy = K
    return np.array([[fx, 0, cx, -fx * shift_m], [0, fy, cy, 0], [0, 0, 1, 0]])


def drive(root: Path, frames: int = 4, size: tuple[int, int] = (24, 32)) -> Path:
    """Write a drive of the raw data that turns to the left while it goes east, 10 m/s, at 60° north."""
    folder = root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for camera in (0, 1):
        images(folder / f"image_{camera:02d}" / "data", frames, 10, camera, size)
        stamps = [f"2011-09-26 13:02:2{5 + k // 10}.{k % 10}6438944{camera}" for k in range(frames)]
        (folder / f"image_{camera:02d}" / "timestamps.txt").write_text("\n".join(stamps))
    (folder / "oxts" / "data").mkdir(parents=True)
    samples = 10 * frames
    times = [f"2011-09-26 13:02:2{5 + k // 100}.{k % 100:02d}0000000\n" for k in range(samples)]
    (folder / "oxts" / "timestamps.txt").write_text("".join(times))
    for k in range(samples):
        east_deg = np.degrees(0.1 * k / (6378137.0 * np.cos(np.radians(60.0))))
        row = np.zeros(30)
        row[:6] = 60.0, 8.0 + east_deg, 112.0 + 0.01 * k, 0.0, 0.0, 0.002 * k
        row[7], row[11:14], row[17:20] = 10.0, (0.1, 2.0, 9.8), (0.01, -0.02, 0.2)
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(words(row))
    place = folder.parent
    (place / "calib_imu_to_velo.txt").write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {words(T_VELO_IMU[:3, :3])}\nT: {words(T_VELO_IMU[:3, 3])}\n"
    )
    (place / "calib_velo_to_cam.txt").write_text(
        f"R: {words(T_CAM_VELO[:3, :3])}\nT: {words(T_CAM_VELO[:3, 3])}\ndelta_f: 0.0 0.0\n"
    )
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
    for camera in (0, 1):
        n, shift = f"_{camera:02d}", camera * BASELINE_M
        text += f"S{n}: 40 30\nK{n}: 80 0 20 0 81 15 0 0 1\nD{n}: -0.37 0.2 0.001 0.002 -0.07\n"
        text += f"R{n}: {words(np.eye(3))}\nT{n}: {words([-shift, 0, 0])}\n"
        text += f"S_rect{n}: 32 24\nR_rect{n}: {words(R_RECT)}\nP_rect{n}: {words(projection(shift))}\n"
    (place / "calib_cam_to_cam.txt").write_text(text)
    return folder


@pytest.mark.parametrize("repair", [False, True])
def test_drives_of_kitti_are_read(tmp_path: Path, repair: bool) -> None:
    read = open_recording(drive(tmp_path), repair=repair, imu=BMI088)
    assert read.name == "2011_09_26_drive_0001_sync" and read.defects == ()
    start_ns = 1317042145 * 10**9  # 2011-09-26 13:02:25
    np.testing.assert_array_equal(read.frame_times_ns, start_ns + 64389440 + 100_000_000 * np.arange(4))
    np.testing.assert_array_equal(read.imu.t_ns, start_ns + 10_000_000 * np.arange(40))
    np.testing.assert_array_equal(read.imu.gyro_rad_s[7], [0.01, -0.02, 0.2])
    np.testing.assert_array_equal(read.imu.accel_m_s2[7], [0.1, 2.0, 9.8])
    assert read.rig.imu.rate_hz == pytest.approx(100.0)
    assert read.rig.imu.gyro_noise_density == BMI088.gyro_noise_density
    left, right = read.rig.cameras
    assert (left.model.fx, left.model.fy, left.model.cx, left.model.cy) == K and not any(left.model.distortion)
    T_cam_imu = pose_matrix(R_RECT, np.zeros(3)) @ T_CAM_VELO @ T_VELO_IMU
    np.testing.assert_allclose(left.T_imu_cam, inverse_pose(T_cam_imu), atol=1e-12)
    baseline = inverse_pose(left.T_imu_cam) @ right.T_imu_cam
    np.testing.assert_allclose(baseline, pose_matrix(np.eye(3), np.array([BASELINE_M, 0.0, 0.0])), atol=1e-12)
    assert len(read.frame(3).images) == 2


def test_ground_truth_of_drives_is_that_of_the_navigation_system(tmp_path: Path) -> None:
    """East 0.1 m, up 0.01 m and 2 mrad to the left per sample."""
    folder = drive(tmp_path)
    truth = read_trajectory(folder)
    np.testing.assert_allclose(truth.p_world_imu[30], [3.0, 0.0, 0.3], atol=1e-6)
    np.testing.assert_allclose(truth.rotations[30], exp_so3(np.array([0.0, 0.0, 0.06])), atol=1e-9)
    assert truth.velocity_m_s is not None
    np.testing.assert_allclose(truth.velocity_m_s[30], [10.0, 0.0, 0.0])
    times_ns = read_frame_times(folder)
    assert times_ns is not None and len(times_ns) == 4


def test_drives_that_are_not_rectified_have_a_lens(tmp_path: Path) -> None:
    read = open_recording(drive(tmp_path, size=(30, 40)))
    left, right = read.rig.cameras
    assert left.model.fx == 80.0 and left.model.distortion == (-0.37, 0.2, 0.001, 0.002, -0.07)
    np.testing.assert_allclose(inverse_pose(left.T_imu_cam), T_CAM_VELO @ T_VELO_IMU, atol=1e-12)
    np.testing.assert_allclose(inverse_pose(right.T_imu_cam)[0, 3], (T_CAM_VELO @ T_VELO_IMU)[0, 3] - BASELINE_M)


def test_noise_of_kittis_imu_must_be_given_for_odometry(tmp_path: Path) -> None:
    folder = drive(tmp_path)
    assert open_recording(folder).rig.imu.name == "unknown"
    with pytest.raises(InputError, match="no noise densities of the IMU; expected --calibration imu"):
        open_recording(folder, repair=True)
    (tmp_path / "imu.yaml").write_text(imu_yaml(replace(open_recording(folder).rig, imu=BMI088)))
    named = open_recording(folder, calibration=[tmp_path / "imu.yaml"], repair=True)
    assert named.rig.imu.accel_noise_density == BMI088.accel_noise_density


def test_missing_samples_and_images_of_a_drive_are_left_out(tmp_path: Path) -> None:
    folder = drive(tmp_path)
    (folder / "oxts" / "data" / "0000000005.txt").unlink()
    (folder / "image_01" / "data" / "0000000002.png").unlink()
    assert len(open_recording(folder).imu) == 39 and len(open_recording(folder).frame_times_ns) == 3
    (defect,) = open_recording(folder, repair=True, imu=BMI088).defects
    assert "no image of image_01" in defect.description


@pytest.mark.parametrize(
    ("file", "content", "found"),
    [
        ("oxts/data/0000000003.txt", "1 2 3", "3 fields"),
        ("oxts/timestamps.txt", "yesterday\n", "'yesterday'"),
        ("image_00/timestamps.txt", "", "no rows"),
        ("../calib_cam_to_cam.txt", "S_00: 1 2\n", "no S_rect_00"),
        ("../calib_imu_to_velo.txt", "R: 1 2\n", "R with 2 numbers"),
        ("image_00/data/0000000000.png", "x", "an image of"),
    ],
)
def test_damaged_drives_are_refused(tmp_path: Path, file: str, content: str, found: str) -> None:
    folder = drive(tmp_path)
    (folder / file).write_text(content)
    with pytest.raises(InputError, match=found):
        open_recording(folder)


def sequence(root: Path, frames: int = 4) -> Path:
    """Write a sequence of the odometry benchmark that goes straight ahead, 1 m per frame, with its poses."""
    folder = root / "dataset" / "sequences" / "07"
    for camera in (0, 1):
        images(folder / f"image_{camera}", frames, 6, camera)
    (folder / "times.txt").write_text("".join(f"{0.1037 * k:e}\n" for k in range(frames)))
    (folder / "calib.txt").write_text("".join(f"P{n}: {words(projection(n * BASELINE_M))}\n" for n in range(4)))
    poses = root / "dataset" / "poses"
    poses.mkdir()
    rows = [np.hstack([np.eye(3), [[0.0], [0.0], [float(k)]]]) for k in range(frames)]
    (poses / "07.txt").write_text("".join(f"{words(row)}\n" for row in rows))
    return folder


def test_sequences_of_kitti_have_images_alone(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    read = open_recording(folder)
    assert len(read.imu) == 0 and len(read.frame_times_ns) == 4
    np.testing.assert_array_equal(read.rig.cameras[0].T_imu_cam, np.eye(4))
    np.testing.assert_allclose(read.rig.cameras[1].T_imu_cam[:3, 3], [BASELINE_M, 0.0, 0.0])
    truth = read_trajectory(folder)
    np.testing.assert_allclose(truth.p_world_imu[3], [3.0, 0.0, 0.0])  # forward, in a frame with z up
    np.testing.assert_allclose(truth.rotations[3][:, 2], [1.0, 0.0, 0.0], atol=1e-12)
    found = open_images(folder, cameras=(0, 1))
    assert len(found) == 8 and found.inertial is None and found.is_calibrated.all()
    with pytest.raises(InputError, match="which has no IMU; expected a drive of the raw data; dronevio sfm needs none"):
        open_recording(folder, repair=True)
    (tmp_path / "dataset" / "poses" / "07.txt").unlink()
    assert open_recording(folder).ground_truth is None
    with pytest.raises(InputError, match="no ground truth"):
        read_trajectory(folder)
