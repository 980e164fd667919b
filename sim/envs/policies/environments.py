"""Environments in which a trained policy can be used: its vehicle, rates, observations and actions."""

from collections.abc import Mapping
from typing import Any

import gymnasium

from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.policies.policy import Policy
from dronevio.sim.envs.policies.mission import vehicle_of_policy


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
    if not has_vectors(name):
        raise ConfigError(f"environment {name!r} without native vectors; expected one that is not flown on an estimate")
    envs: Any = gymnasium.make_vec(name, num_envs=count, **policy_arguments(policy, settings))
    require_fitting(policy, envs, envs.single_action_space.shape, name)
    return envs


def has_vectors(environment: str) -> bool:
    """Return whether there are native vectors of an environment.

    Raises:
        ConfigError: There is no such environment.
    """
    if environment not in gymnasium.registry:
        known = sorted(one for one in gymnasium.registry if one.startswith("dronevio/"))
        raise unknown_name("environment", environment, known)
    return gymnasium.spec(environment).vector_entry_point is not None


def policy_arguments(policy: Policy, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of environments of a policy, with further settings."""
    arguments = {
        "vehicle": settings.get("vehicle") or vehicle_of_policy(policy),
        "action": policy.action_mode,
        "action_limits": policy.action_limits,
        "action_rate_hz": policy.action_rate_hz,
        "imu_rate_hz": policy.imu_rate_hz,
        "observations": policy.names,
    }
    return {**arguments, **settings}


def require_fitting(policy: Policy, envs: Any, actions: tuple[int, ...], name: str) -> None:
    """Close environments and raise ConfigError unless they have the actions and observations of a policy."""
    outputs, shapes = policy.network.outputs, envs.unwrapped.observation_shapes
    unlike = [one for one in policy.inputs if shapes.get(one.name) != one.shape]
    if actions == (outputs,) and not unlike:
        return
    envs.close()
    if actions != (outputs,):
        raise ConfigError(f"a policy with actions of shape {(outputs,)} in {name}; expected {actions}")
    first = unlike[0]
    raise ConfigError(
        f"observation {first.name!r} of shape {shapes.get(first.name)} in {name}; expected {first.shape}, as the policy"
        " was trained"
    )
