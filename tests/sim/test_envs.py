"""Single environments: Gymnasium's contract, reproducibility, ends of episodes, errors, and wrappers."""

import gc
import itertools
import os
import pickle
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.wrappers import FrameStackObservation, NormalizeObservation, RecordVideo

import dronevio.envs
from dronevio.models.actions import ACTION_MODES, ActionLimits
from dronevio.models.errors import ConfigError, GraphicsError
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.sim.envs.episodes.distributions import LogUniform, Normal, Uniform
from dronevio.sim.envs.episodes.randomization import MODERATE, Randomization
from dronevio.sim.envs.settings import settings_of
from dronevio.sim.envs.single import DroneEnv
from dronevio.sim.envs.tasks import TASKS, Hover
from dronevio.sim.pictures.chase_camera import CHASE_CAMERAS
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS

STATE = ("position", "rotation", "velocity", "rate")
ON_THE_TRUTH = [name for name in TASKS if not name.startswith("vio-")]
QUICK_WORLD = "low-texture"  # is painted in half a second
REST = {
    "position_m": np.array([0.0, 0.0, 1.2]),
    "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0]),
    "velocity_m_s": np.zeros(3),
    "rate_rad_s": np.zeros(3),
}


def checked(env: gymnasium.Env[Any, Any]) -> None:
    """Check that Gymnasium finds nothing; a warning is an error in these tests."""
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def env_id(name: str) -> str:
    """Return the id of the environment of a task."""
    return f"dronevio/{name.title().replace('-', '')}-v0"


def rollout(env: gymnasium.Env[Any, Any], seed: int, steps: int = 6) -> list[Any]:
    """Return the results of a reset and of a fixed sequence of actions."""
    actions = np.random.default_rng(seed).uniform(-0.1, 0.1, (steps, 4)).astype(np.float32)
    return [env.reset(seed=seed), *(env.step(action) for action in actions)]


def same(first: Any, second: Any) -> bool:
    """Return whether two results are equal to the byte."""
    return data_equivalence(first, second, exact=True)


# --- the contract


@pytest.mark.parametrize("name", ON_THE_TRUTH)
def test_check_env_reports_nothing_for_any_id(name: str) -> None:
    chosen: dict[str, Any] = {"observations": STATE, "world": "room"} if name == "navigate" else {}
    checked(gymnasium.make(env_id(name), **chosen))


@pytest.mark.parametrize("mode", ACTION_MODES)
def test_check_env_reports_nothing_for_any_mode(mode: str) -> None:
    checked(gymnasium.make("dronevio/Hover-v0", action=mode, flat=True, privileged=("parameters", "wind", "imu_bias")))


def test_environments_are_made_by_module_and_id() -> None:
    with gymnasium.make("dronevio.envs:dronevio/Hover-v0") as env:
        assert isinstance(env.unwrapped, DroneEnv)
        assert env.unwrapped.settings.episode_steps == 500


@pytest.mark.parametrize("name", TASKS)
def test_documented_time_limits_are_those_of_the_tasks(name: str) -> None:
    assert gymnasium.spec(env_id(name)).max_episode_steps is None
    doc = type(TASKS[name]).__doc__ or ""
    assert f"{settings_of(name).episode_steps} steps" in doc and env_id(name) in doc


def steps_until_truncation(env: Any, *, vector: bool = False) -> int:
    """Return the number of steps of hovering after which an episode is truncated."""
    env.reset(seed=0)
    action = np.zeros((2, 4) if vector else 4, np.float32)
    for step in range(1, 400):
        _, _, terminated, truncated, _ = env.step(action)
        assert not np.any(terminated)
        if np.any(truncated):
            return step
    raise AssertionError("no time limit")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"task": Hover(episode_s=1.0)}, 50),
        ({"task": Hover(episode_s=1.0), "action_rate_hz": 100.0}, 100),
        ({"task": Hover(episode_s=1.0), "max_episode_steps": 20}, 20),
    ],
)
def test_time_limits_follow_from_task_and_rate(arguments: dict[str, Any], expected: int) -> None:
    with gymnasium.make("dronevio/Hover-v0", action="velocity", **arguments) as env:
        assert steps_until_truncation(env) == expected
    envs = gymnasium.make_vec("dronevio/Hover-v0", num_envs=2, action="velocity", **arguments)
    assert steps_until_truncation(envs, vector=True) == expected


def test_a_saved_state_knows_its_time_limit() -> None:
    env = DroneEnv(Hover(episode_s=0.1), action="velocity")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(4, np.float32))
    other = pickle.loads(pickle.dumps(env))
    assert [other.step(np.zeros(4, np.float32))[3] for _ in range(2)] == [False, True]


def test_rigs_are_given_by_name() -> None:
    assert settings_of("hover", rig="euroc-stereo").rig.cameras[1].T_imu_cam[0, 3] != 0.0
    assert len(settings_of("hover", rig="euroc-stereo").rig.cameras) == 2
    with pytest.raises(ConfigError, match="'stereo-2'"):
        settings_of("hover", rig="stereo-2")


def test_the_module_of_the_ids_has_tasks_and_settings() -> None:
    from dronevio.envs import MODERATE, DroneVectorEnv, Randomization, Task

    assert isinstance(MODERATE, Randomization) and DroneVectorEnv is not None and Task is not None
    assert set(dir(dronevio.envs)) >= {type(task).__name__ for task in TASKS.values()}


@dataclass(frozen=True)
class Rewarded(Hover):
    """Hovering with a reward that is given."""

    reward: Any = 0.0

    def reward_terms(self, *_: Any) -> dict[str, Any]:
        """Return the given value."""
        return {} if self.reward is None else {"mine": self.reward}


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (np.array([np.nan]), "reward term 'mine' of Rewarded with the value nan; expected 1 finite numbers"),
        (np.zeros(3), r"of shape \(3,\) and type float64; expected 1"),
        (0.5, r"of shape \(\)"),
        (np.array(["a"]), "type <U1"),
        (None, "returned no term"),
    ],
)
def test_rewards_of_own_tasks_are_checked(reward: Any, message: str) -> None:
    env = DroneEnv(Rewarded(reward=reward))
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=message):
        env.step(np.zeros(4, np.float32))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rotor_speed_rad_s": np.full(4, 9e9)}, "'rotor_speed_rad_s' with 9e\\+09; expected 0 to 1000"),
        ({"rotor_speed_rad_s": np.full(4, -1.0)}, "'rotor_speed_rad_s' with -1"),
        ({"battery_charge": 1.5}, "'battery_charge' with 1.5; expected 0 to 1"),
        ({"velocity_m_s": [1e6, 0.0, 0.0]}, "'velocity_m_s'"),
        ({"rate_rad_s": [0.0, 0.0, 1e6]}, "'rate_rad_s'"),
        ({"randomization": {"latency_s": -0.1}}, "'latency_s' with -0.1; expected 0 to inf"),
        ({"randomization": {"light": -1.0}}, "'light'"),
    ],
)
def test_options_outside_of_their_limits_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DroneEnv("hover").reset(seed=0, options=options)


def test_images_and_pictures_show_the_world() -> None:
    env = DroneEnv("hover", "rgb_array", world=QUICK_WORLD, observations=("grey", "position"))
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert observation["grey"].shape == (64, 64, 1) and observation["grey"].std() > 2.0
    before: Any = env.render()
    for _ in range(5):
        env.step(np.zeros(4, np.float32))
    after: Any = env.render()
    assert before.shape == (480, 640, 3) and before.std() > 10.0
    assert not np.array_equal(before, after)
    env.close()
    env.close()


def test_the_argument_camera_selects_a_camera_of_the_rig() -> None:
    rig = rig_named("euroc-stereo")

    def depth(rig: Rig, camera: int) -> Any:
        env = DroneEnv("hover", world=QUICK_WORLD, rig=rig, observations=("depth",), camera=camera)
        image = env.reset(seed=0, options=REST)[0]["depth"]
        env.close()
        return image

    left, right = depth(rig, 0), depth(rig, 1)
    assert not np.array_equal(left, right)
    np.testing.assert_array_equal(right, depth(replace(rig, cameras=rig.cameras[1:]), 0))


def test_pictures_mark_the_goal() -> None:
    """The chase camera looks to positive x and y, and shows a green ball there."""
    env = DroneEnv("hover", "rgb_array", world=QUICK_WORLD, observations=("position",))

    def green_pixels(goal_m: tuple[float, float, float]) -> int:
        env.reset(seed=0, options={**REST, "goal_m": np.array(goal_m)})
        red, green, blue = np.moveaxis(np.asarray(env.render(), dtype=int), -1, 0)
        return int(np.count_nonzero((green > red + 60) & (green > blue + 60)))

    assert green_pixels((0.2, 0.4, 1.4)) > 200
    assert green_pixels((-1.0, -1.7, 1.2)) == 0
    env.close()


def test_images_have_a_rate_of_their_own() -> None:
    env = DroneEnv("hover", world=QUICK_WORLD, observations=("depth",), camera_rate_hz=25.0, image_size=(16, 12))
    images = [env.reset(seed=0)[0]["depth"]]
    images += [env.step(np.full(4, -1.0))[0]["depth"] for _ in range(4)]
    changes = [not np.array_equal(a, b) for a, b in itertools.pairwise(images)]
    assert changes == [False, True, False, True]
    assert images[0].shape == (12, 16, 1) and images[0].dtype == np.float32
    env.close()


# --- reproducibility


def test_seeds_determine_rollouts_to_the_byte() -> None:
    env = DroneEnv("waypoints", randomization=MODERATE, observations=(*STATE, "imu"))
    first, again, other = rollout(env, 3), rollout(env, 3), rollout(env, 4)
    assert same(first, again)
    assert not any(same(a, b) for a, b in zip(first, other, strict=True))
    assert same(first, rollout(DroneEnv("waypoints", randomization=MODERATE, observations=(*STATE, "imu")), 3))


@pytest.mark.parametrize("mode", ["rotors", "velocity"])
def test_a_pickled_environment_continues_identically(mode: str) -> None:
    env = DroneEnv("hover", action=mode, randomization=MODERATE)
    rollout(env, 0)
    other = pickle.loads(pickle.dumps(env))
    for action in np.random.default_rng(0).uniform(-0.1, 0.1, (5, 4)):
        assert same(env.step(action), other.step(action))
    assert same(env.reset(), other.reset())


def test_a_saved_state_can_be_restored() -> None:
    env, other = (DroneEnv("track", randomization=MODERATE, observations=("goals", "imu")) for _ in range(2))
    rollout(env, 0)
    saved = env.save_state()
    observation = other.restore_state(saved)
    actions = np.random.default_rng(1).uniform(-0.1, 0.1, (5, 4))
    first = [env.step(action) for action in actions]
    env.reset(seed=9)
    assert same(observation, env.restore_state(saved))  # the steps have not changed the saved state
    assert same(first, [env.step(action) for action in actions])
    assert same(first, [other.step(action) for action in actions])


def test_options_replace_drawn_values() -> None:
    env = DroneEnv("hover", randomization=MODERATE, observations=("position", "velocity"))
    given = {**REST, "goal_m": np.array([0.5, 0.0, 1.2]), "randomization": {"mass": 1.3, "latency_s": 0.05}}
    observation, info = env.reset(seed=0, options=given)
    np.testing.assert_allclose(observation["position"], [-0.5, 0.0, 0.0], atol=1e-6)
    assert info["distance_m"] == pytest.approx(0.5)
    assert (info["randomization"]["mass"], info["randomization"]["latency_s"]) == (1.3, 0.05)
    assert 0.93 <= info["randomization"]["thrust"] <= 1.07


# --- ends of episodes


@pytest.mark.parametrize(
    ("action", "options", "reason", "latest_s"),
    [
        ([-1.0, -1.0, -1.0, -1.0], {}, "ground", 0.8),
        ([-0.5, 0.5, 0.5, -0.5], {}, "flipped", 0.8),
        ([0.0, 0.0, 0.0, 0.0], {"velocity_m_s": np.array([10.0, 0.0, 0.0])}, "out of bounds", 0.5),
        ([0.0, 0.0, 0.0, 0.0], {"rate_rad_s": np.array([9.9e3, 9.9e3, 9.9e3])}, "diverged", 0.1),
    ],
)
def test_failures_end_the_episode_with_a_reason(action: Any, options: Any, reason: str, latest_s: float) -> None:
    env = DroneEnv("hover", action="rotors")
    env.reset(seed=0, options={**REST, **options})
    terminated = False
    while not terminated:
        observation, reward, terminated, truncated, info = env.step(np.array(action))
        assert observation in env.observation_space and np.isfinite(float(reward)) and not truncated
        assert info["t_ns"] <= latest_s * 1e9
    assert info["termination"].text == reason and not info["success"]


def test_obstacles_end_the_episode() -> None:
    env = DroneEnv("race", observations=STATE)
    gate = env._core.area.gates[0]
    side = np.array([-gate.ahead[1], gate.ahead[0], 0.0])
    bar = gate.middle + (0.5 * gate.opening_m + 0.1) * side
    env.reset(seed=0, options={**REST, "position_m": bar - gate.ahead, "velocity_m_s": 4.0 * gate.ahead})
    for _ in range(30):
        *_, terminated, _, info = env.step(np.zeros(4))
        if terminated:
            break
    assert terminated and info["termination"].text == "collision"


def test_success_ends_the_episode_of_navigation() -> None:
    env = DroneEnv("navigate", world="room", observations=STATE)
    env.reset(seed=0, options={**REST, "position_m": np.array([0.0, 0.0, 1.5]), "goal_m": np.array([0.0, 0.0, 2.2])})
    for _ in range(50):
        _, reward, terminated, _, info = env.step(np.array([0.0, 0.0, 0.5, 0.0]))
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        if terminated:
            break
    assert terminated and info["success"] and info["termination"].text == "success"
    assert info["distance_m"] < 0.5 and info["reward_terms"]["reached"] == 10.0


def test_time_limits_truncate() -> None:
    with gymnasium.make("dronevio/Hover-v0", action="velocity", max_episode_steps=4) as env:
        env.reset(seed=0)
        ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]


def test_the_built_in_loops_keep_hover_at_its_target() -> None:
    """The state observation and the mode velocity suffice for a proportional controller."""
    env = DroneEnv("hover", action="velocity", randomization=MODERATE)
    observation, _ = env.reset(seed=2)
    for _ in range(150):
        yaw = np.arctan2(observation["rotation"][1, 0], observation["rotation"][0, 0])
        x, y, up = (-0.7 * observation["position"]).tolist()
        ahead, left = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
        observation, _, terminated, _, info = env.step(np.array([ahead, left, up, 0.0]))
        assert not terminated
    assert info["success"] and np.linalg.norm(observation["position"]) < 0.1


# --- errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "swim"}, "unknown task 'swim'"),
        ({"action": "thrust"}, "unknown action mode 'thrust'; expected one of rotors, rates, attitude, velocity"),
        ({"observations": ("colour",)}, "unknown observation 'colour'"),
        ({"observations": "imu"}, r"expected a tuple of names, such as \('imu',\)"),
        ({"observations": ("imu", "imu")}, "each name once"),
        ({"observations": ("gates",)}, "task without gates"),
        ({"observations": ("grey",), "flat": True}, "flat observations with 'grey'; expected no images"),
        ({"world": "moon"}, "unknown world 'moon'"),
        ({"vehicle": "plane"}, "unknown vehicle 'plane'"),
        ({"colour": 3}, "unknown argument 'colour'"),
        ({"render_mode": "ansi"}, "render mode 'ansi'; expected None or 'human' or 'rgb_array'"),
        ({"action_rate_hz": 60.0}, "action_rate_hz = 60 with imu_rate_hz = 200"),
        ({"camera_rate_hz": 20.0}, "camera_rate_hz = 20 with action_rate_hz = 50"),
        ({"physics_rate_hz": 500.0}, "imu_rate_hz = 200 with physics_rate_hz = 500"),
        ({"image_size": (0, 64)}, "expected 2 whole numbers, each 1 to 4096"),
        ({"camera": 1}, "camera = 1 of a rig with 1 cameras; expected an index from 0"),
    ],
)
def test_impossible_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DroneEnv(**arguments)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Uniform(2.0, 1.0),
        lambda: Uniform(0.0, np.inf),
        lambda: LogUniform(0.0, 1.0),
        lambda: Normal(0.0, -1.0),
        lambda: Randomization(mass=1.1),  # type: ignore[arg-type]
        lambda: ActionLimits(tilt_rad=0.0),
    ],
)
def test_impossible_distributions_and_limits_are_refused(make: Callable[[], Any]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"place": 3}, "unknown option 'place' of a reset"),
        ({"position_m": np.zeros(2)}, r"of shape \(2,\); expected \(3,\)"),
        ({"position_m": np.full(3, np.nan)}, "expected finite numbers"),
        ({"quat_wxyz": np.zeros(4)}, "not a unit quaternion"),
        ({"randomization": {"size": 1.0}}, "unknown randomization 'size'"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DroneEnv("hover").reset(options=options)


def test_impossible_actions_are_refused() -> None:
    env = DroneEnv("hover")
    with pytest.raises(ConfigError, match=r"expected reset\(\) first"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    for action, message in ((np.array([0.0, np.nan, 0.0, 0.0]), "4 finite numbers"), (np.zeros(3), r"shape \(3,\)")):
        with pytest.raises(ConfigError, match=message):
            env.step(action)


def test_human_rendering_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(GraphicsError, match="display"):
        gymnasium.make("dronevio/Hover-v0", render_mode="human")  # and not by Gymnasium's wrapper, which uses SDL
    env = gymnasium.make("dronevio/Hover-v0", world=QUICK_WORLD, observations=("grey",))
    assert env.metadata["render_modes"] == ["rgb_array"]
    check_env(env.unwrapped)  # tries all render modes; the failure leaves later environments usable
    env.close()


# --- wrappers, and resources


def test_wrappers_of_gymnasium_work(tmp_path: Path) -> None:
    env = FrameStackObservation(NormalizeObservation(gymnasium.make("dronevio/Hover-v0", flat=True)), 3)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (3, 18)
    assert np.isfinite(env.step(env.action_space.sample())[0]).all()
    pytest.importorskip("moviepy")
    filmed: Any = RecordVideo(DroneEnv("hover", "rgb_array", world=QUICK_WORLD), str(tmp_path / "video"))
    filmed.reset(seed=0)
    filmed.step(filmed.action_space.sample())
    filmed.close()
    assert list(tmp_path.glob("video/*.mp4"))


@pytest.mark.skipif(sys.platform != "linux", reason="reads memory and files as Linux lists them")
def test_resets_do_not_leak() -> None:
    env = DroneEnv("hover", randomization=MODERATE)

    def used() -> tuple[int, int]:
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE"), len(list(Path("/proc/self/fd").iterdir()))

    for _ in range(50):
        env.reset()
    memory, files = used()
    for _ in range(200):
        env.reset()
    more_memory, more_files = used()
    assert more_memory - memory < 4e6
    assert more_files <= files


@pytest.mark.skipif(sys.platform != "linux", reason="counts the open files as Linux lists them")
def test_environments_with_cameras_leak_nothing() -> None:
    def lived() -> tuple[int, int]:
        env = DroneEnv("hover", "rgb_array", world=QUICK_WORLD, observations=("grey",))
        env.reset(seed=0)
        env.render()
        env.close()
        return len(LOADED_WORLDS) + len(CHASE_CAMERAS), len(list(Path("/proc/self/fd").iterdir()))

    lived()
    counts = {lived() for _ in range(20)}
    assert len(counts) == 1


def test_the_documented_target_is_the_target() -> None:
    assert Hover().height_m == 1.2
    assert "1.2 m above the landing pad" in (Hover.__doc__ or "")


def test_stereo_images_are_those_of_both_cameras() -> None:
    settings: dict[str, Any] = {"rig": "euroc-stereo", "world": QUICK_WORLD, "image_size": (32, 24)}
    stereo = DroneEnv("hover", observations=("grey:0", "depth:1", "grey:1", "grey"), **settings)
    seen, _ = stereo.reset(seed=0)
    assert seen["grey:0"].shape == (24, 32, 1) and list(stereo.observation_shapes) == list(seen)
    for camera in (0, 1):
        single = DroneEnv("hover", observations=("grey", "depth"), camera=camera, **settings)
        alone, _ = single.reset(seed=0)
        np.testing.assert_array_equal(seen[f"grey:{camera}"], alone["grey"])
        single.close()
    np.testing.assert_array_equal(seen["depth:1"], alone["depth"])
    np.testing.assert_array_equal(seen["grey"], seen["grey:0"])
    assert not np.array_equal(seen["grey:0"], seen["grey:1"])
    stereo.step(np.zeros(4, np.float32))
    stereo.close()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("grey:2", "'grey:2' of a rig with 2 cameras; expected an index from 0"),
        ("grey:", "unknown observation 'grey:'"),
        ("grey:-1", "unknown observation 'grey:-1'"),
        ("rate:1", "unknown observation 'rate:1'"),
    ],
)
def test_images_of_unknown_cameras_are_refused(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DroneEnv("hover", observations=(name,), rig="euroc-stereo")
