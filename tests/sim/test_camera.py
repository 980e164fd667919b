"""The camera's images against its own projection, its depth against an analytic plane."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import GraphicsError
from dronevio.models.rig import EUROC_CAM0
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.camera import ImageNoise, OffscreenCamera
from dronevio.sim.scenery import add_pages, paint_pages
from dronevio.sim.solids import Face

Array = npt.NDArray[np.float64]

PINHOLE = replace(EUROC_CAM0, distortion=(0.0, 0.0, 0.0, 0.0))
T_WORLD_CAM = pose_matrix(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([1.3, -0.8, 2.1]))


def lamps(camera: CameraModel, T_world_cam: Array, rng: np.random.Generator) -> tuple[Array, mujoco.MjModel]:
    """Return the centres (N, 3) of small glowing balls spread over a camera's view, and the model that holds them."""
    u, v = np.meshgrid(np.linspace(25, camera.width - 26, 9), np.linspace(25, camera.height - 26, 6))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2) + rng.uniform(-8.0, 8.0, (54, 2))
    p_cam = camera.unproject(pixels) * rng.uniform(1.5, 4.0, (54, 1))
    p_world = p_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    spec = mujoco.MjSpec()
    spec.add_material(name="glow", rgba=[1.0, 1.0, 1.0, 1.0], emission=1.0)
    for p in p_world:
        radius = 0.006 * float(np.linalg.norm(p - T_world_cam[:3, 3]))  # 2.7 px, whatever the distance
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=p, material="glow")
    spec.visual.quality.numslices = spec.visual.quality.numstacks = 32
    return p_world, spec.compile()


@pytest.mark.parametrize(("camera", "tolerance_px"), [(PINHOLE, 0.1), (EUROC_CAM0, 0.25)])
def test_points_land_where_the_model_projects_them(camera: CameraModel, tolerance_px: float) -> None:
    p_world, model = lamps(camera, T_WORLD_CAM, np.random.default_rng(0))
    with OffscreenCamera(model, camera) as eye:
        image = eye.render(T_WORLD_CAM).astype(np.float64)
    expected = camera.project((p_world - T_WORLD_CAM[:3, 3]) @ T_WORLD_CAM[:3, :3])
    reach = 8
    for u, v in expected:
        left, top = round(u) - reach, round(v) - reach
        patch = image[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
        assert patch.sum() > 1000.0
        y, x = np.mgrid[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
        centroid = np.array([(x * patch).sum(), (y * patch).sum()]) / patch.sum()
        assert np.abs(centroid - [u, v]).max() < tolerance_px


@pytest.mark.parametrize("camera", [PINHOLE, EUROC_CAM0])
def test_depth_of_an_oblique_plane(camera: CameraModel) -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[50.0, 50.0, 0.5], pos=[0.0, 0.0, -0.5])
    model = spec.compile()
    model.stat.extent, model.vis.map.znear, model.vis.map.zfar = 1.0, 0.03, 50.0
    R_down = np.diag([1.0, -1.0, -1.0])
    T = pose_matrix(R_down @ exp_so3(np.array([0.35, -0.2, 0.3])), np.array([0.3, -0.2, 1.7]))
    with OffscreenCamera(model, camera) as eye:
        depth = eye.render_depth(T)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    xy = camera.normalise(np.stack([u, v], axis=-1))
    rays_world = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ T[:3, :3].T
    expected = -T[2, 3] / rays_world[..., 2]  # along the ray at depth 1: the plane z = 0
    assert depth.shape == (camera.height, camera.width)
    assert np.abs(depth / expected - 1.0).max() < 5e-3  # nearest neighbour: a third of a pixel of an oblique plane
    assert np.abs(np.median(depth / expected) - 1.0) < 1e-4


def quadrants(size: int, rng: np.random.Generator, height: int, width: int) -> npt.NDArray[np.uint8]:
    """Return an image whose quarters are black, dark, light, white, in reading order."""
    image = np.zeros((height, width, 3), np.uint8)
    image[: height // 2, width // 2 :] = 80
    image[height // 2 :, : width // 2] = 160
    image[height // 2 :, width // 2 :] = 240
    return image


@pytest.fixture
def small() -> CameraModel:
    return CameraModel(width=64, height=64, fx=64.0, fy=64.0, cx=31.5, cy=31.5)


@pytest.mark.parametrize("size_m", [(0.4, 0.6), (0.6, 0.4)])  # a tall face is laid on its side on the page
def test_a_face_shows_its_picture_upright(small: CameraModel, size_m: tuple[float, float]) -> None:
    height, width = size_m
    face = Face(
        corner=np.array([2.0, 0.5 * width, 0.5 * height]),
        right=np.array([0.0, -width, 0.0]),
        down=np.array([0.0, 0.0, -height]),
        paint=partial(quadrants, 1),
    )
    np.testing.assert_allclose(face.normal, [-1.0, 0.0, 0.0])
    spec = mujoco.MjSpec()
    pages = paint_pages([face], [np.ones((2, 2), np.float32)], np.random.default_rng(0))
    add_pages(spec, spec.worldbody, "face", pages)
    R_forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    with OffscreenCamera(spec.compile(), small) as eye:
        image = eye.render(pose_matrix(R_forward, np.array([1.0, 0.0, 0.0])))
    rows, columns = (32 + np.array([-1, 1]) * int(16 * v) for v in size_m)
    seen = image[np.ix_(rows, columns)].astype(float)
    np.testing.assert_allclose(seen, [[0, 80], [160, 240]], atol=3)


@pytest.fixture
def eye(small: CameraModel) -> Iterator[OffscreenCamera]:
    with OffscreenCamera(mujoco.MjSpec().compile(), small) as opened:
        yield opened


def test_two_cameras_draw_in_turn(small: CameraModel, eye: OffscreenCamera) -> None:
    _, model = lamps(EUROC_CAM0, np.eye(4), np.random.default_rng(1))
    with OffscreenCamera(model, EUROC_CAM0) as other:
        first = other.render(np.eye(4))
        assert eye.render(np.eye(4)).max() == 0
        np.testing.assert_array_equal(other.render(np.eye(4)), first)
        assert first.max() > 200


def test_a_closed_camera_says_so(eye: OffscreenCamera) -> None:
    eye.close()
    eye.close()
    with pytest.raises(GraphicsError, match="closed"):
        eye.render(np.eye(4))


def test_noise_has_the_variance_it_says() -> None:
    noise = ImageNoise(read_sigma=1.5, shot_sigma=3.0, vignetting=0.0)
    for level in (20, 120, 220):
        image = np.full((400, 400), level, np.uint8)
        noisy = noise.apply(image, np.random.default_rng(0)).astype(float)
        expected = 1.5**2 + 3.0**2 * level / 255.0 + 1.0 / 12.0  # rounding adds its own
        assert abs(noisy.mean() - level) < 0.05
        assert noisy.var() == pytest.approx(expected, rel=0.03)


def test_vignetting_darkens_the_corners_only() -> None:
    noise = ImageNoise(read_sigma=0.0, shot_sigma=0.0, vignetting=0.2)
    dimmed = noise.apply(np.full((101, 201), 200, np.uint8), np.random.default_rng(0))
    assert dimmed[50, 100] == 200
    assert dimmed[0, 0] == dimmed[-1, -1] == 160
