"""Evaluation of policies over many episodes: trained ones of their environments, and baselines without learning."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import gymnasium
import numpy as np
import numpy.typing as npt

import dronevio.envs  # noqa: F401 registers the environments
from dronevio.models.actions import ActionLimits
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.policies.policy import Policy
from dronevio.models.progress import Progress, notebook_line
from dronevio.sim.envs.episodes.endings import Termination
from dronevio.sim.envs.episodes.randomization import NOTHING_RANDOM
from dronevio.sim.envs.policies.environments import has_vectors, policy_arguments, policy_envs, require_fitting
from dronevio.sim.envs.policies.goal_flight import fly_to_goal
from dronevio.sim.envs.settings import EnvironmentSettings

MOST_AT_ONCE = 256
"""Largest number of environments that are stepped together."""
MOST_WORLDS = 64
"""Largest number of worlds that are in memory together."""
TIME_LIMIT = "time limit"
"""Name of the end of an episode that is not terminated."""
_TEXTS = np.array([each.text for each in Termination])
BASELINES = ("planner", "straight")
"""Names of the policies without learning: one that maps and plans, and one that flies straight to the goal."""
NAVIGATE = "dronevio/Navigate-v0"
"""Id of the default environment of the baselines."""


class Baseline(Protocol):
    """Interface of a policy without learning, for one drone."""

    def reset(self) -> None:
        """Begin an episode."""

    def action(self, observation: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """Return the action (4,) for the next observation of the episode."""


@dataclass(frozen=True, eq=False)
class PolicyEvaluation:
    """Results of a policy in N episodes."""

    environment: str
    """Id of the environment."""
    seed: int
    """Seed of the first episodes."""
    success: npt.NDArray[np.bool_]
    """(N,) Whether the task is accomplished at the end of the episode."""
    distance_m: Array
    """(N,) Distances from the current goal at the end [m]."""
    reward: Array
    """(N,) Sums of the rewards of all steps."""
    duration_s: Array
    """(N,) Durations of the episodes [s]."""
    ends: tuple[str, ...]
    """Reasons of the ends: ``success``, ``time limit``, or a failure such as ``collision``."""
    laps: int | None
    """Number of laps of a race; None for other tasks."""

    @property
    def crashed(self) -> npt.NDArray[np.bool_]:
        """(N,) Whether the episodes end by a failure."""
        return ~np.isin(np.array(self.ends, dtype=object), ["success", TIME_LIMIT])

    def figures(self) -> dict[str, float | None]:
        """Return means over all episodes by name, with units in the names.

        ``success_duration_s`` and ``lap_s`` are means over the successful episodes; None without one, and ``lap_s`` is
        None without laps.
        """
        succeeded_s = float(self.duration_s[self.success].mean()) if self.success.any() else None
        return {
            "success_rate": float(self.success.mean()),
            "crash_rate": float(self.crashed.mean()),
            "final_distance_m": float(self.distance_m.mean()),
            "final_distance_median_m": float(np.median(self.distance_m)),
            "final_distance_max_m": float(self.distance_m.max()),
            "reward": float(self.reward.mean()),
            "duration_s": float(self.duration_s.mean()),
            "success_duration_s": succeeded_s,
            "lap_s": None if succeeded_s is None or self.laps is None else succeeded_s / self.laps,
        }

    def counts(self) -> dict[str, int]:
        """Return the numbers of episodes by the reason of their end, the most frequent one first."""
        return dict(Counter(self.ends).most_common())


def evaluate_policy(
    policy: Policy,
    episodes: int = 100,
    seed: int = 1_000_000,
    *,
    environment: str = "",
    world_seeds: Sequence[int] = (),
    progress: Progress | None = None,
    **settings: Any,
) -> PolicyEvaluation:
    """Return the results of a policy in episodes that it has not been trained on.

    Episodes run in vectors of 256 environments, or of 64 with several worlds; those on an estimate run one after
    another.

    Args:
        policy: The policy.
        episodes: Number of episodes.
        seed: Seed of the episodes. Every vector, or episode on an estimate, has the following one.
        environment: Id of the environment, such as ``dronevio/VioNavigate-v0``; by default that in which the policy was
            trained.
        world_seeds: Seeds of the worlds of the episodes, which are repeated if there are more episodes; by default
            those of the settings.
        progress: Called with the number of finished episodes; by default, a notebook shows it.
        settings: Further settings of the environments; see `dronevio.sim.envs.EnvironmentSettings`.

    Raises:
        ConfigError: There is no such environment or vehicle, or they do not have the observations or actions of the
            policy.
    """
    name = environment or policy.environment
    progress = progress or notebook_line("episodes")
    worlds = _worlds(episodes, world_seeds)
    if not has_vectors(name):
        settings = policy_arguments(policy, settings)

        def single(chosen: Any) -> Baseline:
            require_fitting(policy, chosen, chosen.action_space.shape, name)
            return _OneDrone(policy)

        return _one_after_another(single, episodes, seed, name, worlds, progress, settings)
    parts: list[PolicyEvaluation] = []
    most = min(episodes, MOST_AT_ONCE if worlds is None else MOST_WORLDS)
    for first in range(0, episodes, most):
        count = min(episodes - first, most)
        options = None if worlds is None else {"randomization": {"world_seed": worlds[first : first + count]}}
        chosen = settings if worlds is None else _in_worlds(settings, worlds[first : first + count])
        envs = policy_envs(policy, count, environment=environment, **chosen)
        try:
            parts.append(_evaluated(policy, envs, seed + len(parts), options))
        finally:
            envs.close()
        progress(first + count, episodes)
    return _joined(parts, name, seed)


def _joined(parts: Sequence[PolicyEvaluation], environment: str, seed: int) -> PolicyEvaluation:
    """Return the results of several vectors as one."""
    return PolicyEvaluation(
        environment,
        seed,
        np.concatenate([part.success for part in parts]),
        np.concatenate([part.distance_m for part in parts]),
        np.concatenate([part.reward for part in parts]),
        np.concatenate([part.duration_s for part in parts]),
        tuple(end for part in parts for end in part.ends),
        parts[0].laps,
    )


def _worlds(episodes: int, seeds: Sequence[int]) -> npt.NDArray[np.int64] | None:
    """Return the seeds (episodes,) of the worlds of episodes; None if none are given.

    Raises:
        ConfigError: There is no episode.
    """
    if episodes < 1:
        raise ConfigError(f"{episodes} episodes; expected 1 or more")
    return np.resize(np.array(seeds, np.int64), episodes) if len(seeds) else None


def _in_worlds(settings: Mapping[str, Any], seeds: npt.NDArray[np.int64]) -> dict[str, Any]:
    """Return settings of environments with worlds of some seeds."""
    randomization = settings.get("randomization", NOTHING_RANDOM)
    return {**settings, "randomization": replace(randomization, world_seeds=tuple(np.unique(seeds).tolist()))}


def _evaluated(policy: Policy, envs: Any, seed: int, options: dict[str, Any] | None) -> PolicyEvaluation:
    """Return the results of the first episode of each environment of a vector."""
    count = envs.num_envs
    running, success = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    distance_m, reward, steps = np.zeros((3, count))
    ends = np.full(count, "", object)
    observations, _ = envs.reset(seed=seed, options=options)
    while running.any():
        observations, rewards, terminated, truncated, infos = envs.step(policy.action(observations))
        reward += np.where(running, rewards, 0.0)
        steps += running
        last = running & (terminated | truncated)
        success[last], distance_m[last] = infos["success"][last], infos["distance_m"][last]
        ends[last] = np.where(terminated, _TEXTS[infos["termination"]], TIME_LIMIT)[last]
        running &= ~last
    settings = envs.unwrapped.settings
    return PolicyEvaluation(
        "",
        seed,
        success,
        distance_m,
        reward,
        steps / settings.action_rate_hz,
        tuple(ends.tolist()),
        getattr(settings.task, "laps", None),
    )


def baseline_named(name: str, environment: EnvironmentSettings) -> Baseline:
    """Return a policy without learning for environments with some settings.

    Args:
        name: One of `BASELINES`.
        environment: Settings of the environment.

    Raises:
        ConfigError: There is no such policy, or it cannot fly in the environment.
    """
    if name == "planner":
        from dronevio.autonomy.policy import PlannerPolicy

        return PlannerPolicy.of(environment)
    if name == "straight":
        return StraightFlight.of(environment)
    raise ConfigError(f"unknown policy {name!r}; expected a file or one of {', '.join(BASELINES)}")


@dataclass(frozen=True)
class StraightFlight:
    """Straight flight to the goal, whatever is in between; implements `Baseline` by `fly_to_goal`."""

    limits: ActionLimits
    """Velocities of actions of ±1."""

    @classmethod
    def of(cls, environment: EnvironmentSettings) -> "StraightFlight":
        """Return the policy for environments with some settings.

        Raises:
            ConfigError: The environment has other actions than velocities, or lacks an observation.
        """
        if environment.action != "velocity" or not {"goals", "rotation"} <= set(environment.policy_names):
            raise ConfigError(
                f"straight flight with the action mode {environment.action!r} and the observations"
                f" {', '.join(environment.policy_names)}; expected 'velocity' and goals, rotation"
            )
        return cls(environment.action_limits)

    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    def action(self, observation: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """Return the action (4,) for an observation."""
        return fly_to_goal(observation, self.limits)


@dataclass(frozen=True)
class _OneDrone:
    """A trained policy of one drone; implements `Baseline`."""

    policy: Policy

    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    def action(self, observation: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """Return the action (A,) for an observation."""
        rows = {name: np.asarray(observation[name])[None] for name in self.policy.names}
        return np.asarray(self.policy.action(rows)[0])


def evaluate_baseline(
    name: str,
    episodes: int = 100,
    seed: int = 1_000_000,
    *,
    environment: str = NAVIGATE,
    world_seeds: Sequence[int] = (),
    progress: Progress | None = None,
    **settings: Any,
) -> PolicyEvaluation:
    """Return the results of a policy without learning, in single environments one episode after another.

    Args:
        name: ``planner`` or ``straight``.
        episodes: Number of episodes.
        seed: Seed of the first episode; each further one has the next.
        environment: Id of an environment with a goal, such as ``dronevio/VioNavigate-v0``.
        world_seeds: Seeds of the worlds of the episodes, which are repeated if there are more episodes; by default
            those of the settings.
        progress: Called with the number of finished episodes; by default, a notebook shows it.
        settings: Further settings of the environment; see `dronevio.sim.envs.EnvironmentSettings`.

    Raises:
        ConfigError: There is no such policy or environment, or they do not fit.
    """
    has_vectors(environment)
    worlds = _worlds(episodes, world_seeds)

    def chosen(env: Any) -> Baseline:
        return baseline_named(name, env.settings)

    return _one_after_another(
        chosen, episodes, seed, environment, worlds, progress or notebook_line("episodes"), settings
    )


def _one_after_another(
    policy_of: Callable[[Any], Baseline],
    episodes: int,
    seed: int,
    environment: str,
    worlds: npt.NDArray[np.int64] | None,
    progress: Progress,
    settings: dict[str, Any],
) -> PolicyEvaluation:
    """Return the results of the policy for a single environment, in episodes with consecutive seeds."""
    flown: list[tuple[bool, float, float, int, str]] = []
    most = episodes if worlds is None else MOST_WORLDS
    for first in range(0, episodes, most):
        part = None if worlds is None else worlds[first : first + most]
        with gymnasium.make(environment, **(settings if part is None else _in_worlds(settings, part))) as env:
            chosen: Any = env.unwrapped
            policy = policy_of(chosen)
            for number in range(first, min(first + most, episodes)):
                options = None if worlds is None else {"randomization": {"world_seed": int(worlds[number])}}
                flown.append(_flown(policy, env, seed + number, options))
                progress(number + 1, episodes)
    success, distance_m, reward, steps, ends = zip(*flown, strict=True)
    duration_s = np.array(steps) / chosen.settings.action_rate_hz
    laps = getattr(chosen.settings.task, "laps", None)
    return PolicyEvaluation(
        environment, seed, np.array(success), np.array(distance_m), np.array(reward), duration_s, ends, laps
    )


def _flown(
    policy: Baseline, env: Any, seed: int, options: dict[str, Any] | None
) -> tuple[bool, float, float, int, str]:
    """Return success, distance at the end [m], reward, number of steps and end of an episode."""
    observation, _ = env.reset(seed=seed, options=options)
    policy.reset()
    reward, steps, terminated, truncated = 0.0, 0, False, False
    info: dict[str, Any] = {}
    while not (terminated or truncated):
        observation, gained, terminated, truncated, info = env.step(policy.action(observation))
        reward, steps = reward + float(gained), steps + 1
    end = info["termination"].text if terminated else TIME_LIMIT
    return bool(info["success"]), float(info["distance_m"]), reward, steps, end
