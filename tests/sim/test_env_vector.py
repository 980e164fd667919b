"""Vector environments: the contract in all autoreset modes, equality with single ones, errors, and adapters."""

import importlib.util
import pickle
import sys
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import dronevio.envs  # noqa: F401 registers
from dronevio.models.errors import ConfigError
from dronevio.sim.envs.episodes.endings import Termination
from dronevio.sim.envs.episodes.randomization import MODERATE
from dronevio.sim.envs.single import DroneEnv
from dronevio.sim.envs.tasks import TASKS
from dronevio.sim.envs.vector import DroneVectorEnv
from dronevio.sim.envs.vector_checker import check_vector_env

MODES = [mode.name for mode in AutoresetMode]
STATE = ("position", "rotation", "velocity", "rate")


# --- the contract


@pytest.mark.parametrize("mode", MODES)
def test_the_checker_finds_nothing(mode: str) -> None:
    flat = mode == "SAME_STEP"
    envs = gymnasium.make_vec(
        "dronevio/Hover-v0", num_envs=3, autoreset_mode=mode, flat=flat, privileged=("wind",) if flat else ()
    )
    assert isinstance(envs, DroneVectorEnv)
    check_vector_env(envs)
    envs.close()


@pytest.mark.parametrize("name", [name for name in TASKS if name not in ("hover", "vio-hover", "vio-navigate")])
def test_the_checker_finds_nothing_for_any_task(name: str) -> None:
    envs = gymnasium.make_vec(
        f"dronevio/{name.capitalize()}-v0",
        num_envs=2,
        world="gates" if name == "race" else "room",
        action="rotors",
        observations=STATE,
        max_episode_steps=20,
        autoreset_mode="SAME_STEP",
    )
    check_vector_env(envs)
    assert pickle.loads(pickle.dumps(envs)).num_envs == 2


def test_the_checker_accepts_vectors_of_gymnasium() -> None:
    for mode in AutoresetMode:
        check_vector_env(SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 2, autoreset_mode=mode))


class Broken(DroneVectorEnv):
    """A vector environment with a defect that its name selects."""

    defect = ""

    def step(self, actions: Any) -> Any:
        observations, rewards, terminated, truncated, infos = super().step(actions)
        if self.defect == "types":
            rewards = rewards > 0.0  # type: ignore[assignment]
        if self.defect == "masks":
            infos.pop("_success")
        if self.defect == "range":
            observations["rotation"] = observations["rotation"] + np.float32(2.0)
        if self.defect == "ends":
            terminated[:] = truncated[:] = False
        return observations, rewards, terminated, truncated, infos

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if self.defect == "mask" and options:
            options = None
        return super().reset(seed=5 if self.defect == "seed" else seed, options=options)


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("types", "rewards are of type bool"),
        ("masks", "'success' without a mask"),
        ("range", "not in the observation_space"),
        ("ends", "no episode has ended"),
        ("mask", "changes observations of other environments|to environments that were not reset"),
        ("seed", "different seeds give the same observations"),
    ],
)
def test_the_checker_finds_defects(defect: str, message: str) -> None:
    envs = Broken(2, "hover", max_episode_steps=3)
    envs.defect = defect
    with pytest.raises(AssertionError, match=message):
        check_vector_env(envs, steps=10)


@pytest.mark.parametrize("context", ["spawn", "forkserver"])
def test_environments_run_in_other_processes(context: str) -> None:
    make = partial(gymnasium.make, "dronevio.envs:dronevio/Hover-v0", observations=("imu",))
    envs, reference = AsyncVectorEnv([make], context=context), make()
    first, expected = envs.reset(seed=0)[0], reference.reset(seed=0)[0]
    np.testing.assert_array_equal(first["imu"][0], expected["imu"])
    actions = np.full((1, 4), 0.1, np.float32)
    np.testing.assert_array_equal(envs.step(actions)[0]["imu"][0], reference.step(actions[0])[0]["imu"])
    envs.close()


# --- equality


@pytest.mark.parametrize(("mode", "amplitude"), [("rotors", 0.02), ("velocity", 0.2)])
def test_a_row_equals_a_single_environment(mode: str, amplitude: float) -> None:
    """Same initial states, parameters and actions: equal over 100 steps in the air; the difference is a few 1e-15."""
    rng = np.random.default_rng(0)
    settings: dict[str, Any] = {"observations": STATE, "randomization": MODERATE, "action": mode}
    envs = DroneVectorEnv(2, "hover", **settings)
    drawn: dict[str, Any] = {
        "mass": rng.uniform(0.98, 1.02, 2),
        "inertia": rng.uniform(0.8, 1.2, (2, 3)),
        "rotor_time_constant": rng.uniform(0.7, 1.4, 2),
        "thrust": rng.uniform(0.99, 1.01, 2),
        "drag": rng.uniform(0.5, 2.0, 2),
        "wind_m_s": rng.uniform(-0.2, 0.2, (2, 3)),
        "gusts": np.zeros(2),
        "latency_s": np.array([0.0, 0.025]),
    }
    given: dict[str, Any] = {
        "position_m": rng.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 1.6], (2, 3)),
        "velocity_m_s": rng.uniform(-0.1, 0.1, (2, 3)),
        "rate_rad_s": rng.uniform(-0.1, 0.1, (2, 3)),
        "quat_wxyz": np.array([[1.0, 0.0, 0.0, 0.0]] * 2),
    }
    envs.reset(seed=0, options={**given, "randomization": drawn})
    singles = [DroneEnv("hover", **settings) for _ in range(2)]
    for k, single in enumerate(singles):
        values = {name: value[k] for name, value in given.items()}
        own = {name: value[k] for name, value in drawn.items()}
        single.reset(seed=7 + k, options={**values, "randomization": own})
    steps = 100
    for _ in range(steps):
        actions = rng.uniform(-amplitude, amplitude, (2, 4))
        envs.step(actions.astype(np.float32))
        for k, single in enumerate(singles):
            single.step(actions[k].astype(np.float32))
            for field in ("position_m", "R_world_vehicle", "velocity_m_s", "rate_rad_s", "battery_charge"):
                one, many = getattr(single._core.states, field)[0], getattr(envs._core.states, field)[k]
                np.testing.assert_allclose(many, one, rtol=0.0, atol=1e-9, err_msg=field)
    assert not envs._ended.any() and envs._core.plant.t_ns.min() == steps * 20_000_000  # no episode has ended


def test_the_number_of_threads_does_not_change_the_bytes() -> None:
    results = []
    for threads in (1, 2):
        envs = DroneVectorEnv(8, "hover", randomization=MODERATE, threads=threads, flat=True)
        envs.reset(seed=1)
        rng = np.random.default_rng(0)
        results.append([envs.step(rng.uniform(-0.3, 0.3, (8, 4)))[0].tobytes() for _ in range(8)])
    assert results[0] == results[1]


def test_a_saved_vector_can_be_restored() -> None:
    envs = DroneVectorEnv(3, "waypoints", randomization=MODERATE, max_episode_steps=4, flat=True)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (8, 3, 4)).astype(np.float32)
    envs.step(actions[0])
    saved, first = envs.save_state(), [envs.step(action) for action in actions]
    envs.restore_state(saved)
    again = [envs.step(action) for action in actions]
    assert data_equivalence(first, again, exact=True)
    other = pickle.loads(pickle.dumps(envs))
    assert data_equivalence(envs.step(actions[0]), other.step(actions[0]), exact=True)


def test_a_reset_of_one_environment_leaves_the_inner_loops_of_the_others() -> None:
    flights = []
    for mask in (None, np.array([True, False])):
        envs = DroneVectorEnv(2, "waypoints", action="velocity", autoreset_mode="DISABLED", observations=STATE)
        envs.reset(seed=0)
        actions = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 2, 4)).astype(np.float32)
        for action in actions[:6]:
            envs.step(action)
        if mask is not None:
            envs.reset(options={"reset_mask": mask})
        flights.append([envs.step(action)[0]["velocity"] for action in actions[6:]])
    undisturbed, reset = np.array(flights)
    np.testing.assert_array_equal(undisturbed[:, 1], reset[:, 1])
    assert np.abs(undisturbed[:, 0] - reset[:, 0]).min() > 1e-3


# --- autoreset


def test_infos_have_the_values_of_new_and_old_episodes() -> None:
    envs = DroneVectorEnv(2, "hover", max_episode_steps=3, autoreset_mode="SAME_STEP")
    envs.reset(seed=0)
    for _ in range(3):
        *_, terminated, truncated, infos = envs.step(np.zeros((2, 4), np.float32))
    assert truncated.all() and not terminated.any()
    assert infos["t_ns"].tolist() == [0, 0] and infos["final_info"]["t_ns"].tolist() == [60_000_000] * 2
    assert "randomization" in infos and not infos["_success"].any() and infos["final_info"]["_success"].all()
    np.testing.assert_allclose(
        [np.linalg.norm(one["position"]) for one in infos["final_obs"]], infos["final_info"]["distance_m"], rtol=1e-5
    )


def test_the_next_step_resets_and_ignores_the_action() -> None:
    envs = DroneVectorEnv(2, "hover", max_episode_steps=2)
    envs.reset(seed=0)
    envs.step(np.zeros((2, 4)))
    envs.reset(options={"reset_mask": np.array([False, True])})
    *_, truncated, _ = envs.step(np.zeros((2, 4)))
    assert truncated.tolist() == [True, False]
    _, rewards, _, truncated, infos = envs.step(np.zeros((2, 4)))
    assert rewards[0] == 0.0 < rewards[1] and truncated.tolist() == [False, True]
    assert infos["t_ns"].tolist() == [0, 40_000_000]
    assert infos["_randomization"].tolist() == [True, False] and infos["_success"].tolist() == [False, True]


def leaves(values: Any) -> list[Any]:
    """Return the arrays of nested dicts."""
    return [leaf for value in values.values() for leaf in (leaves(value) if isinstance(value, dict) else [value])]


def test_infos_are_numbers_that_other_libraries_can_hold() -> None:
    """Gymnasium's conversion to PyTorch passes them as DLPack, which has no text."""
    envs = DroneVectorEnv(2, "hover", randomization=MODERATE, max_episode_steps=2)
    _, begun = envs.reset(seed=0)
    steps = [envs.step(np.zeros((2, 4), np.float32))[-1] for _ in range(4)]
    for leaf in leaves({"begun": begun, **{str(k): info for k, info in enumerate(steps)}}):
        np.from_dlpack(leaf)
    assert steps[0]["termination"].tolist() == [Termination.NONE, Termination.NONE]


# --- errors


def test_impossible_vectors_are_refused() -> None:
    for arguments, message in (
        ({"num_envs": 0}, "num_envs = 0"),
        ({"autoreset_mode": "never"}, "unknown autoreset_mode 'never'"),
        ({"max_episode_steps": 0}, "max_episode_steps = 0"),
        ({"max_episode_steps": 501}, "max_episode_steps = 501; expected 1 to 500, or a task with a longer episode_s"),
        ({"render_mode": "human"}, "render mode 'human'"),
    ):
        with pytest.raises(ConfigError, match=message):
            DroneVectorEnv(**{"num_envs": 2, **arguments})  # type: ignore[arg-type]


def test_impossible_calls_of_vectors_are_refused() -> None:
    envs = DroneVectorEnv(2, "hover", autoreset_mode="DISABLED", max_episode_steps=1)
    with pytest.raises(ConfigError, match=r"expected reset\(\) first"):
        envs.step(np.zeros((2, 4)))
    with pytest.raises(ConfigError, match="expected a reset of all"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(seed=0)
    for mask in (np.array([1, 0]), np.array([True]), np.array([False, False])):
        with pytest.raises(ConfigError, match="expected a mask"):
            envs.reset(options={"reset_mask": mask})
    for actions, message in ((np.zeros(4), r"expected \(2, 4\)"), (np.full((2, 4), np.inf), "of environment 0")):
        with pytest.raises(ConfigError, match=message):
            envs.step(actions)
    envs.step(np.zeros((2, 4)))
    with pytest.raises(ConfigError, match="episode of environment 0 has ended"):
        envs.step(np.zeros((2, 4)))


# --- Stable-Baselines3


class VecEnv:
    """What the adapter inherits from Stable-Baselines3, where that is not installed."""

    def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None:
        self.num_envs, self.observation_space, self.action_space = num_envs, observation_space, action_space
        self.reset_infos: list[dict[str, Any]] = []
        self._reset_seeds()
        self._reset_options()

    def seed(self, seed: int) -> None:
        self._seeds: list[int | None] = [seed + row for row in range(self.num_envs)]

    def _reset_seeds(self) -> None:
        self._seeds = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]

    def step(self, actions: Any) -> Any:
        self.step_async(actions)  # type: ignore[attr-defined]
        return self.step_wait()  # type: ignore[attr-defined]


@pytest.fixture
def baselines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stable-Baselines3, or what the adapter needs of it."""
    if importlib.util.find_spec("stable_baselines3") is None:
        for name in ("stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.vec_env"):
            monkeypatch.setitem(sys.modules, name, SimpleNamespace(VecEnv=VecEnv))
        monkeypatch.delitem(sys.modules, "dronevio.sim.envs.stable_baselines", raising=False)


@pytest.mark.usefixtures("baselines")
def test_the_adapter_has_the_interface_of_stable_baselines() -> None:
    from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv

    with pytest.raises(ConfigError, match="SAME_STEP"):
        StableBaselinesVecEnv(DroneVectorEnv(2, "hover"))
    envs = StableBaselinesVecEnv(DroneVectorEnv(2, "hover", flat=True, autoreset_mode="SAME_STEP", max_episode_steps=2))
    envs.seed(0)
    first = envs.reset()
    assert first.shape == (2, 18) and envs.reset_infos[1]["t_ns"] == 0
    _, rewards, ended, infos = envs.step(np.zeros((2, 4), np.float32))
    assert rewards.dtype == np.float32 and infos == [{}, {}] and not ended.any()
    observations, _, ended, infos = envs.step(np.zeros((2, 4), np.float32))
    assert ended.all() and infos[0]["TimeLimit.truncated"] and not infos[0]["is_success"]
    assert infos[1]["episode"]["l"] == 2 and infos[1]["episode"]["t"] >= 0.0
    before = rewards[1]
    _, rewards, _, _ = envs.step(np.zeros((2, 4), np.float32))
    _, last, _, again = envs.step(np.zeros((2, 4), np.float32))
    assert again[1]["episode"]["r"] == pytest.approx(rewards[1] + last[1], abs=1e-5)
    assert again[1]["episode"]["l"] == 2 and before != rewards[1]
    assert infos[0]["terminal_observation"].shape == (18,)
    assert not np.array_equal(infos[0]["terminal_observation"], observations[0])
    envs.seed(0)
    np.testing.assert_array_equal(envs.reset(), first)
