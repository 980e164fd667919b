"""Reconstructions of the images of a recording: gray values, names, and a folder for programs that read COLMAP."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.colmap import read_colmap
from dronevio.models.reconstructions.recorded import (
    RecordedReconstruction,
    image_name,
    with_images,
    write_colmap_folder,
)
from dronevio.models.recordings.euroc import EurocRecording, write_euroc_recording
from dronevio.models.recordings.images import decode_grey
from dronevio.models.state import NO_IMAGE, CameraFrame

Make = Callable[..., Any]


def recorded(recording: Any) -> RecordedReconstruction:
    """Return a reconstruction of the frames 0 and 2 of a recording, with two points at given pixels."""
    models = tuple(camera.model for camera in recording.rig.cameras)
    stamps_ns = np.repeat(recording.frame_times_ns[[0, 2]], 2)
    return RecordedReconstruction(
        Reconstruction(
            cameras=models,
            image_names=tuple(image_name(i % 2, t) for i, t in enumerate(stamps_ns.tolist())),
            image_camera=np.array([0, 1, 0, 1]),
            Ts_world_cam=np.tile(np.eye(4), (4, 1, 1)),
            points=np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0]]),
            colours=np.full((3, 3), 128, np.uint8),
            observation_image=np.array([3, 0, 1, 0]),
            observation_point=np.array([0, 0, 1, 1]),
            observation_px=np.array([[4.4, 3.6], [10.0, 20.0], [31.4, 23.4], [0.0, 5.0]]),
        ),
        stamps_ns,
    )


def test_points_have_the_mean_gray_value_of_their_pixels(noise_recording: Make) -> None:
    recording = noise_recording()
    r = with_images(recorded(recording), recording)
    first, third = recording.frame(0).images, recording.frame(2).images
    means = np.mean([third[1][4, 4], first[0][20, 10]]), np.mean([first[1][23, 31], first[0][5, 0]])
    np.testing.assert_allclose(r.colours, np.rint([[m] * 3 for m in (*means, 0.0)]), atol=0.5)
    assert r.image_names == recorded(recording).reconstruction.image_names  # it has no files


class WithoutImage:
    """A recording whose first camera lacks the image of a frame."""

    def __init__(self, recording: Any, frame: int) -> None:
        self._recording, self._frame = recording, frame

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def frame(self, index: int) -> CameraFrame:
        """Return a frame."""
        frame: CameraFrame = self._recording.frame(index)
        return replace(frame, images=(NO_IMAGE, frame.images[1])) if index == self._frame else frame


def test_images_that_are_missing_are_left_out(noise_recording: Make, tmp_path: Path) -> None:
    recording = noise_recording()
    found = recorded(recording)
    write_colmap_folder(tmp_path, found, WithoutImage(recording, 0))
    r, whole = read_colmap(tmp_path / "sparse" / "0"), found.reconstruction
    assert r.image_names == whole.image_names[1:]
    np.testing.assert_array_equal(r.image_camera, [1, 0, 1])
    # Two observations remain, in the images that were the second and the fourth.
    np.testing.assert_array_equal(np.sort(r.observation_image), [0, 2])
    np.testing.assert_allclose(r.observation_px[np.argsort(r.observation_image)], [[31.4, 23.4], [4.4, 3.6]])
    written = sorted(str(file.relative_to(tmp_path / "images")) for file in tmp_path.rglob("*.png"))
    assert written == sorted(r.image_names)


def test_images_of_one_time_are_a_frame(noise_recording: Make, tmp_path: Path) -> None:
    """The first frame lacks its first image; poses come from the frames and the mounting."""
    pycolmap = pytest.importorskip("pycolmap")
    recording = noise_recording()
    found = recorded(recording)
    Ts_imu_cam = np.tile(np.eye(4), (2, 1, 1))
    Ts_imu_cam[1, :3, 3] = [0.1, 0.02, -0.03]
    Ts_map_imu = np.tile(np.eye(4), (4, 1, 1))
    Ts_map_imu[2:, :3, 3] = [1.0, 2.0, 3.0]
    moved = replace(found.reconstruction, Ts_world_cam=Ts_map_imu @ Ts_imu_cam[[0, 1, 0, 1]])
    mounted = replace(found, reconstruction=moved, Ts_imu_cam=Ts_imu_cam)
    write_colmap_folder(tmp_path, mounted, WithoutImage(recording, 0))
    theirs = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert (theirs.num_rigs(), theirs.num_frames(), theirs.num_images()) == (1, 2, 3)
    positions = [theirs.image(i + 1).projection_center() for i in range(3)]
    np.testing.assert_allclose(positions, [[0.1, 0.02, -0.03], [1.0, 2.0, 3.0], [1.1, 2.02, 2.97]], atol=1e-12)


def test_written_images_are_those_of_the_recording(noise_recording: Make, tmp_path: Path) -> None:
    recording = noise_recording()
    write_colmap_folder(tmp_path, recorded(recording), recording)
    for i, name in enumerate(recorded(recording).reconstruction.image_names):
        file, expected = tmp_path / "images" / name, recording.frame(2 * (i // 2)).images[i % 2]
        height, width = expected.shape
        np.testing.assert_array_equal(decode_grey(file, file.read_bytes(), width, height), expected)


def test_files_are_copied_with_their_names(noise_recording: Make, tmp_path: Path) -> None:
    recording = noise_recording()
    write_euroc_recording(tmp_path / "recording", recording)
    read = EurocRecording.open(tmp_path / "recording")
    files = [[file.with_name(f"{i:04}.png") for i, file in enumerate(each) if file] for each in read.image_files]
    for before, after in zip(chain(*read.image_files), chain(*files), strict=True):
        assert before is not None
        before.rename(after)
    named = replace(read, image_files=tuple(map(tuple, files)))
    write_colmap_folder(tmp_path / "colmap", recorded(recording), named)
    r = read_colmap(tmp_path / "colmap" / "sparse" / "0")
    assert r.image_names == ("cam0/0000.png", "cam1/0000.png", "cam0/0002.png", "cam1/0002.png")
    for name, file in zip(r.image_names, (files[0][0], files[1][0], files[0][2], files[1][2]), strict=True):
        assert (tmp_path / "colmap" / "images" / name).read_bytes() == file.read_bytes()
    named.__dict__["image_bits"] = (12, 8)  # a deep image is written with 8 bits
    write_colmap_folder(tmp_path / "deep", recorded(recording), named)
    assert read_colmap(tmp_path / "deep" / "sparse" / "0").image_names == r.image_names
    deep = tmp_path / "deep" / "images" / "cam0" / "0000.png"
    np.testing.assert_array_equal(decode_grey(deep, deep.read_bytes(), 32, 24), recording.frame(0).images[0])


def test_another_recording_is_refused(noise_recording: Make, tmp_path: Path) -> None:
    recording = noise_recording()
    found = recorded(recording)
    for shift_ns in (1, 10**12):
        other = replace(found, stamps_ns=found.stamps_ns + shift_ns)
        with pytest.raises(ConfigError, match=r"noise: no frame at \d+ ns; expected the recording of the map"):
            with_images(other, recording)


def test_a_folder_that_cannot_be_made_is_named(noise_recording: Make, tmp_path: Path) -> None:
    recording = noise_recording()
    (tmp_path / "images").write_text("a file")
    with pytest.raises(InputError, match="images"):
        write_colmap_folder(tmp_path, recorded(recording), recording)
