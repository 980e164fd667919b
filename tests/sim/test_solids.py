"""Solids: what collides is what is seen, planning keeps clear of it, and moving objects collide."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix, quat_wxyz_from_matrix
from dronevio.sim.physics.batch_plant import BatchPlant, PlantWorld
from dronevio.sim.physics.clearance_grid import reach_m
from dronevio.sim.physics.mover_bounds import MoverBounds
from dronevio.sim.physics.mover_table import MoverTable
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.vehicle import meeting_spec
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.world import WORLDS, collision_spec, flight_area, illumination_and_movers, solid_space


@pytest.mark.parametrize(
    ("world", "seed"),
    [
        ("room", 0),
        ("corridor", 1),
        ("office", 1),
        ("office-glass", 1),
        ("mirror", 1),
        ("gates", 0),
        ("warehouse", 2),
        ("forest", 2),
    ],
)
def test_what_collides_is_what_is_seen(world: str, seed: int, script: Callable[[str], Any]) -> None:
    (invisible, unsolid, is_open), _ = script("collision_geometry").measured(world, seed, points=40, rays=32)
    assert invisible < 0.5 and unsolid < 0.5 and is_open < 0.05


@pytest.mark.parametrize("world", ["room", "corridor", "forest", "repetitive", "gates", "office", "office-glass"])
def test_free_boxes_and_routes_are_clear_of_the_solids(world: str) -> None:
    area, solids = flight_area(world, 1), solid_space(world, 1)
    low, high = area.free_box + [[0, 0, 0.02], [0, 0, 0]]
    points = np.random.default_rng(0).uniform(low, high, (2000, 3))
    assert solids.clearance(points).min() > 0.0  # the free box is free of solids, too
    legs = np.roll(area.route, -1, axis=0) - area.route
    along = (area.route[:, None] + np.linspace(0.0, 1.0, 60)[:, None] * legs[:, None]).reshape(-1, 3)
    assert solids.clearance(along).min() >= 0.55  # as far as the keep-out boxes, but for what protrudes from them


@pytest.mark.parametrize("world", list(WORLDS))
def test_no_solid_protrudes_from_what_planned_paths_avoid(world: str) -> None:
    solids = solid_space(world, 1)
    steps = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    points = solids.centres[:, None] + (steps * solids.halves[:, None]) @ solids.rotations.transpose(0, 2, 1)
    outside_m = flight_area(world, 1).space.clearance(points).max(axis=1)
    assert outside_m.max() <= 1e-3


def in_the_lane() -> Array:
    """Return where a person of the concourse is after three seconds, at the height of the chest (3,) [m]."""
    mover = illumination_and_movers("moving", 1)[1][0]
    return np.asarray(mover.poses(np.array([3.0]))[0, :3, 3] + [0.0, 0.0, 1.2])


def test_a_person_runs_into_a_hovering_drone() -> None:
    movers, rig = illumination_and_movers("moving", 1)[1], euroc_rig()
    plant = QuadrotorPlant(rig, surroundings=collision_spec("moving", 1), movers=movers)
    speeds = np.full(4, plant.quadrotor.hover_speed_rad_s)
    plant.reset(pose_matrix(np.eye(3), in_the_lane()), rotor_speeds_rad_s=speeds)
    while plant.collision is None and plant.t_ns < 3_100_000_000:
        plant.advance(plant.t_ns + plant.interval_ns, speeds)
    assert plant.collision is not None and plant.collision.against.startswith("person_0")
    assert 2.0 < plant.collision.t_ns * 1e-9 < 3.0


def test_vehicles_of_a_batch_meet_movers_at_their_own_times() -> None:
    movers, rig = illumination_and_movers("moving", 1)[1], euroc_rig()
    batch = BatchPlant(3, rig, worlds=[PlantWorld(collision_spec("moving", 1), movers)])
    speeds = np.full((3, 4), batch.quadrotor.hover_speed_rad_s)
    states = VehicleStates.at(np.array([in_the_lane(), [0.0, 0.0, 1.5], in_the_lane()]), rotor_speed_rad_s=speeds)
    batch.reset(np.ones(3, bool), states)
    hit_s = np.full(3, np.inf)
    for interval in range(700):
        if interval == 100:
            batch.reset(np.array([False, False, True]), states)  # half a second later
        batch.advance(speeds)
        hit_s[batch.now.touched & np.isinf(hit_s)] = 0.005 * (interval + 1)
    assert 2.0 < hit_s[0] < 3.0 and np.isinf(hit_s[1])
    assert hit_s[2] == pytest.approx(hit_s[0] + 0.5, abs=0.011)


def test_tabulated_poses_are_those_of_the_movers_and_near_is_not_missed() -> None:
    movers = illumination_and_movers("moving", 1)[1]
    model = meeting_spec(RESEARCH, euroc_rig(), collision_spec("moving", 1)).compile()
    table, bounds = MoverTable(model, movers, 0.005), MoverBounds(model, movers, 0.005)
    interval = np.array([0, 1023, 1024, 70_000])  # in several blocks
    positions, quats = table.at(interval)
    data = mujoco.MjData(model)
    for row, number in enumerate(interval):
        for mover in movers:
            expected, place = mover.poses(np.array([0.005 * number]))[0], model.body(mover.body).mocapid[0]
            assert positions[row, place] == pytest.approx(expected[:3, 3])
            assert matrix_from_quat_wxyz(quats[row, place]) == pytest.approx(expected[:3, :3])
        data.mocap_pos[:], data.mocap_quat[:] = positions[row], quats[row]
        for point in np.random.default_rng(row).uniform([-7.0, -5.5, 0.5], [7.0, 5.5, 3.0], (150, 3)):
            data.qpos[:3] = point
            mujoco.mj_forward(model, data)
            touching = model.geom_bodyid[data.contact.geom].min(axis=1) > 0  # the vehicle is the first body
            assert bounds.near(interval[[row]], point[None])[0] or not touching.any()
    assert not bounds.near(interval[:1], np.array([[0.0, 0.0, 1.5]]))[0]


def test_moving_objects_do_not_leave_their_bounds() -> None:
    movers = illumination_and_movers("moving", 1)[1]
    model = meeting_spec(RESEARCH, euroc_rig(), collision_spec("moving", 1)).compile()
    bounds, data = MoverBounds(model, movers, 0.005), mujoco.MjData(model)
    for number in (0, 5, 31, 63, 64, 100, 12_345):
        for mover in movers:
            T, place = mover.poses(np.array([0.005 * number]))[0], model.body(mover.body).mocapid[0]
            data.mocap_pos[place], data.mocap_quat[place] = T[:3, 3], quat_wxyz_from_matrix(T[:3, :3])
        mujoco.mj_kinematics(model, data)
        moving = model.geom_bodyid > model.body("quadrotor").id
        R = data.geom_xmat[moving].reshape(-1, 3, 3)
        corners = data.geom_xpos[moving] + (R @ model.geom_size[moving, :, None])[..., 0]
        gaps_m = bounds.gap_m(np.full(len(corners), number), corners)
        np.testing.assert_allclose(gaps_m, -reach_m(model), atol=1e-9)  # within a box, as the ball around the vehicle


def test_a_batch_meets_a_person_when_a_single_vehicle_does() -> None:
    movers, rig = illumination_and_movers("moving", 1)[1], euroc_rig()
    world = collision_spec("moving", 1)
    one = QuadrotorPlant(rig, surroundings=world, movers=movers)
    many = BatchPlant(1, rig, worlds=[PlantWorld(world, movers)])
    speeds = np.full(4, one.quadrotor.hover_speed_rad_s)
    for _ in range(2):  # the second flight begins at an earlier time than that of the last comparison with the bounds
        one.reset(pose_matrix(np.eye(3), in_the_lane()), rotor_speeds_rad_s=speeds)
        many.reset(np.ones(1, bool), VehicleStates.at(in_the_lane()[None], rotor_speed_rad_s=speeds[0]))
        while one.collision is None and one.t_ns < 3_100_000_000:
            one.advance(one.t_ns + one.interval_ns, speeds)
            many.advance(speeds[None])
            assert bool(many.now.touched[0]) == (one.collision is not None)
        assert one.collision is not None
