"""Flow images of environments: against rays and projections, against images, and over the steps of episodes."""

import pickle
from collections.abc import Iterator
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.ndimage import maximum_filter, minimum_filter

from dronevio.envs import Constant, DroneEnv, DroneVectorEnv, Hover, Randomization
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rig import EUROC_CAM0, RigCamera
from dronevio.models.rig_presets import TUM_VI_CAMERA, rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix, quat_wxyz_from_matrix
from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.envs.sensing.camera_observation import ImageSettings, RenderedObservation
from dronevio.sim.envs.sensing.image_flow import ImagePoses
from dronevio.sim.rendering import loaded_world
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS, LoadedWorld
from dronevio.sim.world import Mover, instance_spec

SETTINGS: dict[str, Any] = {"world": "low-texture", "image_size": (32, 24)}
SIZE = 48, 36
ALWAYS = np.ones(1, np.bool_)
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axis along world x
T_BEFORE = pose_matrix(AHEAD, np.array([0.0, 0.0, 1.5]))
T_NOW = pose_matrix(exp_so3(np.array([0.02, 0.03, 0.1])) @ AHEAD, np.array([0.15, 0.1, 1.45]))
V, U = np.mgrid[: SIZE[1], : SIZE[0]]
PIXELS = np.stack([U, V], axis=-1)
CAMERA = EUROC_CAM0.fitted(*SIZE)
WALL_M, CRATE_M = 3.0, 2.0


def flow(
    T_before: Array, T_now: Array, world: str = "low-texture", seconds: tuple[float, float] = (0.0, 0.0), **changes: Any
) -> Array:
    """Return the flow (H, W, 2) between two poses (4, 4) of a camera at two times [s]."""
    camera = RigCamera(changes.pop("model", EUROC_CAM0), np.eye(4))
    observation = RenderedObservation(camera, world, 0, ImageSettings(("flow",), *SIZE, **changes))
    times_ns = np.rint(1e9 * np.array(seconds)).astype(np.int64)
    image = observation.observe(T_now[None], times_ns[1:], ImagePoses(T_before[None], times_ns[:1], ALWAYS))["flow"][0]
    assert image in observation.spaces()["flow"]
    observation.close()
    return np.asarray(image)


def ahead_m(model: mujoco.MjModel, data: mujoco.MjData, origin: Array, rays: Array) -> tuple[Array, Array]:
    """Return distances and geoms (N,) at which rays (N, 3) hit the surfaces of a model; those of no hit are −1."""
    distances, geoms, geom = [], [], np.empty(1, np.int32)
    for ray in rays:
        distances.append(mujoco.mj_ray(model, data, origin, ray, None, True, -1, geom, None))
        geoms.append(int(geom[0]))
    return np.array(distances), np.array(geoms)


def along_x(t_s: Array) -> Array:
    """Return poses (M, 4, 4) of a crate that turns and moves to the right at 1 m/s."""
    t = np.atleast_1d(t_s)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = exp_so3(np.stack([0.0 * t, 0.6 * t, 0.0 * t], axis=-1))
    T[:, 0, 3], T[:, 2, 3] = t, CRATE_M
    return T


@pytest.fixture
def crate_world(monkeypatch: pytest.MonkeyPatch) -> Iterator[mujoco.MjModel]:
    """Replaces all worlds by a wall at z = 3 m from x = −2 to 2 m, and a crate that moves before it."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[2.0, 9.0, 0.5], pos=[0.0, 0.0, WALL_M + 0.5]
    )
    crate = spec.worldbody.add_body(name="crate", mocap=True, pos=[0.0, 0.0, CRATE_M])
    crate.add_geom(name="crate", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.4, 0.3, 0.2])
    spec.stat.extent = 10.0
    model = spec.compile()
    world = model, 1.0, (Mover("crate", along_x),)
    monkeypatch.setattr(loaded_world, "resolved_world", lambda name: name)
    monkeypatch.setattr(loaded_world, "_loaded_instances", lambda *key: LoadedWorld(*world, RenderContext(model)))
    LOADED_WORLDS.clear()
    yield model
    LOADED_WORLDS.clear()


def test_flow_is_that_of_the_points_that_rays_hit() -> None:
    """Each pixel's ray is cast, and its point is projected into the previous image, with the distortion of the lens."""
    model = instance_spec("low-texture", 0).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bearings = CAMERA.unproject(PIXELS)
    distance_m, geom = ahead_m(model, data, T_NOW[:3, 3], (bearings @ T_NOW[:3, :3].T).reshape(-1, 3))
    p_world = T_NOW[:3, 3] + distance_m.reshape(*V.shape, 1) * (bearings @ T_NOW[:3, :3].T)
    before = CAMERA.project((p_world - T_BEFORE[:3, 3]) @ T_BEFORE[:3, :3])
    same = geom.reshape(V.shape)
    inside = maximum_filter(same, 3) == minimum_filter(same, 3)
    found = flow(T_BEFORE, T_NOW)
    error_px = np.linalg.norm(found - (PIXELS - before), axis=-1)[inside]
    assert np.median(error_px) < 1e-4 and error_px.max() < 0.04  # depth is that of a rendered pixel on steep surfaces
    assert inside.mean() > 0.7 and np.abs(found).max() > 2.0


def test_moving_objects_move_with_their_surfaces(crate_world: mujoco.MjModel) -> None:
    before_s, now_s = 0.2, 0.5
    data = mujoco.MjData(crate_world)
    then, now = along_x(np.array([before_s, now_s]))
    data.mocap_pos[0], data.mocap_quat[0] = now[:3, 3], quat_wxyz_from_matrix(now[:3, :3])
    mujoco.mj_kinematics(crate_world, data)
    bearings = CAMERA.unproject(PIXELS).reshape(-1, 3)
    distance_m, geom = ahead_m(crate_world, data, np.zeros(3), bearings)
    on_crate = geom == crate_world.geom("crate").id
    points = distance_m[:, None] * bearings
    T = then @ inverse_pose(now)
    points[on_crate] = points[on_crate] @ T[:3, :3].T + T[:3, 3]
    inside = minimum_filter(on_crate.reshape(V.shape), 3)
    found = flow(np.eye(4), np.eye(4), "crate", (before_s, now_s))
    expected = PIXELS - CAMERA.project(points).reshape(*V.shape, 2)
    np.testing.assert_allclose(found[inside], expected[inside], atol=0.01)
    assert inside.sum() > 50 and found[inside][:, 0].min() > 1.0
    still = ~maximum_filter(on_crate.reshape(V.shape), 3)
    assert np.abs(found[still]).max() < 1e-3


@pytest.mark.usefixtures("crate_world")
def test_what_is_infinitely_far_moves_by_the_rotation() -> None:
    back = np.diag([-1.0, 1.0, -1.0])  # away from the wall
    T_before, T_now = (
        pose_matrix(back @ exp_so3(np.array(turn)), np.array(place))
        for turn, place in (([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), ([0.03, -0.05, 0.1], [0.5, 0.2, -0.3]))
    )
    found = flow(T_before, T_now, "nothing")
    rotated = CAMERA.unproject(PIXELS) @ (T_before[:3, :3].T @ T_now[:3, :3]).T
    np.testing.assert_allclose(found, PIXELS - CAMERA.project(rotated), atol=2e-3)
    assert np.abs(found).max() > 1.0


def test_flow_of_a_rotation_is_that_of_its_homography() -> None:
    model = rig_named("pinhole").cameras[0].model
    K = model.fitted(*SIZE).K
    R = exp_so3(np.array([0.05, -0.04, 0.1]))
    found = flow(T_BEFORE, T_BEFORE @ pose_matrix(R, np.zeros(3)), model=model)
    H = K @ R @ np.linalg.inv(K)
    before = np.concatenate([PIXELS, np.ones((*V.shape, 1))], axis=-1) @ H.T
    np.testing.assert_allclose(found, PIXELS - before[..., :2] / before[..., 2:], atol=2e-3)


def test_a_static_camera_has_no_flow() -> None:
    assert np.abs(flow(T_NOW, T_NOW)).max() < 1e-3


def test_the_previous_image_is_warped_onto_the_current_one() -> None:
    """As `cv2.remap` does it, at the pixels of the current image minus the flow."""
    camera = RigCamera(EUROC_CAM0, np.eye(4))
    observation = RenderedObservation(camera, "low-texture", 0, ImageSettings(("grey", "flow"), 160, 120))
    before = observation.observe(T_BEFORE[None])["grey"][0, ..., 0]
    seen = observation.observe(T_NOW[None], None, ImagePoses(T_BEFORE[None], np.zeros(1, np.int64), ALWAYS))
    observation.close()
    now, moved = seen["grey"][0, ..., 0].astype(float), seen["flow"][0]
    v, u = np.mgrid[:120, :160].astype(np.float32)
    x, y = u - moved[..., 0], v - moved[..., 1]
    warped = cv2.remap(before, x, y, cv2.INTER_LINEAR).astype(float)
    visible = (x > 1) & (x < 158) & (y > 1) & (y < 118)
    error, raw = np.abs(warped - now)[visible], np.abs(before.astype(float) - now)[visible]
    assert np.mean(error) < 0.2 * np.mean(raw)
    assert np.percentile(error, 95) < 6.0 < np.percentile(raw, 95)


@pytest.mark.parametrize("model", [EUROC_CAM0, TUM_VI_CAMERA])
@pytest.mark.parametrize("turn", [0.4, np.pi])
def test_flow_is_bounded_and_finite(model: Any, turn: float) -> None:
    found = flow(T_BEFORE, T_BEFORE @ pose_matrix(exp_so3(np.array([0.0, turn, 0.0])), np.zeros(3)), model=model)
    assert (
        np.isfinite(found).all() and np.abs(found[..., 0]).max() <= SIZE[0] and np.abs(found[..., 1]).max() <= SIZE[1]
    )
    if model is EUROC_CAM0 and turn > 1.0:
        assert not found.any()  # behind the camera


def test_batches_equal_single_images() -> None:
    observation = RenderedObservation(
        RigCamera(EUROC_CAM0, np.eye(4)), "low-texture", 0, ImageSettings(("flow",), *SIZE)
    )
    now, before = np.stack([T_NOW, T_BEFORE, T_NOW]), np.stack([T_BEFORE, T_NOW, T_NOW])
    times = np.zeros(3, np.int64)
    batch = observation.observe(now, times, ImagePoses(before, times, np.array([True, True, False])))["flow"]
    for row in range(2):
        one = ImagePoses(before[row][None], times[:1], ALWAYS)
        assert np.array_equal(observation.observe(now[row][None], times[:1], one)["flow"][0], batch[row])
    assert batch[0].any() and not batch[2].any()
    observation.close()


def test_flow_with_depth_is_that_without() -> None:
    alone = DroneEnv(observations=("flow",), **SETTINGS)
    both = DroneEnv(observations=("depth", "flow"), **SETTINGS)
    depth = DroneEnv(observations=("depth",), **SETTINGS)
    for env in (alone, both, depth):
        env.reset(seed=1)
    seen = [env.step(np.array([0.0, 0.5, 0.0, 0.5]))[0] for env in (alone, both, depth)]
    assert np.array_equal(seen[0]["flow"], seen[1]["flow"]) and seen[0]["flow"].any()
    assert np.array_equal(seen[1]["depth"], seen[2]["depth"])
    for env in (alone, both, depth):
        env.close()


def test_flow_is_that_between_images_of_the_mounted_camera() -> None:
    """With images at half the rate of the actions, and cameras that are turned on the rig."""
    mounting = Randomization(
        camera_rotation_rad=Constant(0.05), camera_translation_m=Constant(0.02), light=Constant(0.3)
    )
    env = DroneEnv(observations=("flow",), randomization=mounting, camera_rate_hz=25.0, **SETTINGS)
    rig = env.settings.rig
    error = pose_matrix(exp_so3(np.full(3, 0.05)), np.full(3, 0.02))
    seen, poses = [env.reset(seed=2)[0]["flow"]], [env._core.shown(0)[1] @ rig.T_vehicle_imu @ error]
    for _ in range(4):
        seen.append(env.step(np.array([0.0, 0.8, 0.2, 1.0]))[0]["flow"])
        poses.append(env._core.shown(0)[1] @ rig.T_vehicle_imu @ error)
    env.close()
    assert not seen[0].any() and not seen[1].any()  # the first image, which is repeated
    assert np.array_equal(seen[2], seen[3]) and not np.array_equal(seen[3], seen[4])
    observation = RenderedObservation(rig.cameras[0], "low-texture", 0, ImageSettings(("flow",), 32, 24))
    for now, before in ((2, 0), (4, 2)):
        previous = ImagePoses(poses[before][None], np.zeros(1, np.int64), ALWAYS)
        assert np.array_equal(observation.observe(poses[now][None], None, previous)["flow"][0], seen[now])
        assert seen[now].any()
    observation.close()


def test_saved_states_continue_with_the_same_flow() -> None:
    env = DroneEnv(observations=("flow",), camera_rate_hz=25.0, **SETTINGS)
    check_env(env, skip_render_check=True)
    action = np.array([0.0, 0.6, 0.1, 0.8])
    env.reset(seed=4)
    for _ in range(3):
        env.step(action)
    saved, copied = env.save_state(), pickle.loads(pickle.dumps(env))
    first = [env.step(action)[0]["flow"] for _ in range(3)]
    env.reset(seed=9)
    env.restore_state(saved)
    for again in (env, copied):
        assert all(np.array_equal(flow, again.step(action)[0]["flow"]) for flow in first)
        again.close()
    assert first[0].any()


def test_single_and_vector_agree() -> None:
    places = np.array([[0.0, 0.0, 1.5], [0.4, -0.3, 1.2], [-0.5, 0.2, 1.8]])
    still = {"velocity_m_s": np.zeros(3), "rate_rad_s": np.zeros(3), "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
    vector = DroneVectorEnv(3, observations=("flow", "flow:1"), rig="euroc-stereo", **SETTINGS)
    vector.reset(seed=0, options={"position_m": places, **still})
    actions = np.array([[0.1, 0.4, 0.0, 1.0], [0.0, -0.3, 0.5, -1.0], [0.3, 0.0, 0.0, 0.2]])
    batch = [vector.step(actions)[0] for _ in range(3)]
    for row, place in enumerate(places):
        single = DroneEnv(observations=("flow", "flow:1"), rig="euroc-stereo", **SETTINGS)
        single.reset(seed=0, options={"position_m": place, **still})
        for step in range(3):
            seen = single.step(actions[row])[0]
            for name in ("flow", "flow:1"):
                np.testing.assert_allclose(seen[name], batch[step][name][row], atol=1e-4)
        assert seen["flow"].any() and not np.array_equal(seen["flow"], seen["flow:1"])
        single.close()
    vector.close()


@pytest.mark.parametrize("mode", ["SAME_STEP", "NEXT_STEP"])
def test_new_episodes_begin_without_flow(mode: str) -> None:
    """The second environment begins two steps after the first, so that their episodes end one after the other."""
    vector = DroneVectorEnv(2, task=Hover(episode_s=0.1), autoreset_mode=mode, observations=("flow",), **SETTINGS)
    vector.reset(seed=0)
    action = np.tile([0.0, 0.5, 0.0, 1.0], (2, 1))
    vector.step(action)
    vector.step(action)
    seen = vector.reset(options={"reset_mask": np.array([False, True])})[0]["flow"]
    assert seen[0].any() and not seen[1].any()
    moving, infos = [], []
    for _ in range(4):
        observation, _, _, _, info = vector.step(action)
        moving.append([bool(image.any()) for image in observation["flow"]])
        infos.append(info)
    first = 2 if mode == "SAME_STEP" else 3  # of the steps of 0.02 s after which the first environment begins again
    assert moving == [[step != first, True] for step in range(4)]
    if mode == "SAME_STEP":
        assert infos[first]["final_obs"][0]["flow"].any()
    vector.close()


def test_flow_is_an_image() -> None:
    with pytest.raises(ConfigError, match="flat observations with 'flow'"):
        DroneEnv(observations=("flow",), flat=True)
