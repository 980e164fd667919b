"""Environment Hover: bring a disturbed quadrotor to a point in a room and keep it there."""

from collections.abc import Mapping
from typing import Any, SupportsFloat, TypeVar

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import NavState
from dronevio.sim.chase_camera import ChaseCamera, lease_chase_camera
from dronevio.sim.envs.camera_observation import (
    CameraObservation,
    ImageSettings,
    NoCameraObservation,
    RenderedObservation,
)
from dronevio.sim.inertial.imu import ImuErrors
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.props.room import FREE_BOX_M
from dronevio.sim.rendering.shared import Lease
from dronevio.sim.rendering.window import Window, has_display, require_display

Array = npt.NDArray[np.float64]
Observation = dict[str, npt.NDArray[Any]]
_Content = TypeVar("_Content")

TARGET_M = np.array([0.0, 0.0, 1.2])
"""(3,) Target position of the centre of mass in the world frame [m]."""
STEPS_PER_S = 50
"""Number of actions per second."""
GYRO_RANGE_RAD_S = float(np.radians(1000.0))
"""Measurement range of the gyroscope [rad/s] (data sheet of the ADIS16448)."""
ACCEL_RANGE_M_S2 = 18.0 * 9.81
"""Measurement range of the accelerometer [m/s²] (data sheet of the ADIS16448)."""

_FARTHEST_M, _FASTEST_M_S = 5.0, 20.0  # bounds of the observation, beyond those of an episode
_WORLD = "room"
_IMAGES = ImageSettings(width=188, height=120)
_START_OFFSET_M, _START_SPEED_M_S, _START_TILT_RAD, _START_RATE_RAD_S = 0.5, 0.5, 0.2, 0.5
_CRASH_HEIGHT_M = 0.03  # above the height of the standing drone
_REWARD_DISTANCE_M, _REWARD_RATE_RAD_S = 0.5, 5.0


class Hover(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """Bring a disturbed quadrotor to a point 1.2 m above the floor and keep it there.

    ## Description
    A quadrotor of 1.5 kg (`dronevio.models.quadrotor.Quadrotor`) in MuJoCo, with a rotor lag of 30 ms, thrust and
    torque proportional to the square of the rotor speed, drag, ground effect, and a battery whose voltage sags. It
    starts in the air near the target, with random velocity and tilt, its rotors at hover speed. The agent commands the
    speeds of the four rotors 50 times per second. It observes the true state and the samples of an IMU with errors;
    with ``camera=True`` it also observes an image, so that the position can be removed from the observation and
    estimated from images.

    ## Action space
    ``Box(-1, 1, (4,), float32)``: the speed of each rotor. −1 is standstill, 0 the hover speed and 1 the largest speed,
    with linear interpolation between them. The order is front right, rear left, front left, rear right; the first two
    turn anticlockwise seen from above.

    ## Observation space
    A ``Dict`` of ``Box`` (flatten it with `gymnasium.wrappers.FlattenObservation`):

    | key | shape | content |
    |---|---|---|
    | ``position`` | (3,) float32 | position of the centre of mass relative to the target, in the world frame [m] |
    | ``orientation`` | (4,) float32 | quaternion wxyz, vehicle (x forward, y left, z up) to world, w ≥ 0 |
    | ``velocity`` | (3,) float32 | velocity of the centre of mass in the world frame [m/s] |
    | ``rotors`` | (4,) float32 | rotor speeds relative to the largest speed |
    | ``imu`` | (4, 6) float32 | the samples since the last action, at 200 Hz, in time order: angular velocity [rad/s] \
and specific force [m/s²] in the IMU's frame, with noise and biases |
    | ``image`` | (120, 188, 1) uint8 | grey image of the forward camera; only with ``camera=True`` |

    State and rotor speeds are true values; the IMU samples have errors. The IMU frame has x up, y right and z forward,
    as in EuRoC. After a reset all rows of ``imu`` contain the sample of the start.

    ## Reward
    exp(−d / 0.5 m) · exp(−|ω| / 5 rad/s) per step, with the distance d from the target and the true angular velocity ω:
    1 at perfect hover and never negative, so that staying in the air is always rewarded.

    ## Starting state
    Uniform: position within ±0.5 m of the target and velocity within ±0.5 m/s on each axis, a rotation vector within
    ±0.2 rad and an angular velocity within ±0.5 rad/s on each axis. The IMU biases are drawn at each reset.

    ## Episode end
    Terminated when the drone comes within 3 cm of standing on the floor, leaves the room's free space (5.6 × 3.8 × 2.4
    m), or tilts by more than 90°. Truncated after 500 steps, 10 s, by `gymnasium.make`.

    ## Arguments
    ``camera`` adds the image, which takes about 10 ms per step without a GPU. ``world_seed`` is the seed of the room in
    images and renderings. With ``render_mode="rgb_array"``, `render` returns an RGB image (480, 640, 3) of the drone
    from a chase camera; with ``render_mode="human"``, `reset` and `step` show these images in a window, in real time.
    The first image of a process takes seconds, in which the room is built, and requires off-screen OpenGL (``dronevio
    doctor`` checks it); later environments share the room.

    ```python
    import gymnasium

    env = gymnasium.make("dronevio.envs:dronevio/Hover-v0")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    ```

    ``info`` has ``distance_m`` (from the target) and ``t_ns`` (time since the reset). The same seed and the same
    actions give the same bytes.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": STEPS_PER_S}  # noqa: RUF012 as Gymnasium declares it

    def __init__(self, render_mode: str | None = None, camera: bool = False, world_seed: int = 0) -> None:
        """Build the physics; the renderers are built when they are first used.

        Args:
            render_mode: None, ``rgb_array`` or ``human``.
            camera: Whether observations contain an image.
            world_seed: Seed of the room.

        Raises:
            ConfigError: The render mode is unknown.
            GraphicsError: The render mode is ``human``, and there is no display.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render mode {render_mode!r}; expected None, 'rgb_array' or 'human'")
        if render_mode == "human":
            require_display()
        if not has_display():  # Gymnasium's `check_env` tries all modes
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self.render_mode = render_mode
        self._world_seed = world_seed
        self._rig = euroc_rig()
        self._plant = QuadrotorPlant(self._rig)
        self._quadrotor = self._plant.quadrotor
        self._interval_ns = round(1e9 / STEPS_PER_S)
        self._samples = self._interval_ns // self._plant.interval_ns
        self._errors = ImuErrors(self._rig.imu, self.np_random)
        self._camera_observation: CameraObservation = (
            RenderedObservation(self._rig.cameras[0], _WORLD, world_seed, _IMAGES) if camera else NoCameraObservation()
        )
        self._chase_camera: Lease[ChaseCamera] | None = None
        self._window: Window | None = None
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space: spaces.Space[Observation] = spaces.Dict(  # type: ignore[assignment]
            {**_sensed_spaces(self._samples), **_named(self._camera_observation.spaces())}
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of all random numbers from now on; None continues the current stream.
            options: Not used.

        Returns:
            The first observation and the info dictionary.
        """
        super().reset(seed=seed)
        rng = self.np_random
        position = TARGET_M + _START_OFFSET_M * rng.uniform(-1.0, 1.0, 3)
        R = exp_so3(_START_TILT_RAD * rng.uniform(-1.0, 1.0, 3))
        self._plant.reset(
            pose_matrix(R, position),
            _START_SPEED_M_S * rng.uniform(-1.0, 1.0, 3),
            _START_RATE_RAD_S * rng.uniform(-1.0, 1.0, 3),
            np.full(4, self._quadrotor.hover_speed_rad_s),
        )
        self._errors = ImuErrors(self._rig.imu, rng)
        first, _, _ = self._errors.add_to(self._plant.step_until(0, np.zeros(4)))
        state = self._plant.vehicle_state()
        if self.render_mode == "human":
            self.render()
        return self._observe(state, first), _info(state)

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Apply an action (4,) for 20 ms.

        Returns:
            Observation, reward, terminated, truncated (always False: time limits are wrappers) and the info dictionary.

        Raises:
            ConfigError: The action is not four finite numbers.
        """
        command = self._rotor_speeds(np.asarray(action, dtype=np.float64))
        samples, _, _ = self._errors.add_to(self._plant.step_until(self._plant.t_ns + self._interval_ns, command))
        state = self._plant.vehicle_state()
        if self.render_mode == "human":
            self.render()
        return self._observe(state, samples), _reward(state), self._ended(state), False, _info(state)

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Return an RGB image (480, 640, 3) from the chase camera, or show it; None without a render mode.

        With ``render_mode="human"``, `reset` and `step` show the images in a window, in real time.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        if self.render_mode is None:
            return None
        if self._chase_camera is None:
            self._chase_camera = lease_chase_camera(_WORLD, self._world_seed, self._quadrotor, self._rig)
        image = self._chase_camera.value.render(self._plant.vehicle_state().T_world_imu)
        if self.render_mode == "rgb_array":
            return image
        if self._window is None:
            self._window = Window(image.shape[1], image.shape[0], "dronevio", STEPS_PER_S)
        self._window.show(image)
        return None

    def close(self) -> None:
        """Release the renderers and close the window; further calls have no effect."""
        self._camera_observation.close()
        if self._chase_camera is not None:
            self._chase_camera.release()
            self._chase_camera = None
        if self._window is not None:
            self._window.close()
            self._window = None

    def _rotor_speeds(self, action: Array) -> Array:
        """Return the rotor speeds (4,) [rad/s] of an action (4,).

        Raises:
            ConfigError: The action is not four finite numbers.
        """
        if action.shape != (4,) or not np.all(np.isfinite(action)):
            raise ConfigError(f"action {action.tolist()}; expected four finite numbers")
        hover, fastest = self._quadrotor.hover_speed_rad_s, self._quadrotor.rotor_speed_max_rad_s
        return np.interp(action, [-1.0, 0.0, 1.0], [0.0, hover, fastest])

    def _observe(self, state: NavState, samples: ImuSamples) -> Observation:
        """Return the observation of a state and of the IMU samples of the last step."""
        imu = np.hstack([samples.gyro_rad_s, samples.accel_m_s2])
        values: dict[str, Array] = {
            "position": state.T_world_imu[:3, 3] - TARGET_M,
            "orientation": quat_wxyz_from_matrix(state.T_world_imu[:3, :3]),
            "velocity": state.velocity_m_s,
            "rotors": self._plant.rotor_speeds_rad_s / self._quadrotor.rotor_speed_max_rad_s,
            "imu": np.resize(imu, (self._samples, 6)),  # repeats the one sample of a reset
        }
        sensed = {key: np.clip(v, *_BOUNDS[key]).astype(np.float32) for key, v in values.items()}
        T_world_imu = state.T_world_imu @ self._rig.T_vehicle_imu
        images = self._camera_observation.observe(T_world_imu[None])
        return {**sensed, **_named({kind: batch[0] for kind, batch in images.items()})}

    def _ended(self, state: NavState) -> bool:
        """Return whether the drone has crashed, left the free space or tilted by more than 90°."""
        position, up = state.T_world_imu[:3, 3], state.T_world_imu[2, 2]
        outside = np.any(position < FREE_BOX_M[0]) or np.any(position > FREE_BOX_M[1])
        return bool(outside or up < 0.0 or position[2] < self._plant.standing_height_m + _CRASH_HEIGHT_M)


_IMU_RANGE = np.repeat([GYRO_RANGE_RAD_S, ACCEL_RANGE_M_S2], 3)
_BOUNDS: dict[str, tuple[float | Array, float | Array]] = {
    "position": (-_FARTHEST_M, _FARTHEST_M),
    "orientation": (-1.0, 1.0),
    "velocity": (-_FASTEST_M_S, _FASTEST_M_S),
    "rotors": (0.0, 1.0),
    "imu": (-_IMU_RANGE, _IMU_RANGE),
}


def _sensed_spaces(samples: int) -> dict[str, spaces.Space[Any]]:
    """Return the spaces of all entries but the image, for a number of IMU samples per step."""
    shapes = {"position": (3,), "orientation": (4,), "velocity": (3,), "rotors": (4,), "imu": (samples, 6)}
    return {
        key: spaces.Box(_filled(shape, _BOUNDS[key][0]), _filled(shape, _BOUNDS[key][1]), shape, np.float32)
        for key, shape in shapes.items()
    }


def _filled(shape: tuple[int, ...], bound: float | Array) -> npt.NDArray[np.float32]:
    """Return a bound broadcast to the shape of a space."""
    return np.broadcast_to(bound, shape).astype(np.float32)


def _named(images: Mapping[str, _Content]) -> dict[str, _Content]:
    """Return the grey image, or its space, under its name in the observation; nothing without images."""
    return {"image": images["grey"]} if images else {}


def _distance_m(state: NavState) -> float:
    """Return the distance of the vehicle from the target [m]."""
    return float(np.linalg.norm(state.T_world_imu[:3, 3] - TARGET_M))


def _reward(state: NavState) -> float:
    """Return the reward of a state, in [0, 1]."""
    assert state.angular_velocity_rad_s is not None
    rate = float(np.linalg.norm(state.angular_velocity_rad_s))
    return float(np.exp(-_distance_m(state) / _REWARD_DISTANCE_M - rate / _REWARD_RATE_RAD_S))


def _info(state: NavState) -> dict[str, Any]:
    """Return the info dictionary of a state."""
    return {"distance_m": _distance_m(state), "t_ns": state.t_ns}
