"""Files of Bundler: round trips, axes and pixels by hand, damaged files, and agreement with GTSAM."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_bundler, write_bundler

Make = Callable[..., Reconstruction]
Same = Callable[[Reconstruction, Reconstruction], None]

CAMERAS = (
    CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5, (-0.1, 0.02, 0.0, 0.0)),
    CameraModel(101, 81, 90.0, 90.0, 50.0, 40.0),
)

BY_HAND = """# Bundle file v0.3
2 1
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
100 0 0
1 0 0
0 1 0
0 0 1
1 2 3
1 2 -7
255 128 0
1 1 4 50.0 -20.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bundler")


def write(folder: Path, text: str = BY_HAND) -> Path:
    path = folder / "bundle.out"
    path.write_text(text)
    return path


def test_round_trip(
    tmp_path: Path, scene: Make, assert_same_reconstruction: Same, contents: Callable[..., object]
) -> None:
    before = scene(*CAMERAS)
    for name in ("one", "two"):
        write_bundler(tmp_path / name / "bundle.out", before)
    sizes = [(before.cameras[i].width, before.cameras[i].height) for i in before.image_camera]
    assert_same_reconstruction(read_bundler(tmp_path / "one" / "bundle.out", image_sizes=sizes), before)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert (tmp_path / "one" / "bundle.list.txt").read_text().split() == list(before.image_names)


def test_unknown_sizes_keep_reprojection_errors(tmp_path: Path, scene: Make) -> None:
    before = scene(*CAMERAS)
    write_bundler(tmp_path / "a.out", before)
    after = read_bundler(tmp_path / "a.out")
    np.testing.assert_allclose(np.sort(after.reprojection_errors_px()), np.sort(before.reprojection_errors_px()))
    for ours, theirs in zip(before.cameras, after.cameras, strict=True):
        assert theirs.width <= ours.width and theirs.height <= ours.height
    size = np.array([(c.width, c.height) for c in after.cameras])[after.image_camera[after.observation_image]]
    assert np.all((after.observation_px >= -0.5) & (after.observation_px <= size - 0.5))


def test_a_file_by_hand(tmp_path: Path) -> None:
    """The camera at (−1, −2, −3) looks along −z with y up; its x is right. The first camera is not registered."""
    (tmp_path / "list.txt").write_text("first.jpg 0 99.5\n./second.jpg\n")
    r = read_bundler(write(tmp_path), image_sizes=[(1, 1), (201, 101)])
    assert r.image_names == ("./second.jpg",)
    assert r.cameras == (CameraModel(201, 101, 100.0, 100.0, 100.0, 50.0),)
    np.testing.assert_allclose(r.positions, [[-1, -2, -3]])
    np.testing.assert_allclose(r.Ts_world_cam[0, :3, :3], np.diag([1, -1, -1]), atol=1e-15)
    # In the camera frame the point is (2, 4, −4) for Bundler: right of the axis, above it and 4 in front.
    np.testing.assert_allclose(r.points_in_cameras(), [[2, -4, 4]])
    # Bundler's (50, −20) is right of the centre (100, 50) by 50 and below it by 20.
    np.testing.assert_allclose(r.observation_px, [[150, 70]])
    np.testing.assert_allclose(r.reprojection_errors_px(), [120.0])  # the point projects to (150, −50)
    np.testing.assert_array_equal(r.colours, [[255, 128, 0]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("v0.3", "v0.4", r":1: '# Bundle file v0\.4'; expected the first line"),
        ("2 1\n", "2 2\n", r"43 numbers for 2 cameras and 2 points; expected a complete file"),
        ("2 1\n", "2 99999999999999999\n", r"43 numbers for 2 cameras and 99999999999999999 points"),
        ("2 1\n", "2 1.5\n", r":2: .*'1\.5'; expected integers"),
        ("1 1 4 50.0 -20.0", "2 1 4 50.0 -20.0", r":15: 4 numbers after point 0 with 2 observations"),
        ("1 1 4 50.0 -20.0", "1 1 4 50.0", r":15: 3 numbers after point 0 with 1 observations"),
        ("1 1 4 50.0 -20.0", "1 1 4 5O.0 -20.0", r":15: '5O\.0'; expected a number"),
        ("1 1 4 50.0 -20.0", "1 1 4 nan -20.0", r":15: the number nan"),
        ("1 1 4 50.0 -20.0", "1 1 4 50.0 -20.0 7", r": 1 numbers after the last point"),
        ("1 1 4 50.0 -20.0", "1 2 4 50.0 -20.0", r"a camera that does not exist; expected cameras 0 to 1"),
        ("1 1 4 50.0 -20.0", "1 0 4 50.0 -20.0", r"camera 0, which is not registered"),
        ("1 1 4 50.0 -20.0", "1 1 4 1e9 -20.0", r"an observation at 1e\+09 px"),
        ("0 1 0\n0 0 1", "0 1 0\n0 0 2", r"a matrix that is not a rotation"),
        ("0 1 0\n0 0 1", "0 1 0\n0 0 -1", r"a matrix that is not a rotation"),
        ("100 0 0", "-100 0 0", r"fx = -100"),
        ("255 128 0", "255 128 0.5", r"the colour 255 128 0\.5"),
    ],
)
def test_damage_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in BY_HAND
    with pytest.raises(InputError, match=r"bundle\.out" + ".*" + message):
        read_bundler(write(tmp_path, BY_HAND.replace(old, new, 1)))


def test_the_end_within_a_point_is_named(tmp_path: Path) -> None:
    text = BY_HAND.replace("2 1\n", "2 2\n") + "1 2 3\n"
    with pytest.raises(
        InputError, match=r"bundle\.out:16: the end of the file within point 1; expected a complete file"
    ):
        read_bundler(write(tmp_path, text))


@pytest.mark.parametrize(
    ("names", "message"),
    [("a.jpg\n../b.jpg\n", r":2: the image name '\.\./b"), ("a.jpg\n", ": 1 images; expected one")],
)
def test_wrong_lists_are_refused(tmp_path: Path, names: str, message: str) -> None:
    (tmp_path / "names.txt").write_text(names)
    with pytest.raises(InputError, match=r"names\.txt" + message):
        read_bundler(write(tmp_path), tmp_path / "names.txt")
    with pytest.raises(ConfigError, match="1 image sizes; expected one for each of 2 cameras"):
        read_bundler(write(tmp_path), image_sizes=[(10, 10)])


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_damaged_files_raise_only_input_errors(folder: Path, data: st.DataObject) -> None:
    original = BY_HAND.encode()
    start = data.draw(st.integers(0, len(original)))
    end = data.draw(st.integers(start, min(start + 6, len(original))) | st.just(len(original)))
    middle = data.draw(st.binary(max_size=12) | st.text("0123456789.-e \n", max_size=12).map(str.encode))
    path = folder / "damaged.out"
    path.write_bytes(original[:start] + middle + original[end:])
    try:
        read_bundler(path).reprojection_errors_px()
    except InputError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lens": "equidistant"}, "the lens equidistant"),
        ({"distortion": (0.0, 0.0, 0.0, 1e-4)}, "tangential distortion"),
        ({"fy": 501.0}, "focal lengths 500.0 and 501.0 px"),
        ({"cx": 320.0}, r"the principal point \(320.0, 239.5\) px; expected the image centre, \(319.5, 239.5\)"),
    ],
)
def test_other_cameras_are_not_written(tmp_path: Path, scene: Make, change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=f"Bundler: camera 1 has {message}"):
        write_bundler(tmp_path / "a.out", scene(CAMERAS[1], replace(CAMERAS[0], **change)))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_balbianello_agrees_with_gtsam(tmp_path: Path) -> None:
    """GTSAM reads the file that it carries, and what is written of it, with the same reprojection errors."""
    path = Path(gtsam.findExampleDataFile("Balbianello.out"))
    r = read_bundler(path)
    assert (len(r.image_names), len(r.cameras), len(r.points)) == (5, 5, 544)
    write_bundler(tmp_path / "copy.out", r)
    for file in (path, tmp_path / "copy.out"):
        poses, errors, counts = gtsam_errors_px(file)
        np.testing.assert_allclose(r.Ts_world_cam, poses, atol=1e-9)  # the file has eleven digits
        np.testing.assert_array_equal(r.track_lengths(), counts)
        np.testing.assert_allclose(r.reprojection_errors_px(), errors, atol=1e-6)
    assert np.median(errors) < 0.5


def gtsam_errors_px(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the poses, the reprojection errors and the track lengths of a file by GTSAM."""
    data = gtsam.SfmData.FromBundlerFile(str(path))
    cameras = [data.camera(i) for i in range(data.numberCameras())]
    errors, counts = [], []
    for j in range(data.numberTracks()):
        track = data.track(j)
        counts.append(track.numberMeasurements())
        for k in range(counts[-1]):
            i, uv = track.measurement(k)
            errors.append(np.linalg.norm(cameras[i].project(track.point3()) - uv))
    return np.stack([camera.pose().matrix() for camera in cameras]), np.array(errors), np.array(counts)
