"""The environment of one drone, for all tasks."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.sim.envs.core import DroneCore
from dronevio.sim.envs.episodes.actions import action_space
from dronevio.sim.envs.episodes.endings import Termination
from dronevio.sim.envs.info import Info, row_of
from dronevio.sim.envs.rendering import RENDER_MODES, DronePictures, check_render_mode, possible_render_modes
from dronevio.sim.envs.sensing.arrangement import rows_of
from dronevio.sim.envs.settings import settings_of
from dronevio.sim.envs.tasks import AnyTask

_ALL = np.ones(1, dtype=np.bool_)


class DroneEnv(gymnasium.Env[Any, npt.NDArray[np.floating[Any]]]):
    """A quadrotor with a task: the class of all environments of dronevio.

    The tasks are `Hover`, `Waypoints`, `Track`, `Race`, `Navigate`, `Explore`, `VioHover` and `VioNavigate` in
    `dronevio.sim.envs.tasks`, whose docstrings specify the environments. Physics, IMU and camera are those of the
    scenarios. A vector of environments, `DroneVectorEnv`, runs the same code on many drones at once.

    ## Arguments
    The keyword arguments are the fields of `dronevio.sim.envs.settings.EnvironmentSettings`: task, world, vehicle, rig,
    wind, action mode, observations, randomization and rates.

    ```python
    import gymnasium

    env = gymnasium.make("dronevio.envs:dronevio/Hover-v0", action="rates", flat=True)
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    ```

    ## Time limits
    An episode is truncated after the ``episode_s`` of its task, in seconds, whatever the rate of the actions:
    ``task=Hover(episode_s=3.0)``. The ``max_episode_steps`` of `gymnasium.make` and `gymnasium.make_vec` can only
    shorten it.

    ## Info
    | key | content |
    |---|---|
    | ``success`` | whether the vehicle does what the task demands; not after a reset |
    | ``termination`` | why the episode has terminated, a `Termination`: ``NONE`` (0), ``SUCCESS``, ``NO_ESTIMATE``, \
``FLIPPED``, ``OUT_OF_BOUNDS``, ``GROUND``, ``COLLISION``, ``DIVERGED`` or ``TASK_FAILED``; not after a reset |
    | ``reward_terms`` | terms of the reward by name; not after a reset |
    | ``distance_m`` | distance from the current goal [m] |
    | ``t_ns`` | time since the start of the episode [ns] |
    | ``known_m3`` | volume of the known cells of the map, with a map [m³] |
    | ``randomization`` | drawn values by name, see `RandomizedParameters`; only after a reset |

    With an estimator, there are also the entries that `dronevio.sim.envs.sensing.estimation` describes.

    ## Determinism
    The same seed and the same actions give the same bytes on the same kind of processor. A reset without seed continues
    the random numbers.

    ## Saved states
    `save_state` returns the state of episode, physics, IMU and random numbers, with which `restore_state` continues in
    this or another environment with the same arguments. Environments can be pickled with their state. With an
    estimator, the state cannot be saved.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 50}  # noqa: RUF012 as Gymnasium has it

    def __init__(self, task: AnyTask | str = "hover", render_mode: str | None = None, **settings: Any) -> None:
        """Build the physics; renderers are built when they are first used.

        Args:
            task: Task or name of a task.
            render_mode: None, ``rgb_array`` or ``human``.
            settings: Other fields of `EnvironmentSettings` by name.

        Raises:
            ConfigError: An argument is unknown or not possible, or two exclude each other.
            GraphicsError: The render mode is ``human``, and there is no display.
        """
        check_render_mode(render_mode, RENDER_MODES)
        self._arguments = {"task": task, "render_mode": render_mode, **settings}
        self.render_mode = render_mode
        self.settings = settings_of(task, **settings)
        self.metadata = {"render_modes": possible_render_modes(), "render_fps": round(self.settings.action_rate_hz)}
        self._core = DroneCore(1, self.settings)
        self._pictures = DronePictures(self.settings)
        self._started, self._steps = False, 0
        self.action_space = action_space(self._core.action_size)
        self.observation_space = self._core.arrangement.space
        self.observation_shapes = self._core.arrangement.shapes
        """Shapes of the observations of the policy by name, in order."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Start an episode.

        Args:
            seed: Seed of all random numbers from now on; None continues the current stream.
            options: Values to use instead of drawn ones; `dronevio.sim.envs.episodes.options` lists them.

        Returns:
            The first observation and the info dictionary.

        Raises:
            ConfigError: An option is unknown, or a value has a wrong shape.
        """
        super().reset(seed=seed)
        if seed is not None or not self._started:
            self._core.reseed(self.np_random)
        info = self._core.reset(_ALL, options or {})
        self._started, self._steps = True, 0
        self._show()
        return rows_of(self._core.observe(), 0), row_of(info, 0)

    def step(self, action: npt.NDArray[np.floating[Any]]) -> tuple[Any, SupportsFloat, bool, bool, Info]:
        """Apply an action (A,), clipped to [−1, 1], for the time between two actions.

        Returns:
            Observation, reward, terminated, truncated and the info dictionary.

        Raises:
            ConfigError: The action is not A finite numbers, or there was no reset.
        """
        self._require_started()
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ConfigError(f"action of shape {action.shape}; expected {self.action_space.shape}")
        result = self._core.step(action[None])
        self._steps += 1
        self._show()
        observation, info = rows_of(self._core.observe(), 0), row_of(result.info, 0)
        info["termination"] = Termination(info["termination"])
        is_over = self._steps >= self.settings.episode_steps
        return observation, float(result.reward[0]), bool(result.terminated[0]), is_over, info

    def render(self) -> Any:
        """Return an RGB image (480, 640, 3) from the chase camera, or show it; None without a render mode.

        Green balls mark the current goal and, more transparent, the following ones that are observed.

        With ``render_mode="human"``, `reset` and `step` show the images in a window, in real time.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        if self.render_mode == "rgb_array":
            return self._pictures.picture(*self._core.shown(0))
        self._show()
        return None

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""
        self._core.close()
        self._pictures.close()

    def save_state(self) -> dict[str, Any]:
        """Return the state of episode, physics and random numbers, which `restore_state` accepts.

        Raises:
            ConfigError: There was no reset, or there is an estimator.
        """
        self._require_started()
        return {"core": self._core.save(), "steps": self._steps}

    def restore_state(self, saved: dict[str, Any]) -> Any:
        """Return to a state of this or another environment with the same arguments.

        Returns:
            The observation of the state.
        """
        self._core.require_copyable()
        if not self._started:
            self.reset()
        self._core.restore(saved["core"])
        self._steps = saved["steps"]
        return rows_of(self._core.observe(), 0)

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments and state."""
        return {"arguments": self._arguments, "saved": self.save_state() if self._started else None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build the environment from arguments and state."""
        self.__init__(**state["arguments"])  # type: ignore[misc]
        if state["saved"] is not None:
            self.restore_state(state["saved"])

    def _show(self) -> None:
        """Show the current picture with ``render_mode="human"``."""
        if self.render_mode == "human":
            self._pictures.show(*self._core.shown(0))

    def _require_started(self) -> None:
        """Raise ConfigError before the first reset."""
        if not self._started:
            raise ConfigError("the environment has not been reset; expected reset() first")
