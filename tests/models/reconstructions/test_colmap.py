"""Sparse models of COLMAP: round trips, the half pixel, damaged files, and what pycolmap reads and writes."""

import struct
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.lenses.lens import LensName
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import ReconstructionFormat, RigFrames, read_colmap, write_colmap
from dronevio.models.reconstructions.formats import check_format
from dronevio.models.rotation import exp_so3, pose_matrix

Make = Callable[..., Reconstruction]
Same = Callable[[Reconstruction, Reconstruction], None]

CAMERAS = "1 SIMPLE_PINHOLE 640 480 500 320 240\n"
IMAGES = """# Comments and empty lines are ignored.

7 1 0 0 0 -1 -2 3 1 second.png
100.5 200.5 5 1 2 -1
3 1 0 0 0 0 0 0 1 first.png
"""
POINTS = "5 1 2 7 10 20 30 0.5 7 0\n"


def write_model(folder: Path, cameras: str = CAMERAS, images: str = IMAGES, points: str | None = POINTS) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        if text is not None:
            (folder / f"{name}.txt").write_text(text)
    return folder


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_round_trip(
    tmp_path: Path, scene: Make, assert_same_reconstruction: Same, contents: Callable[..., object], binary: bool
) -> None:
    before = scene()
    for name in ("one", "two"):
        write_colmap(tmp_path / name, before, binary)
    assert_same_reconstruction(read_colmap(tmp_path / "one"), before)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_no_points_and_no_images(tmp_path: Path, scene: Make, assert_same_reconstruction: Same, binary: bool) -> None:
    r, none = scene(), np.empty(0, np.int64)
    unobserved = replace(r, observation_image=none, observation_point=none, observation_px=np.empty((0, 2)))
    poses = replace(unobserved, points=np.empty((0, 3)), colours=np.empty((0, 3), np.uint8))
    empty = replace(poses, image_names=(), image_camera=none, Ts_world_cam=np.empty((0, 4, 4)), cameras=())
    for name, reconstruction in (("poses", poses), ("empty", empty)):
        write_colmap(tmp_path / name, reconstruction, binary)
        assert_same_reconstruction(read_colmap(tmp_path / name), reconstruction)
        (tmp_path / name / f"points3D.{'bin' if binary else 'txt'}").unlink()
        assert_same_reconstruction(read_colmap(tmp_path / name), reconstruction)


def test_a_model_by_hand(tmp_path: Path) -> None:
    """The centre of the first pixel is (0.5, 0.5) in the files and (0, 0) here; images are ordered by number."""
    r = read_colmap(write_model(tmp_path))
    assert r.image_names == ("first.png", "second.png")
    assert r.cameras == (CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5),)
    np.testing.assert_array_equal(r.positions, [[0, 0, 0], [1, 2, -3]])
    np.testing.assert_array_equal(r.observation_px, [[100.0, 200.0]])
    assert (r.observation_image.tolist(), r.observation_point.tolist()) == ([1], [0])
    np.testing.assert_array_equal(r.colours, [[10, 20, 30]])
    # The point is on the optical axis of the second camera, whose pixel is (320, 240) in COLMAP.
    np.testing.assert_allclose(r.reprojection_errors_px(), np.hypot(320 - 100.5, 240 - 200.5))


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize(
    ("lens", "distortion"),
    [
        ("radtan", (0.1, 0.2, 0.3, 0.4, 0.5)),
        ("fov", (0.9,)),
        ("eucm", (0.6, 1.1)),
        ("equidistant", (0.1, 0.2, 0.3, 0.4)),
    ],
)
def test_lenses_of_colmap_return(
    tmp_path: Path, scene: Make, lens: LensName, distortion: tuple[float, ...], binary: bool
) -> None:
    model = CameraModel(640, 480, 500.0, 510.0, 319.5, 239.5, distortion, lens)
    write_colmap(tmp_path, scene(model), binary=binary)
    (back,) = read_colmap(tmp_path).cameras
    expected = (*distortion, 0.0, 0.0, 0.0) if lens == "radtan" else distortion
    assert back == replace(model, distortion=expected)


@pytest.mark.parametrize(("lens", "distortion"), [("ds", (0.1, 0.5)), ("omni", (1.0, 0.0, 0.0, 0.0, 0.0))])
@pytest.mark.parametrize("format", ["colmap-binary", "colmap-text", "bundler"])
def test_lenses_that_a_format_does_not_have_are_refused(
    lens: LensName, distortion: tuple[float, ...], format: ReconstructionFormat
) -> None:
    model = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5, distortion, lens)
    with pytest.raises(ConfigError, match=f"lens {lens}; expected"):
        check_format(format, [model])
    check_format("ply", [model])  # has no cameras


@pytest.mark.parametrize(
    ("format", "has_spaces"), [("colmap-text", False), ("bundler", False), ("colmap-binary", True)]
)
def test_formats_without_spaces_in_names_refuse_them(format: ReconstructionFormat, has_spaces: bool) -> None:
    model = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)
    check_format(format, [model], ["a/b.jpg"])
    with nullcontext() if has_spaces else pytest.raises(ConfigError, match=r"the image 'a b\.jpg'; expected a name"):
        check_format(format, [model], ["a.jpg", "a b.jpg"])


def test_pixels_are_written_half_a_pixel_further(tmp_path: Path, scene: Make) -> None:
    r = scene(CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5))
    write_colmap(tmp_path, replace(r, observation_px=np.round(r.observation_px)), binary=False)
    assert "1 PINHOLE 640 480 500.0 500.0 320.0 240.0" in (tmp_path / "cameras.txt").read_text()
    keypoints = (tmp_path / "images.txt").read_text().splitlines()[5].split()
    assert all(x.endswith(".5") for x in [*keypoints[0::3], *keypoints[1::3]])


@pytest.mark.parametrize(
    ("row", "distortion", "lens"),
    [
        ("SIMPLE_PINHOLE 64 48 50 32 24", (0, 0, 0, 0), "radtan"),
        ("PINHOLE 64 48 50 60 32 24", (0, 0, 0, 0), "radtan"),
        ("SIMPLE_RADIAL 64 48 50 32 24 .1", (0.1, 0, 0, 0), "radtan"),
        ("RADIAL 64 48 50 32 24 .1 .2", (0.1, 0.2, 0, 0), "radtan"),
        ("OPENCV 64 48 50 60 32 24 .1 .2 .3 .4", (0.1, 0.2, 0.3, 0.4), "radtan"),
        ("OPENCV_FISHEYE 64 48 50 60 32 24 .1 .2 .3 .4", (0.1, 0.2, 0.3, 0.4), "equidistant"),
        ("FULL_OPENCV 64 48 50 60 32 24 .1 .2 .3 .4 .5 .6 .7 .8", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), "radtan"),
        ("FOV 64 48 50 60 32 24 .9", (0.9,), "fov"),
        ("EUCM 64 48 50 60 32 24 .6 1.1", (0.6, 1.1), "eucm"),
    ],
)
def test_camera_models(tmp_path: Path, row: str, distortion: tuple[float, ...], lens: str) -> None:
    (camera,) = read_colmap(write_model(tmp_path, f"1 {row}\n")).cameras
    assert (camera.distortion, camera.lens, camera.cx, camera.cy) == (distortion, lens, 31.5, 23.5)
    assert (camera.fx, camera.fy) == (50, 60 if " 60 " in row else 50)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"cameras": "# one\n1 FISHEYE 64 48 50 60 32 24 .1\n"},
            r"cameras\.txt:2: camera 1: camera model FISHEYE; expected one",
        ),
        ({"cameras": "1 PINHOLE 64 48 50 60 32\n"}, r"cameras\.txt:1: camera 1: 3 parameters of PINHOLE; expected 4"),
        ({"cameras": "1 PINHOLE 64 48 -50 60 32 24\n"}, r"cameras\.txt:1: camera 1: CameraModel\.fx = -50"),
        ({"cameras": f"1 PINHOLE {10**12} 48 50 60 32 24\n"}, r"cameras\.txt:1: camera 1: an image of 10{12} × 48 px"),
        ({"cameras": CAMERAS * 2}, r"cameras\.txt: camera 1 twice"),
        ({"cameras": "2" + CAMERAS[1:]}, r"images\.txt: a reference to camera 1, which does not exist"),
        ({"images": IMAGES.replace("second.png", "../up.png")}, r"images\.txt:3: the image name '\.\./up\.png'"),
        ({"images": IMAGES.replace("second.png", "/etc/passwd")}, r"images\.txt:3: the image name '/etc/passwd'"),
        ({"images": IMAGES.replace("100.5 200.5 5", "100.5 200.5")}, r"images\.txt:4: 5 fields instead of POINTS2D"),
        ({"images": IMAGES.replace("100.5", "inf")}, r"images\.txt:4: the number inf"),
        ({"images": IMAGES.replace("1 0 0 0 -1", "1 1 0 0 -1")}, r"images\.txt:3: a quaternion of length 1\.41"),
        ({"images": IMAGES[:-12]}, r"images\.txt:5: 8 fields; expected IMAGE_ID"),
        ({"images": IMAGES.replace("200.5 5", "200.5 6")}, r"points3D\.txt: point 5 with keypoint 0 of image 7, which"),
        ({"points": POINTS.replace("7 0\n", "7 1\n")}, r"points3D\.txt: point 5 with keypoint 1 of image 7, which"),
        ({"points": POINTS.replace("7 0\n", "8 0\n")}, r"points3D\.txt: a reference to image 8"),
        ({"points": POINTS.replace(" 7 0\n", "")}, r"points3D\.txt: 0 track elements for 1 observations"),
        ({"points": POINTS.replace(" 0\n", "")}, r"points3D\.txt:1: 9 fields instead of POINT3D_ID"),
        ({"points": POINTS.replace("30", "300")}, r"points3D\.txt:1: the colour 10 20 300"),
        ({"points": None}, r"points3D\.txt: no such file"),
    ],
)
def test_damage_is_named_with_file_and_line(tmp_path: Path, files: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_colmap(write_model(tmp_path, **files))


def test_truncated_binary_files_are_refused(tmp_path: Path, scene: Make) -> None:
    write_colmap(tmp_path, scene())
    for path in sorted(tmp_path.iterdir()):
        data = path.read_bytes()
        for end in [*range(0, len(data), 11), len(data) - 1]:
            path.write_bytes(data[:end])
            with pytest.raises(InputError, match=path.name):
                read_colmap(tmp_path)
        path.write_bytes(data + b"\0")
        with pytest.raises(InputError, match=path.name):
            read_colmap(tmp_path)
        path.write_bytes(data)
    read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_corrupt_counts_allocate_nothing(tmp_path: Path, scene: Make, name: str) -> None:
    write_colmap(tmp_path, scene())
    path = tmp_path / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", 2**62) + path.read_bytes()[8:])
    with pytest.raises(InputError, match=rf"{name}\.bin: a count of {2**62} "):
        read_colmap(tmp_path)


def test_unknown_models_in_binary_files_are_named(tmp_path: Path, scene: Make) -> None:
    write_colmap(tmp_path, scene())
    path = tmp_path / "cameras.bin"
    data = bytearray(path.read_bytes())
    for number, name in ((10, "THIN_PRISM_FISHEYE"), (99, "number 99")):
        data[12:16] = struct.pack("<i", number)
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"cameras\.bin: camera 1: camera model {name}; expected one of SIMPLE"):
            read_colmap(tmp_path)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory, scene: Make) -> Path:
    """Folder with the scene as text and as binary files."""
    folder = tmp_path_factory.mktemp("stored")
    for name in ("text", "binary"):
        write_colmap(folder / name, scene(), name == "binary")
    return folder


@settings(max_examples=400, deadline=None)
@given(
    data=st.data(), kind=st.sampled_from(["text", "binary"]), name=st.sampled_from(["cameras", "images", "points3D"])
)
def test_damaged_files_raise_only_input_errors(stored: Path, data: st.DataObject, kind: str, name: str) -> None:
    path = next((stored / kind).glob(f"{name}.*"))
    original = path.read_bytes()
    start = data.draw(st.integers(0, len(original)))
    end = data.draw(st.integers(start, min(start + 12, len(original))) | st.just(len(original)))
    try:
        path.write_bytes(original[:start] + data.draw(st.binary(max_size=12)) + original[end:])
        with_input_error_only(stored / kind)
    finally:
        path.write_bytes(original)


@settings(max_examples=200, deadline=None)
@given(files=st.tuples(*[st.binary(max_size=200)] * 3), suffix=st.sampled_from([".txt", ".bin"]))
def test_arbitrary_bytes_raise_only_input_errors(
    tmp_path_factory: pytest.TempPathFactory, files: tuple[bytes, ...], suffix: str
) -> None:
    folder = tmp_path_factory.mktemp("arbitrary")
    for name, content in zip(("cameras", "images", "points3D"), files, strict=True):
        (folder / (name + suffix)).write_bytes(content)
    with_input_error_only(folder)


def with_input_error_only(folder: Path) -> None:
    """Read a model that may be damaged."""
    try:
        read_colmap(folder).reprojection_errors_px()
    except InputError as error:
        assert str(folder) in str(error) and "; expected " in str(error)


def test_files_of_another_model_are_not_mixed(tmp_path: Path, scene: Make) -> None:
    write_colmap(tmp_path, scene(), binary=False)
    write_colmap(tmp_path, scene(), binary=False)  # the same files are replaced
    with pytest.raises(InputError, match=r"cameras\.txt: a file of another model"):
        write_colmap(tmp_path, scene(), binary=True)
    (tmp_path / "frames.txt").write_text("")
    with pytest.raises(InputError, match=r"frames\.txt: a file of another model"):
        write_colmap(tmp_path, scene(), binary=False)


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "a\nb.png", "", "C:\\a.png", "a\0b", "\ud800.png", " a.png"])
def test_names_that_are_no_paths_are_not_written(tmp_path: Path, scene: Make, name: str) -> None:
    r = scene()
    with pytest.raises(InputError, match="the image name"):
        write_colmap(tmp_path, replace(r, image_names=(name, *r.image_names[1:])))
    assert not list(tmp_path.iterdir())


def test_names_with_spaces_need_binary_files(tmp_path: Path, scene: Make) -> None:
    r = replace(scene(), image_names=("a b.png", "b", "c", "d", "e"))
    with pytest.raises(ConfigError, match=r"image name 'a b\.png'; expected a name without spaces, or binary files"):
        write_colmap(tmp_path, r, binary=False)
    write_colmap(tmp_path, r)
    assert read_colmap(tmp_path).image_names == r.image_names


# --- pycolmap as an independent reader and writer


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_pycolmap_reads_the_same(tmp_path: Path, scene: Make, binary: bool) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    r = scene()
    write_colmap(tmp_path, r, binary)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert (theirs.num_images(), theirs.num_cameras(), theirs.num_points3D()) == (5, 2, 20)
    assert theirs.compute_num_observations() == len(r.observation_px)
    errors = r.reprojection_errors_px()
    for i, name in enumerate(r.image_names):
        image = theirs.image(i + 1)
        assert image.name == name and image.camera_id == r.image_camera[i] + 1
        np.testing.assert_allclose(image.projection_center(), r.positions[i], atol=1e-13)
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix().T, r.Ts_world_cam[i, :3, :3], atol=1e-13)
        observed = np.flatnonzero(r.observation_image == i)
        assert len(image.points2D) == len(observed)
        for point2D, k in zip(image.points2D, observed, strict=True):
            assert point2D.point3D_id == r.observation_point[k] + 1
            point = theirs.point3D(point2D.point3D_id)
            np.testing.assert_array_equal(point.xyz, r.points[r.observation_point[k]])
            np.testing.assert_array_equal(point.color, r.colours[r.observation_point[k]])
            # COLMAP's own projection, in its own pixel coordinates, has the same residual.
            residual = image.project_point(point.xyz) - point2D.xy
            assert np.linalg.norm(residual) == pytest.approx(errors[k], abs=1e-9)
    for n, length in enumerate(r.track_lengths().tolist()):
        point = theirs.point3D(n + 1)
        assert point.track.length() == length
        mean = errors[r.observation_point == n].mean() if length else -1.0
        assert point.error == pytest.approx(mean, rel=1e-12)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "EUCM"])
def test_models_of_pycolmap_are_read(tmp_path: Path, binary: bool, model: str) -> None:
    """A rig of two cameras with files of rigs and frames, and keypoints without points."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 30
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    coefficients = {
        "OPENCV_FISHEYE": (0.02, -0.01, 0.003, -0.001),
        "FULL_OPENCV": (0.4, 0.05, 5e-4, -5e-4, 0.001, 0.5, 0.1, 0.002),
        "FOV": (0.9,),
        "EUCM": (0.6, 1.1),
    }
    if model in coefficients:
        options.camera_params = [900.0, 910.0, 510.0, 380.0, *coefficients[model]]
    pycolmap.set_random_seed(0)
    theirs = pycolmap.synthesize_dataset(options)
    (theirs.write_binary if binary else theirs.write_text)(str(tmp_path))
    assert (tmp_path / f"frames.{'bin' if binary else 'txt'}").exists()
    r = read_colmap(tmp_path)
    assert r.image_names == tuple(theirs.image(i).name for i in sorted(theirs.images))
    assert len(r.observation_px) == theirs.compute_num_observations() > 100
    np.testing.assert_allclose(r.positions[2], theirs.image(sorted(theirs.images)[2]).projection_center(), atol=1e-12)
    assert r.reprojection_errors_px().max() < 1e-8  # its observations are exact


# --- Rigs and frames


def rig_scene(scene: Make) -> tuple[Reconstruction, RigFrames]:
    """A reconstruction of a rig whose third frame lacks the first camera, with images in no particular order."""
    r = scene()
    Ts_rig_cam = pose_matrix(
        exp_so3(np.array([[0.1, -0.2, 0.3], [-0.3, 0.1, 1.2]])), np.array([[0.1, 0, 0], [0, 0.2, 1]])
    )
    image_camera, frame = np.array([1, 0, 0, 1, 1]), np.array([4, 4, 2, 2, 9])
    Ts_world_rig = r.Ts_world_cam[[0, 0, 1, 1, 2]]
    return replace(r, image_camera=image_camera, Ts_world_cam=Ts_world_rig @ Ts_rig_cam[image_camera]), RigFrames(
        frame, Ts_rig_cam
    )


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_pycolmap_reads_rigs_and_frames(
    tmp_path: Path, scene: Make, assert_same_reconstruction: Same, binary: bool
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    r, rig = rig_scene(scene)
    for _ in range(2):  # the second replaces the first
        write_colmap(tmp_path, r, binary, rig)
    assert_same_reconstruction(read_colmap(tmp_path), r)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert (theirs.num_rigs(), theirs.num_frames(), theirs.num_images()) == (1, 3, 5)
    [their_rig] = theirs.rigs.values()
    assert their_rig.ref_sensor_id.id == 1 and their_rig.num_sensors() == 2
    [(sensor, pose)] = their_rig.non_ref_sensors.items()
    expected = np.linalg.inv(rig.Ts_rig_cam[1]) @ rig.Ts_rig_cam[0]
    assert sensor.id == 2
    np.testing.assert_allclose(pose.matrix(), expected[:3], atol=1e-13)
    frames = [sorted(data.id for data in frame.data_ids) for _, frame in sorted(theirs.frames.items())]
    assert frames == [[3, 4], [1, 2], [5]]
    for i in range(5):  # poses that pycolmap composes of those of the frame and the rig
        pose = theirs.image(i + 1).cam_from_world().matrix()
        np.testing.assert_allclose(pose, np.linalg.inv(r.Ts_world_cam[i])[:3], atol=1e-12)
    theirs.write(str(tmp_path))
    assert_same_reconstruction(read_colmap(tmp_path), r)


def test_the_pose_of_a_frame_is_the_mean_of_its_images(tmp_path: Path, scene: Make) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    r, rig = rig_scene(scene)
    moved = r.Ts_world_cam.copy()
    moved[0, :3, 3] += [0.02, 0.0, -0.04]
    write_colmap(tmp_path, replace(r, Ts_world_cam=moved), True, rig)
    center = pycolmap.Reconstruction(str(tmp_path)).image(2).projection_center()
    np.testing.assert_allclose(center, r.positions[1] + [0.01, 0.0, -0.02], atol=1e-12)


def test_rigs_that_contradict_the_images_are_refused(tmp_path: Path, scene: Make) -> None:
    r, rig = rig_scene(scene)
    for wrong, message in (
        (replace(rig, image_frame=np.array([4, 4, 2, 9, 9])), "two images of camera 1 in frame 9"),
        (replace(rig, image_frame=rig.image_frame[:4]), r"image_frame has shape \(4,\); expected \(5,\)"),
        (replace(rig, Ts_rig_cam=rig.Ts_rig_cam[:1]), r"Ts_rig_cam has shape \(1, 4, 4\); expected \(2, 4, 4\)"),
    ):
        with pytest.raises(ConfigError, match=message):
            write_colmap(tmp_path, r, True, wrong)
        assert not list(tmp_path.iterdir())
    write_colmap(tmp_path, r, True, rig)
    with pytest.raises(InputError, match=r"rigs\.bin: a file of another model"):
        write_colmap(tmp_path, r, True)
