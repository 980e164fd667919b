"""Files of results for other programs."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dronevio.cli import main
from dronevio.estimator.dense.pipeline import DenseResult
from dronevio.exports import check_surface_formats, rig_frames, write_component, write_surface_files
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.image_sets import ImageSet
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import ReconstructionFormat, SurfaceFormat
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.surfaces import Mesh, PointCloud

CAMERAS = (CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5), CameraModel(32, 24, 30.0, 30.0, 15.5, 11.5))
NAMES = ("cam0/5", "cam1/5", "cam0/6", "cam1/6", "cam0/7")
Ts_IMU_CAM = pose_matrix(
    exp_so3(np.array([[0.2, 0.1, 1.5], [0.1, -0.3, 1.6]])), np.array([[0.0, 0.1, 0], [0.0, -0.1, 0]])
)


def picture(index: int) -> np.ndarray:
    """Return an image; those of the first camera have colours."""
    camera = CAMERAS[index % 2]
    rows, columns = np.mgrid[: camera.height, : camera.width]
    grey = (3 * rows + columns + 10 * index).astype(np.uint8)
    return grey if index % 2 else np.stack([grey, grey // 2, 255 - grey], axis=2)


@pytest.fixture
def images() -> ImageSet:
    """Images of a rig of two cameras, which are in no files."""
    return ImageSet(
        names=NAMES,
        image_camera=np.array([0, 1, 0, 1, 0]),
        cameras=CAMERAS,
        is_calibrated=np.full(2, True),
        is_ordered=True,
        t_ns=None,
        frame=np.array([0, 0, 1, 1, 2]),
        Ts_imu_cam=Ts_IMU_CAM,
        read=picture,
        read_mask=lambda _: None,
    )


def reconstruction_of(rows: list[int], cameras: tuple[CameraModel, ...] = CAMERAS) -> Reconstruction:
    """Return a reconstruction of some of the images, along a straight path of the IMU."""
    none = np.empty(0, np.int64)
    image_camera = np.array([row % 2 for row in rows])
    Ts_world_imu = pose_matrix(np.repeat(np.eye(3)[None], 3, axis=0), np.outer(np.arange(3.0), [1.0, 2.0, 0.5]))
    return Reconstruction(
        cameras=cameras,
        image_names=tuple(NAMES[row] for row in rows),
        image_camera=image_camera if len(cameras) == 2 else np.zeros(len(rows), np.int64),
        Ts_world_cam=Ts_world_imu[np.array(rows) // 2] @ Ts_IMU_CAM[image_camera],
        points=np.array([[0.0, 1.0, 2.0]]),
        colours=np.array([[1, 2, 3]], np.uint8),
        observation_image=none,
        observation_point=none,
        observation_px=np.empty((0, 2)),
    )


def write(
    folder: Path, form: ReconstructionFormat, r: Reconstruction, images: ImageSet, sources: list[Path], mounted: bool
) -> None:
    write_component(folder / ".new", form, 0, r, images, sources=sources, has_mounting=mounted)


def test_the_rig_is_that_of_the_calibration(tmp_path: Path, images: ImageSet) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    r = reconstruction_of([1, 0, 4, 3])
    forms: tuple[ReconstructionFormat, ...] = ("colmap-binary", "colmap-text")
    for form in forms:
        write(tmp_path, form, r, images, [], mounted=True)
        theirs = pycolmap.Reconstruction(str(tmp_path / ".new" / form / "0"))
        [rig] = theirs.rigs.values()
        [pose] = rig.non_ref_sensors.values()
        T_cam1_cam0 = np.linalg.inv(Ts_IMU_CAM[1]) @ Ts_IMU_CAM[0]
        np.testing.assert_allclose(pose.matrix(), T_cam1_cam0[:3], atol=1e-13)
        members = [
            sorted(theirs.image(data.id).name for data in frame.data_ids) for _, frame in sorted(theirs.frames.items())
        ]
        assert members == [["cam0/5", "cam1/5"], ["cam1/6"], ["cam0/7"]]
        for i in range(4):
            np.testing.assert_allclose(theirs.image(i + 1).projection_center(), r.positions[i], atol=1e-12)
    write(tmp_path / "free", "colmap-binary", r, images, [], mounted=False)
    assert not (tmp_path / "free" / ".new" / "colmap-binary" / "0" / "rigs.bin").exists()


def test_no_rig_without_images_of_one_moment(images: ImageSet) -> None:
    r = reconstruction_of([0, 3, 4])
    assert rig_frames(images, r) is None
    assert rig_frames(replace(images, frame=None, Ts_imu_cam=None), reconstruction_of([0, 1])) is None
    found = rig_frames(images, reconstruction_of([0, 1]))
    assert found is not None and found.image_frame.tolist() == [0, 0]


def test_images_that_are_no_files_are_written_for_nerfstudio(tmp_path: Path, images: ImageSet) -> None:
    r = reconstruction_of([0, 1])
    write(tmp_path, "nerfstudio", r, images, [tmp_path], mounted=True)
    folder = tmp_path / ".new" / "nerfstudio" / "0"
    document = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    files = [frame["file_path"] for frame in document["frames"]]
    assert files == ["images/cam0/5.png", "images/cam1/5.png"]
    for i, file in enumerate(files):
        read = cv2.imread(str(folder / file), cv2.IMREAD_UNCHANGED)
        assert read is not None
        np.testing.assert_array_equal(read if read.ndim == 2 else read[..., ::-1], picture(i))


def test_paths_lead_to_files(tmp_path: Path, images: ImageSet) -> None:
    names = tuple(f"{name}.png" for name in NAMES)
    named = replace(images, names=names)
    r = replace(reconstruction_of([0, 1]), image_names=names[:2])
    (tmp_path / "photographs" / "cam1").mkdir(parents=True)
    (tmp_path / "photographs" / names[1]).write_bytes(b"")
    write(tmp_path, "nerfstudio", r, named, [tmp_path / "photographs"], mounted=True)
    document = json.loads((tmp_path / ".new" / "nerfstudio" / "0" / "transforms.json").read_text(encoding="utf-8"))
    files = [frame["file_path"] for frame in document["frames"]]
    assert files == ["images/cam0/5.png", "../../../photographs/cam1/5.png"]


def test_images_of_openmvs_are_undistorted(tmp_path: Path, images: ImageSet) -> None:
    distorted = tuple(replace(camera, distortion=(-0.1, 0.0, 0.0, 0.0)) for camera in CAMERAS)
    write(tmp_path, "openmvs", reconstruction_of([0, 1], distorted), images, [tmp_path], mounted=True)
    folder = tmp_path / ".new" / "openmvs" / "0"
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert found == {"scene.mvs", "images/cam0/5.png", "images/cam1/5.png"}
    read = cv2.imread(str(folder / "images/cam0/5.png"), cv2.IMREAD_UNCHANGED)
    assert read is not None and read.ndim == 3 and read.shape[1] > 64
    # The principal points coincide: rows and columns at the centre stay.
    np.testing.assert_allclose(
        read[read.shape[0] // 2, read.shape[1] // 2, ::-1], picture(0)[23:25, 31:33].mean((0, 1)), atol=3
    )


# --- Surfaces


def surfaces() -> DenseResult:
    """Return a square of 4 × 3 m at height 2, of grey triangles, with a coloured point."""
    corners = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [4.0, 3.0, 2.0], [0.0, 3.0, 2.0]])
    up = np.array([[0.0, 0.0, 1.0]])
    mesh = Mesh(corners, np.repeat(up, 4, 0), np.full((4, 3), 90, np.uint8), np.array([[0, 1, 2], [0, 2, 3]]))
    cloud = PointCloud(np.array([[3.75, 2.75, 2.1]]), up, np.array([[200, 100, 50]], np.uint8))
    return DenseResult(cloud, mesh, spacing=0.5, voxel=1.0, depths=(), times_s={})


@pytest.mark.parametrize(
    ("form", "package", "names"),
    [
        ("ply", "numpy", {"dense.ply", "mesh.ply"}),
        ("glb", "numpy", {"mesh.glb"}),
        ("obj", "numpy", {"mesh.obj"}),
        ("las", "laspy", {"dense.las"}),
        ("laz", "laspy", {"dense.laz"}),
        ("geotiff", "rasterio", {"orthophoto.tif", "height.tif"}),
    ],
)
def test_files_of_surfaces(tmp_path: Path, form: SurfaceFormat, package: str, names: set[str]) -> None:
    pytest.importorskip(package)
    write_surface_files(tmp_path, form, surfaces())
    assert {path.name for path in tmp_path.iterdir()} == names


def test_a_map_of_surfaces(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    write_surface_files(tmp_path, "geotiff", surfaces())
    with rasterio.open(tmp_path / "height.tif") as heights, rasterio.open(tmp_path / "orthophoto.tif") as photo:
        assert heights.shape == (6, 8) and (heights.read(1) == 2.0).all()
        colours = photo.read()
        assert colours[:, 0, 7].tolist() == [200, 100, 50, 255]  # the point, in the north-eastern corner
        assert (colours[:3].reshape(3, -1)[:, :7] == 90).all() and photo.bounds == heights.bounds == (0, 0, 4, 3)


def test_a_map_has_the_place_of_its_origin(tmp_path: Path) -> None:
    """The north-western corner, 3 m north of the origin."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.warp import transform

    origin = GeodeticPoint(47.0, 8.0, 500.0)
    write_surface_files(tmp_path, "geotiff", surfaces(), origin)
    with rasterio.open(tmp_path / "height.tif") as heights:
        np.testing.assert_allclose(heights.read(1), 502.0)
        [longitude], [latitude] = transform(heights.crs, "EPSG:4326", [heights.bounds.left], [heights.bounds.top])
    np.testing.assert_allclose(origin.to_enu(np.array([latitude, longitude, 500.0])), [0.0, 3.0, 0.0], atol=1e-3)


@pytest.mark.parametrize(
    ("report", "message"),
    [
        ({"unit": "", "up": None}, "arbitrary scale"),
        ({"unit": "m", "up": None}, "unknown vertical"),
        ({"unit": "m", "up": [0.0, 0.0, 1.0]}, None),
        (None, None),
    ],
)
def test_maps_need_metres_and_the_vertical(
    tmp_path: Path, report: dict[str, object] | None, message: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are refused before anything else of the scene is read."""
    pytest.importorskip("rasterio")
    if report is not None:
        (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    check_surface_formats(("ply", "glb", "obj"), tmp_path)
    if message is None:
        check_surface_formats(("geotiff",), tmp_path)
        return
    with pytest.raises(ConfigError, match=message):
        check_surface_formats(("ply", "geotiff"), tmp_path)
    assert main(["dense", str(tmp_path), "--format", "geotiff", "--out", str(tmp_path / "out")]) == 2
    assert f"world frame of {message}; expected metres and z up" in capsys.readouterr().err
