"""Depth images of rigs: rectification, stereo, the sweep of one camera, standard deviations."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from dronevio.estimator.dense.views import View
from dronevio.estimator.mapping import refinement
from dronevio.estimator.mapping.camera_pose import delay_s, pose_after
from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.estimator.mapping.depth_source import depth_source
from dronevio.estimator.mapping.rectification import Rectification, rectified_pair
from dronevio.estimator.mapping.stereo_depth import StereoDepth
from dronevio.estimator.mapping.sweep_depth import SweepDepth, inverse_depth
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import OCCUPIED
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import NO_IMAGE, CameraFrame, Estimate, Health, NavState

SMALL = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5)
FISHEYES = {
    "equidistant": (0.01, -0.005, 0.0, 0.0),
    "fov": (0.9,),
    "ds": (-0.2, 0.6),
    "eucm": (0.6, 1.1),
    "omni": (1.2, -0.1, 0.02, 0.0, 0.0),
}
WALL_M = 2.0
"""Distance of the wall z = 2 m from the IMU at rest, whose frame is that of a camera."""


@cache
def texture(seed: int = 0) -> Image:
    """Return a picture (1600, 1600) of smooth noise."""
    noise = np.random.default_rng(seed).normal(size=(1600, 1600))
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return np.asarray(np.clip(128.0 + 40.0 * smooth / smooth.std(), 0.0, 255.0), np.uint8)


def picture(model: CameraModel, T_world_cam: Array, seed: int = 0, noise: float = 1.0) -> Image:
    """Return the image of the wall z = 2 m of the world, whose texture has 5 mm a pixel."""
    u, v = np.meshgrid(np.arange(model.width, dtype=float), np.arange(model.height, dtype=float))
    rays = model.unproject(np.stack([u, v], axis=-1)) @ T_world_cam[:3, :3].T
    with np.errstate(invalid="ignore", divide="ignore"):
        at = T_world_cam[:3, 3] + rays * ((WALL_M - T_world_cam[2, 3]) / rays[..., 2:])
        at = np.where((rays[..., 2:] > 0.05) & np.isfinite(at), at, 1e3)
    px = (at[..., :2] / 0.005 + 800.0).astype(np.float32)
    image = cv2.remap(texture(seed), px[..., 0], px[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    noisy = image + np.random.default_rng(seed + 1).normal(size=image.shape) * noise
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)


def pair_of(model: CameraModel, other: Array, second: CameraModel | None = None) -> Rig:
    """Return a rig of two cameras, the first of which has the frame of the IMU."""
    return Rig((RigCamera(model, np.eye(4)), RigCamera(second or model, other)))


def estimate(
    T: Array | None = None, t_ns: int = 0, velocity: Array | None = None, rate: Array | None = None
) -> Estimate:
    """Return an estimate at a pose."""
    pose = np.eye(4) if T is None else T
    state = NavState(
        t_ns, pose, np.zeros(3) if velocity is None else velocity, np.zeros(3), np.zeros(3), None,
        np.zeros(3) if rate is None else rate,
    )  # fmt: skip
    return Estimate(t_ns, Health.TRACKING, state)


def depth_of(rig: Rig, **images: float) -> DepthImage:
    """Return the depth image of the wall."""
    frame = CameraFrame(0, tuple(picture(c.model, c.T_imu_cam, **images) for c in rig.cameras))  # type: ignore[arg-type]
    found = depth_source(rig).depth(frame, estimate())
    assert found is not None
    return found


def depth_at_rest(rig: Rig) -> DepthImage | None:
    """Return what the images of a rig at rest tell of the wall, of which one camera sees nothing."""
    frame = CameraFrame(0, tuple(picture(c.model, c.T_imu_cam) for c in rig.cameras))
    return depth_source(rig).depth(frame, estimate())


def check_wall(found: DepthImage, density: float = 0.5) -> None:
    """Check that the points of a depth image lie on the wall within their standard deviations."""
    known = found.known
    assert known.mean() > density
    errors = found.points_odom()[:, 2] - WALL_M
    slope = (found.T_odom_cam[:3, :3] @ found.camera.rays()[known].T)[2]
    normalized = errors / (slope * found.sigma_m[known])
    assert np.mean(np.abs(normalized) > 5.0) < 0.002
    assert np.mean(normalized**2) < 1.5
    assert abs(np.median(errors)) < 0.02


OTHERS = {
    "right": pose_matrix(np.eye(3), np.array([0.1, 0.0, 0.0])),
    "left": pose_matrix(np.eye(3), np.array([-0.1, 0.0, 0.0])),
    "below": pose_matrix(np.eye(3), np.array([0.0, 0.1, 0.0])),
    "above": pose_matrix(np.eye(3), np.array([0.0, -0.1, 0.0])),
    "turned": pose_matrix(exp_so3(np.array([0.05, -0.2, 0.1])), np.array([0.1, 0.02, 0.02])),
    "upside down": pose_matrix(exp_so3(np.array([0.0, 0.0, np.pi])), np.array([0.1, 0.0, 0.0])),
}


@pytest.mark.parametrize("side", OTHERS)
def test_any_arrangement_of_two_cameras_sees_the_wall(side: str) -> None:
    """The depth is right whatever the direction of the baseline and the rotation between the cameras."""
    check_wall(depth_of(pair_of(SMALL, OTHERS[side])))


@pytest.mark.parametrize("lens", FISHEYES)
def test_fisheyes_are_limited_to_an_angle(lens: str) -> None:
    """Every lens model is rectified, and no ray is farther from the axis than the limit."""
    focal = 2.2 if lens == "omni" else 1.0
    model = CameraModel(320, 240, 130.0 * focal, 130.0 * focal, 159.5, 119.5, FISHEYES[lens], lens)  # type: ignore[arg-type]
    found = depth_of(pair_of(model, OTHERS["right"]))
    check_wall(found, 0.4)
    assert np.abs(found.camera.rays()[..., :2]).max() <= np.tan(np.radians(55.5))


def test_cameras_of_different_lenses_and_sizes() -> None:
    """A pinhole and a fisheye of another resolution are a pair."""
    other = CameraModel(400, 300, 160.0, 160.0, 199.5, 149.5, FISHEYES["equidistant"], "equidistant")
    check_wall(depth_of(pair_of(SMALL, OTHERS["turned"], other)))


def test_a_point_has_the_disparity_of_its_depth_in_the_same_row() -> None:
    """Projections of a point into the two rectified images differ by f b / z along the row."""
    rig = rig_named("euroc-stereo")
    pair = rectified_pair(rig)
    assert pair is not None
    point = pair.T_imu_left @ np.array([0.3, -0.2, 3.0, 1.0])
    rows = []
    for index, map_ in zip((pair.left, pair.right), pair.maps, strict=True):
        camera = rig.cameras[index]
        uv = camera.model.project((inverse_pose(camera.T_imu_cam) @ point)[:3])
        full = np.stack([map_.u, map_.v], axis=-1) * 2.0 + 0.5
        rows.append(np.unravel_index(np.argmin(np.linalg.norm(full - uv, axis=-1)), map_.u.shape))
    expected = pair.camera.K @ [0.1, -0.2 / 3.0, 1.0]
    assert abs(rows[0][0] - expected[1]) <= 1.0
    assert abs(rows[0][1] - expected[0]) <= 1.0
    assert abs(int(rows[0][0]) - int(rows[1][0])) <= 1
    assert abs(int(rows[0][1]) - int(rows[1][1]) - pair.fb / 3.0) <= 1.0


def test_the_main_view_is_upright_if_the_cameras_are_swapped() -> None:
    """The left image is that of the camera on the left, whatever their order in the rig."""
    pair = rectified_pair(pair_of(SMALL, OTHERS["left"]))
    assert pair is not None
    assert (pair.left, pair.right) == (1, 0)
    assert pair.T_imu_left[:3, :3] == pytest.approx(np.eye(3), abs=1e-9)


def test_the_best_pair_of_three_cameras() -> None:
    """The pair with the larger view and baseline is chosen, and one that looks away is not."""
    away = pose_matrix(exp_so3(np.array([0.0, np.pi, 0.0])), np.array([0.3, 0.0, 0.0]))
    cameras = (RigCamera(SMALL, np.eye(4)), RigCamera(SMALL, away), RigCamera(SMALL, OTHERS["right"]))
    pair = rectified_pair(Rig(cameras))
    assert pair is not None
    assert {pair.left, pair.right} == {0, 2}


def test_the_source_by_the_rig() -> None:
    """Two cameras with a common view are a pair; one behind the other, or back to back, they are not."""
    behind = pose_matrix(np.eye(3), np.array([0.0, 0.0, -0.2]))
    back = pose_matrix(exp_so3(np.array([0.0, np.pi, 0.0])), np.array([0.1, 0.0, 0.0]))
    assert depth_at_rest(pair_of(SMALL, OTHERS["right"])) is not None
    assert depth_at_rest(Rig((RigCamera(SMALL, np.eye(4)),))) is None
    for other in (behind, back, np.eye(4)):
        assert depth_at_rest(pair_of(SMALL, other)) is None
    with pytest.raises(ConfigError, match="rig without a camera"):
        depth_source(Rig(()))


def stereo() -> tuple[Rig, Rectification]:
    """Return a rig with its rectification."""
    rig = pair_of(SMALL, OTHERS["right"])
    pair = rectified_pair(rig)
    assert pair is not None
    return rig, pair


def test_exposures_that_differ() -> None:
    """Another brightness and contrast of the right image changes little."""
    rig, pair = stereo()
    left, right = (picture(c.model, c.T_imu_cam) for c in rig.cameras)
    darker = np.rint(0.6 * right + 20.0).astype(np.uint8)
    found = StereoDepth(rig, pair).depth(CameraFrame(0, (left, darker)), estimate())
    assert found is not None
    check_wall(found, 0.4)


def test_nothing_is_known_without_texture_or_of_different_scenes() -> None:
    """Grey walls and unrelated images have no depth."""
    rig, pair = stereo()
    source = StereoDepth(rig, pair)
    noise = np.random.default_rng(0)
    grey = tuple(np.clip(128 + noise.normal(size=(240, 320)), 0, 255).astype(np.uint8) for _ in range(2))
    other = tuple(picture(SMALL, np.eye(4), seed) for seed in (1, 2))
    for images in (grey, other):
        found = source.depth(CameraFrame(0, images), estimate())
        assert found is not None
        assert found.known.mean() < 0.01


def test_more_noise_has_a_larger_standard_deviation() -> None:
    """The standard deviation follows the noise of the images, and the error stays within it."""
    rig, _ = stereo()
    fine, coarse = depth_of(rig, noise=1.0), depth_of(rig, noise=8.0)
    check_wall(coarse, 0.2)
    assert np.median(coarse.sigma_m[coarse.known]) > 1.3 * np.median(fine.sigma_m[fine.known])


def test_a_missing_image_or_state_has_no_depth() -> None:
    """There is no depth image without both images and a state."""
    rig, pair = stereo()
    images = tuple(picture(c.model, c.T_imu_cam) for c in rig.cameras)
    source = StereoDepth(rig, pair)
    assert source.depth(CameraFrame(0, (images[0], NO_IMAGE)), estimate()) is None
    assert source.depth(CameraFrame(0, images), Estimate(0, Health.LOST, None)) is None


def test_the_pose_is_that_of_the_exposure() -> None:
    """Time offset of the camera and delay of the image move the pose by velocity and rate."""
    rig, _ = stereo()
    late = replace(rig, cameras=tuple(replace(c, time_offset_s=0.01) for c in rig.cameras))
    frame = CameraFrame(0, (NO_IMAGE, NO_IMAGE), image_delays_ns=(5_000_000, 5_000_000))
    assert delay_s(late, frame, 1) == pytest.approx(0.015)
    state = estimate(velocity=np.array([1.0, 2.0, 0.0]), rate=np.array([0.0, 0.0, 2.0])).state
    assert state is not None
    T = pose_after(state, 0.015)
    assert T[:3, 3] == pytest.approx([0.015, 0.03, 0.0])
    assert T[:3, :3] == pytest.approx(exp_so3(np.array([0.0, 0.0, 0.03])))
    images = tuple(picture(c.model, c.T_imu_cam) for c in rig.cameras)
    found = depth_source(late).depth(CameraFrame(0, images), estimate(velocity=np.array([1.0, 0.0, 0.0])))
    assert found is not None
    assert found.T_odom_cam[0, 3] == pytest.approx(0.01)


@pytest.mark.parametrize("tells", [True, False])
def test_the_pose_has_the_time_offset_of_the_rig(tells: bool) -> None:
    """An estimator that tells the state at the exposure is believed; otherwise the given offset moves the state."""
    rig = replace(stereo()[0], time_offset_s=0.02)
    frame = CameraFrame(0, tuple(picture(c.model, c.T_imu_cam) for c in rig.cameras))
    at_stamp, velocity = estimate(velocity=np.array([1.0, 0.0, 0.0])), np.array([1.0, 0.0, 0.0])
    exposed = estimate(pose_matrix(np.eye(3), np.array([0.3, 0.0, 0.0])), velocity=velocity).state
    found = depth_source(rig).depth(frame, replace(at_stamp, exposed=exposed if tells else None))
    assert found is not None
    assert found.T_odom_cam[0, 3] == pytest.approx(0.3 if tells else 0.02)


def test_the_poses_of_the_cameras_are_those_in_use() -> None:
    """With the right camera turned against the calibration by half a degree, depth is right by the corrected one."""
    true, _ = stereo()
    turned = pose_matrix(exp_so3(np.array([0.009, 0.004, 0.0])), np.zeros(3))
    given = replace(true, cameras=(true.cameras[0], replace(true.cameras[1], T_imu_cam=OTHERS["right"] @ turned)))
    frame, source = CameraFrame(0, tuple(picture(c.model, c.T_imu_cam) for c in true.cameras)), depth_source(given)
    wrong = source.depth(frame, estimate())
    assert wrong is None or wrong.known.mean() < 0.5 or abs(np.median(wrong.points_odom()[:, 2]) - WALL_M) > 0.05
    found = source.depth(frame, replace(estimate(), rig=true))
    assert found is not None
    check_wall(found)


@pytest.mark.parametrize("delay_ns", [10_000_000, -10_000_000])
def test_cameras_that_are_exposed_one_after_another_see_the_wall(delay_ns: int) -> None:
    """The pair is rectified from where its cameras were: here a third one is in time, and the right one is not."""
    rig, third = stereo()[0], RigCamera(SMALL, pose_matrix(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3)))
    rig = replace(rig, cameras=(third, *rig.cameras))
    moves = estimate(velocity=np.array([0.5, 1.0, -1.0]), rate=np.array([0.5, 1.0, -1.5]))
    assert moves.state is not None
    poses = [pose_after(moves.state, 1e-9 * delay) for delay in (0, 0, delay_ns)]
    images = tuple(picture(c.model, T @ c.T_imu_cam) for c, T in zip(rig.cameras, poses, strict=True))
    found = depth_source(rig).depth(CameraFrame(0, images, image_delays_ns=(0, 0, delay_ns)), moves)
    assert found is not None
    check_wall(found)


def test_the_sky_beside_a_gate_has_not_the_depth_of_the_gate() -> None:
    """Beside a textured strip before a plain background, the background is unknown but for two pixels at the edge."""
    rig, pair = stereo()
    height, width, noise, disparity = pair.camera.height, pair.camera.width, np.random.default_rng(0), 12
    strip = 0.6 * cv2.resize(texture()[:height, :80].astype(float), (80, height))
    images = []
    for first in (120, 120 - disparity):
        image = 200.0 + 0.5 * noise.normal(size=(height, width))
        image[:, first : first + 80] = strip
        images.append(np.rint(cv2.GaussianBlur(image, (0, 0), 0.7)).astype(np.uint8))
    known = StereoDepth(rig, pair).disparity(*images)[0][20:-20] > 0.0
    assert known[:, 120:200].mean() > 0.9
    assert known[:, :118].mean() < 0.001
    assert known[:, 202:].mean() < 0.001


def test_one_camera_has_no_depth_of_the_sky_beside_a_gate() -> None:
    """As with a pair: the strip is 2 m away, and moves by 6 pixels for each 10 cm."""
    camera, noise = Pinhole(200, 150, np.array([[120.0, 0.0, 99.5], [0.0, 120.0, 74.5], [0.0, 0.0, 1.0]])), 0.5
    strip, rng = 0.6 * cv2.resize(texture()[:150, :80].astype(float), (60, 150)), np.random.default_rng(0)
    views = []
    for step in range(4):
        image = 200.0 + noise * rng.normal(size=(150, 200))
        image[:, 80 - 6 * step : 140 - 6 * step] = strip
        T = pose_matrix(np.eye(3), np.array([0.1 * step, 0.0, 0.0]))
        grey = cv2.GaussianBlur(image, (0, 0), 1.2).astype(np.float32)
        views.append(View(camera, T, grey, np.ones((150, 200), bool), np.zeros((0, 0, 3), np.uint8)))
    found = inverse_depth(views[0], views[1:])
    assert found is not None
    known = found[0][20:-20] > 0.0
    assert known[:, 80:140].mean() > 0.8
    assert known[:, :78].mean() < 0.001
    assert known[:, 142:].mean() < 0.001


def test_the_step_of_least_squares_finds_a_shift() -> None:
    """The step is the shift of a smooth image, with a standard deviation by the noise and the gradient."""
    x, y = np.meshgrid(np.arange(60.0), np.arange(40.0))
    wave = (100.0 + 30.0 * np.sin(0.3 * x + 0.05 * y)).astype(np.float32)
    shifted = (100.0 + 30.0 * np.sin(0.3 * (x + 0.4) + 0.05 * y)).astype(np.float32)
    gradient = (9.0 * np.cos(0.3 * x + 0.05 * y)).astype(np.float32)  # of wave(x + q) at q = 0
    step, sigma = refinement.least_squares_step(shifted, wave, gradient)
    inner = np.isfinite(sigma[5:-5, 5:-5]) & (sigma[5:-5, 5:-5] < 0.3)
    assert inner.mean() > 0.3
    assert np.median(np.abs(step[5:-5, 5:-5][inner] - 0.4)) < 0.05


def moving(direction: Array, step_m: float = 0.03, turn: float = 0.0) -> tuple[SweepDepth, list[DepthImage | None]]:
    """Return the depth images of one camera that moves before the wall, at 20 Hz."""
    rig = Rig((RigCamera(SMALL, np.eye(4)),))
    source, found = SweepDepth(rig), []
    for k in range(12):
        T = pose_matrix(exp_so3(np.array([0.0, turn * k, 0.0])), direction * step_m * k)
        frame = CameraFrame(k * 50_000_000, (picture(SMALL, T),))
        found.append(source.depth(frame, estimate(T, frame.t_ns)))
    return source, found


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
def test_one_camera_in_motion_sees_the_wall(direction: list[float]) -> None:
    """The sweep finds the wall in sideways, vertical and forward motion, at most four times a second."""
    images = [image for image in moving(np.array(direction), turn=0.005)[1] if image is not None]
    assert 1 <= len(images) <= 3
    check_wall(images[-1], 0.3)


def test_one_camera_at_rest_sees_nothing() -> None:
    """Without motion, or with rotation alone, there is no depth image."""
    assert not any(moving(np.zeros(3))[1])
    assert not any(moving(np.zeros(3), turn=0.02)[1])


def test_a_loss_forgets_the_images() -> None:
    """Images from before a loss have poses in another frame and are not compared."""
    source, _ = moving(np.array([1.0, 0.0, 0.0]))
    assert source.depth(CameraFrame(10**9, (picture(SMALL, np.eye(4)),)), Estimate(10**9, Health.LOST, None)) is None
    frame = CameraFrame(10**9 + 50_000_000, (picture(SMALL, np.eye(4)),))
    assert source.depth(frame, estimate(t_ns=frame.t_ns)) is None


def test_another_track_forgets_the_images() -> None:
    """Images of another track have poses in another frame and are not compared, even if no loss was reported."""
    for track, is_known in ((0, True), (1, False)):
        source, _ = moving(np.array([1.0, 0.0, 0.0]))
        T = pose_matrix(np.eye(3), np.array([0.5, 0.0, 0.0]))
        frame = CameraFrame(10**9, (picture(SMALL, T),))
        found = source.depth(frame, replace(estimate(T, frame.t_ns), track=track))
        assert (found is not None) is is_known


def test_the_dense_map_of_one_camera() -> None:
    """Frames that are due enter the dense map with the depth of one camera, whose wall is occupied."""
    rig = Rig((RigCamera(SMALL, np.eye(4)),))
    source = SweepDepth(rig)
    asked, count = [], 40

    class Counted:
        def depth(self, frame: CameraFrame, at: Estimate) -> DepthImage | None:
            asked.append(frame.t_ns)
            return source.depth(frame, at)

    mapper = DenseMapper(rig, DenseMapConfig(rate_hz=10.0), Counted())
    found = 0
    for k in range(count):
        T = pose_matrix(np.eye(3), np.array([0.015 * k, 0.0, 0.0]))
        frame = CameraFrame(k * 50_000_000, (picture(SMALL, T),))
        found += mapper.add_frame(frame, estimate(T, frame.t_ns)) is not None
    assert asked == [100_000_000 * k for k in range(count // 2)]
    assert found >= 3
    grid = mapper.local_map
    assert grid is not None
    occupied = grid.points(OCCUPIED)
    assert len(occupied) > 50
    assert abs(np.median(occupied[:, 2]) - WALL_M) < 0.1
