"""Worlds that vary from episode to episode, in single environments and vectors."""

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dronevio.envs import BeamSettings, DroneEnv, DroneVectorEnv, Explore, Hover, Navigate, Race, Randomization
from dronevio.models.errors import ConfigError
from dronevio.sim.envs.tasks import AnyTask
from dronevio.sim.envs.worlds import WorldPool
from dronevio.sim.world import flight_area, solid_space

SEEDS = (3, 1, 2)
VARIED = Randomization(world_seeds=SEEDS)
SEEN = ("position", "rotation", "body_velocity", "goals", "ranges")


def flown(envs: DroneVectorEnv, actions: np.ndarray) -> list[np.ndarray]:
    """Return the observations of some steps."""
    return [envs.step(action)[0] for action in actions]


def test_an_episode_is_in_one_of_the_worlds_and_starts_in_its_free_space() -> None:
    env, seeds = DroneEnv("navigate", observations=SEEN, randomization=VARIED, world="room"), set()
    for seed in range(12):
        _, info = env.reset(seed=seed)
        drawn = int(info["randomization"]["world_seed"])
        seeds.add(drawn)
        shown, T_world_vehicle, (goal,) = env._core.shown(0)
        assert shown == drawn
        space = flight_area("room", drawn).space
        assert space.clearance(goal[None])[0] >= 0.6
        start = T_world_vehicle[None, :3, 3]  # deviates by 0.1 m along each axis
        assert space.clearance(start)[0] > 0.6 - 0.1 * np.sqrt(3.0)
    assert seeds == set(SEEDS)


def turned(yaw_deg: float) -> list[float]:
    """Return the quaternion of a heading."""
    half = np.radians(0.5 * yaw_deg)
    return [float(np.cos(half)), 0.0, 0.0, float(np.sin(half))]


def test_a_row_of_a_vector_is_in_the_world_of_its_seed() -> None:
    """A vehicle that glides towards furniture hits what it hits in an environment of that world alone."""
    arguments: dict[str, Any] = {"task": Navigate(world="room"), "observations": SEEN, "action": "rates", "flat": True}
    varied = DroneVectorEnv(3, **arguments, randomization=VARIED)
    options: dict[str, Any] = {
        "position_m": [0.0, 0.0, 0.5],
        "quat_wxyz": turned(135.0),
        "velocity_m_s": [-2.8, 2.8, 0.0],
    }
    options |= {"rate_rad_s": [0.0, 0.0, 0.0], "goal_m": [1.0, 2.0, 1.0]}
    varied.reset(seed=0, options={**options, "randomization": {"world_seed": np.array([1, 2, 3])}})
    alone = [DroneVectorEnv(1, **arguments, world_seed=seed) for seed in (1, 2, 3)]
    for envs in alone:
        envs.reset(seed=0, options=options)
    ends = []
    for _ in range(50):
        for envs in (varied, *alone):
            envs._core.step(np.zeros((envs.num_envs, 4)))  # episodes go on
        now = varied._core.plant.now
        ends.append(now.touched)
        for row, envs in enumerate(alone):
            assert envs._core.plant.now.touched[0] == now.touched[row]
            np.testing.assert_allclose(envs._core.plant.now.motion[:, 0], now.motion[:, row], atol=1e-9)
    hits = np.sum(ends, axis=0)
    assert hits.max() > 0 and len(set(hits.tolist())) > 1  # the worlds differ


def test_beams_see_the_world_of_the_episode() -> None:
    beam = BeamSettings(beams=(1, 1), sigma_m=0.0, relative_sigma=0.0, lost=0.0, reach_m=30.0)
    envs = DroneVectorEnv(3, "navigate", world="room", observations=("ranges",), beams=beam, randomization=VARIED)
    options = {"position_m": [0.0, 0.0, 0.5], "quat_wxyz": turned(90.0)}
    ranges = envs.reset(seed=0, options={**options, "randomization": {"world_seed": np.array([1, 2, 3])}})[0]["ranges"]
    along = np.linspace(0.0, 6.0, 12001)
    points = along[:, None] * [0.0, 1.0, 0.0] + [0.0, 0.0, 0.5]
    for seen, seed in zip(ranges.ravel(), (1, 2, 3), strict=True):
        first = np.argmax(solid_space("room", seed).clearance(points) <= 1e-3)
        assert seen == pytest.approx(along[first], abs=0.005)
    assert len(set(ranges.ravel().tolist())) == 3


def test_images_and_maps_show_the_world_of_the_episode() -> None:
    seen_names, both = ("depth", "local_map"), Randomization(world_seeds=(1, 2))
    varied = DroneVectorEnv(2, "explore", randomization=both, observations=seen_names)
    options = {"position_m": [-8.9, 0.0, 0.5], "quat_wxyz": turned(0.0)}
    seen, _ = varied.reset(seed=0, options={**options, "randomization": {"world_seed": np.array([1, 2])}})
    for row, seed in enumerate((1, 2)):
        alone = DroneEnv("explore", world_seed=seed, observations=seen_names)
        expected, info = alone.reset(seed=0, options=options)
        np.testing.assert_allclose(seen["depth"][row], expected["depth"], atol=1e-5)
        np.testing.assert_array_equal(seen["local_map"][row], expected["local_map"])
        assert info["known_m3"] == varied._core._maps.known_m3[row]  # type: ignore[union-attr]
        alone.close()
    assert np.abs(seen["depth"][0] - seen["depth"][1]).max() > 0.2
    varied.close()


@pytest.mark.parametrize(
    "task", [Hover(), Navigate(world="room"), Explore(), Race()], ids=lambda task: type(task).__name__
)
def test_all_tasks_have_worlds_that_vary(task: AnyTask) -> None:
    arguments: dict[str, Any] = {
        "task": task,
        "randomization": VARIED,
        "flat": True,
        "observations": ("position", "goals"),
    }
    envs = DroneVectorEnv(5, autoreset_mode="SAME_STEP", **arguments)
    first, info = envs.reset(seed=4)
    drawn = info["randomization"]["world_seed"]
    assert set(drawn.tolist()) <= set(SEEDS)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 5, 4)).astype(np.float32)
    seen = flown(envs, actions)
    saved = envs.save_state()
    later = flown(envs, actions)
    envs.restore_state(saved)
    np.testing.assert_array_equal(flown(envs, actions), later)
    again, _ = envs.reset(seed=4)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(flown(envs, actions), seen)


def test_the_checker_passes_and_pictures_are_of_the_world() -> None:
    env = DroneEnv(
        "navigate", world="room", observations=("position", "ranges"), randomization=VARIED, render_mode="rgb_array"
    )
    check_env(env, skip_render_check=True)
    pictures = []
    for seed in (1, 2):
        options = {"position_m": [0.0, 0, 1.5], "goal_m": [1.0, 0, 1.5], "quat_wxyz": [1.0, 0, 0, 0]}
        env.reset(seed=0, options={**options, "randomization": {"world_seed": seed}})
        pictures.append(env.render().astype(float))
    assert np.abs(pictures[0] - pictures[1]).mean() > 5.0
    env.close()


def test_worlds_are_given_by_their_seeds() -> None:
    pool = WorldPool("room", SEEDS, Navigate(world="room"))
    np.testing.assert_array_equal(pool.index(np.array([3, 1, 3])), [2, 0, 2])
    with pytest.raises(ConfigError, match="world_seed 7 of an episode; expected one of 1, 2, 3"):
        pool.index(np.array([1, 7]))
    env = DroneEnv("hover", randomization=VARIED)
    with pytest.raises(ConfigError, match="world_seed 7"):
        env.reset(seed=0, options={"randomization": {"world_seed": 7}})
