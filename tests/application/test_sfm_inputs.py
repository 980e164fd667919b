"""Known poses of images from trajectories and from models of COLMAP."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets import ImageSet, InertialData
from dronevio.models.imu import EUROC_IMU, ImuSamples
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import write_reconstruction
from dronevio.models.recordings.tum import write_tum
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import Trajectory
from dronevio.sfm_inputs import read_poses, with_cameras_of

T_IMU_CAM = pose_matrix(exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.array([0.1, 0.0, 0.0]))
OFFSET_S = 0.02


@pytest.fixture
def images() -> ImageSet:
    """Four blank images, 50 ms apart, of a camera on a rig whose clock is late."""
    times = np.arange(4) * 50_000_000
    return ImageSet(
        names=tuple(f"cam0/{t}" for t in times),
        image_camera=np.zeros(4, np.int64),
        cameras=(CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5),),
        is_calibrated=np.array([True]),
        is_ordered=True,
        t_ns=times,
        frame=np.arange(4),
        Ts_imu_cam=T_IMU_CAM[None],
        read=lambda index: np.zeros((6, 8), np.uint8),
        read_mask=lambda index: None,
        inertial=InertialData(ImuSamples.empty(), EUROC_IMU, OFFSET_S),
    )


@pytest.fixture
def trajectory(tmp_path: Path) -> Path:
    """A file with poses every 50 ms up to .15 s, which move along x at 2 m/s without rotation."""
    t_ns = np.arange(4) * 50_000_000
    p = np.stack([2e-9 * t_ns, np.zeros(4), np.ones(4)], axis=1)
    write_tum(tmp_path / "path.tum", Trajectory(t_ns, p, np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))))
    return tmp_path / "path.tum"


def test_poses_of_the_imu_and_of_the_camera(images: ImageSet, trajectory: Path) -> None:
    imu = read_poses(trajectory, images)
    assert imu.is_exact
    assert imu.is_vertical
    # The second image is taken at .05 s of the camera's clock, .07 s of the IMU's; the camera is .1 m ahead.
    np.testing.assert_allclose(imu.Ts_world_cam[1, :3, 3], [0.14 + 0.1, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(imu.Ts_world_cam[1, :3, :3], T_IMU_CAM[:3, :3], atol=1e-12)
    assert imu.is_known.tolist() == [True, True, True, False]  # the trajectory ends before the last image
    camera = read_poses(trajectory, images, "camera", sigma_m=0.1, sigma_rad=0.01)
    np.testing.assert_allclose(camera.Ts_world_cam[1], pose_matrix(np.eye(3), np.array([0.1, 0.0, 1.0])), atol=1e-12)
    assert camera.is_known.all()
    assert (camera.sigma_m, camera.sigma_rad) == (0.1, 0.01)


def write_model(images: ImageSet, folder: Path, camera: CameraModel) -> None:
    """Write a model of COLMAP with two of the images, as dronevio sfm writes it."""
    Ts = np.tile(np.eye(4), (2, 1, 1))
    Ts[1, 0, 3] = 3.0
    none = np.empty(0, np.int64)
    model = Reconstruction(
        (camera,),
        (images.names[2], images.names[0]),
        np.zeros(2, np.int64),
        Ts,
        np.empty((0, 3)),
        np.empty((0, 3), np.uint8),
        none,
        none,
        np.empty((0, 2)),
    )
    write_reconstruction(model, folder / "colmap-text" / "0", "colmap-text")


def test_poses_by_the_names_of_images(images: ImageSet, tmp_path: Path) -> None:
    write_model(images, tmp_path, images.cameras[0])
    found = read_poses(tmp_path, images)
    assert found.is_known.tolist() == [True, False, True, False]
    assert found.Ts_world_cam[0, 0, 3] == 3.0
    assert not found.is_vertical
    with pytest.raises(ConfigError, match="a model of COLMAP has those of the cameras"):
        read_poses(tmp_path, images, "imu")


@pytest.mark.parametrize(
    ("is_calibrated", "size", "focal_px"), [(False, (8, 6), 12.0), (True, (8, 6), 10.0), (False, (16, 12), 10.0)]
)
def test_cameras_without_calibration_begin_with_those_of_the_model(
    images: ImageSet, tmp_path: Path, is_calibrated: bool, size: tuple[int, int], focal_px: float
) -> None:
    """A guessed focal length would contradict the poses; a calibration, or images of another size, keep theirs."""
    write_model(images, tmp_path, CameraModel(*size, 12.0, 12.0, 3.5, 2.5))
    given = replace(images, is_calibrated=np.array([is_calibrated]))
    assert with_cameras_of(tmp_path, given).cameras[0].fx == focal_px


def test_a_trajectory_has_no_cameras(images: ImageSet, trajectory: Path) -> None:
    assert with_cameras_of(trajectory, images) is images


def test_poses_that_do_not_exist(images: ImageSet, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="colmap: no such file or folder; expected a trajectory"):
        read_poses(tmp_path / "colmap", replace(images, t_ns=None))


def test_poses_that_belong_to_no_image(images: ImageSet, trajectory: Path) -> None:
    with pytest.raises(ConfigError, match="poses with time stamps for images without"):
        read_poses(trajectory, replace(images, t_ns=None))
    with pytest.raises(ConfigError, match="whose mounting is unknown"):
        read_poses(trajectory, replace(images, Ts_imu_cam=None), "imu")
    assert images.t_ns is not None
    with pytest.raises(ConfigError, match="poses of 0 of the 4 images"):
        read_poses(trajectory, replace(images, t_ns=images.t_ns + 10**9))
