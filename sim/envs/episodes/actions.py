"""Action modes: the meaning of the numbers of an action, and the inner control loops that fly them.

All actions are in [−1, 1]. `ActionLimits` has the largest values; 0 commands hover or no motion in every mode. Thrusts
and rotor speeds are interpolated linearly from 0 (at −1) over hover (at 0) to the largest value (at 1).

| mode | numbers of an action |
|---|---|
| ``rotors`` | speeds of the R rotors in their order; of ``quad-x``: front right, rear left, front left, rear right |
| ``rates`` | collective thrust, and angular velocity about x, y and z of the vehicle |
| ``attitude`` | collective thrust, roll, pitch and yaw rate; positive roll tilts to the right, positive pitch forward |
| ``velocity`` | velocity forward, to the left and up in the horizontal frame of the heading, and yaw rate |
| ``position`` | place along x, y and z of the world from that of the start of the episode, and yaw rate |

The other modes have four numbers for every vehicle. The vehicle frame is x forward, y left, z up. The inner loops of
all modes but ``rotors`` run at the rate of the IMU on the true state, or on the estimate of an estimator if there is
one, with the gains, the disturbance observers and the nominal parameters of the controller that flies the scenarios
(`dronevio.sim.physics.cascade.Cascade`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.actions import ACTION_MODES, ActionLimits
from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.quadrotor import Quadrotor
from dronevio.sim.physics.cascade import Body, Cascade, CascadeState, attitude_along
from dronevio.sim.physics.gains import Gains
from dronevio.sim.physics.vehicle_states import VehicleStates


class ActionMode(Protocol):
    """Interface of the inner loops of n vehicles."""

    @property
    def size(self) -> int:
        """Number A of the numbers of an action."""

    def start(self, states: VehicleStates) -> Any:
        """Return the state of the loops at the start of flights: nested tuples of arrays with n rows."""

    def commands(self, loops: Any, actions: Array, states: Callable[[], VehicleStates]) -> tuple[Array, Any]:
        """Return commands (n, R) of rotor speeds [rad/s] for one IMU interval, and the next state of the loops.

        Args:
            loops: State of the loops.
            actions: (n, A) Actions within [−1, 1].
            states: Function that returns the current states.
        """


class RotorSpeeds:
    """Mode ``rotors``: the speeds of the rotors; implements `ActionMode`."""

    def __init__(self, quadrotor: Quadrotor) -> None:
        self._speeds = [0.0, quadrotor.hover_speed_rad_s, quadrotor.rotor_speed_max_rad_s]
        self.size = quadrotor.rotor_count

    def start(self, states: VehicleStates) -> tuple[()]:
        """Return an empty state."""
        return ()

    def commands(
        self, loops: tuple[()], actions: Array, states: Callable[[], VehicleStates]
    ) -> tuple[Array, tuple[()]]:
        """Return the rotor speeds (n, R) [rad/s]."""
        return np.interp(actions, [-1.0, 0.0, 1.0], self._speeds), loops


@dataclass(frozen=True, eq=False)
class SetPoint:
    """Set point of the inner loops of n vehicles."""

    thrust_n: Array
    """(n,) Collective thrust in free air [N]."""
    R_desired: Array
    """(n, 3, 3) Desired attitude; the current one where only rates are controlled."""
    rate_rad_s: Array
    """(n, 3) Desired angular velocity in the frame of the desired attitude [rad/s]."""


Law = Callable[[Array, Body, Cascade, CascadeState, ActionLimits], SetPoint]
"""Function from actions (n, A) and the motion of n vehicles to their set points."""


class ControlledFlight:
    """Modes with inner loops; implements `ActionMode`."""

    size = 4

    def __init__(self, quadrotor: Quadrotor, limits: ActionLimits, law: Law, interval_s: float) -> None:
        """Define vehicle and mode.

        Args:
            quadrotor: The vehicle type, whose nominal parameters the loops use.
            limits: Values of actions of ±1.
            law: Meaning of the actions.
            interval_s: Time between two calls of `commands` [s].
        """
        self._cascade = Cascade(quadrotor, Gains(), interval_s)
        self._limits, self._law = limits, law

    def start(self, states: VehicleStates) -> CascadeState:
        """Return the state of the loops in steady motion."""
        return self._cascade.at(states.rotor_speed_rad_s, states.velocity_m_s, states.rate_rad_s)

    def commands(
        self, loops: CascadeState, actions: Array, states: Callable[[], VehicleStates]
    ) -> tuple[Array, CascadeState]:
        """Return the rotor speeds (n, R) [rad/s], and the next state of the loops."""
        return self.commands_by(self._law, loops, actions, states())

    def commands_by(
        self, law: Law, loops: CascadeState, actions: Array, now: VehicleStates
    ) -> tuple[Array, CascadeState]:
        """Return the rotor speeds (n, R) [rad/s] by a law, and the next state of the loops."""
        cascade = self._cascade
        body = Body(now.position_m, now.R_world_vehicle, now.velocity_m_s, now.rate_rad_s)
        loads = cascade.loads(loops, body)
        observed = cascade.observe(loops, body, loads)
        wanted = law(actions, body, cascade, observed, self._limits)
        acceleration = cascade.angular_acceleration(observed, body, wanted.R_desired, wanted.rate_rad_s)
        return cascade.commands(observed, loads, wanted.thrust_n / loads.lift, acceleration)


class PositionState(NamedTuple):
    """State of the loops of the mode ``position``."""

    cascade: CascadeState
    """State of the inner loops."""
    start_m: Array
    """(n, 3) Places of the start of the episodes [m]."""


class PositionFlight:
    """Mode ``position``; implements `ActionMode`. The place of the start is part of the state of the loops."""

    size = 4

    def __init__(self, quadrotor: Quadrotor, limits: ActionLimits, interval_s: float) -> None:
        """Define the vehicle; see `ControlledFlight`."""
        self._flight = ControlledFlight(quadrotor, limits, _velocity, interval_s)
        self._limits = limits

    def start(self, states: VehicleStates) -> PositionState:
        """Return the state of the loops in steady motion, with the places of the start."""
        return PositionState(self._flight.start(states), states.position_m.copy())

    def commands(
        self, loops: PositionState, actions: Array, states: Callable[[], VehicleStates]
    ) -> tuple[Array, PositionState]:
        """Return the rotor speeds (n, R) [rad/s], and the next state of the loops."""
        place_m, gains = loops.start_m + self._limits.position_m * actions[:, :3], Gains()

        def toward(actions: Array, body: Body, cascade: Cascade, state: CascadeState, limits: ActionLimits) -> SetPoint:
            wanted = gains.position_per_s2 / gains.velocity_per_s * (place_m - body.position_m)
            speed = np.linalg.norm(wanted, axis=1, keepdims=True)
            wanted *= np.minimum(1.0, limits.velocity_m_s / np.maximum(speed, 1e-9))
            return _at_velocity(wanted, actions[:, 3], body, cascade, state, limits)

        commands, cascade = self._flight.commands_by(toward, loops.cascade, actions, states())
        return commands, PositionState(cascade, loops.start_m)


def _rates(actions: Array, body: Body, cascade: Cascade, state: CascadeState, limits: ActionLimits) -> SetPoint:
    """Return the set points of the mode ``rates``."""
    largest = np.array([limits.rate_rad_s, limits.rate_rad_s, limits.yaw_rate_rad_s])
    return SetPoint(_thrust_n(actions[:, 0], cascade.quadrotor), body.R_world_vehicle, largest * actions[:, 1:])


def _attitude(actions: Array, body: Body, cascade: Cascade, state: CascadeState, limits: ActionLimits) -> SetPoint:
    """Return the set points of the mode ``attitude``."""
    roll, pitch = limits.tilt_rad * actions[:, 1], limits.tilt_rad * actions[:, 2]
    up = np.stack([np.sin(pitch) * np.cos(roll), -np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=1)
    yaw = _yaw_rad(body.R_world_vehicle)
    R = attitude_along(_turned(up, yaw), yaw)
    thrust = _thrust_n(actions[:, 0], cascade.quadrotor)
    return SetPoint(thrust, R, _yaw_rate(actions[:, 3], R, limits))


def _velocity(actions: Array, body: Body, cascade: Cascade, state: CascadeState, limits: ActionLimits) -> SetPoint:
    """Return the set points of the mode ``velocity``."""
    wanted = _turned(limits.velocity_m_s * actions[:, :3], _yaw_rad(body.R_world_vehicle))
    return _at_velocity(wanted, actions[:, 3], body, cascade, state, limits)


def _at_velocity(
    wanted_m_s: Array, turn: Array, body: Body, cascade: Cascade, state: CascadeState, limits: ActionLimits
) -> SetPoint:
    """Return the set points for velocities (n, 3) in the world [m/s] and turns (n,) from −1 to 1."""
    yaw = _yaw_rad(body.R_world_vehicle)
    error = wanted_m_s - body.velocity_m_s
    largest = limits.acceleration_m_s2 / Gains().velocity_per_s
    error *= np.minimum(1.0, largest / np.maximum(np.linalg.norm(error, axis=1), 1e-9))[:, None]
    force = cascade.specific_force(state, body, body.position_m, body.velocity_m_s + error)
    R = attitude_along(force, yaw)
    thrust = cascade.quadrotor.mass_kg * np.vecdot(force, body.R_world_vehicle[..., 2])
    return SetPoint(np.maximum(thrust, 0.0), R, _yaw_rate(turn, R, limits))


_LAWS: dict[str, Law] = {"rates": _rates, "attitude": _attitude, "velocity": _velocity}


def action_mode(name: str, quadrotor: Quadrotor, limits: ActionLimits, interval_s: float) -> ActionMode:
    """Return an action mode.

    Args:
        name: One of `ACTION_MODES`.
        quadrotor: The vehicle type.
        limits: Values of actions of ±1.
        interval_s: Length of an IMU interval [s].

    Raises:
        ConfigError: There is no such mode.
    """
    if name not in ACTION_MODES:
        raise unknown_name("action mode", name, ACTION_MODES)
    if name == "rotors":
        return RotorSpeeds(quadrotor)
    if name == "position":
        return PositionFlight(quadrotor, limits, interval_s)
    return ControlledFlight(quadrotor, limits, _LAWS[name], interval_s)


def action_space(size: int) -> spaces.Space[Any]:
    """Return the space of the actions of one environment, which have ``size`` numbers."""
    return spaces.Box(-1.0, 1.0, (size,), np.float32)


def checked_actions(actions: npt.ArrayLike, count: int, size: int) -> Array:
    """Return the actions (n, A) of ``count`` environments, clipped to [−1, 1].

    Raises:
        ConfigError: They are not n rows of A = ``size`` finite numbers.
    """
    action = np.asarray(actions, dtype=np.float64)
    if action.shape != (count, size):
        raise ConfigError(f"actions of shape {action.shape}; expected {(count, size)}")
    finite = np.isfinite(action)
    if not finite.all():
        row = int(np.argmin(finite.all(axis=1)))
        raise ConfigError(f"action {action[row].tolist()} of environment {row}; expected {size} finite numbers")
    return np.clip(action, -1.0, 1.0)


def _thrust_n(action: Array, quadrotor: Quadrotor) -> Array:
    """Return collective thrusts (n,) [N] of actions (n,)."""
    per_square = quadrotor.rotor_count * quadrotor.thrust_n_per_rad2_s2
    hover, fastest = quadrotor.hover_speed_rad_s, quadrotor.rotor_speed_max_rad_s
    return np.interp(action, [-1.0, 0.0, 1.0], [0.0, per_square * hover**2, per_square * fastest**2])


def _yaw_rate(action: Array, R_desired: Array, limits: ActionLimits) -> Array:
    """Return angular velocities (n, 3) about the vertical, in the frames of desired attitudes [rad/s]."""
    return np.asarray(R_desired[:, 2] * (limits.yaw_rate_rad_s * action)[:, None])


def _yaw_rad(R: Array) -> Array:
    """Return yaws (n,) [rad] of attitudes (n, 3, 3), the inverse of `attitude_along` for upright vehicles.

    The heading is the horizontal direction in the plane of the vehicle's x and z axes.
    """
    x, z = R[..., 0], R[..., 2]
    heading = x[..., :2] * z[..., 2:] - z[..., :2] * x[..., 2:]
    return np.arctan2(heading[..., 1], heading[..., 0])


def _turned(vectors: Array, yaw_rad: Array) -> Array:
    """Return vectors (n, 3) turned about the vertical by angles (n,) [rad]."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, vectors[:, 2]], axis=1)


def merged(mask: Mask, new: Any, old: Any) -> Any:
    """Return nested tuples of arrays whose rows in a mask (n,) are new and whose other rows are old."""
    if isinstance(new, tuple):
        parts = (merged(mask, a, b) for a, b in zip(new, old, strict=True))
        return type(new)(*parts) if new else new
    return np.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)
