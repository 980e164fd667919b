"""Clearances by which contacts are left out: what may touch is simulated with contacts, and the motion is the same."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.physics.batch_plant import BatchPlant, PlantWorld
from dronevio.sim.physics.clearance_grid import ClearanceGrid, ClearanceGrids, reach_m
from dronevio.sim.physics.collisions import COLLISION_GROUP
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.vehicle import physics_model
from dronevio.sim.physics.vehicle_states import VehicleParameters, VehicleStates
from dronevio.sim.world import collision_spec, solid_space

RIG, INTERVAL_S = euroc_rig(), 0.005
SLACK_M = 0.05


def clear(grid: ClearanceGrid, points: Array, velocity: Array) -> Mask:
    """Return what is clear in one world."""
    return ClearanceGrids([grid]).clear(points, velocity, np.zeros(points.shape[1], dtype=np.intp))


@pytest.mark.parametrize("world", ["room", "gates"])
def test_what_is_clear_of_a_world_is_farther_than_the_reach_of_the_vehicle(world: str) -> None:
    model, solids = physics_model(RESEARCH, RIG, 1e-3, collision_spec(world, 1)), solid_space(world, 1)
    if world == "gates":  # outdoors
        solids = replace(solids, low=np.array([-np.inf, -np.inf, 0.0]), high=np.full(3, np.inf))
    grid, reach = ClearanceGrid(model, INTERVAL_S), reach_m(model)
    points = np.random.default_rng(0).uniform([-5.0, -4.0, -0.5], [5.0, 4.0, 4.0], (2000, 3))
    clearance, free = solids.clearance(points), clear(grid, points.T, np.zeros((3, len(points))))
    assert clearance[free].min() > reach + SLACK_M - 1e-6
    assert free[clearance > reach + SLACK_M + 0.2 * np.sqrt(3.0)].all()  # the middle of a cell is that much nearer
    assert 0.2 < free.mean() < 0.8
    assert [grid.clears(point, np.zeros(3)) for point in points[:300]] == free[:300].tolist()


def test_a_vehicle_in_contact_is_never_clear() -> None:
    model = physics_model(RESEARCH, RIG, 1e-3, collision_spec("room", 1))
    grid, data, rng = ClearanceGrid(model, INTERVAL_S), mujoco.MjData(model), np.random.default_rng(1)
    space, touching = solid_space("room", 1), 0
    for point in rng.uniform(space.low, space.high, (1500, 3)):
        data.qpos[:3], data.qpos[3:] = point, rng.standard_normal(4)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        touching += data.ncon > 0
        assert not (data.ncon and grid.clears(point, np.zeros(3)))
    assert touching > 300


def wall(rotation: Array, half_m: float = 0.1) -> mujoco.MjSpec:
    """Return a wall at x = 2, whose box is turned about x."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], group=COLLISION_GROUP)
    spec.worldbody.add_geom(
        name="wall",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half_m, 3.0, 3.0],
        pos=[2.0 + half_m, 0.0, 0.0],
        xyaxes=rotation[:, :2].T.ravel(),
        group=COLLISION_GROUP,
    )
    return spec


def test_fast_vehicles_are_clear_only_far_from_a_wall() -> None:
    model = physics_model(RESEARCH, RIG, 1e-3, wall(exp_so3(np.array([0.4, 0.0, 0.0]))))
    grid, reach = ClearanceGrid(model, INTERVAL_S), reach_m(model)
    ahead_m = np.linspace(0.0, 1.5, 76)
    points = np.stack([2.0 - reach - ahead_m, 0.3 * np.ones(76), np.ones(76)])
    for speed_m_s in (0.0, 10.0, 40.0):
        free = clear(grid, points, np.tile([[speed_m_s], [0.0], [0.0]], 76))
        assert not free[ahead_m < SLACK_M + speed_m_s * INTERVAL_S].any()
        assert free[ahead_m > 0.4 + 2.0 * speed_m_s * INTERVAL_S].all()
        assert [grid.clears(point, np.array([speed_m_s, 0.0, 0.0])) for point in points.T] == free.tolist()


def test_only_planes_and_far_away_places_are_clear_without_a_cell() -> None:
    standing = physics_model(RESEARCH, RIG, 1e-3)
    for model in (standing, physics_model(RESEARCH, RIG, 1e-3, wall(np.eye(3)))):
        heights = np.array([[-50.0] * 3, [-50.0] * 3, [0.3, 0.5, 50.0]])
        assert clear(ClearanceGrid(model, INTERVAL_S), heights, np.zeros((3, 3))).tolist() == [False, True, True]
        solids = ClearanceGrid(model, INTERVAL_S, with_planes=False)
        assert clear(solids, heights, np.zeros((3, 3))).all()
    assert not clear(ClearanceGrid(standing, INTERVAL_S), np.full((3, 1), np.nan), np.zeros((3, 1))).any()


def test_grids_of_several_worlds_are_those_of_each() -> None:
    models = [physics_model(RESEARCH, RIG, 1e-3, collision_spec("room", seed)) for seed in (1, 2)]
    models.insert(1, physics_model(RESEARCH, RIG, 1e-3))
    points, velocity = (
        np.random.default_rng(0).uniform([-5.0, -4.0, -0.5], [5.0, 4.0, 4.0], (600, 3)).T,
        np.ones((3, 600)),
    )
    world = np.random.default_rng(1).integers(0, 3, 600)
    together = ClearanceGrids([ClearanceGrid(model, INTERVAL_S) for model in models]).clear(points, velocity, world)
    for number, model in enumerate(models):
        rows = world == number
        alone = clear(ClearanceGrid(model, INTERVAL_S), points[:, rows], velocity[:, rows])
        np.testing.assert_array_equal(together[rows], alone)
    assert 0.2 < together.mean() < 0.9


def test_contacts_that_are_left_out_do_not_change_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    def flown() -> tuple[Array, Array, Mask]:
        world = collision_spec("room", 1)
        one, many = QuadrotorPlant(RIG, surroundings=world), BatchPlant(6, RIG, worlds=[PlantWorld(world)], nthread=1)
        speeds = np.full(4, one.quadrotor.hover_speed_rad_s)
        velocity = np.random.default_rng(0).uniform(-8.0, 8.0, (6, 3))
        start = np.array([0.0, 0.0, 1.6])
        one.reset(pose_matrix(np.eye(3), start), velocity[0], rotor_speeds_rad_s=speeds)
        one.advance(200 * one.interval_ns, speeds)  # into furniture
        many.reset(np.ones(6, dtype=bool), VehicleStates.at(np.tile(start, (6, 1)), None, velocity, 0.0, speeds[0]))
        for _ in range(200):
            many.advance(np.tile(speeds, (6, 1)))
        assert one.collision is not None
        return one.motion().pose, many.now.motion, many.now.touched

    left_out = flown()
    monkeypatch.setattr(ClearanceGrid, "clears", lambda *_: False)
    monkeypatch.setattr(ClearanceGrids, "clear", lambda _, position, *__: np.zeros(position.shape[1], dtype=bool))
    (pose, motion, touched), (pose_without, motion_without, touched_without) = flown(), left_out
    np.testing.assert_array_equal(pose, pose_without)
    np.testing.assert_array_equal(touched, touched_without)
    assert 0 < touched.sum() < 6
    flying = ~touched  # by MuJoCo, or in free flight, whose errors are smaller
    np.testing.assert_allclose(motion[:, flying], motion_without[:, flying], atol=1e-4)


def test_vehicles_near_a_wall_have_their_own_masses_and_diverge_once() -> None:
    plant = BatchPlant(4, RIG, worlds=[PlantWorld(wall(np.eye(3)))], nthread=1)
    parameters = VehicleParameters.of(RESEARCH, 4)
    parameters = replace(parameters, mass_kg=parameters.mass_kg * [1.0, 1.3, 1.0, 1.3])
    places = np.array([[1.6, 0.0, 2.0], [1.6, 0.0, 2.0], [-20.0, 0.0, 2.0], [-20.0, 0.0, 2.0]])
    hover = RESEARCH.hover_speed_rad_s
    plant.reset(np.ones(4, dtype=bool), VehicleStates.at(places, rotor_speed_rad_s=hover), parameters)
    for _ in range(20):
        plant.advance(np.full((4, 4), hover))
    falling = plant.states.velocity_m_s[:, 2]
    np.testing.assert_allclose(falling[:2], falling[2:], atol=1e-12)  # near the wall and far from it
    assert falling[1] < falling[0] - 0.1 and not plant.now.touched.any()


def test_vehicles_near_solids_do_not_depend_on_how_many_there_are() -> None:
    """Forty vehicles glide to a wall, more than are simulated in one call; each moves as it does in another order."""
    rng, motions = np.random.default_rng(0), []
    places = np.column_stack([rng.uniform(1.2, 1.65, 40), rng.uniform(-2.0, 2.0, 40), rng.uniform(1.0, 2.5, 40)])
    velocity = rng.uniform([0.0, -1.0, -1.0], [2.0, 1.0, 1.0], (40, 3))
    hover = RESEARCH.hover_speed_rad_s
    for order in (np.arange(40), rng.permutation(40)):
        plant = BatchPlant(40, RIG, worlds=[PlantWorld(wall(np.eye(3)))], nthread=1)
        states = VehicleStates.at(places[order], None, velocity[order], rotor_speed_rad_s=hover)
        plant.reset(np.ones(40, dtype=bool), states)
        for _ in range(60):
            plant.advance(np.full((40, 4), hover))
        motions.append((plant.now.motion[:, np.argsort(order)], plant.now.touched[np.argsort(order)]))
    assert 5 < motions[0][1].sum() < 40
    np.testing.assert_array_equal(motions[0][1], motions[1][1])
    np.testing.assert_allclose(motions[0][0], motions[1][0], atol=1e-9)
