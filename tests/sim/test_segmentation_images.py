"""Segmentation images of environments: numbers of objects against rays, names, and what they do not depend on."""

import pickle
from typing import Any

import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.ndimage import maximum_filter, minimum_filter

from dronevio.envs import Constant, DroneEnv, DroneVectorEnv, Randomization
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rig import EUROC_CAM0, RigCamera
from dronevio.models.rig_presets import TUM_VI_CAMERA
from dronevio.models.rotation import exp_so3, pose_matrix, quat_wxyz_from_matrix
from dronevio.sim.envs.sensing.camera_observation import ImageSettings, RenderedObservation
from dronevio.sim.envs.sensing.world_objects import NOTHING, world_objects
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS
from dronevio.sim.world import WORLDS, illumination_and_movers, instance_spec

SETTINGS: dict[str, Any] = {"world": "low-texture", "image_size": (32, 24)}
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axis along world x
T_S = 3.7


def looking(yaw_rad: float, position_m: tuple[float, float, float]) -> Array:
    """Return the pose (4, 4) of a camera that looks ahead and slightly down."""
    R = exp_so3(np.array([0.0, 0.0, yaw_rad])) @ exp_so3(np.array([0.0, 0.15, 0.0])) @ AHEAD
    return np.asarray(pose_matrix(R, np.array(position_m)))


def hit_names(world: str, t_s: float, origin: Array, rays: Array) -> list[str]:
    """Return the names of the objects that rays (N, 3) of the world frame hit first."""
    model = instance_spec(world, 0).compile()
    data = mujoco.MjData(model)
    for mover in illumination_and_movers(world, 0)[1]:
        T, number = mover.poses(np.array([t_s]))[0], model.body(mover.body).mocapid[0]
        data.mocap_pos[number], data.mocap_quat[number] = T[:3, 3], quat_wxyz_from_matrix(T[:3, :3])
    mujoco.mj_kinematics(model, data)
    geom, names = np.empty(1, np.int32), []
    for ray in rays:
        mujoco.mj_ray(model, data, origin, ray, None, True, -1, geom, None)
        names.append(model.geom(int(geom[0])).name if geom[0] >= 0 else NOTHING)
    return names


@pytest.mark.parametrize(("world", "yaw_rad"), [("moving", 0.3), ("moving", 2.5), ("forest", -1.0)])
def test_numbers_are_those_of_the_objects_that_rays_hit(world: str, yaw_rad: float) -> None:
    camera = RigCamera(EUROC_CAM0, np.eye(4))
    observation = RenderedObservation(camera, world, 0, ImageSettings(("segmentation",), 48, 36))
    T = looking(yaw_rad, (0.0, 0.0, 1.4))
    image = observation.observe(T[None], np.array([round(1e9 * T_S)]))["segmentation"][0, :, :, 0]
    observation.close()
    inside = maximum_filter(image, 3) == minimum_filter(image, 3)  # away from edges
    v, u = np.nonzero(inside)
    rays = EUROC_CAM0.fitted(48, 36).unproject(np.stack([u, v], axis=-1)) @ T[:3, :3].T
    names = world_objects(world, 0).names
    seen, hit = [names[number] for number in image[inside]], hit_names(world, T_S, T[:3, 3], rays)
    assert (
        np.mean([a == b for a, b in zip(seen, hit, strict=True)]) > 0.99
    )  # all but parts of trees that are narrower than a pixel
    assert len(set(hit)) > 3
    if world == "moving":
        assert any(name.startswith(("person", "cart", "banner")) for name in hit)


def test_names_are_unique_and_kinds_are_shared() -> None:
    for world in ("gates", "moving", "office-glass"):
        objects = world_objects(world, 0)
        assert objects.names[0] == objects.kinds[0] == NOTHING
        assert len(set(objects.names)) == len(objects.names) == len(objects.kinds)
        assert {"floor", "landing_mat"} & set(objects.kinds)
        assert not any(kind[-1].isdecimal() for kind in objects.kinds)
    gates = world_objects("gates", 0)
    assert [gates.names[number] for number in np.flatnonzero(gates.of_kind("gate"))] == [
        f"gate_{number}" for number in range(1, 11)
    ]
    assert gates.of_kind("gate", "flag").sum() == 25
    with pytest.raises(ConfigError, match="sofa"):
        gates.of_kind("sofa")


@pytest.mark.slow
def test_all_worlds_have_named_objects() -> None:
    assert all("something" not in world_objects(world, 1).kinds for world in WORLDS)


def test_light_and_textures_do_not_change_numbers() -> None:
    """The world is not even painted."""
    LOADED_WORLDS.clear()
    before = len(LOADED_WORLDS)
    random = Randomization(light=Constant(0.3), texture_seeds=(7,))
    plain, dark = (
        DroneEnv(observations=("segmentation",), randomization=randomization, **SETTINGS)
        for randomization in (Randomization(), random)
    )
    seen = [env.reset(seed=0, options={"position_m": [0.0, 0.0, 1.5]})[0]["segmentation"] for env in (plain, dark)]
    assert len(LOADED_WORLDS) == before + 1
    assert np.array_equal(*seen) and len(np.unique(seen[0])) > 2
    plain.close()
    dark.close()


def test_single_and_vector_agree_and_pass_the_checker() -> None:
    single = DroneEnv(observations=("segmentation", "grey"), **SETTINGS)
    check_env(single, skip_render_check=True)
    vector = DroneVectorEnv(1, observations=("segmentation", "grey"), **SETTINGS)
    ours, theirs = single.reset(seed=3)[0]["segmentation"], vector.reset(seed=3)[0]["segmentation"][0]
    assert ours.shape == (24, 32, 1) and ours.dtype == np.int32
    assert np.array_equal(ours, theirs)
    box: Any = single.observation_space["segmentation"]  # type: ignore[index]  # of a Dict
    objects = single.settings.objects
    assert box.low.min() == 0 and box.high.max() >= len(objects.names) - 1
    copied = pickle.loads(pickle.dumps(single))
    assert copied.settings.objects == objects
    assert np.array_equal(copied.step(np.zeros(4))[0]["segmentation"], single.step(np.zeros(4))[0]["segmentation"])
    for env in (single, vector, copied):
        env.close()


def test_cameras_are_those_of_the_names() -> None:
    stereo = DroneEnv(observations=("segmentation:0", "segmentation:1"), rig="euroc-stereo", **SETTINGS)
    seen = stereo.reset(seed=0)[0]
    right = DroneEnv(observations=("segmentation",), rig="euroc-stereo", camera=1, **SETTINGS)
    assert np.array_equal(seen["segmentation:1"], right.reset(seed=0)[0]["segmentation"])
    assert not np.array_equal(seen["segmentation:0"], seen["segmentation:1"])
    stereo.close()
    right.close()


def test_nothing_is_seen_outside_the_field_of_view() -> None:
    camera = RigCamera(TUM_VI_CAMERA, np.eye(4))
    observation = RenderedObservation(camera, "low-texture", 0, ImageSettings(("segmentation",), 32, 32))
    image = observation.observe(looking(0.0, (0.0, 0.0, 1.5))[None])["segmentation"][0, :, :, 0]
    observation.close()
    v, u = np.mgrid[:32, :32]
    outside = np.isnan(TUM_VI_CAMERA.fitted(32, 32).unproject(np.stack([u, v], axis=-1))[..., 0])
    assert np.array_equal(image == 0, outside)


def test_images_of_objects_are_not_flat() -> None:
    with pytest.raises(ConfigError, match="flat observations with 'segmentation'"):
        DroneEnv(observations=("segmentation",), flat=True)
