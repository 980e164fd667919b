"""Rolling shutter and motion blur: points appear at the pose of their row in the middle of its exposure."""

import mujoco
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.rig import EUROC_CAM0, RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.sim.cameras import shutter as shutter_module
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.shutter import Poses, Shutter

FISHEYE = CameraModel(
    width=320,
    height=240,
    fx=130.0,
    fy=131.0,
    cx=157.0,
    cy=121.0,
    distortion=(0.01, -0.02, 0.01, -0.002),
    lens="equidistant",
)
SMALL = CameraModel(width=376, height=240, fx=229.0, fy=229.0, cx=183.6, cy=124.2, distortion=EUROC_CAM0.distortion)
TINY = CameraModel(width=188, height=120, fx=115.0, fy=115.0, cx=92.0, cy=62.0, distortion=EUROC_CAM0.distortion)
T_START = pose_matrix(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([1.3, -0.8, 2.1]))
MIDDLE_NS = 1_403_715_273_262_142_976


def moving(velocity_m_s: list[float], rate_rad_s: list[float]) -> Poses:
    """Return poses of constant velocity and rate in the camera frame, with `T_START` at `MIDDLE_NS`."""
    v, w = np.array(velocity_m_s), np.array(rate_rad_s)

    def poses(t_ns: np.ndarray) -> np.ndarray:
        s = (np.asarray(t_ns) - MIDDLE_NS)[:, None] * 1e-9
        return T_START @ pose_matrix(exp_so3(s * w), s * v)

    return poses


def glowing_spheres(camera: CameraModel, rng: np.random.Generator) -> tuple[np.ndarray, mujoco.MjModel]:
    """Return the centres (N, 3) of small glowing spheres distributed over the image at `T_START`, and their model."""
    u, v = np.meshgrid(np.linspace(30, camera.width - 31, 7), np.linspace(30, camera.height - 31, 5))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2) + rng.uniform(-4.0, 4.0, (35, 2))
    p_cam = camera.unproject(pixels) * rng.uniform(1.5, 4.0, (35, 1))
    p_world = p_cam @ T_START[:3, :3].T + T_START[:3, 3]
    spec = mujoco.MjSpec()
    spec.add_material(name="glow", rgba=[1.0, 1.0, 1.0, 1.0], emission=1.0)
    for p in p_world:
        radius = 2.7 / camera.fx * float(np.linalg.norm(p - T_START[:3, 3]))  # 2.7 px at any distance
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=p, material="glow")
    spec.visual.quality.numslices = spec.visual.quality.numstacks = 32
    spec.stat.extent = 5.0
    return p_world, spec.compile()


def project_points(T_world_cam: np.ndarray, camera: CameraModel, p_world: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points (N, 3), each from one of the camera poses (N, 4, 4)."""
    T = inverse_pose(T_world_cam)
    return camera.project(np.einsum("nij,nj->ni", T[:, :3, :3], p_world) + T[:, :3, 3])


def expected_pixels(rig_camera: RigCamera, poses: Poses, p_world: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points (N, 3), each at the camera pose in the middle of its row's exposure."""
    camera, delay_s = rig_camera.model, np.zeros(len(p_world))
    for _ in range(20):  # the row depends on the pose, the pose on the row
        pixels = project_points(poses(MIDDLE_NS + np.rint(delay_s * 1e9).astype(np.int64)), camera, p_world)
        delay_s = (pixels[:, 1] / (camera.height - 1) - 0.5) * rig_camera.readout_s
    return pixels


def centroid(light: np.ndarray, around: np.ndarray, half_width: int) -> np.ndarray:
    """Return the intensity centroid (2,) of an image around a pixel."""
    left, top = (round(v) - half_width for v in around.tolist())
    patch = light[top : top + 2 * half_width + 1, left : left + 2 * half_width + 1].astype(np.float64)
    assert patch.shape == (2 * half_width + 1, 2 * half_width + 1)
    assert patch.sum() > 500.0
    y, x = np.mgrid[top : top + 2 * half_width + 1, left : left + 2 * half_width + 1]
    return np.asarray(np.array([(x * patch).sum(), (y * patch).sum()]) / patch.sum())


@pytest.mark.parametrize("camera", [SMALL, FISHEYE], ids=["radtan", "fisheye"])
@pytest.mark.parametrize(
    ("velocity", "rate", "exposure_s", "readout_s"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.004, 0.02),
        ([3.0, -1.0, 0.5], [0.2, 1.5, 0.6], 0.008, 0.0),
        ([0.3, 0.2, 0.5], [1.0, -2.0, 0.6], 0.001, 0.02),
        ([1.5, -1.0, 0.5], [0.7, 1.5, -1.0], 0.006, 0.015),
    ],
    ids=["still", "blurred", "rolling", "both"],
)
def test_points_appear_at_the_pose_of_their_row(
    camera: CameraModel, velocity: list[float], rate: list[float], exposure_s: float, readout_s: float
) -> None:
    poses = moving(velocity, rate)
    rig_camera = RigCamera(camera, np.eye(4), readout_s=readout_s)
    p_world, model = glowing_spheres(camera, np.random.default_rng(0))
    shutter = Shutter(rig_camera)
    plan = shutter.plan(poses, MIDDLE_NS, exposure_s, nearest_m=1.5)
    drawn = []
    with OffscreenCamera(model, shutter.drawn) as offscreen:

        def view(t_ns: int, rows: slice) -> np.ndarray:
            drawn.append(rows.stop - rows.start)
            return offscreen.render(poses(np.array([t_ns]))[0], rows=rows)

        light = shutter.expose(plan, poses, view)
    assert light.shape == (camera.height, camera.width)
    assert sum(drawn) <= (1.0 if not any(rate) else 5.0) * shutter.drawn.height
    expected = expected_pixels(rig_camera, poses, p_world)
    assert len(expected) == 35
    error = np.array([centroid(light, pixel, 12) - pixel for pixel in expected])
    assert np.abs(error).max() < 0.1
    if any(velocity) and readout_s:  # the rolling shutter has an effect
        assert np.abs(project_points(np.tile(T_START, (35, 1, 1)), camera, p_world) - expected).max() > 2.0


def clutter() -> mujoco.MjModel:
    """Return boxes of different grey levels and distances in front of `T_START`."""
    rng = np.random.default_rng(8)
    spec = mujoco.MjSpec()
    greys = np.linspace(0.1, 1.0, 20)
    for number, grey in enumerate(greys):
        spec.add_material(name=f"grey_{number}", emission=1.0, rgba=[grey, grey, grey, 1.0])
    for _ in range(400):
        depth_m = rng.uniform(1.4, 4.0)
        at = depth_m * np.array([rng.uniform(-1.3, 1.3), rng.uniform(-0.9, 0.9), 1.0])
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=rng.uniform(0.02, 0.1, 3) * depth_m,
            pos=T_START[:3, :3] @ at + T_START[:3, 3],
            material=f"grey_{rng.integers(len(greys))}",
        )
    spec.stat.extent = 5.0
    return spec.compile()


@pytest.mark.slow
@pytest.mark.parametrize(("exposure_s", "readout_s"), [(0.008, 0.0), (0.001, 0.02)], ids=["blurred", "rolling"])
def test_images_are_the_mean_over_the_exposure_of_rows(exposure_s: float, readout_s: float) -> None:
    poses, model = moving([2.0, -1.0, 2.0], [1.0, 2.4, -1.2]), clutter()
    camera = RigCamera(TINY, np.eye(4), readout_s=readout_s)
    shutter = Shutter(camera)
    count = 85 if readout_s else 31
    since_ns = np.linspace(-0.5, 0.5, count) * (exposure_s + readout_s) * 1e9
    with OffscreenCamera(model, shutter.drawn) as offscreen, OffscreenCamera(model, TINY) as plain:
        plan = shutter.plan(poses, MIDDLE_NS, exposure_s, nearest_m=1.4)
        light = shutter.expose(plan, poses, lambda t_ns, rows: offscreen.render(poses(np.array([t_ns]))[0], rows=rows))
        images = np.stack([plain.render(T) for T in poses(MIDDLE_NS + np.rint(since_ns).astype(np.int64))])
    delays_ns = (np.arange(TINY.height) / (TINY.height - 1) - 0.5) * readout_s * 1e9
    exposed = np.abs(since_ns[:, None] - delays_ns) <= 0.5e9 * exposure_s + 1.0
    exact = np.einsum("th,thw->hw", exposed / exposed.sum(axis=0), images)
    static_error = np.abs(images[count // 2] - exact).mean()
    assert static_error > 4.0
    assert np.abs(light - exact).mean() < 0.25 * static_error
    assert np.abs(light - exact)[:, :12].mean() < 0.3 * static_error  # the border contains what enters the image


def test_a_static_view_is_rendered_once() -> None:
    shutter = Shutter(RigCamera(SMALL, np.eye(4), readout_s=0.02), margin_px=3)
    poses = moving([0.002, 0.0, 0.0], [0.0, 0.002, 0.0])
    plan = shutter.plan(poses, MIDDLE_NS, 0.002, nearest_m=2.0)
    assert plan.static and plan.keys_ns.tolist() == [MIDDLE_NS]
    drawn = np.random.default_rng(0).integers(0, 255, (shutter.drawn.height, shutter.drawn.width), dtype=np.uint8)
    light = shutter.expose(plan, poses, lambda t_ns, rows: drawn[rows])
    np.testing.assert_array_equal(light, drawn[3:-3, 3:-3])


def test_fast_turns_are_complete_with_a_narrow_margin() -> None:
    camera, turning = RigCamera(TINY, np.eye(4), readout_s=0.015), moving([0.0, 0.0, 0.0], [0.3, 5.0, 0.5])
    lights, keys = [], []
    for margin_px in (4, 34):
        shutter = Shutter(camera, margin_px)
        u, v = np.meshgrid(np.arange(shutter.drawn.width), np.arange(shutter.drawn.height))
        rays = shutter.drawn.unproject(np.stack([u, v], axis=-1).astype(float))

        def waves(t_ns: int, rows: slice, rays: np.ndarray = rays) -> np.ndarray:
            """Return a distant scene with waves of about 40 px."""
            p = rays[rows] @ turning(np.array([t_ns]))[0, :3, :3].T
            return np.rint(128.0 + 50.0 * (np.sin(18.0 * p[..., 0]) + np.cos(17.0 * p[..., 1]))).astype(np.uint8)

        plan = shutter.plan(turning, MIDDLE_NS, 0.005, np.inf)
        assert plan.reach_px <= margin_px
        keys.append(len(plan.keys_ns))
        lights.append(shutter.expose(plan, turning, waves).astype(float))
    assert keys[0] > 3 and keys[1] == 1
    np.testing.assert_allclose(lights[0], lights[1], atol=5.0)  # 10 if the margin did not limit the turn


def test_number_of_renderings_follows_the_motion() -> None:
    shutter = Shutter(RigCamera(SMALL, np.eye(4), readout_s=0.02))

    def effort(poses: Poses, nearest_m: float = 2.0, exposure_s: float = 0.001) -> tuple[int, int]:
        plan = shutter.plan(poses, MIDDLE_NS, exposure_s, nearest_m)
        return len(plan.keys_ns), len(plan.samples_ns)

    turning = moving([0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert effort(turning, exposure_s=0.0005) == (1, 1)  # 4.5 px during the readout, but no parallax
    assert effort(turning, exposure_s=0.01)[1] >= 3
    assert effort(moving([0.0, 0.0, 0.0], [0.0, 8.0, 0.0]))[0] >= 2  # the margin of an image is limited
    assert effort(moving([2.0, 0.0, 0.0], [0.0, 0.0, 0.0]), nearest_m=np.inf) == (1, 1)
    near, far = (effort(moving([2.0, 0.0, 0.0], [0.0, 0.0, 0.0]), nearest_m)[0] for nearest_m in (0.5, 4.0))
    assert 2 <= far < near <= 20


@pytest.mark.parametrize(("blur_px", "most"), [(0.2, 1), (0.5, 2), (1.9, 2), (2.9, 3), (3.1, 5), (20.0, 27)])
def test_samples_have_the_moments_of_the_exposure(blur_px: float, most: int) -> None:
    instants, weights = shutter_module._quadrature(blur_px)
    assert len(instants) <= most
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ instants == pytest.approx(0.0, abs=1e-12)
    variance_px2 = weights @ instants**2 * blur_px**2
    assert variance_px2 == pytest.approx(blur_px**2 / 12.0, abs=0.05)
    assert np.diff(instants).max(initial=0.0) * blur_px < 1.2
