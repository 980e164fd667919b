"""Tasks and observations of one's own, by the page that describes them."""

import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dronevio.envs import DroneEnv, DroneVectorEnv, OwnObservation, Termination, check_vector_env
from dronevio.models.errors import ConfigError

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "own-task.md"
FORWARD, ASIDE = np.array([1.0, 0.0, 0.0, 0.0], np.float32), np.array([0.0, 1.0, 0.0, 0.0], np.float32)

pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="not a checkout")


@pytest.fixture(scope="module")
def dash(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """Return the module of the task, with the name that the page gives it."""
    [code] = re.findall(r"The file `dash.py`:\n\n```python\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S)
    path = tmp_path_factory.mktemp("own") / "dash.py"
    path.write_text(code, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("dash", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["dash"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["dash"]


def flown(env: Any, action: np.ndarray) -> tuple[float, bool, bool, dict[str, Any]]:
    """Return what the last step of an episode with one action returns, without the observation."""
    env.reset(seed=0)
    while True:
        _, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return reward, terminated, truncated, info


def test_they_are_short() -> None:
    task, observation, _ = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S)
    lines = [line for line in task[task.index("@dataclass") :].splitlines() if line]
    assert len(lines) <= 30
    assert len(observation[observation.index("def ") : observation.index("env =")].strip().splitlines()) <= 10


def test_the_task_is_flown(dash: ModuleType) -> None:
    _, terminated, _, info = flown(DroneEnv(dash.Dash()), FORWARD)
    assert terminated and info["success"] and info["termination"] == Termination.SUCCESS
    reward, terminated, _, info = flown(DroneEnv(dash.Dash()), ASIDE)
    assert terminated and not info["success"] and info["termination"] == Termination.TASK_FAILED
    assert info["termination"].text == "task failed" and reward < -4.9
    _, terminated, truncated, info = flown(DroneEnv(dash.Dash(episode_s=0.2)), ASIDE)
    assert truncated and not terminated and info["termination"] == Termination.NONE


def test_single_environments_equal_rows_of_vectors(dash: ModuleType) -> None:
    single, vector = DroneEnv(dash.Dash(), flat=True), DroneVectorEnv(2, dash.Dash(), flat=True)
    given = {
        "position_m": np.array([[0.0, 0.2, 1.2], [0.1, 0.0, 1.3]]),
        "velocity_m_s": np.array([[0.3, 0.0, 0.0], [0.0, 0.2, 0.1]]),
        "rate_rad_s": np.zeros((2, 3)),
        "quat_wxyz": np.array([[1.0, 0.0, 0.0, 0.0]] * 2),
        "goal_m": np.array([[2.0, 0.2, 1.2], [2.1, 0.0, 1.3]]),
    }
    vector.reset(seed=0, options=given)
    single.reset(seed=5, options={name: value[1] for name, value in given.items()})
    for _ in range(20):
        one, many = single.step(FORWARD), vector.step(np.tile(FORWARD, (2, 1)))
        np.testing.assert_allclose(one[0], many[0][1], atol=1e-6)
        assert one[1] == pytest.approx(many[1][1], abs=1e-9)


@pytest.mark.filterwarnings("ignore")  # of Gymnasium, about unbounded spaces and the like
def test_checkers_accept_the_task(dash: ModuleType) -> None:
    check_env(DroneEnv(dash.Dash()), skip_render_check=True)
    check_vector_env(DroneVectorEnv(2, dash.Dash()))


def offset(state: Any) -> np.ndarray:
    """Return the offsets (n, 2) from the goal in the horizontal plane [m]."""
    return np.asarray((state.states.position_m - state.objective.position_m[:, 0])[:, :2])


OFFSET = OwnObservation("offset", (2,), -5.0, [5.0, 5.0], offset)


def test_own_observations_stand_among_the_others() -> None:
    envs: Any = gymnasium.make_vec("dronevio.envs:dronevio/Hover-v0", 4, observations=("position", OFFSET, "rate"))
    seen, _ = envs.reset(seed=1)
    np.testing.assert_array_equal(seen["offset"], seen["position"][:, :2])
    assert envs.unwrapped.observation_shapes["offset"] == (2,)
    flat = DroneEnv(observations=("rate", OFFSET), privileged=("wind",), flat=True)
    seen, _ = flat.reset(seed=1)
    assert seen["policy"].shape == (5,) and list(flat.observation_shapes) == ["rate", "offset"]
    near = OwnObservation("near", (2,), -0.01, 0.01, offset)
    seen, _ = DroneEnv(observations=(near,)).reset(seed=1)
    assert np.abs(seen["near"]).max() == np.float32(0.01)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OwnObservation("rate", (2,), 0.0, 1.0, offset), "'rate'; expected an identifier that names no other"),
        (lambda: OwnObservation("depth", (2,), 0.0, 1.0, offset), "'depth'"),
        (lambda: OwnObservation("a b", (2,), 0.0, 1.0, offset), "'a b'"),
        (lambda: OwnObservation("mine", (2,), np.zeros(3), 1.0, offset), r"do not fit its shape \(2,\)"),
        (lambda: OwnObservation("mine", (2,), 1.0, 0.0, offset), "expected finite ones, low < high"),
        (lambda: OwnObservation("mine", (2,), 0.0, np.inf, offset), "expected finite ones, low < high"),
        (lambda: DroneEnv(observations=(OFFSET, "rate", OFFSET)), "offset, rate, offset; expected each name once"),
    ],
)
def test_impossible_observations_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (lambda state: offset(state)[0], r"'mine' of shape \(2,\); expected \(1, 2\)"),
        (lambda state: offset(state) * np.nan, "'mine' of environment 0: .*nan nan.*; expected finite values"),
    ],
)
def test_values_of_own_observations_are_checked(values: Any, message: str) -> None:
    env = DroneEnv(observations=(OwnObservation("mine", (2,), -1.0, 1.0, values),))
    with pytest.raises(ConfigError, match=message):
        env.reset(seed=0)


@pytest.mark.parametrize("method", ["success", "failed"])
def test_masks_of_own_tasks_are_checked(dash: ModuleType, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = DroneEnv(dash.Dash())
    env.reset(seed=0)
    for wrong, found in ((np.zeros(2, bool), r"shape \(2,\)"), (np.zeros(1), "type float64"), (True, r"shape \(\)")):
        monkeypatch.setattr(dash.Dash, method, lambda *_, wrong=wrong: wrong)
        with pytest.raises(ConfigError, match=f"Dash.{method} returned .*{found}.*; expected 1 values of type bool"):
            env.step(FORWARD)


def test_a_task_without_a_start_cannot_be_made(dash: ModuleType) -> None:
    with pytest.raises(TypeError, match="begin"):
        type("Incomplete", (dash.BaseTask,), {})()
