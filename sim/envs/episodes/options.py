"""Options of a reset: values that are given instead of drawn.

``reset(options={…})`` takes these keys. Each value is that of one environment, or an array with one row for each
environment of a vector.

| key | shape | content |
|---|---|---|
| ``position_m`` | (3,) | position of the centre of mass in the world [m] |
| ``quat_wxyz`` | (4,) | orientation, vehicle to world |
| ``velocity_m_s`` | (3,) | velocity in the world frame [m/s] |
| ``rate_rad_s`` | (3,) | angular velocity in the vehicle frame [rad/s] |
| ``rotor_speed_rad_s`` | (R,) | rotor speeds [rad/s] |
| ``battery_charge`` | () | charge of the battery, from 1 (full) to 0 (empty) |
| ``goal_m`` | (3,) | first goal of the task in the world [m]; not for ``track`` and ``race`` |
| ``randomization`` | dict | values of the randomization by name, as in ``info["randomization"]`` |
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.tasks import AnyTask
from dronevio.sim.physics.vehicle_states import VehicleStates

Rows = npt.NDArray[np.intp]

_STATES = ("position_m", "velocity_m_s", "rate_rad_s", "rotor_speed_rad_s", "battery_charge")
_LIMITS = {"battery_charge": (0.0, 1.0), "velocity_m_s": (-1e4, 1e4), "rate_rad_s": (-1e4, 1e4)}
_NOT_NEGATIVE = ("drag", "gusts", "latency_s", "imu_errors", "light")
_KEYS = (*_STATES, "quat_wxyz", "goal_m", "randomization")


def require_known(options: Mapping[str, Any]) -> None:
    """Check the names of options.

    Raises:
        ConfigError: A name is unknown.
    """
    for key in options:
        if key not in _KEYS:
            raise ConfigError(f"unknown option {key!r} of a reset; expected some of {', '.join(_KEYS)}")


def overridden(
    task: AnyTask,
    quadrotor: Quadrotor,
    states: VehicleStates,
    goals: Any,
    options: Mapping[str, Any],
    rows: Rows,
    count: int,
) -> tuple[VehicleStates, Any]:
    """Return initial states and goals of k episodes, with given values in place of random ones.

    Args:
        task: The task.
        quadrotor: The vehicle.
        states: Drawn initial states of k vehicles.
        goals: Drawn goals of k episodes.
        options: Given values by name; see the module.
        rows: (k,) Indices of the environments.
        count: Number n of all environments.

    Raises:
        ConfigError: A value has a wrong shape, is not finite or not possible.
    """
    given = {key: _rows_of(key, options[key], getattr(states, key), rows, count) for key in _STATES if key in options}
    for key, (least, most) in _LIMITS.items():
        _require_within(key, given.get(key), least, most)
    _require_within("rotor_speed_rad_s", given.get("rotor_speed_rad_s"), 0.0, quadrotor.rotor_speed_max_rad_s)
    if "quat_wxyz" in options:
        quat = _rows_of("quat_wxyz", options["quat_wxyz"], np.zeros((len(rows), 4)), rows, count)
        if np.any(np.abs(np.linalg.norm(quat, axis=1) - 1.0) > 1e-3):
            raise ConfigError("option 'quat_wxyz' is not a unit quaternion; expected one")
        given["R_world_vehicle"] = matrix_from_quat_wxyz(quat)
    if "goal_m" in options:
        goals = task.with_goal(goals, _rows_of("goal_m", options["goal_m"], np.zeros((len(rows), 3)), rows, count))
    return replace(states, **given), goals


def overridden_parameters(
    randomized: RandomizedParameters, values: Mapping[str, Any], rows: Rows, count: int
) -> RandomizedParameters:
    """Return randomized parameters of k episodes with given values.

    Args:
        randomized: Randomized parameters of k episodes.
        values: Given values by name.
        rows: (k,) Indices of the environments.
        count: Number n of all environments.

    Raises:
        ConfigError: A name is unknown, or a value has a wrong shape, is not finite or negative where it cannot be.
    """
    known = [field.name for field in fields(randomized)]
    for name in values:
        if name not in known:
            raise ConfigError(f"unknown randomization {name!r} in the options; expected some of {', '.join(known)}")
    given: dict[str, Any] = {
        name: _rows_of(name, value, getattr(randomized, name), rows, count) for name, value in values.items()
    }
    for name in _NOT_NEGATIVE:
        _require_within(name, given.get(name), 0.0, np.inf)
    return replace(randomized, **given)


def _require_within(name: str, values: Array | None, least: float, most: float) -> None:
    """Raise ConfigError if a value is given and outside of its limits."""
    if values is not None and not np.all((values >= least) & (values <= most)):
        wrong = values[(values < least) | (values > most)].flat[0]
        raise ConfigError(f"option {name!r} with {wrong:g}; expected {least:g} to {most:g}")


def _rows_of(name: str, value: Any, drawn: Array, rows: Rows, count: int) -> Array:
    """Return the rows (k, …) of a given value, for one environment or for all.

    Raises:
        ConfigError: The value has a wrong shape or is not finite.
    """
    shape = drawn.shape[1:]
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or not np.all(np.isfinite(array)):
        raise ConfigError(f"option {name!r} = {value!r}; expected finite numbers")
    if array.shape == shape:
        return np.array(np.broadcast_to(array, drawn.shape), drawn.dtype)
    if array.shape == (count, *shape):
        return np.array(array[rows], drawn.dtype)
    raise ConfigError(f"option {name!r} of shape {array.shape}; expected {shape}, or {(count, *shape)} for all")
