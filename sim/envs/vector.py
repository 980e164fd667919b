"""The vector environment: many drones with the same task, stepped together."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.sim.envs.core import DroneCore
from dronevio.sim.envs.episodes.actions import action_space
from dronevio.sim.envs.info import Info, with_masks
from dronevio.sim.envs.rendering import DronePictures, check_render_mode
from dronevio.sim.envs.sensing.arrangement import rows_of
from dronevio.sim.envs.settings import settings_of
from dronevio.sim.envs.tasks import AnyTask

StepReturn = tuple[Any, Array, Mask, Mask, Info]

RENDER_MODES = ("rgb_array",)
"""Render modes of vectors; Gymnasium's wrapper `HumanRendering` shows their images in a window."""


class DroneVectorEnv(VectorEnv[Any, npt.NDArray[np.floating[Any]], Any]):
    """Many quadrotors with the same task; `gymnasium.make_vec` makes it.

    It behaves like a `SyncVectorEnv` of `DroneEnv`, but one call of the physics and of numpy serves all environments,
    which is a hundred times as fast. All random numbers come from one stream, so that the values of an environment
    depend on the number of environments.

    ```python
    import gymnasium

    envs = gymnasium.make_vec("dronevio.envs:dronevio/Hover-v0", num_envs=1024, flat=True)
    observations, infos = envs.reset(seed=0)
    observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
    ```

    ## Arguments
    ``autoreset_mode`` is one of Gymnasium's three modes: ``NEXT_STEP`` (the default) resets an environment in the step
    after its episode ends, ``SAME_STEP`` in the same step, with ``final_obs`` and ``final_info`` in the infos, and
    ``DISABLED`` leaves it to ``reset(options={"reset_mask": …})``. Episodes are truncated after the ``episode_s`` of
    the task, or ``max_episode_steps`` before. ``threads`` is the number of threads of the physics. Other keyword
    arguments are the fields of `dronevio.sim.envs.settings.EnvironmentSettings`.

    ## Infos
    Those of `DroneEnv` as arrays with one row for each environment. As in all vectors of Gymnasium, ``_key`` is a mask
    of the environments that have a value of ``key``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: AnyTask | str = "hover",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        """Build the physics; renderers are built when they are first used.

        Args:
            num_envs: Number of environments.
            task: Task or name of a task.
            render_mode: None or ``rgb_array``.
            max_episode_steps: Number of steps after which an episode is truncated, at most that of the task.
            autoreset_mode: What happens when an episode ends.
            settings: Other fields of `EnvironmentSettings` by name.

        Raises:
            ConfigError: An argument is unknown or not possible, or two exclude each other.
        """
        check_render_mode(render_mode, RENDER_MODES)
        if num_envs < 1:
            raise ConfigError(f"num_envs = {num_envs}; expected 1 or more")
        self._arguments = {
            "num_envs": num_envs,
            "task": task,
            "render_mode": render_mode,
            "max_episode_steps": max_episode_steps,
            "autoreset_mode": autoreset_mode,
            **settings,
        }
        self.num_envs, self.render_mode = num_envs, render_mode
        self.settings = settings_of(task, **settings)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {
            "render_modes": list(RENDER_MODES),
            "render_fps": round(self.settings.action_rate_hz),
            "autoreset_mode": self.autoreset_mode,
        }
        most = self.settings.episode_steps
        self._limit = most if max_episode_steps is None else max_episode_steps
        if not 1 <= self._limit <= most:
            raise ConfigError(
                f"max_episode_steps = {self._limit}; expected 1 to {most}, or a task with a longer episode_s"
            )
        self._core = DroneCore(num_envs, self.settings)
        self._pictures = DronePictures(self.settings)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._started = False
        self.single_action_space = action_space(self._core.action_size)
        self.single_observation_space = self._core.arrangement.space
        self.observation_shapes = self._core.arrangement.shapes
        """Shapes of the observations of one environment's policy by name, in order."""
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Start episodes, of all environments or of those in a mask.

        Args:
            seed: Seed of all random numbers from now on; None continues the current stream.
            options: ``reset_mask`` is a mask (n,) of the environments to reset; `dronevio.sim.envs.episodes.options`
                lists values to use instead of drawn ones.

        Returns:
            The observations of all environments, and the infos of those that were reset.

        Raises:
            ConfigError: An option is unknown, a value has a wrong shape, or the first reset is not one of all
                environments.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        mask = _checked_mask(given.pop("reset_mask", np.ones(self.num_envs, dtype=np.bool_)), self.num_envs)
        if not (self._started or mask.all()):
            raise ConfigError("the first reset with a reset_mask of some environments; expected a reset of all")
        if seed is not None or not self._started:
            self._core.reseed(self.np_random)
        info = self._begin(mask, given)
        self._started = True
        return self._core.observe(), with_masks(info, mask)

    def step(self, actions: npt.NDArray[np.floating[Any]]) -> StepReturn:
        """Apply actions (n, A), clipped to [−1, 1], for the time between two actions.

        Returns:
            Observations, rewards (n,), terminations (n,), truncations (n,) and infos.

        Raises:
            ConfigError: The actions are not n rows of A finite numbers, there was no reset, or an episode has ended
                without a reset and ``autoreset_mode`` is ``DISABLED``.
        """
        if not self._started:
            raise ConfigError("the environments have not been reset; expected reset() first")
        due = self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and due.any():
            raise ConfigError(
                f"the episode of environment {int(np.argmax(due))} has ended; expected a reset with options="
                "{'reset_mask': …}"
            )
        result = self._core.step(actions)
        self._steps += 1
        truncated = (self._steps >= self._limit) & ~due
        terminated = result.terminated & ~due
        reward = np.where(due, 0.0, result.reward)
        infos = with_masks(result.info, ~due)
        self._ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._reset_ended(self._ended.copy(), result.info)
        elif due.any():
            infos = _combined(infos, with_masks(self._begin(due, {}), due))
        return self._core.observe(), reward, terminated, truncated, infos

    def render(self) -> Any:
        """Return RGB images (480, 640, 3) of all environments as a tuple; None without a render mode.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        if self.render_mode is None:
            return None
        return tuple(self._pictures.picture(*self._core.shown(row)) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Release the resources of rendering; further calls have no effect."""
        self._core.close()
        self._pictures.close()

    def save_state(self) -> dict[str, Any]:
        """Return the state of episodes, physics and random numbers, which `restore_state` accepts."""
        return {"core": self._core.save(), "steps": self._steps.copy(), "ended": self._ended.copy()}

    def restore_state(self, saved: dict[str, Any]) -> Any:
        """Return to a state of this or another vector with the same arguments.

        Returns:
            The observations of the state.
        """
        if not self._started:
            self.reset()
        self._core.restore(saved["core"])
        self._steps, self._ended = saved["steps"].copy(), saved["ended"].copy()
        return self._core.observe()

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments and state."""
        return {"arguments": self._arguments, "saved": self.save_state() if self._started else None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build the environments from arguments and state."""
        self.__init__(**state["arguments"])  # type: ignore[misc]
        if state["saved"] is not None:
            self.restore_state(state["saved"])

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Info:
        """Start the episodes of a mask, and return their infos."""
        info = self._core.reset(mask, options)
        self._steps[mask] = 0
        self._ended = self._ended & ~mask
        return info

    def _reset_ended(self, ended: Mask, info: Info) -> Info:
        """Reset the environments whose episodes end in this step; return infos with the end of the old episodes."""
        observations = self._core.observe()
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):  # Gymnasium demands an object for each of them
            final[row] = rows_of(observations, int(row))
        begun = with_masks(self._begin(ended, {}), ended)
        infos = _combined(with_masks(info, ~ended), begun)
        infos["final_obs"], infos["_final_obs"] = final, ended.copy()
        infos["final_info"], infos["_final_info"] = with_masks(info, ended), ended.copy()
        return infos


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode, given by itself or by its name or value.

    Raises:
        ConfigError: There is no such mode.
    """
    for known in AutoresetMode:
        if mode in (known, known.name, known.value):
            return known
    raise unknown_name("autoreset_mode", str(mode), (m.name for m in AutoresetMode))


def _checked_mask(mask: Any, count: int) -> Mask:
    """Return a mask (n,) of at least one environment.

    Raises:
        ConfigError: It is not one.
    """
    array = np.asarray(mask)
    if array.dtype != np.bool_ or array.shape != (count,) or not array.any():
        raise ConfigError(
            f"reset_mask of type {array.dtype} and shape {array.shape} with {int(np.count_nonzero(array))} environments"
            f"; expected a mask of type bool and shape {(count,)} with one or more"
        )
    return array.copy()


def _combined(stepped: Info, begun: Info) -> Info:
    """Return masked infos of environments that were stepped and of others that were reset."""
    combined = {**stepped}
    for name, value in begun.items():
        if name not in combined:
            combined[name] = value
        elif isinstance(value, dict):
            combined[name] = _combined(combined[name], value)
        elif name.startswith("_"):
            combined[name] = combined[name] | value
        else:
            mask = begun[f"_{name}"]
            combined[name] = np.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, combined[name])
    return combined
