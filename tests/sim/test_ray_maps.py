"""Maps by rays: values worked out by hand in a small space, against exact rays in worlds, and in environments."""

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

import dronevio.envs  # noqa: F401 registers
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN
from dronevio.models.rig import RigCamera, euroc_rig
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.sim.envs.sensing.ray_maps import FINER, MapSettings, RayMaps, world_cells
from dronevio.sim.envs.single import DroneEnv
from dronevio.sim.envs.tasks.explore import Explore
from dronevio.sim.envs.tasks.places import free_places
from dronevio.sim.envs.vector import DroneVectorEnv
from dronevio.sim.paths.solid_cells import solid_cells
from dronevio.sim.paths.space import Space
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.world import flight_area

Array = np.ndarray

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from a camera that looks along x to the vehicle."""
WALL = Space(
    np.array([0.0, 0.0, 0.0]),
    np.array([8.0, 4.0, 2.0]),
    np.array([[5.05, 2.0, 1.0]]),  # from x = 4.55 m
    np.array([[0.5, 2.0, 1.0]]),
    np.eye(3)[None],
)


def forward_camera(model: CameraModel) -> RigCamera:
    """Return a camera that looks along x, at the centre of the IMU."""
    (camera,) = euroc_rig().cameras
    return replace(camera, model=model, T_imu_cam=pose_matrix(FORWARD, np.zeros(3)))


def at(*position: float, yaw_rad: float = 0.0) -> Array:
    """Return poses (1, 4, 4) of one IMU with a heading."""
    return pose_matrix(rotation_z(np.array([yaw_rad])), np.array([position]))


FIRST = np.zeros(2, dtype=np.intp)  # all environments are in the first world


def wall_maps(settings: MapSettings, count: int = 1, period: int = 1) -> RayMaps:
    """Return maps in a box with a wall, by the lens of EuRoC's camera, or by its axis if there is one ray."""
    (camera,) = euroc_rig().cameras
    model = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0) if settings.rays == (1, 1) else camera.model
    return RayMaps(count, [solid_cells(WALL, settings.cell_m / FINER)], forward_camera(model), settings, period)


# --- by hand


def test_one_ray_makes_its_cells_free_up_to_the_wall() -> None:
    """From x = 1.1 m, the ray along x passes the cells of 0.5 m from 1.0 m on and ends in the one from 4.0 to 4.5 m.

    The wall begins at 4.55 m; half a diagonal of a cell of 0.25 m, 0.217 m, before it, cells are solid.
    """
    maps = wall_maps(MapSettings(cell_m=0.5, reach_m=6.0, rays=(1, 1)))
    maps.restart(np.array([True]), at(1.1, 2.1, 1.1), FIRST[:1])
    line = maps.states[0, :, 4, 2]
    assert line[:2].tolist() == [UNKNOWN] * 2
    assert line[2:8].tolist() == [FREE] * 6
    assert line[8] == OCCUPIED
    assert line[9:].tolist() == [UNKNOWN] * 7  # behind the wall
    assert np.count_nonzero(maps.states) == 7
    assert maps.known_m3[0] == pytest.approx(7 * 0.125)


def test_only_what_is_new_counts() -> None:
    """Two steps along the ray show two cells more behind the start; the same place shows nothing again."""
    maps = wall_maps(MapSettings(cell_m=0.5, reach_m=2.0, rays=(1, 1)))
    maps.restart(np.array([True]), at(0.6, 2.1, 1.1), FIRST[:1])  # cells 1 to 5: samples up to x = 2.5 m
    assert maps.known_m3[0] == pytest.approx(4 * 0.125)
    assert maps.advance(at(0.6, 2.1, 1.1))[0] == 0.0
    assert maps.advance(at(1.6, 2.1, 1.1))[0] == pytest.approx(2 * 0.125)
    assert maps.known_m3[0] == pytest.approx(6 * 0.125)


def test_rays_are_cast_when_they_are_due_and_maps_begin_anew() -> None:
    maps = wall_maps(MapSettings(), count=2, period=3)
    both = np.array([True, True])
    poses = np.concatenate([at(1.0, 2.0, 1.0), at(1.0, 2.0, 1.0)])
    turned = np.concatenate([at(1.0, 2.0, 1.0, yaw_rad=1.0)] * 2)
    maps.restart(both, poses, FIRST[:2])
    first = maps.known_m3.copy()
    assert [maps.advance(turned)[0] > 0.0 for _ in range(6)] == [False, False, True, False, False, False]
    assert first[0] == first[1] and maps.known_m3[0] > first[0]
    maps.restart(np.array([False, True]), poses, FIRST[:2])
    assert maps.known_m3[0] > maps.known_m3[1] == first[1]
    assert np.count_nonzero(maps.states[1]) * 0.25**3 == pytest.approx(maps.known_m3[1])


def test_nothing_is_seen_from_outside_and_no_bound_is_a_surface() -> None:
    maps = wall_maps(MapSettings())
    maps.restart(np.array([True]), at(-0.5, 2.0, 1.0), FIRST[:1])
    assert maps.known_m3[0] == 0.0
    maps.restart(np.array([True]), at(6.5, 2.0, 1.0), FIRST[:1])  # behind the wall, toward the end of the box
    assert maps.known_m3[0] > 0.0 and not np.any(maps.states == OCCUPIED)


def test_the_local_map_turns_with_the_heading() -> None:
    """A single occupied cell 1 m ahead appears ahead, then to the right after a turn to the left."""
    maps = wall_maps(MapSettings(side=8, layers=3))
    maps.states[:] = FREE
    maps.states[0, 12, 8, 4] = OCCUPIED  # centre at (3.125, 2.125, 1.125) m
    position = np.array([[2.0, 2.0, 1.1]])

    def local(yaw_rad: float) -> Array:
        return np.asarray(maps.around(VehicleStates.at(position, rotation_z(np.array([yaw_rad]))))[0])

    ahead = local(0.0)
    assert ahead.shape == (3, 8, 8)
    # Cells are −0.875, …, 0.875 m from the vehicle along both axes.
    assert np.argwhere(ahead == 1.0).size == 0
    maps.states[0, 11, 8, 4] = OCCUPIED  # 0.875 m ahead, 0.125 m to the left
    assert np.argwhere(local(0.0) == 1.0).tolist() == [[1, 7, 4]]
    assert np.argwhere(local(0.5 * np.pi) == 1.0).tolist() == [[1, 4, 0]]
    maps.states[0, 11, 8, 4], maps.states[0, 11, 8, 6] = FREE, UNKNOWN  # 0.5 m higher
    assert np.argwhere(local(0.0) == 0.0).tolist() == [[2, 7, 4]]


def test_what_is_outside_the_world_is_occupied() -> None:
    maps = wall_maps(MapSettings(side=8, layers=3, layer_m=1.0))
    local = maps.around(VehicleStates.at(np.array([[0.3, 2.0, 1.1]])))[0]
    assert np.all(local[:, :3] == 1.0) and not np.any(local[:2, 3:])
    low = maps.around(VehicleStates.at(np.array([[4.0, 2.0, 0.5]])))[0]
    assert np.all(low[0] == 1.0) and not np.any(low[1:])  # below the floor


# --- against exact rays


@pytest.mark.parametrize("world", ["office", "forest"])
def test_no_cell_behind_a_surface_becomes_known(world: str) -> None:
    """Some point of every free cell is in sight of the camera, along rays to the visible surfaces of the world."""
    rig, settings = euroc_rig(), MapSettings()
    (camera,) = rig.cameras
    solids = world_cells(world, 0, settings.cell_m / FINER)
    maps, caster = RayMaps(1, [solids], camera, settings, 1), RayCaster(world, 0)
    places, rng = free_places(flight_area(world, 0), (1.0, 1.8), 0.6), np.random.default_rng(0)
    offsets = np.stack(np.meshgrid(*[[-0.11, 0.0, 0.11]] * 3), axis=-1).reshape(-1, 3)
    for place in places[rng.integers(0, len(places), 6)]:
        T_world_imu = at(*place, yaw_rad=rng.uniform(-np.pi, np.pi)) @ rig.T_vehicle_imu
        maps.restart(np.array([True]), T_world_imu, FIRST[:1])
        origin = (T_world_imu @ camera.T_imu_cam)[0, :3, 3]
        free = solids.low_m + settings.cell_m * (np.argwhere(maps.states[0] == FREE) + 0.5)
        assert len(free) > 50
        seen = np.zeros(len(free), np.bool_)
        for offset in offsets:
            ways = free + offset - origin
            length = np.linalg.norm(ways, axis=1)
            clear = caster.ranges_m(pose_matrix(np.eye(3), origin)[None], ways / length[:, None])[0]
            seen |= clear > length - 0.01
        assert seen.all()


def test_solid_cells_are_those_near_solids() -> None:
    turned = replace(WALL, rotations=rotation_z(np.array([0.4])))
    cells = solid_cells(turned, 0.25)
    centres = cells.low_m + 0.25 * (np.argwhere(np.ones(cells.is_solid.shape)) + 0.5)
    to_box = replace(turned, low=np.full(3, -np.inf), high=np.full(3, np.inf)).clearance(centres)
    np.testing.assert_array_equal(cells.is_solid.ravel(), to_box <= 0.125 * 3**0.5)
    assert 0.1 < cells.is_solid.mean() < 0.3


# --- in environments


def actions(steps: int, count: int) -> Array:
    """Return small random actions (steps, count, 4) of the mode velocity, with a turn."""
    drawn = np.random.default_rng(0).uniform(-0.2, 0.2, (steps, count, 4))
    return np.asarray(drawn + [0.1, 0.0, 0.0, 0.3], np.float32)


def test_a_row_of_explore_equals_a_single_environment() -> None:
    """Same initial states and actions: the same rewards and local maps."""
    given: dict[str, Any] = {
        "position_m": np.array([[-8.9, 0.0, 1.3], [-6.0, 0.0, 1.2]]),
        "quat_wxyz": np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]),
        "velocity_m_s": np.zeros((2, 3)),
        "rate_rad_s": np.zeros((2, 3)),
    }
    envs = DroneVectorEnv(2, "explore")
    many = envs.reset(seed=0, options=given)[0]["local_map"]
    singles = [DroneEnv("explore") for _ in range(2)]
    for k, single in enumerate(singles):
        one = single.reset(seed=5 + k, options={name: value[k] for name, value in given.items()})[0]["local_map"]
        np.testing.assert_array_equal(many[k], one)
    gained = np.zeros(2)
    for action in actions(60, 2):
        observed, rewards, *_, infos = envs.step(action)
        for k, single in enumerate(singles):
            one, reward, *_, info = single.step(action[k])
            np.testing.assert_array_equal(observed["local_map"][k], one["local_map"])
            assert rewards[k] == pytest.approx(reward, abs=1e-9)
            assert infos["known_m3"][k] == info["known_m3"]
        gained += infos["reward_terms"]["seen"]
    assert np.all(gained > 0.5)


def test_the_seed_determines_the_bytes_and_a_saved_state_continues() -> None:
    envs, other = DroneVectorEnv(3, "explore", flat=True), DroneVectorEnv(3, "explore", flat=True)
    moves = actions(24, 3)
    runs = [[each.reset(seed=3), *(each.step(action) for action in moves[:12])] for each in (envs, other)]
    assert data_equivalence(runs[0], runs[1], exact=True)
    saved, first = envs.save_state(), [envs.step(action) for action in moves[12:]]
    envs.restore_state(saved)
    assert data_equivalence(first, [envs.step(action) for action in moves[12:]], exact=True)


def test_the_reward_is_the_volume_that_the_info_gains() -> None:
    env = DroneEnv("explore", world="room")
    _, info = env.reset(seed=1)
    begun, total = info["known_m3"], 0.0
    assert begun > 5.0
    for action in actions(40, 1)[:, 0]:
        *_, info = env.step(action)
        total += info["reward_terms"]["seen"]
    assert total == pytest.approx(0.2 * (info["known_m3"] - begun)) and total > 0.5


def test_a_collision_ends_an_exploration() -> None:
    """From the middle of the room, full speed ahead leads into a wall within four seconds."""
    env = gymnasium.make("dronevio/Explore-v0", world="room")
    env.reset(seed=0, options={"position_m": np.array([0.0, 0.0, 2.6]), "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])})
    ended = False
    for _ in range(200):
        *_, reward, ended, _, info = env.step(np.array([1.0, 0.0, 0.0, 0.0], np.float32))
        if ended:
            break
    assert ended and info["termination"].text == "collision" and not info["success"]
    assert info["reward_terms"]["failure"] == -10.0 and float(reward) < -9.0


def test_maps_need_their_conditions() -> None:
    rig = replace(euroc_rig(), cameras=())
    with pytest.raises(ConfigError, match="rig without cameras"):
        DroneEnv("explore", rig=rig)
    with pytest.raises(ConfigError, match=r"mapping\.rate_hz = 3 with action_rate_hz = 50"):
        DroneEnv("explore", mapping=MapSettings(rate_hz=3.0))
    DroneEnv("hover", mapping=MapSettings(rate_hz=3.0))  # without a map
    with pytest.raises(ConfigError, match="a map of true poses with an estimator"):
        DroneEnv("vio-hover", estimator=lambda rig: None, observations=("local_map",))


def test_any_task_can_observe_a_local_map() -> None:
    env = DroneEnv(Explore(volume_m3=0.0), world="room", mapping=MapSettings(side=16, layers=1))
    assert env.reset(seed=0)[0]["local_map"].shape == (1, 16, 16)
    hover = DroneEnv("hover", observations=("local_map", "position"))
    assert set(np.unique(hover.reset(seed=0)[0]["local_map"])) == {-1.0, 0.0, 1.0}
