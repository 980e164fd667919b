"""Evaluation of policies over many episodes: trained ones of their environments, and baselines without learning."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
import numpy.typing as npt

import dronevio.envs  # noqa: F401 registers the environments
from dronevio.models.actions import ActionLimits
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.policies.policy import Policy
from dronevio.models.progress import Progress, silent
from dronevio.sim.envs.episodes.endings import Termination
from dronevio.sim.envs.policies.goal_flight import fly_to_goal
from dronevio.sim.envs.policies.mission import vehicle_of_policy
from dronevio.sim.envs.settings import EnvironmentSettings

MOST_AT_ONCE = 256
"""Largest number of environments that are stepped together."""
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


def policy_envs(policy: Policy, count: int, *, environment: str = "", **settings: Any) -> Any:
    """Return a vector of environments in which a policy can be used.

    Args:
        policy: The policy, which determines vehicle, observations, actions and rates.
        count: Number of environments.
        environment: Id of the environment; by default that in which the policy was trained.
        settings: Further settings of the environments; see `dronevio.sim.envs.EnvironmentSettings`.

    Raises:
        ConfigError: There is no such environment or vehicle, or they do not have the observations or actions of the
            policy.
    """
    name = environment or policy.environment
    _require_registered(name)
    if gymnasium.spec(name).vector_entry_point is None:
        raise ConfigError(f"environment {name!r} without native vectors; expected one that is not flown on an estimate")
    arguments = {
        "vehicle": settings.get("vehicle") or vehicle_of_policy(policy),
        "action": policy.action_mode,
        "action_limits": policy.action_limits,
        "action_rate_hz": policy.action_rate_hz,
        "imu_rate_hz": policy.imu_rate_hz,
        "observations": policy.names,
    }
    envs = gymnasium.make_vec(name, num_envs=count, **{**arguments, **settings})
    outputs, shape = policy.network.outputs, envs.single_action_space.shape
    if shape != (outputs,):
        envs.close()
        raise ConfigError(f"a policy with actions of shape {(outputs,)} in {name}; expected {shape}")
    shapes = getattr(envs.unwrapped, "observation_shapes", {})
    for one in policy.inputs:
        if shapes.get(one.name) != one.shape:
            envs.close()
            raise ConfigError(
                f"observation {one.name!r} of shape {shapes.get(one.name)} in {name}; expected {one.shape}, as the"
                " policy was trained"
            )
    return envs


def evaluate_policy(
    policy: Policy,
    episodes: int = 100,
    seed: int = 1_000_000,
    *,
    environment: str = "",
    progress: Progress = silent,
    **settings: Any,
) -> PolicyEvaluation:
    """Return the results of a policy in episodes that it has not been trained on.

    Args:
        policy: The policy.
        episodes: Number of episodes.
        seed: Seed of the episodes. Every 256 episodes have the following one.
        environment: Id of the environment; by default that in which the policy was trained.
        progress: Called with the number of finished episodes.
        settings: Further settings of the environments; see `dronevio.sim.envs.EnvironmentSettings`.

    Raises:
        ConfigError: There is no such environment or vehicle, or they do not have the observations or actions of the
            policy.
    """
    if episodes < 1:
        raise ConfigError(f"{episodes} episodes; expected 1 or more")
    parts: list[PolicyEvaluation] = []
    done = 0
    while done < episodes:
        count = min(episodes - done, MOST_AT_ONCE)
        envs = policy_envs(policy, count, environment=environment, **settings)
        try:
            parts.append(_evaluated(policy, envs, seed + len(parts)))
        finally:
            envs.close()
        done += count
        progress(done, episodes)
    return PolicyEvaluation(
        environment or policy.environment,
        seed,
        np.concatenate([part.success for part in parts]),
        np.concatenate([part.distance_m for part in parts]),
        np.concatenate([part.reward for part in parts]),
        np.concatenate([part.duration_s for part in parts]),
        tuple(end for part in parts for end in part.ends),
        parts[0].laps,
    )


def _evaluated(policy: Policy, envs: Any, seed: int) -> PolicyEvaluation:
    """Return the results of the first episode of each environment of a vector."""
    count = envs.num_envs
    running, success = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    distance_m, reward, steps = np.zeros((3, count))
    ends = np.full(count, "", object)
    observations, _ = envs.reset(seed=seed)
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


def evaluate_baseline(
    name: str,
    episodes: int = 100,
    seed: int = 1_000_000,
    *,
    environment: str = NAVIGATE,
    progress: Progress = silent,
    **settings: Any,
) -> PolicyEvaluation:
    """Return the results of a policy without learning, in single environments one episode after another.

    Args:
        name: ``planner`` or ``straight``.
        episodes: Number of episodes.
        seed: Seed of the first episode; each further one has the next.
        environment: Id of an environment with a goal, such as ``dronevio/VioNavigate-v0``.
        progress: Called with the number of finished episodes.
        settings: Further settings of the environment; see `dronevio.sim.envs.EnvironmentSettings`.

    Raises:
        ConfigError: There is no such policy or environment, or they do not fit.
    """
    if episodes < 1:
        raise ConfigError(f"{episodes} episodes; expected 1 or more")
    _require_registered(environment)
    with gymnasium.make(environment, **settings) as env:
        chosen: Any = env.unwrapped
        policy = baseline_named(name, chosen.settings)
        flown = []
        for number in range(episodes):
            flown.append(_flown(policy, env, seed + number))
            progress(number + 1, episodes)
    success, distance_m, reward, steps, ends = zip(*flown, strict=True)
    duration_s = np.array(steps) / chosen.settings.action_rate_hz
    laps = getattr(chosen.settings.task, "laps", None)
    return PolicyEvaluation(
        environment, seed, np.array(success), np.array(distance_m), np.array(reward), duration_s, ends, laps
    )


def _flown(policy: Baseline, env: Any, seed: int) -> tuple[bool, float, float, int, str]:
    """Return success, distance at the end [m], reward, number of steps and end of an episode."""
    observation, _ = env.reset(seed=seed)
    policy.reset()
    reward, steps, terminated, truncated = 0.0, 0, False, False
    info: dict[str, Any] = {}
    while not (terminated or truncated):
        observation, gained, terminated, truncated, info = env.step(policy.action(observation))
        reward, steps = reward + float(gained), steps + 1
    end = info["termination"].text if terminated else TIME_LIMIT
    return bool(info["success"]), float(info["distance_m"]), reward, steps, end


def _require_registered(environment: str) -> None:
    """Raise ConfigError if there is no environment with an id."""
    if environment not in gymnasium.registry:
        known = sorted(one for one in gymnasium.registry if one.startswith("dronevio/"))
        raise unknown_name("environment", environment, known)
