"""Images against the camera model's projection; depth and flow against analytic boxes and against the images."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial

import cv2
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, GraphicsError
from dronevio.models.rig import EUROC_CAM0
from dronevio.models.rig_presets import TUM_VI_CAMERA, UZH_FPV_CAMERA, rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix, skew
from dronevio.sim.appearance.scenery import add_pages, paint_pages
from dronevio.sim.appearance.solids import Face
from dronevio.sim.cameras import camera as camera_module
from dronevio.sim.cameras import views
from dronevio.sim.cameras.camera import GreyImage, OffscreenCamera
from dronevio.sim.cameras.surfaces import Flow, points_in_camera
from dronevio.sim.cameras.views import Views

PINHOLE = replace(EUROC_CAM0, distortion=(0.0, 0.0, 0.0, 0.0))
T_WORLD_CAM = pose_matrix(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([1.3, -0.8, 2.1]))


def glowing_spheres(
    camera: CameraModel, T_world_cam: Array, rng: np.random.Generator, margin_px: float = 12.0
) -> tuple[Array, mujoco.MjModel]:
    """Return the centres (N, 3) of small glowing spheres distributed over a camera's image, and their model."""
    low, high = np.full(2, margin_px), np.array([camera.width, camera.height]) - 1.0 - margin_px
    grid = np.stack(np.meshgrid(*(np.linspace(low[k], high[k], n) for k, n in enumerate((9, 6)))), axis=-1)
    pixels = np.clip(grid.reshape(-1, 2) + rng.uniform(-8.0, 8.0, (54, 2)), low, high)
    p_cam = camera.unproject(pixels) * rng.uniform(1.5, 4.0, (54, 1))
    p_world = p_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    spec = mujoco.MjSpec()
    spec.add_material(name="glow", rgba=[1.0, 1.0, 1.0, 1.0], emission=1.0)
    for p in p_world:
        radius = (
            2.7 / camera.central_focal_px[0] * float(np.linalg.norm(p - T_world_cam[:3, 3]))
        )  # 2.7 px at any distance
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=p, material="glow")
    spec.visual.quality.numslices = spec.visual.quality.numstacks = 32
    return p_world, spec.compile()


def in_camera(p_world: Array, T_world_cam: Array) -> Array:
    """Return points (N, 3) of the world in a camera's frame."""
    return np.asarray((p_world - T_world_cam[:3, 3]) @ T_world_cam[:3, :3])


def detected_centroids(image: npt.NDArray[np.uint8], expected: Array) -> Array:
    """Return the intensity centroids (N, 2) around the expected pixels (N, 2) of spheres."""
    centroids, half_width = [], 8
    for u, v in np.rint(expected).astype(int):
        patch = image[v - half_width : v + half_width + 1, u - half_width : u + half_width + 1].astype(np.float64)
        assert patch.sum() > 1000.0
        y, x = np.mgrid[v - half_width : v + half_width + 1, u - half_width : u + half_width + 1]
        centroids.append([(x * patch).sum() / patch.sum(), (y * patch).sum() / patch.sum()])
    return np.array(centroids)


@pytest.mark.parametrize(
    ("camera", "tolerance_px"),
    [
        (PINHOLE, 0.1),
        (EUROC_CAM0, 0.25),
        (UZH_FPV_CAMERA, 0.25),
        (TUM_VI_CAMERA, 0.25),
        (CameraModel(512, 512, 158.286, 158.274, 254.96, 256.89, (-0.172, 0.593), "ds"), 0.25),
        (CameraModel(640, 480, 700.0, 698.0, 318.0, 242.5, (1.6, -0.2, 0.1, 1e-3, -1e-3), "omni"), 0.25),
        (CameraModel(640, 480, 300.0, 298.0, 318.0, 242.5, (0.93,), "fov"), 0.25),
    ],
    ids=["pinhole", "radtan", "fisheye", "fisheye wider than 180°", "ds", "omni", "fov"],
)
def test_rendered_points_agree_with_the_camera_model(camera: CameraModel, tolerance_px: float) -> None:
    p_world, model = glowing_spheres(camera, T_WORLD_CAM, np.random.default_rng(0))
    with OffscreenCamera(model, camera) as offscreen:
        image = offscreen.render(T_WORLD_CAM)
    expected = camera.project(in_camera(p_world, T_WORLD_CAM))
    off = np.linalg.norm(detected_centroids(image, expected) - expected, axis=1)
    assert off.max() < tolerance_px
    assert np.median(off) < 0.4 * tolerance_px


def test_a_lens_is_rendered_with_the_resolution_of_its_centre() -> None:
    """That of ``omni`` is a fraction of its focal length: (1 + ξ) times as many pixels would be wasted."""
    camera = CameraModel(320, 240, 520.0, 520.0, 159.5, 119.5, (1.6, 0.0, 0.0, 0.0, 0.0), "omni")
    np.testing.assert_allclose(Views.around(camera, 1.5).views[0].f, 1.5 * 200.0)


@pytest.mark.parametrize("name", ["pinhole-stereo", "euroc-stereo", "fisheye-stereo"])
def test_stereo_images_satisfy_the_epipolar_constraint(name: str) -> None:
    left, right = rig_named(name).cameras
    T_left_right = inverse_pose(left.T_imu_cam) @ right.T_imu_cam
    T_world_right = T_WORLD_CAM @ T_left_right
    p_world, model = glowing_spheres(left.model, T_WORLD_CAM, np.random.default_rng(1), margin_px=60.0)
    pixels = []
    for camera, T_world_cam in ((left.model, T_WORLD_CAM), (right.model, T_world_right)):
        with OffscreenCamera(model, camera) as offscreen:
            expected = camera.project(in_camera(p_world, T_world_cam))
            pixels.append(detected_centroids(offscreen.render(T_world_cam), expected))
    # The constraint is b_leftᵀ [t]× R b_right = 0; divided by its gradient, it is a distance in the right image.
    normals = left.model.unproject(pixels[0]) @ skew(T_left_right[:3, 3]) @ T_left_right[:3, :3]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def epipolar_error(at: Array) -> Array:
        return np.asarray(np.sum(normals * right.model.unproject(at), axis=1))

    step = 1e-3
    gradient = [
        (epipolar_error(pixels[1] + e) - epipolar_error(pixels[1] - e)) / (2.0 * step) for e in step * np.eye(2)
    ]
    distance_px = np.abs(epipolar_error(pixels[1])) / np.hypot(*gradient)
    assert len(distance_px) == 54
    assert distance_px.max() < 0.1
    shift = np.linalg.norm(pixels[1] - pixels[0], axis=1)
    assert np.median(shift) > 4.0  # otherwise the constraint would hold trivially


@cache
def textured_box(half_m: float = 2.0, with_cart: bool = False) -> mujoco.MjModel:
    """Return a cubic room with textured walls, seen from inside, optionally with a box that can be moved."""
    rng, spec = np.random.default_rng(5), mujoco.MjSpec()
    ends = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (0, 0, 0))
    for number, end in enumerate(ends):
        shades = sum(
            strength
            * cv2.resize(rng.normal(size=(1024 // px, 1024 // px)), (1024, 1024), interpolation=cv2.INTER_CUBIC)
            for px, strength in ((8, 0.6), (16, 1.0), (64, 0.8))
        )
        image = np.repeat(np.clip(128.0 + 45.0 * shades, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        name = f"wall_{number}"
        flat = mujoco.mjtTexture.mjTEXTURE_2D if any(end) else mujoco.mjtTexture.mjTEXTURE_CUBE
        texture = spec.add_texture(name=name, type=flat, nchannel=3)
        texture.height, texture.width = (1024, 1024) if any(end) else (6 * 1024, 1024)
        texture.data = (image if any(end) else np.tile(image, (6, 1, 1))).tobytes()
        material = spec.add_material(name=name, emission=1.0, texrepeat=[1.0, 1.0])
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        size, plane = [half_m, half_m, 1.0], mujoco.mjtGeom.mjGEOM_PLANE
        if any(end):
            inward = [-float(v) for v in end]
            pos = [half_m * v for v in end]
            spec.worldbody.add_geom(name=name, type=plane, size=size, pos=pos, zaxis=inward, material=name)
    if with_cart:
        body = spec.worldbody.add_body(name="cart", mocap=True, pos=[1.0, 0.2, -0.3])
        body.add_geom(
            name="cart", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.3, 0.25], pos=[0.05, 0.0, 0.1], material="wall_6"
        )
    model = spec.compile()
    model.stat.extent, model.vis.map.znear, model.vis.map.zfar = 1.0, 0.03, 30.0
    return model


R_WORLD_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # the optical axis is the world's x
T_NOW = pose_matrix(R_WORLD_CAM @ exp_so3(np.array([0.1, 0.2, 0.05])), np.array([-0.4, 0.2, 0.1]))
T_NEXT = T_NOW @ pose_matrix(exp_so3(np.array([0.01, -0.015, 0.02])), np.array([0.05, 0.02, 0.03]))


def warp_residuals(offscreen: OffscreenCamera, flow: Flow, now: GreyImage, later: GreyImage) -> Array:
    """Return the displacements (N, 2) that remain after a later image is warped by the flow [px]."""
    height, width = now.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    target = np.stack([u, v], axis=-1) + flow
    warped = cv2.remap(later, target[..., 0], target[..., 1], cv2.INTER_CUBIC)
    inside = np.all((target > 12) & (target < np.array([width, height]) - 13.0), axis=-1).astype(np.uint8)
    inside = cv2.erode(inside, np.ones((25, 25)), borderValue=0)
    corners = cv2.goodFeaturesToTrack(now, 300, 0.05, 10, mask=inside, blockSize=5)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        now, warped, corners, corners.copy(), winSize=(15, 15), maxLevel=0, criteria=criteria
    )
    assert status.all()
    return np.asarray((tracked - corners)[:, 0])


@pytest.mark.parametrize("camera", [PINHOLE, EUROC_CAM0, UZH_FPV_CAMERA, TUM_VI_CAMERA])
def test_flow_warps_the_next_image_onto_the_first(camera: CameraModel) -> None:
    with OffscreenCamera(textured_box(), camera) as offscreen:
        flow = offscreen.render_flow(T_NOW, T_NEXT)
        off = warp_residuals(offscreen, flow, offscreen.render(T_NOW), offscreen.render(T_NEXT))
    assert np.median(np.linalg.norm(flow, axis=-1)) > 3.0
    assert len(off) > 150
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert np.abs(off.mean(axis=0)).max() < 0.02


def test_flow_of_a_moving_body() -> None:
    camera, model = EUROC_CAM0, textured_box(with_cart=True)
    before, after = (
        pose_matrix(exp_so3(np.array([0.0, 0.0, a])), np.array([1.1, x, -0.2])) for a, x in ((0.4, 0.3), (0.42, 0.27))
    )
    with OffscreenCamera(model, camera) as offscreen:
        seen = offscreen.render_surfaces(T_NOW, {"cart": before})
        flow = offscreen.render_flow(T_NOW, T_NOW, {"cart": before}, {"cart": after})
        now, later = offscreen.render(T_NOW, {"cart": before}), offscreen.render(T_NOW, {"cart": after})
        off = warp_residuals(offscreen, flow, now, later)
        unmoved = offscreen.render(T_NOW)
        initial = offscreen.render(T_NOW, {"cart": pose_matrix(np.eye(3), np.array([1.0, 0.2, -0.3]))})
    cart = seen.geom == offscreen.geom_names.index("cart")
    assert 0.02 < cart.mean() < 0.4
    assert np.abs(flow[~cart]).max() < 1e-3
    assert np.median(np.linalg.norm(flow[cart], axis=-1)) > 3.0
    assert np.percentile(np.linalg.norm(off, axis=1), 90) < 0.3  # the others are occluded by the cart afterwards
    np.testing.assert_array_equal(unmoved, initial)
    assert np.mean(unmoved != now) > 0.05
    p = points_in_camera(camera, seen.depth_m)[cart] @ T_NOW[:3, :3].T + T_NOW[:3, 3]
    T_after_before = after @ inverse_pose(before)
    moved = in_camera(p @ T_after_before[:3, :3].T + T_after_before[:3, 3], T_NOW)
    v, u = np.nonzero(cart)
    np.testing.assert_allclose(flow[cart], camera.project(moved) - np.stack([u, v], axis=-1), atol=1e-3)


def test_moving_an_unknown_body_is_refused() -> None:
    with OffscreenCamera(textured_box(with_cart=True), PINHOLE) as offscreen:
        for name in ("ghost", "world"):
            with pytest.raises(ConfigError, match=name):
                offscreen.render(T_NOW, {name: np.eye(4)})


def test_a_cube_of_views_agrees_with_a_single_view(monkeypatch: pytest.MonkeyPatch) -> None:
    model = textured_box()
    with OffscreenCamera(model, EUROC_CAM0) as offscreen:
        assert len(offscreen.views.views) == 1
        single, depth = offscreen.render(T_NOW).astype(float), offscreen.render_depth(T_NOW)
    monkeypatch.setattr(views, "_WORTH_A_CUBE", np.inf)
    monkeypatch.setattr(camera_module, "_lens_tables", camera_module._lens_tables.__wrapped__)  # without the cache
    with OffscreenCamera(model, EUROC_CAM0) as offscreen:
        assert len(offscreen.views.views) > 1
        cube, depth_of_cube = offscreen.render(T_NOW).astype(float), offscreen.render_depth(T_NOW)
    assert np.abs(cube - single).mean() < 1.0
    assert np.abs(cube - single).max() < 24.0  # the resolution of the texture differs, not its position
    assert np.median(np.abs(depth_of_cube / depth - 1.0)) < 1e-5


@pytest.mark.parametrize("camera", [EUROC_CAM0, UZH_FPV_CAMERA])
def test_a_band_of_rows_equals_the_rows_of_the_image(camera: CameraModel) -> None:
    with OffscreenCamera(textured_box(), camera) as offscreen:
        whole = offscreen.render(T_NOW).astype(float)
        for rows in (slice(0, 40), slice(100, 170), slice(camera.height - 30, camera.height)):
            difference = np.abs(offscreen.render(T_NOW, rows=rows) - whole[rows])
            assert difference.max() <= 3.0  # the projection of a part of a view is rounded differently
            assert difference.mean() < 0.05


@pytest.mark.parametrize("samples", [0, 4])
def test_grey_levels_are_those_of_the_colours(samples: int) -> None:
    model = textured_box()
    before, model.vis.quality.offsamples = model.vis.quality.offsamples, samples
    try:
        with OffscreenCamera(model, EUROC_CAM0) as offscreen:
            grey = offscreen._renderer.grey(T_NOW).copy()
            colours = offscreen._renderer.colours(T_NOW)
            for view in offscreen.views.views:
                part = (slice(view.height), slice(view.column, view.column + view.width))
                np.testing.assert_array_equal(grey[part], cv2.cvtColor(colours[part].copy(), cv2.COLOR_RGB2GRAY))
                assert grey[part].std() > 10.0
    finally:
        model.vis.quality.offsamples = before


def test_pixels_outside_the_field_of_view_are_empty() -> None:
    camera = CameraModel(320, 240, 90.0, 90.0, 159.5, 119.5, (0.02, -0.03, 0.004, -0.002), "equidistant")
    outside = np.asarray(
        np.isnan(camera.unproject(np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1))).any(axis=-1)
    )
    assert 0.05 < outside.mean() < 0.6
    with OffscreenCamera(textured_box(), camera) as offscreen:
        image, seen = offscreen.render(T_NOW), offscreen.render_surfaces(T_NOW)
        flow = offscreen.render_flow(T_NOW, T_NEXT)
    assert image[cv2.erode(outside.astype(np.uint8), np.ones((5, 5)), borderValue=1) > 0].max() == 0
    assert image[cv2.erode((~outside).astype(np.uint8), np.ones((5, 5))) > 0].mean() > 90
    np.testing.assert_array_equal(np.isnan(seen.depth_m), outside)
    np.testing.assert_array_equal(seen.geom == -1, outside)
    assert np.isnan(flow[outside]).all()


@pytest.mark.parametrize("camera", [PINHOLE, EUROC_CAM0, UZH_FPV_CAMERA, TUM_VI_CAMERA])
def test_depth_and_geoms_of_a_box(camera: CameraModel) -> None:
    """In an analytic box, each ray ends at the nearest wall."""
    with OffscreenCamera(textured_box(2.0), camera) as offscreen:
        seen = offscreen.render_surfaces(T_NOW)
    rays = camera.unproject(np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1))
    in_world = rays @ T_NOW[:3, :3].T
    lengths = (np.where(in_world > 0.0, 2.0, -2.0) - T_NOW[:3, 3]) / in_world
    axis, length = lengths.argmin(axis=-1), lengths.min(axis=-1)
    wall = 2 * axis + (np.take_along_axis(in_world, axis[..., None], axis=-1)[..., 0] < 0.0)
    names = np.array(offscreen.geom_names)[seen.geom]
    near_edge = np.diff(np.sort(lengths, axis=-1)[..., :2], axis=-1)[..., 0] < 0.02 * length
    assert (names == np.array([f"wall_{k}" for k in range(6)])[wall])[~near_edge].all()
    depth = length * rays[..., 2] if camera.lens == "radtan" else length
    error = np.abs(seen.depth_m / depth - 1.0)
    assert error[~near_edge].max() < 1e-4
    assert error.max() < 2e-2


def test_empty_background_has_infinite_depth() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.5, 0, 0], pos=[0.0, 0.0, 3.0])
    with OffscreenCamera(spec.compile(), PINHOLE) as offscreen:
        seen = offscreen.render_surfaces(np.eye(4))
        flow = offscreen.render_flow(np.eye(4), np.eye(4))
    assert seen.depth_m[240, 367] == pytest.approx(2.5, abs=0.01)  # the sphere is rendered as a polyhedron
    assert seen.geom[240, 367] == 0
    assert np.isinf(seen.depth_m[5, 5])
    assert seen.geom[5, 5] == -1
    assert np.isnan(flow[5, 5]).all()


def test_a_reflective_floor_shows_mirror_images() -> None:
    images = []
    for reflectance in (0.0, 0.5):
        spec = mujoco.MjSpec()
        spec.add_material(name="floor", rgba=[0.1, 0.1, 0.1, 1.0], emission=1.0, reflectance=reflectance)
        spec.add_material(name="glow", rgba=[1.0, 1.0, 1.0, 1.0], emission=1.0)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9.0, 9.0, 1.0], material="floor")
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], pos=[3.0, 0.2, 0.8], material="glow"
        )
        model = spec.compile()
        model.stat.extent, model.vis.map.znear, model.vis.map.zfar = 1.0, 0.03, 30.0
        with OffscreenCamera(model, EUROC_CAM0) as offscreen:
            images.append(offscreen.render(pose_matrix(R_WORLD_CAM, np.array([0.0, 0.0, 0.7]))).astype(float))
    mirrored = in_camera(np.array([[3.0, 0.2, -0.8]]), pose_matrix(R_WORLD_CAM, np.array([0.0, 0.0, 0.7])))
    u, v = np.rint(EUROC_CAM0.project(mirrored))[0].astype(int)
    matt, reflective = (image[v - 3 : v + 4, u - 3 : u + 4].mean() for image in images)
    assert reflective > matt + 50.0


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


@pytest.mark.parametrize("size_m", [(0.4, 0.6), (0.6, 0.4)])  # a tall face is rotated in the texture atlas
def test_the_texture_of_a_face_is_upright(small: CameraModel, size_m: tuple[float, float]) -> None:
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
    with OffscreenCamera(spec.compile(), small) as offscreen:
        image = offscreen.render(pose_matrix(R_forward, np.array([1.0, 0.0, 0.0])))
    rows, columns = (32 + np.array([-1, 1]) * int(16 * v) for v in size_m)
    seen = image[np.ix_(rows, columns)].astype(float)
    np.testing.assert_allclose(seen, [[0, 80], [160, 240]], atol=3)


@pytest.fixture
def offscreen(small: CameraModel) -> Iterator[OffscreenCamera]:
    with OffscreenCamera(mujoco.MjSpec().compile(), small) as opened:
        yield opened


def test_two_cameras_render_alternately(small: CameraModel, offscreen: OffscreenCamera) -> None:
    _, model = glowing_spheres(EUROC_CAM0, np.eye(4), np.random.default_rng(1))
    with OffscreenCamera(model, EUROC_CAM0) as other:
        first = other.render(np.eye(4))
        assert offscreen.render(np.eye(4)).max() == 0
        np.testing.assert_array_equal(other.render(np.eye(4)), first)
        assert first.max() > 200


def test_a_closed_camera_raises(offscreen: OffscreenCamera) -> None:
    offscreen.close()
    offscreen.close()
    with pytest.raises(GraphicsError, match="closed"):
        offscreen.render(np.eye(4))
