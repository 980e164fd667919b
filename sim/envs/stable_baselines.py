"""Adapter of vector environments for Stable-Baselines3, which has a vector interface of its own.

Stable-Baselines3 is no dependency of dronevio: ``pip install stable-baselines3``. Importing this module without it
raises `ImportError`.

```python
import gymnasium
from stable_baselines3 import PPO

from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv

envs = gymnasium.make_vec("dronevio.envs:dronevio/Hover-v0", num_envs=256, autoreset_mode="SAME_STEP", flat=True)
PPO("MlpPolicy", StableBaselinesVecEnv(envs), n_steps=32, batch_size=2048).learn(500_000)
```
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import Wrapper
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from dronevio.models.errors import ConfigError
from dronevio.sim.envs.info import row_of

Indices = int | Iterable[int] | None
Returned = tuple[Any, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]


class StableBaselinesVecEnv(VecEnv):  # type: ignore[misc]  # the library is not installed where types are checked
    """A vector environment of Gymnasium as a `VecEnv` of Stable-Baselines3.

    An environment is reset in the step in which its episode ends. Its info then has ``terminal_observation``,
    ``TimeLimit.truncated`` (truncated and not terminated), ``episode`` with the return, length and time of the episode
    as `VecMonitor` has them, ``is_success`` if there is a ``success``, and the values of the last step by name. The
    infos of other steps are empty, since a dict for each environment takes longer than the physics.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        """Adapt a vector environment.

        Args:
            envs: Vector environment with ``autoreset_mode=SAME_STEP``; it is closed with the adapter.

        Raises:
            ConfigError: It has another autoreset mode.
        """
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ConfigError(f"vector environment with autoreset_mode {mode}; expected AutoresetMode.SAME_STEP")
        self.envs = envs
        self._actions: npt.NDArray[np.float32] | None = None
        self._returns, self._lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs, np.int64)
        self._began_s = time.time()
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Start episodes of all environments, with the seed and options that were set before."""
        observations, infos = self.envs.reset(seed=self._seeds[0], options=self._options[0])
        self.reset_infos = [row_of(_without_masks(infos), row) for row in range(self.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> Returned:
        """Apply the stored actions, and return observations, rewards, ends of episodes and infos."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        listed: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        final = _without_masks(infos.get("final_info", {}))
        for row in np.flatnonzero(ended).tolist():
            listed[row] = {
                **row_of(final, row),
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {
                    "r": round(float(self._returns[row]), 6),
                    "l": int(self._lengths[row]),
                    "t": round(time.time() - self._began_s, 6),
                },
            }
            if "success" in final:
                listed[row]["is_success"] = bool(final["success"][row])
        self._returns[ended], self._lengths[ended] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, listed

    def close(self) -> None:
        """Close the vector environment."""
        self.envs.close()

    def get_images(self) -> Sequence[Any]:
        """Return RGB images of all environments."""
        images = self.envs.render()
        return [None] * self.num_envs if images is None else list(images)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute, which all environments share, once for each of the indices."""
        return [getattr(self.envs, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of all environments.

        Raises:
            ConfigError: Indices of some environments are given, which share their attributes with the others.
        """
        if len(self._rows(indices)) < self.num_envs:
            raise ConfigError(
                f"attribute {attr_name!r} of some environments; expected all, which share their attributes"
            )
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Indices = None, **keywords: Any) -> list[Any]:
        """Call a method of the vector environment, and return its result once for each of the indices."""
        result = getattr(self.envs, method_name)(*arguments, **keywords)
        return [result] * len(self._rows(indices))

    def env_is_wrapped(self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: Indices = None) -> list[bool]:
        """Return False for each of the indices: the environments are not wrapped one by one."""
        return [False] * len(self._rows(indices))

    def _rows(self, indices: Indices) -> list[int]:
        """Return the indices of environments; all for None."""
        if indices is None:
            return list(range(self.num_envs))
        return [indices] if isinstance(indices, int) else list(indices)


def _without_masks(info: dict[str, Any]) -> dict[str, Any]:
    """Return an info without the masks of its values."""
    return {
        name: _without_masks(value) if isinstance(value, dict) else value
        for name, value in info.items()
        if not name.startswith("_")
    }
