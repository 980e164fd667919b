"""Checker of vector environments, the counterpart of Gymnasium's `check_env` for single ones.

It checks any `gymnasium.vector.VectorEnv` against the documented behaviour of `SyncVectorEnv`: spaces, seeds, shapes
and types, masks of infos, data that belong to the caller, the three autoreset modes and ``reset_mask``.
"""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.utils.passive_env_checker import data_shares_objects
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, iterate

from dronevio.models.arrays import Mask

Vector = VectorEnv[Any, Any, Any]
Policy = Callable[[Any], Any]

_SEED = 123


def check_vector_env(envs: Vector, policy: Policy | None = None, steps: int = 1000) -> None:
    """Check that a vector environment does what Gymnasium documents.

    Args:
        envs: The vector environment; it is reset and stepped, and not closed.
        policy: Function from observations to actions under which episodes end; random actions by default.
        steps: Largest number of steps until an episode has to end.

    Raises:
        AssertionError: It does not; the message says what is wrong.
    """
    assert isinstance(envs, VectorEnv), f"{type(envs)} is not a VectorEnv"
    _check_spaces(envs)
    _check_seeds(envs)
    _check_steps(envs)
    _check_reset_mask(envs)
    _check_autoreset(envs, policy or (lambda _: envs.action_space.sample()), steps)


def _check_spaces(envs: Vector) -> None:
    """Check spaces and metadata."""
    n = envs.num_envs
    assert envs.observation_space == batch_space(envs.single_observation_space, n), "observation_space is no batch"
    assert envs.action_space == batch_space(envs.single_action_space, n), "action_space is no batch"
    mode = envs.metadata.get("autoreset_mode")
    assert isinstance(mode, AutoresetMode), f"metadata['autoreset_mode'] is {mode!r}; expected an AutoresetMode"


def _check_seeds(envs: Vector) -> None:
    """Check that seeds determine resets and steps."""
    envs.action_space.seed(_SEED)
    actions = [envs.action_space.sample() for _ in range(3)]
    first, again = _rollout(envs, _SEED, actions), _rollout(envs, _SEED, actions)
    assert data_equivalence(first, again, exact=True), "the same seed and actions do not give the same results"
    other = _rollout(envs, _SEED + 1, actions)
    assert not data_equivalence(first[0][0], other[0][0], exact=True), "different seeds give the same observations"
    fresh, _ = envs.reset()
    assert not data_equivalence(first[0][0], fresh, exact=True), "a reset without seed repeats the first episode"
    if envs.num_envs > 1:
        one, two = list(iterate(envs.observation_space, first[0][0]))[:2]
        assert not data_equivalence(one, two, exact=True), "all environments start with the same observation"


def _rollout(envs: Vector, seed: int, actions: list[Any]) -> list[Any]:
    """Return copies of the results of a reset and of steps."""
    results = [copy.deepcopy(envs.reset(seed=seed))]
    return results + [copy.deepcopy(envs.step(action)) for action in actions]


def _check_steps(envs: Vector) -> None:
    """Check shapes, types and ownership of the results of resets and steps."""
    result = envs.reset(seed=_SEED)
    assert isinstance(result, tuple) and len(result) == 2, "reset does not return (observations, infos)"
    observations, infos = result
    _check_observations(envs, observations, "reset")
    _check_infos(envs, infos, "reset")
    for _ in range(3):
        kept = copy.deepcopy(observations)
        stepped = envs.step(envs.action_space.sample())
        assert len(stepped) == 5, f"step returns {len(stepped)} values; expected 5"
        _check_observations(envs, stepped[0], "step")
        _check_scalars(envs, stepped[1], np.floating, "rewards")
        _check_scalars(envs, stepped[2], np.bool_, "terminations")
        _check_scalars(envs, stepped[3], np.bool_, "truncations")
        assert np.isfinite(stepped[1]).all(), f"rewards {stepped[1]} are not finite"
        _check_infos(envs, stepped[4], "step")
        assert not data_shares_objects(observations, stepped[0]), "two calls return observations that share memory"
        assert data_equivalence(kept, observations, exact=True), "a step modifies observations that it returned before"
        assert not data_shares_objects(infos, stepped[4]), "two calls return infos that share memory"
        observations, infos = stepped[0], stepped[4]


def _check_observations(envs: Vector, observations: Any, method: str) -> None:
    """Check that observations are in their space."""
    assert observations in envs.observation_space, f"observations of {method} are not in the observation_space"


def _check_scalars(envs: Vector, values: Any, kind: type, name: str) -> None:
    """Check shape and type of an array with one value for each environment."""
    assert isinstance(values, np.ndarray), f"{name} are of type {type(values)}; expected an array"
    assert values.shape == (envs.num_envs,), f"{name} have shape {values.shape}; expected {(envs.num_envs,)}"
    assert np.issubdtype(values.dtype, kind), f"{name} are of type {values.dtype}; expected {kind.__name__}"


def _check_infos(envs: Vector, infos: Any, method: str) -> None:
    """Check that each value has one row for each environment, and a mask."""
    assert isinstance(infos, dict), f"infos of {method} are of type {type(infos)}; expected a dict"
    for name, value in infos.items():
        if name.startswith("_"):
            _check_scalars(envs, value, np.bool_, f"infos[{name!r}] of {method}")
            assert name[1:] in infos, f"infos of {method} have the mask {name!r} without a value"
            continue
        assert f"_{name}" in infos, f"infos of {method} have {name!r} without a mask {'_' + name!r}"
        if isinstance(value, dict):
            _check_infos(envs, value, method)
        else:
            rows = np.shape(value)[:1]
            assert rows == (envs.num_envs,), f"infos[{name!r}] of {method} has {rows} rows; expected {envs.num_envs}"


def _check_reset_mask(envs: Vector) -> None:
    """Check that a reset with a mask leaves other environments as they are."""
    if envs.num_envs < 2:
        return
    envs.reset(seed=_SEED)
    before = copy.deepcopy(envs.step(envs.action_space.sample())[0])
    mask = np.zeros(envs.num_envs, dtype=np.bool_)
    mask[0] = True
    after, infos = envs.reset(options={"reset_mask": mask.copy()})
    _check_observations(envs, after, "reset with a mask")
    _check_infos(envs, infos, "reset with a mask")
    pairs = zip(iterate(envs.observation_space, before), iterate(envs.observation_space, after), strict=True)
    same = np.array([data_equivalence(old, new, exact=True) for old, new in pairs])
    assert not same[0], "a reset with a mask does not reset the environment of the mask"
    assert same[1:].all(), "a reset with a mask changes observations of other environments"
    for name, value in infos.items():
        if name.startswith("_"):
            assert not value[1:].any(), f"a reset with a mask gives {name[1:]!r} to environments that were not reset"


def _check_autoreset(envs: Vector, policy: Policy, steps: int) -> None:
    """Check what happens when an episode ends."""
    mode = envs.metadata["autoreset_mode"]
    observations, _ = envs.reset(seed=_SEED)
    for _ in range(steps):
        observations, _, terminated, truncated, infos = envs.step(policy(observations))
        ended = terminated | truncated
        if ended.any():
            break
    else:
        raise AssertionError(f"no episode has ended in {steps} steps")
    last = copy.deepcopy(observations)
    if mode is AutoresetMode.SAME_STEP:
        _check_final(envs, observations, ended, infos)
        return
    assert "final_obs" not in infos, f"infos have 'final_obs' with {mode}"
    if mode is AutoresetMode.DISABLED:
        observations, _ = envs.reset(options={"reset_mask": ended.copy()})
    else:
        observations, rewards, terminated, truncated, _ = envs.step(policy(observations))
        assert not rewards[ended].any(), "rewards of the step that resets are not 0"
        assert not (terminated | truncated)[ended].any(), "the step that resets ends the new episode"
    _check_observations(envs, observations, "an autoreset")
    _check_renewed(envs, last, observations, ended)


def _check_final(envs: Vector, observations: Any, ended: Mask, infos: dict[str, Any]) -> None:
    """Check the final observations and infos of episodes that are reset in the same step."""
    for name in ("final_obs", "final_info"):
        assert name in infos, f"infos lack {name!r} although an episode has ended"
        assert np.array_equal(infos[f"_{name}"], ended), f"the mask of {name!r} is not that of the ended episodes"
    final = infos["final_obs"]
    for row, current in enumerate(iterate(envs.observation_space, observations)):
        if ended[row]:
            assert final[row] in envs.single_observation_space, "a final observation is not in its space"
            assert not data_equivalence(final[row], current, exact=True), "an episode goes on although it has ended"
        else:
            assert final[row] is None, "an environment has a final observation although its episode goes on"
    _check_infos(envs, infos["final_info"], "final_info")


def _check_renewed(envs: Vector, last: Any, observations: Any, ended: Mask) -> None:
    """Check that ended episodes have been replaced by new ones."""
    pairs = zip(iterate(envs.observation_space, last), iterate(envs.observation_space, observations), strict=True)
    for row, (old, new) in enumerate(pairs):
        if ended[row]:
            assert not data_equivalence(old, new, exact=True), "an episode goes on although it has ended"
