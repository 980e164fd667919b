"""Gravity and scale of a reconstruction from an IMU."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation, RotationSpline

from dronevio.estimator.sfm.config import InertialConfig, SfmConfig
from dronevio.estimator.sfm.model import Scene, initial_state
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.estimator.sfm.placement.inertial import InertialAlignment, _NormalEquations, align_with_imu
from dronevio.estimator.sfm.placement.world import WorldFrame, place
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.image_sets import ImageSet, InertialData
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
from dronevio.models.rotation import exp_so3, pose_matrix

if TYPE_CHECKING:
    from pathlib import Path

    from dronevio.estimator.sfm.workspace import Workspace
    from tests.estimator.sfm.conftest import MakeImages, MakeScene


UNIT_M = 2.5
"""Length of a unit of the reconstruction [m]."""
R_NEW = exp_so3(np.array([0.7, -0.4, 0.2]))
"""Rotation from the true world frame to that of the reconstruction."""
GYRO_BIAS, ACCEL_BIAS = np.array([0.02, -0.01, 0.005]), np.array([0.05, 0.02, -0.04])
T_IMU_CAM = pose_matrix(exp_so3(np.array([1.2, -0.3, 0.4])), np.array([0.1, -0.05, 0.02]))
DATA_SHEET = ImuModel()


def imu_samples(T_of: "list[Array]", t_s: Array) -> ImuSamples:
    """Return the samples of an ideal IMU with biases, given its pose (4, 4) at times (N + 2,)."""
    dt = t_s[1] - t_s[0]
    R, p = np.stack(T_of)[:, :3, :3], np.stack(T_of)[:, :3, 3]
    acceleration = (p[2:] - 2.0 * p[1:-1] + p[:-2]) / dt**2
    accel = np.einsum("nji,nj->ni", R[1:-1], acceleration + [0.0, 0.0, GRAVITY_M_S2]) + ACCEL_BIAS
    change = np.swapaxes(R[:-2], 1, 2) @ R[2:]
    gyro = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1) / (2.0 * dt) + GYRO_BIAS
    return ImuSamples(np.round(t_s[1:-1] * 1e9).astype(np.int64), gyro, accel)


def flight(is_straight: bool) -> tuple[npt.NDArray[np.int64], Array, InertialData]:
    """Return times and camera poses of a flight, in the frame of the reconstruction, and the IMU samples."""
    t_s = 0.005 * np.arange(-1.0, 2002.0)
    Ts = []
    for t in t_s:
        curve = np.zeros(3) if is_straight else np.array([np.sin(t), 0.7 * np.cos(1.3 * t), 0.3 * np.sin(0.8 * t)])
        attitude = np.array([0.3 * np.sin(0.9 * t), 0.2 * np.cos(0.7 * t), 0.5 * np.sin(0.4 * t)])
        Ts.append(pose_matrix(exp_so3(attitude), np.array([0.6 * t, -0.2 * t, 1.0]) + curve))
    inertial = InertialData(imu_samples(Ts, t_s), DATA_SHEET, time_offset_s=0.03)
    index = np.arange(50, 1950, 60)
    Ts_true = np.stack([Ts[i] @ T_IMU_CAM for i in index])
    Ts_world_cam = Ts_true.copy()
    Ts_world_cam[:, :3, :3] = R_NEW @ Ts_true[:, :3, :3]
    Ts_world_cam[:, :3, 3] = Ts_true[:, :3, 3] @ R_NEW.T / UNIT_M + [1.0, 2.0, 3.0]
    return np.round((t_s[index] - 0.03) * 1e9).astype(np.int64), Ts_world_cam, inertial


def aligned(is_straight: bool = False, known_scale: bool = False) -> InertialAlignment | str:
    """Return gravity and scale of a flight."""
    t_ns, Ts, inertial = flight(is_straight)
    if known_scale:
        Ts[:, :3, 3] *= UNIT_M
    Ts_imu_cam = np.tile(T_IMU_CAM, (len(Ts), 1, 1))
    return align_with_imu(t_ns, Ts, Ts_imu_cam, inertial, InertialConfig(), known_scale)


@pytest.mark.parametrize("known_scale", [False, True], ids=["scale unknown", "scale known"])
def test_gravity_scale_and_biases(known_scale: bool) -> None:
    found = aligned(known_scale=known_scale)
    assert isinstance(found, InertialAlignment)
    assert found.scale == pytest.approx(1.0 if known_scale else UNIT_M, rel=1e-3)
    assert (found.scale_sigma == 0.0) == known_scale
    assert found.scale_sigma < 0.01
    np.testing.assert_allclose(found.gravity, R_NEW @ [0.0, 0.0, -GRAVITY_M_S2], atol=0.01)
    assert np.linalg.norm(found.gravity) == pytest.approx(GRAVITY_M_S2, abs=1e-9)
    np.testing.assert_allclose(found.gyro_bias_rad_s, GYRO_BIAS, atol=1e-4)
    np.testing.assert_allclose(found.accel_bias_m_s2, ACCEL_BIAS, atol=0.01)
    assert found.rms_position_m < 1e-3
    assert np.degrees(found.tilt_sigma_rad) < 0.1


def test_constant_velocity_leaves_the_scale_uncertain() -> None:
    found = aligned(is_straight=True)
    assert isinstance(found, InertialAlignment)
    assert found.scale_sigma > 10.0 * InertialConfig().max_scale_sigma or found.scale < 0.0
    assert np.degrees(found.tilt_sigma_rad) < 1.0


def test_noise_has_the_stated_sigma() -> None:
    t_ns, Ts, inertial = flight(is_straight=False)
    rng = np.random.default_rng(0)
    # The solver assumes the inflated density; white noise with it must give errors of the stated size.
    density = InertialConfig().noise_inflation * DATA_SHEET.accel_noise_density
    scores = []
    for _ in range(8):
        noise = rng.normal(scale=density / np.sqrt(0.005), size=inertial.samples.accel_m_s2.shape)
        noisy = replace(inertial.samples, accel_m_s2=inertial.samples.accel_m_s2 + noise)
        Ts_imu_cam = np.tile(T_IMU_CAM, (len(Ts), 1, 1))
        found = align_with_imu(t_ns, Ts, Ts_imu_cam, replace(inertial, samples=noisy), InertialConfig())
        assert isinstance(found, InertialAlignment)
        scores.append((found.scale / UNIT_M - 1.0) / found.scale_sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.7


def test_too_few_samples_are_refused() -> None:
    t_ns, Ts, inertial = flight(is_straight=False)
    Ts_imu_cam = np.tile(T_IMU_CAM, (len(Ts), 1, 1))
    short = replace(inertial, samples=inertial.samples.up_to(int(t_ns[3])))
    found = align_with_imu(t_ns, Ts, Ts_imu_cam, short, InertialConfig())
    assert isinstance(found, str)
    assert "2 intervals between images with IMU samples" in found


def moving_images(make_scene: "MakeScene", make_images: "MakeImages", folder: "Path") -> tuple[ImageSet, "Workspace"]:
    """Return images of a camera that swings along an arc, with its IMU, and their stored features."""
    scene = make_scene(images=8)
    images, workspace = make_images(scene, folder)
    # Positions and rotations between the images are those of splines through the true poses.
    t_images = 0.25 * np.arange(8)
    position = CubicSpline(t_images, scene.Ts_world_cam[:, :3, 3])
    rotation = RotationSpline(t_images, Rotation.from_matrix(scene.Ts_world_cam[:, :3, :3]))
    t_s = 0.005 * np.arange(-1.0, 353.0)
    level = exp_so3(np.array([-np.pi / 2, 0.0, 0.0]))  # the camera's y axis points down
    R = level @ rotation(t_s).as_matrix()
    Ts = [pose_matrix(R[k], level @ position(t)) for k, t in enumerate(t_s)]
    inertial = InertialData(imu_samples(Ts, t_s), DATA_SHEET, 0.0)
    t_ns = np.round(t_images * 1e9).astype(np.int64)
    return replace(images, t_ns=t_ns, Ts_imu_cam=np.eye(4)[None], inertial=inertial), workspace


def test_a_single_camera_gives_metres(make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path") -> None:
    images, workspace = moving_images(make_scene, make_images, tmp_path)
    config = SfmConfig(inertial=InertialConfig(max_scale_sigma=0.2))
    result = reconstruct(images, config, workspace)
    assert result.is_metric
    assert result.worlds[0].scale == "imu"
    [found] = result.reconstructions
    true = make_scene(images=8).Ts_world_cam[:, :3, 3]
    lengths = [np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in (found.positions, true)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.05)
    # The y axis of the cameras points down, the origin is the first position.
    assert found.Ts_world_cam[:, 2, 1].max() < -0.99
    np.testing.assert_allclose(found.positions[0], 0.0, atol=1e-9)


def test_an_imu_that_does_not_suffice() -> None:
    t_ns, Ts, inertial = flight(is_straight=False)
    blank = np.zeros((6, 8), np.uint8)
    images = ImageSet(
        names=tuple(map(str, t_ns)),
        image_camera=np.zeros(len(Ts), np.int64),
        cameras=(CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5),),
        is_calibrated=np.array([True]),
        is_ordered=True,
        t_ns=t_ns,
        frame=None,
        Ts_imu_cam=T_IMU_CAM[None],
        read=lambda index: blank,
        read_mask=lambda index: None,
        inertial=inertial,
    )
    none = np.empty(0, np.int64)
    scene = Scene(Tracks(none, none, none), np.empty((0, 2)), np.empty(0), images.image_camera, images.is_calibrated)
    state = initial_state(scene, images.cameras, Ts)
    strict = InertialConfig(max_scale_sigma=1e-6)
    level, world = place(scene, state, images, SfmConfig(inertial=strict))
    assert not world.is_metric
    assert world.is_vertical
    assert "too little acceleration: the scale has a standard deviation of" in world.note
    np.testing.assert_allclose(level.Ts_world_cam[0, :3, 3], 0.0, atol=1e-12)
    _, world = place(scene, state, images, SfmConfig(inertial=replace(strict, max_tilt_sigma_deg=1e-6)))
    assert not world.is_vertical
    assert "the direction of gravity has a standard deviation of" in world.note
    required = SfmConfig(inertial=replace(strict, use="required"))
    with pytest.raises(ConfigError, match="does not determine gravity and scale: too little acceleration"):
        place(scene, state, images, required)
    with pytest.raises(ConfigError, match="without measurements of an IMU"):
        place(scene, state, replace(images, inertial=None), required)
    unchanged, world = place(scene, state, images, SfmConfig(inertial=InertialConfig(use="off")))
    assert world == WorldFrame()
    assert unchanged is state


def test_normal_equations_are_as_exact_as_an_orthogonal_decomposition() -> None:
    """Columns of very different length, two of which are nearly parallel; the last one is zero."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(200, 12)) * 10.0 ** rng.uniform(-3.0, 3.0, 12)
    J[:, 1] = J[:, 0] + 1e-4 * np.linalg.norm(J[:, 0]) * rng.normal(size=200)
    r = rng.normal(size=200)
    expected = np.linalg.lstsq(J, r, rcond=None)[0]
    equations = _NormalEquations(csr_array(np.column_stack([J, np.zeros(200)])))
    np.testing.assert_allclose(equations.solve(r), [*expected, 0.0], rtol=1e-7)
    covariance = equations.covariance(np.arange(12))
    np.testing.assert_allclose(covariance, np.linalg.inv(J.T @ J), rtol=1e-2, atol=1e-12 * np.abs(covariance).max())
