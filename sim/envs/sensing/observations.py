"""Observations by name: the space of each, and the function from the state of n environments to its values.

| name | shape | content |
|---|---|---|
| ``position`` | (3,) | position of the centre of mass relative to the current goal, in the world frame [m] |
| ``height`` | (1,) | height of the centre of mass above the floor [m] |
| ``orientation`` | (4,) | quaternion wxyz, vehicle to world, w ≥ 0 |
| ``rotation`` | (3, 3) | rotation matrix, vehicle to world |
| ``velocity`` | (3,) | velocity of the centre of mass in the world frame [m/s] |
| ``body_velocity`` | (3,) | velocity of the centre of mass in the vehicle frame [m/s] |
| ``rate`` | (3,) | angular velocity in the vehicle frame [rad/s] |
| ``rotors`` | (R,) | rotor speeds relative to the largest speed |
| ``battery`` | (1,) | charge of the battery, from 1 (full) to 0 (empty) |
| ``imu`` | (N, 6) | IMU samples since the last action in time order, with errors: angular velocity [rad/s] and \
specific force [m/s²] in the IMU frame |
| ``goals`` | (K, 3) | current goal and the following ones relative to the vehicle, in its frame [m] |
| ``gates`` | (K, 4, 3) | corners of the openings of the next gates relative to the vehicle, in its frame [m]; \
only in the task Race |
| ``local_map`` | (L, N, N) | cells of the map around the vehicle: 0 unknown, −1 free, 1 occupied or outside the \
world; layers from below, then cells from behind to ahead and from right to left, by the heading alone |
| ``ranges`` | (R, C) | distances along the beams of a range sensor, with errors, rows from above, columns from the \
left [m] |
| ``last_action`` | (A,) | action of the last step; zeros after a reset |
| ``parameters`` | (14,) | drawn values of the randomization: mass, inertia (3), rotor time constant, thrust and drag \
as factors, wind (3) [m/s], gusts, latency [s], and errors of the IMU as a factor, light |
| ``wind`` | (3,) | velocity of the air at the vehicle in the world frame [m/s] |
| ``imu_bias`` | (6,) | biases of gyroscope [rad/s] and accelerometer [m/s²] in the IMU frame |
| ``grey`` | (H, W, 1) uint8 | grey image of the observed camera |
| ``rgb`` | (H, W, 3) uint8 | colour image of the observed camera |
| ``depth`` | (H, W, 1) float32 | depth along the optical axis of the observed camera [m] |
| ``segmentation`` | (H, W, 1) int32 | number of the object that the observed camera sees at each pixel, 0 for none; \
`dronevio.sim.envs.sensing.world_objects` has names and kinds |
| ``flow`` | (H, W, 2) float32 | motion of the visible surfaces since the previous image of the observed camera, to \
the right and down [px]; 0 in the first image (`dronevio.sim.envs.sensing.image_flow`) |

The observed camera is that of the argument ``camera``. A name such as ``grey:1`` is the image of the camera 1 of the
rig: ``("grey:0", "grey:1")`` are stereo images.

All but images are float32. They are true values, except for ``imu`` and ``ranges``, which have errors; with an
estimator, the policy sees estimated ones, except for ``rotors``, ``battery``, ``ranges``, ``parameters`` and ``wind``
(`dronevio.sim.envs.sensing.estimation`). The vehicle frame is x forward, y left, z up. Values are clipped to the bounds
of their spaces. Images are those of `dronevio.sim.envs.sensing.camera_observation`, maps those of
`dronevio.sim.envs.sensing.ray_maps`, ranges those of `dronevio.sim.envs.sensing.range_beams`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.camera_observation import IMAGES
from dronevio.sim.envs.sensing.range_beams import DEFAULT_BEAMS, BeamSettings
from dronevio.sim.envs.tasks.task import Objective
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import VehicleStates

Array32 = npt.NDArray[np.float32]

GYRO_RANGE_RAD_S = float(np.radians(1000.0))
"""Bound of observed angular velocities [rad/s], the measurement range of the ADIS16448."""
ACCEL_RANGE_M_S2 = 18.0 * 9.81
"""Bound of observed specific forces [m/s²], the measurement range of the ADIS16448."""
FASTEST_M_S = 30.0
"""Bound of observed velocities [m/s]."""

_IMU_RANGE = np.repeat([GYRO_RANGE_RAD_S, ACCEL_RANGE_M_S2], 3)
_BIAS_RANGE = np.repeat([1.0, 10.0], 3)
_PHYSICAL = ("mass", "inertia", "rotor_time_constant", "thrust", "drag", "wind_m_s", "gusts")
_PARAMETERS = (*_PHYSICAL, "latency_s", "imu_errors", "light")
_PARAMETERS_WIDTH, _PARAMETERS_BOUND = 14, 100.0
_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])  # along the opening's width and height


@dataclass(frozen=True, eq=False)
class ObservedState:
    """State from which the observations of n environments are computed."""

    states: VehicleStates
    """States of the vehicles, true or estimated."""
    objective: Objective
    """Current and following goals."""
    imu: Array
    """(n, N, 6) IMU samples since the last action."""
    imu_bias: Array
    """(n, 6) Biases of the IMUs."""
    wind_m_s: Callable[[], Array]
    """Function that returns the velocities (n, 3) of the air in the world frame [m/s]."""
    last_action: Array
    """(n, A) Actions of the last step."""
    randomized: RandomizedParameters
    """Randomized parameters of the episodes."""
    map_around: Callable[[VehicleStates], Array] | None = None
    """Function that returns the parts (n, L, N, N) of the maps around vehicles; None without maps."""
    ranges_m: Array | None = None
    """(n, R, C) Newest measurements of the range sensors [m]; None without one."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Sizes and bounds of observations, which depend on the environment."""

    reach_m: float
    """Bound of relative positions [m]."""
    height_m: float
    """Bound of heights above the floor [m]."""
    floor_m: float
    """Height of the floor in the world [m]."""
    rotors: int
    """Number of rotors."""
    rotor_speed_rad_s: float
    """Largest rotor speed [rad/s]."""
    action_size: int
    """Number of the numbers of an action."""
    samples: int
    """Number of IMU samples per action."""
    goals: int
    """Number of observed goals."""
    has_gates: bool
    """Whether the goals are gates."""
    map_shape: tuple[int, ...] = ()
    """Shape of the observed part of a map; empty without one."""
    beams: BeamSettings = DEFAULT_BEAMS
    """Settings of the range sensor."""


def limits_of(
    areas: Sequence[FlightArea],
    objective: Objective,
    quadrotor: Quadrotor,
    samples: int,
    action_size: int,
    map_shape: tuple[int, ...] = (),
    beams: BeamSettings = DEFAULT_BEAMS,
) -> Limits:
    """Return the sizes and bounds of observations.

    Args:
        areas: The worlds, whose floors have one height.
        objective: Goals of any number of vehicles.
        quadrotor: The type of the vehicles.
        samples: Number of IMU samples per action.
        action_size: Number of the numbers of an action.
        map_shape: Shape of the observed part of a map; empty without one.
        beams: Settings of the range sensor.
    """
    extents = np.max([area.space.high - area.space.low for area in areas], axis=0)
    return Limits(
        reach_m=float(np.linalg.norm(extents)),
        height_m=float(extents[2]),
        floor_m=float(areas[0].pad[2]),
        rotors=quadrotor.rotor_count,
        rotor_speed_rad_s=quadrotor.rotor_speed_max_rad_s,
        action_size=action_size,
        samples=samples,
        goals=objective.position_m.shape[1],
        has_gates=bool(objective.size_m.any()),
        map_shape=map_shape,
        beams=beams,
    )


@dataclass(frozen=True, eq=False)
class Observation:
    """One named observation."""

    space: spaces.Box
    """Space of one environment, of type float32."""
    values: Callable[[ObservedState], Array]
    """Function that returns the values of n environments, before clipping."""

    def observe(self, state: ObservedState) -> Array32:
        """Return the values of n environments within the space."""
        return np.clip(self.values(state), self.space.low, self.space.high).astype(np.float32)


@dataclass(frozen=True, eq=False)
class OwnObservation:
    """An observation of one's own.

    ```python
    def tilt_rad(state: ObservedState) -> Array:
        return np.arccos(state.states.R_world_vehicle[:, 2, 2:])

    gymnasium.make(id, observations=("goals", OwnObservation("tilt", (1,), 0.0, np.pi, tilt_rad)))
    ```
    """

    name: str
    """Name, which no other observation has."""
    shape: tuple[int, ...]
    """Shape of the values of one environment."""
    low: npt.ArrayLike
    """Lower bound, which is broadcast to the shape."""
    high: npt.ArrayLike
    """Upper bound, which is broadcast to the shape."""
    values: Callable[[ObservedState], Array]
    """Function that returns the values (n, …) of n environments, which are clipped to the bounds."""

    def __post_init__(self) -> None:
        """Check name and bounds.

        Raises:
            ConfigError: The name is that of another observation, or the bounds do not fit the shape or are no range.
        """
        if self.name in NAMES or self.name in IMAGES or not self.name.isidentifier():
            raise ConfigError(f"own observation {self.name!r}; expected an identifier that names no other observation")
        try:
            low, high = (np.broadcast_to(np.asarray(bound, np.float64), self.shape) for bound in (self.low, self.high))
        except ValueError:
            raise ConfigError(f"bounds of the observation {self.name!r} do not fit its shape {self.shape}") from None
        if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
            raise ConfigError(f"bounds of the observation {self.name!r}; expected finite ones, low < high")

    def observation(self) -> Observation:
        """Return the observation, whose values are checked."""
        return Observation(_box(self.shape, self.low, self.high), self._checked)

    def _checked(self, state: ObservedState) -> Array:
        """Return the values of n environments.

        Raises:
            ConfigError: They have another shape or are not finite.
        """
        values, shape = np.asarray(self.values(state), dtype=np.float64), (len(state.last_action), *self.shape)
        if values.shape != shape:
            raise ConfigError(f"values of the observation {self.name!r} of shape {values.shape}; expected {shape}")
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))
            raise ConfigError(f"observation {self.name!r} of environment {row}: {values[row]}; expected finite values")
        return values


def observation_named(name: str, limits: Limits) -> Observation:
    """Return the observation with a given name.

    Raises:
        ConfigError: There is no such observation, or the task has no gates.
    """
    if name not in NAMES:
        raise ConfigError(f"unknown observation {name!r}; expected some of {', '.join((*NAMES, *IMAGES))}")
    return NAMES[name](limits)


def _box(shape: tuple[int, ...], low: npt.ArrayLike, high: npt.ArrayLike) -> spaces.Box:
    """Return a space of float32 with bounds that are broadcast to a shape."""
    low32, high32 = (np.broadcast_to(np.asarray(bound, np.float32), shape).copy() for bound in (low, high))
    return spaces.Box(low32, high32, shape, np.float32)


def _symmetric(shape: tuple[int, ...], bound: npt.ArrayLike) -> spaces.Box:
    """Return a space of float32 from minus to plus a bound."""
    return _box(shape, -np.asarray(bound), bound)


def _position(limits: Limits) -> Observation:
    return Observation(_symmetric((3,), limits.reach_m), lambda s: s.states.position_m - s.objective.position_m[:, 0])


def _height(limits: Limits) -> Observation:
    floor = limits.floor_m
    return Observation(_symmetric((1,), limits.height_m), lambda s: s.states.position_m[:, 2:] - floor)


def _orientation(limits: Limits) -> Observation:
    return Observation(_symmetric((4,), 1.0), lambda s: quat_wxyz_from_matrix(s.states.R_world_vehicle))


def _rotation(limits: Limits) -> Observation:
    return Observation(_symmetric((3, 3), 1.0), lambda s: s.states.R_world_vehicle)


def _velocity(limits: Limits) -> Observation:
    return Observation(_symmetric((3,), FASTEST_M_S), lambda s: s.states.velocity_m_s)


def _body_velocity(limits: Limits) -> Observation:
    return Observation(
        _symmetric((3,), FASTEST_M_S), lambda s: _in_vehicle(s.states, s.states.velocity_m_s[:, None])[:, 0]
    )


def _rate(limits: Limits) -> Observation:
    return Observation(_symmetric((3,), GYRO_RANGE_RAD_S), lambda s: s.states.rate_rad_s)


def _rotors(limits: Limits) -> Observation:
    fastest = limits.rotor_speed_rad_s
    return Observation(_box((limits.rotors,), 0.0, 1.0), lambda s: s.states.rotor_speed_rad_s / fastest)


def _battery(limits: Limits) -> Observation:
    return Observation(_box((1,), 0.0, 1.0), lambda s: s.states.battery_charge[:, None])


def _imu(limits: Limits) -> Observation:
    return Observation(_symmetric((limits.samples, 6), _IMU_RANGE), lambda s: s.imu)


def _goals(limits: Limits) -> Observation:
    def values(s: ObservedState) -> Array:
        return _in_vehicle(s.states, s.objective.position_m - s.states.position_m[:, None])

    return Observation(_symmetric((limits.goals, 3), limits.reach_m), values)


def _gates(limits: Limits) -> Observation:
    if not limits.has_gates:
        raise ConfigError("observation 'gates' of a task without gates; expected the task 'race'")

    def values(s: ObservedState) -> Array:
        ahead, middle = s.objective.direction, s.objective.position_m
        side = np.stack([-ahead[..., 1], ahead[..., 0], np.zeros_like(ahead[..., 0])], axis=-1)
        across, up = (_CORNERS * s.objective.size_m[..., None, None]).transpose(3, 0, 1, 2)
        corners = middle[:, :, None] + across[..., None] * side[:, :, None]
        corners[..., 2] += up
        relative = corners - s.states.position_m[:, None, None]
        return _in_vehicle(s.states, relative.reshape(len(relative), -1, 3)).reshape(relative.shape)

    return Observation(_symmetric((limits.goals, 4, 3), limits.reach_m), values)


def _local_map(limits: Limits) -> Observation:
    def values(s: ObservedState) -> Array:
        assert s.map_around is not None  # environments have maps where one is observed
        return s.map_around(s.states)

    return Observation(_symmetric(limits.map_shape, 1.0), values)


def _ranges(limits: Limits) -> Observation:
    def values(s: ObservedState) -> Array:
        assert s.ranges_m is not None  # environments have range sensors where one is observed
        return s.ranges_m

    return Observation(_box(limits.beams.shape, 0.0, limits.beams.reach_m), values)


def _last_action(limits: Limits) -> Observation:
    return Observation(_symmetric((limits.action_size,), 1.0), lambda s: s.last_action)


def _parameters(limits: Limits) -> Observation:
    def values(s: ObservedState) -> Array:
        n = len(s.last_action)
        return np.concatenate([getattr(s.randomized, name).reshape(n, -1) for name in _PARAMETERS], axis=1)

    return Observation(_symmetric((_PARAMETERS_WIDTH,), _PARAMETERS_BOUND), values)


def _wind(limits: Limits) -> Observation:
    return Observation(_symmetric((3,), FASTEST_M_S), lambda s: s.wind_m_s())


def _imu_bias(limits: Limits) -> Observation:
    return Observation(_symmetric((6,), _BIAS_RANGE), lambda s: s.imu_bias)


def _in_vehicle(states: VehicleStates, vectors: Array) -> Array:
    """Return vectors (n, K, 3) of the world frame in the frames of the vehicles."""
    return np.asarray(vectors @ states.R_world_vehicle)


NAMES: dict[str, Callable[[Limits], Observation]] = {
    "position": _position,
    "height": _height,
    "orientation": _orientation,
    "rotation": _rotation,
    "velocity": _velocity,
    "body_velocity": _body_velocity,
    "rate": _rate,
    "rotors": _rotors,
    "battery": _battery,
    "imu": _imu,
    "goals": _goals,
    "gates": _gates,
    "local_map": _local_map,
    "ranges": _ranges,
    "last_action": _last_action,
    "parameters": _parameters,
    "wind": _wind,
    "imu_bias": _imu_bias,
}
"""Functions that make the observations other than images, by name."""
