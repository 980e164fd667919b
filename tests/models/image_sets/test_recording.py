"""Recordings as image sets, and the recognition of folders, videos and recordings."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image as PillowImage

from dronevio.models import CameraModel, ConfigError, ImageSet, InputError, image_recording, open_images
from dronevio.models.recordings.calibration.kalibr import camchain_yaml
from dronevio.models.recordings.euroc import write_euroc_recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import inverse_pose


@pytest.fixture(scope="module")
def recording(noise_recording: Callable[..., Any]) -> Any:
    return noise_recording("euroc-stereo", frames=5)


@pytest.fixture(scope="module")
def folder(recording: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "flight"
    write_euroc_recording(path, recording)
    return path


def test_stereo_images_belong_to_frames(recording: Any) -> None:
    images = image_recording(recording, cameras=(0, 1))
    t_ns = recording.frame_times_ns
    assert images.names[:3] == (f"cam0/{t_ns[0]}", f"cam1/{t_ns[0]}", f"cam0/{t_ns[1]}")
    assert images.frame is not None and images.t_ns is not None and images.Ts_imu_cam is not None
    assert images.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert images.image_camera.tolist() == [0, 1] * 5
    np.testing.assert_array_equal(images.t_ns, np.repeat(t_ns, 2))
    assert images.cameras == tuple(camera.model for camera in recording.rig.cameras)
    for T_imu_cam, camera in zip(images.Ts_imu_cam, recording.rig.cameras, strict=True):
        np.testing.assert_array_equal(T_imu_cam, camera.T_imu_cam)
    assert images.is_calibrated.all() and images.is_ordered and images.focal_source == ("calibration",) * 2
    for index in (5, 4, 0, 9, 1):
        frame = recording.frame(index // 2)
        np.testing.assert_array_equal(images.read(index), frame.images[index % 2])


def test_the_second_camera_alone(recording: Any, folder: Path) -> None:
    for images in (image_recording(recording, cameras=[1]), image_recording(folder, cameras=[1])):
        assert images.names[2] == f"cam1/{recording.frame_times_ns[2]}" and images.image_camera.tolist() == [0] * 5
        np.testing.assert_array_equal(images.read(2), recording.frame(2).images[1])


@pytest.mark.parametrize(
    ("frames", "expected"), [(None, [0, 1, 2, 3, 4]), (3, [0, 2, 4]), (1, [0]), (5, [0, 1, 2, 3, 4]), ([3, 1], [1, 3])]
)
def test_frames_are_spread_evenly(recording: Any, frames: Any, expected: list[int]) -> None:
    images = image_recording(recording, frames=frames)
    assert images.t_ns is not None and images.frame is not None
    assert images.t_ns.tolist() == recording.frame_times_ns[expected].tolist()
    assert images.frame.tolist() == list(range(len(expected)))
    np.testing.assert_array_equal(images.read(len(expected) - 1), recording.frame(expected[-1]).images[0])


@pytest.mark.parametrize("options", [{"cameras": (2,)}, {"cameras": ()}, {"cameras": (0, 0)}, {"cameras": (-1,)}])
def test_wrong_cameras_are_refused(recording: Any, folder: Path, options: dict[str, Any]) -> None:
    for source in (recording, folder):
        with pytest.raises(ConfigError, match=r"cameras .*; expected different ones of cam0 to cam1"):
            image_recording(source, **options)


@pytest.mark.parametrize("frames", [0, 6, [5], [1, 1]])
def test_wrong_frames_are_refused(recording: Any, frames: Any) -> None:
    with pytest.raises(ConfigError, match=r"expected (1 to 5|different ones from 0 to 4)"):
        image_recording(recording, frames=frames)


def test_masks_of_a_rig_are_per_camera(recording: Any, tmp_path: Path) -> None:
    values = np.full((24, 32), 255, np.uint8)
    values[:5] = 0
    PillowImage.fromarray(values).save(tmp_path / "cam1.png")
    images = image_recording(recording, cameras=(0, 1), masks=tmp_path)
    mask = images.read_mask(3)
    assert images.read_mask(2) is None and mask is not None
    np.testing.assert_array_equal(mask, values > 0)


def test_damaged_images_are_refused(recording: Any, tmp_path: Path) -> None:
    write_euroc_recording(tmp_path, recording)
    images = image_recording(tmp_path)
    file = tmp_path / "mav0/cam0/data" / f"{recording.frame_times_ns[1]}.png"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match="truncated PNG"):
        images.read(1)
    assert images.read(0).shape == (24, 32)


# --- recognition


def test_recordings_are_recognized(folder: Path, tmp_path: Path) -> None:
    for path in (folder, folder / "mav0"):
        images = open_images(path, frames=2)
        assert len(images) == 2 and images.is_calibrated.all()
    with pytest.raises(InputError, match="no such file; expected a bag of ROS 1"):
        open_images(tmp_path / "a.bag")


def test_folders_are_recognized(tmp_path: Path) -> None:
    (tmp_path / "cam0").mkdir()
    PillowImage.fromarray(np.zeros((24, 32), np.uint8)).save(tmp_path / "cam0/a.png")
    assert open_images(tmp_path, camera="per-image").names == ("cam0/a.png",)


@pytest.mark.parametrize("name", ["none", "none.mp4", "notes.txt"])
def test_other_paths_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "notes.txt").write_text("no images")
    with pytest.raises(InputError, match=f"{name}: .*; expected a"):
        open_images(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "options"),
    [("flight", {"every": 2}), ("flight", {"model": "model"}), ("a.mp4", {"frames": 3}), ("", {"cameras": (0,)})],
)
def test_options_of_other_kinds_are_refused(folder: Path, name: str, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"the option {next(iter(options))} for a"):
        open_images(folder.parent / name, **options)


# --- the class


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "a")}, "two images with the name a"),
        ({"image_camera": np.array([0, 1])}, "values from 0 to 1; expected 0 to 0"),
        ({"t_ns": np.zeros(3, np.int64)}, r"t_ns has shape \(3,\)"),
        ({"Ts_imu_cam": np.eye(4)}, r"Ts_imu_cam has shape \(4, 4\); expected \(1, 4, 4\)"),
        ({"focal_source": ("assumed", "assumed")}, "focal_source has 2 values"),
    ],
)
def test_contradictions_are_refused(changes: dict[str, Any], message: str) -> None:
    images = ImageSet(
        names=("a", "b"),
        image_camera=np.zeros(2, np.int64),
        cameras=(CameraModel(4, 3, 1.0, 1.0, 1.5, 1.0),),
        is_calibrated=np.array([False]),
        is_ordered=False,
        t_ns=None,
        frame=None,
        Ts_imu_cam=None,
        read=lambda _: np.zeros((3, 4), np.uint8),
        read_mask=lambda _: None,
    )
    with pytest.raises(ConfigError, match=message):
        replace(images, **changes)


@pytest.mark.parametrize("is_stamped", [True, False], ids=["time stamps", "time offset"])
def test_cameras_exposed_apart_have_frames_of_their_own(is_stamped: bool, noise_recording: Callable[..., Any]) -> None:
    recording = noise_recording("euroc-stereo", frames=3)
    times, later_ns = recording.frame_times_ns, 2_160_000
    if is_stamped:
        delays = np.tile([0, later_ns], (3, 1))
        recording = SimpleNamespace(
            rig=recording.rig, imu=recording.imu, frame_times_ns=times, frame=recording.frame, image_delays_ns=delays
        )
    else:
        first, second = recording.rig.cameras
        rig = replace(recording.rig, cameras=(first, replace(second, time_offset_s=later_ns * 1e-9)))
        recording = replace(recording, rig=rig)
    images = image_recording(recording, cameras=(0, 1))
    np.testing.assert_array_equal(images.t_ns, np.ravel(np.column_stack([times, times + later_ns])))
    np.testing.assert_array_equal(images.frame, [0, 4, 1, 6, 2, 8])
    second_alone = image_recording(recording, cameras=(1,))
    np.testing.assert_array_equal(second_alone.t_ns, times + later_ns)
    np.testing.assert_array_equal(second_alone.frame, [0, 1, 2])


def test_a_recording_needs_no_imu(recording: Any, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "flight")
    shutil.rmtree(tmp_path / "flight" / "mav0" / "imu0")
    images, with_imu = (open_images(path, cameras=[0, 1]) for path in (tmp_path / "flight", folder))
    assert images.inertial is None and with_imu.inertial is not None
    assert images.names == with_imu.names and images.cameras == with_imu.cameras
    np.testing.assert_array_equal(images.Ts_imu_cam, with_imu.Ts_imu_cam)
    np.testing.assert_array_equal(images.read(3), recording.frame(1).images[1])
    with pytest.raises(InputError, match="no IMU; expected a recording with an IMU"):
        open_recording(tmp_path / "flight", repair=True)


@pytest.fixture
def pairs(recording: Any, tmp_path: Path) -> Path:
    """A folder of a rig: two frames of the recording, and one image of the first camera alone."""
    for camera, count in ((0, 3), (1, 2)):
        (tmp_path / f"cam{camera}").mkdir()
        for k in range(count):
            PillowImage.fromarray(recording.frame(k).images[camera]).save(tmp_path / f"cam{camera}" / f"{9 + k}.png")
    without_imu = re.sub(r" *T_(cam_imu|imu_cam):\n( *- .*\n){4}", "", camchain_yaml(recording.rig))
    assert "T_cam_imu" not in without_imu and "T_cn_cnm1" in without_imu
    (tmp_path / "rig.yaml").write_text(without_imu)
    return tmp_path


def test_images_of_a_rig_with_one_name_are_of_one_moment(recording: Any, pairs: Path) -> None:
    (pairs / "cam1" / "10.png").rename(pairs / "cam1" / "10.PNG")
    (pairs / "cam1" / "11.png").write_text("a text")
    images = open_images(pairs)
    assert images.names == ("cam0/9.png", "cam1/9.png", "cam0/10.png", "cam1/10.PNG", "cam0/11.png")
    assert images.frame is not None and images.frame.tolist() == [0, 0, 1, 1, 2]
    assert images.image_camera.tolist() == [0, 1, 0, 1, 0] and images.is_calibrated.all()
    assert list(images.skipped) == ["cam1/11.png"]
    np.testing.assert_array_equal(images.read(3), recording.frame(1).images[1])
    # The frame of the rig is that of the first camera, since there is no IMU.
    assert images.Ts_imu_cam is not None
    T_0_1 = inverse_pose(recording.rig.cameras[0].T_imu_cam) @ recording.rig.cameras[1].T_imu_cam
    np.testing.assert_allclose(images.Ts_imu_cam, [np.eye(4), T_0_1], atol=1e-9)


def test_cameras_of_a_rig_are_chosen(pairs: Path) -> None:
    images = open_images(pairs, cameras=[1])
    assert images.names == ("cam1/9.png", "cam1/10.png") and images.image_camera.tolist() == [0, 0]
    with pytest.raises(ConfigError, match=r"cameras 0, 2; expected different ones of cam0 to cam1"):
        open_images(pairs, cameras=[0, 2])
    with pytest.raises(ConfigError, match="cameras -1; expected"):
        open_images(pairs, cameras=[-1])
    with pytest.raises(ConfigError, match="the option every for a folder of a rig"):
        open_images(pairs, every=2)
    shutil.rmtree(pairs / "cam1")
    with pytest.raises(InputError, match="cam1: no such folder"):
        open_images(pairs)
