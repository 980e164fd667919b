import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

import dronevio.envs  # noqa: F401 registers
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, GraphicsError
from dronevio.models.rig import EUROC_CAM0, euroc_rig
from dronevio.sim.chase_camera import CHASE_CAMERAS
from dronevio.sim.envs.hover import TARGET_M, Hover
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS

ID = "dronevio/Hover-v0"


@pytest.fixture(params=[{}, {"camera": True}], ids=["state", "camera"])
def hover(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    env = gymnasium.make(ID, render_mode="rgb_array", **request.param)
    yield env
    env.close()


def rollout(env: gymnasium.Env[Any, Any], seed: int, steps: int) -> list[bytes]:
    """Return the observations and rewards of a fixed sequence of actions as bytes."""
    actions = np.random.default_rng(seed).uniform(-0.1, 0.1, (steps, 4)).astype(np.float32)
    observation, _ = env.reset(seed=seed)
    outputs = [b"".join(v.tobytes() for v in observation.values())]
    for action in actions:
        observation, reward, *_ = env.step(action)
        outputs.append(b"".join(v.tobytes() for v in observation.values()) + np.float64(reward).tobytes())
    return outputs


def test_check_env_reports_nothing(hover: gymnasium.Env[Any, Any]) -> None:
    check_env(hover.unwrapped)  # a warning is an error in these tests


def test_rollouts_repeat_to_the_byte(hover: gymnasium.Env[Any, Any]) -> None:
    first, again, other = rollout(hover, 3, 10), rollout(hover, 3, 10), rollout(hover, 4, 10)
    assert first == again
    assert all(a != b for a, b in zip(first, other, strict=True))


def test_environments_are_independent(hover: gymnasium.Env[Any, Any]) -> None:
    expected = rollout(hover, 3, 6)
    other = gymnasium.make(ID, render_mode="rgb_array", camera=True, world_seed=0)
    observation, _ = hover.reset(seed=3)
    outputs = [b"".join(v.tobytes() for v in observation.values())]
    other.reset(seed=9)
    for action in np.random.default_rng(3).uniform(-0.1, 0.1, (6, 4)).astype(np.float32):
        other.step(-action)
        other.render()
        observation, reward, *_ = hover.step(action)
        outputs.append(b"".join(v.tobytes() for v in observation.values()) + np.float64(reward).tobytes())
    other.close()
    observation, *_ = hover.step(np.zeros(4, np.float32))  # closing one environment does not close the other
    assert outputs == expected
    assert observation in hover.observation_space


def test_rendered_images_show_the_motion(hover: gymnasium.Env[Any, Any]) -> None:
    hover.reset(seed=0)
    before: Any = hover.render()
    for _ in range(5):
        hover.step(np.zeros(4, np.float32))
    after: Any = hover.render()
    assert before.shape == after.shape == (480, 640, 3)
    assert before.std() > 20.0
    assert not np.array_equal(before, after)


def test_the_camera_sees_the_room() -> None:
    with gymnasium.make(ID, camera=True) as env:
        observation, _ = env.reset(seed=0)
        assert observation["image"].shape == (120, 188, 1)
        assert observation["image"].std() > 15.0


def test_environment_can_be_made_by_module_and_id() -> None:
    with gymnasium.make("dronevio.envs:dronevio/Hover-v0") as env:
        assert isinstance(env.unwrapped, Hover)


def test_zero_action_is_hover_thrust() -> None:
    env = Hover()
    observation, _ = env.reset(seed=1)
    start = observation["position"].copy()
    velocity = observation["velocity"].copy()
    for _ in range(5):
        observation, *_ = env.step(np.zeros(4, np.float32))
    np.testing.assert_allclose(observation["position"], start + 0.1 * velocity, atol=0.02)
    space: object = env.observation_space
    assert isinstance(space, spaces.Dict) and isinstance(space["rotors"], spaces.Box)
    np.testing.assert_allclose(observation["rotors"], space["rotors"].high * 0.656, atol=1e-3)


@pytest.mark.parametrize(("action", "share"), [(-1.0, 0.0), (1.0, 1.0)])
def test_full_and_no_throttle(action: float, share: float) -> None:
    env = Hover()
    env.reset(seed=0)
    for _ in range(15):
        observation, *_ = env.step(np.full(4, action, np.float32))
    np.testing.assert_allclose(observation["rotors"], share, atol=0.02)  # the battery sags under full load


def test_imu_reports_every_sample_since_the_last_action() -> None:
    env = Hover()
    first, _ = env.reset(seed=0)
    assert np.ptp(first["imu"], axis=0).max() == 0.0
    second, *_ = env.step(np.zeros(4, np.float32))
    assert second["imu"].shape == (4, 6)
    assert np.all(np.ptp(second["imu"], axis=0) > 0.0)
    assert np.linalg.norm(second["imu"][-1, 3:]) == pytest.approx(9.81, abs=1.5)


def test_a_fall_ends_the_episode() -> None:
    env = Hover()
    env.reset(seed=0)
    for _ in range(60):
        observation, reward, terminated, truncated, info = env.step(np.full(4, -1.0, np.float32))
        if terminated:
            break
    assert terminated and not truncated
    assert 0.3 < info["t_ns"] * 1e-9 < 1.0  # 1.2 m take half a second
    assert info["distance_m"] == pytest.approx(np.linalg.norm(observation["position"]), rel=1e-5)
    assert 0.0 <= float(reward) < 0.2


def test_an_inverted_drone_ends_the_episode() -> None:
    env = Hover()
    env.reset(seed=0)
    for _ in range(60):
        observation, _, terminated, _, _ = env.step(np.array([-0.5, 0.5, 0.5, -0.5], np.float32))
        if terminated:
            break
    _, x, y, _ = observation["orientation"]
    assert terminated
    assert 1.0 - 2.0 * (x**2 + y**2) < 0.0  # the vehicle's z axis points down
    assert np.linalg.norm(observation["position"]) < 1.0


def test_rewards_are_best_at_the_target() -> None:
    env = Hover()
    rewards, distances = [], []
    for seed in range(30):
        env.reset(seed=seed)
        _, reward, _, _, info = env.step(np.zeros(4, np.float32))
        rewards.append(float(reward))
        distances.append(info["distance_m"])
    assert min(rewards) > 0.0 and max(rewards) < 1.0
    assert np.corrcoef(rewards, distances)[0, 1] < -0.8


def test_a_simple_controller_survives_until_the_time_limit() -> None:
    """The state observation suffices for a PD controller to hover."""
    env = gymnasium.make(ID)
    observation, _ = env.reset(seed=2)
    mix = np.array([[1, -1, -1, -1], [1, 1, 1, -1], [1, 1, -1, 1], [1, -1, 1, 1]], dtype=np.float64)
    T_vehicle_imu = euroc_rig().T_vehicle_imu[:3, :3]
    total, steps, truncated = 0.0, 0, False
    while not truncated:
        w, x, y, z = observation["orientation"].astype(float)
        rate = T_vehicle_imu @ observation["imu"][-1, :3]
        wanted = -1.0 * observation["position"] - 1.2 * observation["velocity"]
        yaw = 2.0 * np.arctan2(z, w)
        ahead, left = (
            wanted[0] * np.cos(yaw) + wanted[1] * np.sin(yaw),
            wanted[1] * np.cos(yaw) - wanted[0] * np.sin(yaw),
        )
        tilt = np.clip([-left / 9.81, ahead / 9.81], -0.3, 0.3) - 2.0 * np.array([x, y]) * np.sign(w)
        torque = np.array([*(0.4 * tilt - 0.08 * rate[:2]), -0.2 * yaw - 0.2 * rate[2]])
        action = np.clip(mix @ [0.1 * wanted[2], *torque], -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert not terminated
        total, steps = total + float(reward), steps + 1
    assert steps == 500
    assert total > 350.0
    assert np.linalg.norm(observation["position"]) < 0.2


def test_vector_environment_has_independent_states() -> None:
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync")
    observation, _ = envs.reset(seed=0)
    assert observation["position"].shape == (2, 3)
    assert not np.array_equal(observation["position"][0], observation["position"][1])
    envs.close()


@pytest.mark.parametrize("action", [np.full(4, np.nan), np.zeros(3)])
def test_invalid_actions_are_refused(action: np.ndarray) -> None:
    env = Hover()
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="four finite numbers"):
        env.step(action)


def test_unknown_render_modes_are_refused() -> None:
    with pytest.raises(ConfigError, match="'human'"):
        Hover(render_mode="ansi")


@pytest.mark.skipif(sys.platform != "linux", reason="displays are Linux's")
def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(GraphicsError, match="no display"):
        gymnasium.make(ID, render_mode="human")
    with gymnasium.make(ID, render_mode="rgb_array", camera=True) as env:  # rendering still works
        assert env.reset(seed=0)[0]["image"].std() > 15.0


@pytest.mark.skipif(sys.platform != "linux", reason="counts the open files as Linux lists them")
def test_environments_with_cameras_leak_nothing() -> None:
    def lived() -> tuple[int, int]:
        with gymnasium.make(ID, render_mode="rgb_array", camera=True) as env:
            env.reset(seed=0)
            env.render()
        return len(LOADED_WORLDS) + len(CHASE_CAMERAS), len(list(Path("/proc/self/fd").iterdir()))

    lived()
    counts = {lived() for _ in range(20)}
    assert len(counts) == 1


def test_environment_can_be_closed_twice() -> None:
    env = Hover(render_mode="rgb_array", camera=True)
    env.reset(seed=0)
    env.render()
    env.close()
    env.close()


def test_scaled_camera_has_the_same_field_of_view() -> None:
    small: CameraModel = EUROC_CAM0.resized(188, 120)
    assert (small.width, small.height) == (188, 120)
    corners = np.array([[-0.5, -0.5], [751.5, 479.5]])
    small_corners = np.array([[-0.5, -0.5], [187.5, 119.5]])
    np.testing.assert_allclose(small.normalize(small_corners), EUROC_CAM0.normalize(corners), atol=1e-9)


def test_documented_target_is_the_target() -> None:
    np.testing.assert_array_equal(TARGET_M, [0.0, 0.0, 1.2])
    assert "1.2 m above the floor" in (Hover.__doc__ or "")
