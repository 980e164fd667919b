"""The planner as a policy: what it maps and commands by hand-made observations, and flights in environments."""

import json
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

import dronevio as dv
from dronevio.autonomy.observed_map import ObservedMap, pinhole_of
from dronevio.autonomy.policy import OBSERVATIONS, PlannerPolicy
from dronevio.autonomy.policy_settings import PlannerSettings
from dronevio.cli import main
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN
from dronevio.models.rig import RigCamera, euroc_rig
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.policy_evaluation import BASELINES, baseline_named
from dronevio.sim.envs.settings import settings_of

Array = np.ndarray

FORWARD = pose_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""Pose of a camera that looks along x."""
CAMERA = replace(euroc_rig().cameras[0], model=CameraModel(64, 64, 32.0, 32.0, 31.5, 31.5), T_imu_cam=FORWARD)
"""Camera of 90° without distortion."""


def observation(depth_m: Array | float, goal: Array, yaw_rad: float = 0.0) -> dict[str, Array]:
    """Return an observation at rest, of surfaces at depths (64, 64) and a goal (3,) in the frame of the vehicle."""
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), (64, 64))[..., None].copy()
    R = rotation_z(np.array([yaw_rad]))[0]
    return {"depth": depth, "goals": goal[None], "rotation": R, "body_velocity": np.zeros(3)}


def planner(camera: RigCamera = CAMERA, **settings: Any) -> PlannerPolicy:
    """Return a planner at 10 actions a second."""
    return PlannerPolicy(camera, np.eye(4), 10.0, settings=PlannerSettings(**settings))


# --- the map


def test_a_wall_is_occupied_what_is_before_it_free_and_what_is_behind_unknown() -> None:
    """From (1, 2, 0.5) m along y, a wall at y = 4.05 m."""
    seen = ObservedMap(CAMERA, np.eye(4), 0.1, 4.0)
    T = pose_matrix(rotation_z(np.array([0.5 * np.pi]))[0], np.array([1.0, 2.0, 0.5]))
    image = np.full((64, 64, 1), 2.05, np.float32)
    for _ in range(4):
        seen.add(image, T)
    ahead = np.array([[1.02, y, 0.52] for y in (2.55, 3.05, 3.85, 4.05, 4.25, 5.05, 1.55)])
    known = seen.known
    assert known is not None
    expected = [FREE, FREE, FREE, OCCUPIED, UNKNOWN, UNKNOWN, UNKNOWN]
    assert known.at(ahead).tolist() == expected
    local = seen.around(np.array([1.0, 3.0, 0.5]))
    assert local.states.shape == (80, 80, 40) and local.at(ahead).tolist() == expected
    assert not local.states[:, local.cells(np.array([0.0, 4.3, 0.0]))[1] :].any()


def test_images_that_are_held_while_the_vehicle_moves_are_recognized() -> None:
    seen, moved = ObservedMap(CAMERA, np.eye(4), 0.1, 4.0), pose_matrix(np.eye(3), np.array([0.1, 0.0, 0.0]))
    image = np.full((64, 64, 1), 2.0, np.float32)
    assert not seen.is_held(image, np.eye(4))
    seen.add(image, np.eye(4))
    assert not seen.is_held(image.copy(), np.eye(4))
    assert seen.is_held(image.copy(), moved) and not seen.is_held(image + np.float32(0.1), moved)


def test_the_pinhole_has_the_directions_of_the_lens() -> None:
    (camera,) = euroc_rig().cameras
    model = camera.model.fitted(64, 64)
    pinhole, pixels = pinhole_of(model)
    rays = pinhole.rays()[pixels.mask]
    source = np.stack([pixels.u, pixels.v], axis=-1)[pixels.mask]
    np.testing.assert_allclose(model.project(rays.astype(np.float64)), source, atol=1e-3)
    assert pixels.mask.mean() > 0.9
    middle = pixels.mask[pinhole.height // 2]
    assert middle[1:-1].all()  # all of the view along the axis


# --- actions


def test_it_flies_ahead_where_the_view_is_free() -> None:
    policy, goal = planner(), np.array([6.0, 0.0, 0.0])
    actions = [policy.action(observation(10.0, goal)) for _ in range(10)]
    assert actions[0].shape == (4,) and actions[0].dtype == np.float32
    assert policy.decisions[-1][1] == "fly"
    assert actions[-1][0] > 0.1 and np.abs(actions[-1][1:]).max() < 0.05


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5 * np.pi, 2.5])
def test_a_vehicle_that_follows_the_actions_reaches_the_goal(yaw_rad: float) -> None:
    """A point that has the commanded velocity, in free space, with any heading of the axes of the world."""
    policy = planner()
    position, yaw = rotation_z(np.array([yaw_rad]))[0] @ [-4.0, 1.0, 0.3], yaw_rad
    for step in range(80):
        R, depth_m = rotation_z(np.array([yaw]))[0], 10.0 + 0.001 * step  # images of a moving vehicle differ
        action = policy.action(observation(depth_m, -R.T @ position, yaw)).astype(np.float64)
        assert np.abs(action[:3]).max() < 0.9  # the limit is 1.5 of 2 m/s
        position, yaw = position + 0.2 * R @ action[:3], yaw + 0.2 * action[3]
        if np.linalg.norm(position) < 0.4:
            break
    assert np.linalg.norm(position) < 0.4 and 20 < step < 70


def test_it_stays_before_a_wall() -> None:
    """A wall 0.8 m ahead, across the whole view, leaves nothing to be flown through."""
    policy, goal = planner(), np.array([6.0, 0.0, 0.0])
    actions = [policy.action(observation(0.8, goal)) for _ in range(10)]
    assert max(float(action[0]) for action in actions) < 0.1


def test_it_turns_to_the_goal_before_it_flies() -> None:
    policy, goal = planner(), np.array([0.0, 6.0, 0.0])
    actions = [policy.action(observation(10.0, goal)) for _ in range(6)]
    assert policy.decisions[-1][1] == "turn"
    assert np.abs(actions[-1][:3]).max() < 0.05 and actions[-1][3] == pytest.approx(1.5 / 2.0)


def test_an_episode_does_not_depend_on_the_one_before() -> None:
    policy, goal = planner(), np.array([6.0, 0.5, 0.0])
    first = [policy.action(observation(10.0, goal)) for _ in range(8)]
    for _ in range(5):
        policy.action(observation(0.6, goal, 1.0))
    policy.reset()
    np.testing.assert_array_equal(first, [policy.action(observation(10.0, goal)) for _ in range(8)])


def test_it_takes_off_before_it_plans() -> None:
    policy = PlannerPolicy(CAMERA, np.eye(4), 10.0, takes_off=True)
    actions = [policy.action(observation(10.0, np.array([6.0, 0.0, 1.0]))) for _ in range(15)]
    assert not policy.decisions
    assert all(action[2] > 0.0 and abs(action[0]) < 1e-6 for action in actions)


# --- in environments


def test_it_needs_depth_and_velocities() -> None:
    with pytest.raises(ConfigError, match="expected 'velocity' and depth, goals, rotation, body_velocity"):
        PlannerPolicy.of(settings_of("hover"))
    with pytest.raises(ConfigError, match="action mode 'rates'"):
        PlannerPolicy.of(settings_of("navigate", action="rates"))
    with pytest.raises(ConfigError, match="straight flight"):
        baseline_named("straight", settings_of("navigate", action="rates"))
    with pytest.raises(ConfigError, match="unknown policy 'fly'; expected a file or one of planner, straight"):
        baseline_named("fly", settings_of("navigate"))
    with pytest.raises(ConfigError, match="unknown environment"):
        dv.evaluate_baseline("planner", 1, environment="dronevio/Fly-v0")


@pytest.mark.slow
def test_it_receives_the_observation_alone_and_reaches_a_goal_behind_a_tree() -> None:
    """The straight flight of this episode ends by a collision. Nothing but four observations reaches the policy."""
    with gymnasium.make("dronevio/Navigate-v0") as env:
        chosen: Any = env.unwrapped
        policy = PlannerPolicy.of(chosen.settings)
        observed, _ = env.reset(seed=1_000_001)
        ended = False
        while not ended:
            action = policy.action({name: observed[name] for name in OBSERVATIONS})
            observed, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
    assert info["success"] and info["termination"].text == "success" and info["t_ns"] < 15e9


def test_command_evaluates_baselines(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["policy", "evaluate", *BASELINES, "--episodes", "1", "--world", "low-texture", "--seed", "3", "--json"]
    assert main(command) == 0
    rows = json.loads(capsys.readouterr().out)["policies"]
    assert [row["policy"] for row in rows] == ["planner", "straight"]
    assert all(row["environment"] == "dronevio/Navigate-v0" for row in rows)
    assert rows[0]["success_rate"] == 1.0
    again = dv.evaluate_baseline("planner", 1, 3, world="low-texture")
    assert again.figures()["reward"] == rows[0]["reward"]  # the same bytes


@pytest.mark.slow
def test_it_flies_on_the_estimate() -> None:
    result = dv.evaluate_baseline("planner", 1, 100, environment="dronevio/VioNavigate-v0")
    assert result.counts() == {"success": 1}
