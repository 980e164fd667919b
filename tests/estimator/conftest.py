"""Synthetic flights: an analytic path, its IMU, and a front end that observes landmarks instead of images."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import Keyframe, KeyframeResult, KeyframeSmoother
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.protocol import AtExposure
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.keyframe_observer import KeyframeObserver
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.types import Calibration, ExpectedFeatures, Observations, common_rows
from dronevio.models.arrays import Array, Integers
from dronevio.models.camera import CameraModel
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples, Sampling
from dronevio.models.protocols import measurements
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import NO_IMAGE, CameraFrame, Estimate, NavState, Trajectory

Times = npt.NDArray[np.int64]

START_NS = 1_403_715_273_000_000_000
IMU_STEP_NS, FRAME_STEP_NS = 5_000_000, 50_000_000


def seconds(t_ns: Times) -> Array:
    """Return the times (N,) since the start of a flight [s]."""
    return (t_ns - START_NS).astype(np.float64) * 1e-9


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The motion of the IMU at N instants."""

    R: Array
    """(N, 3, 3) Orientations `R_world_imu` over time."""
    p: Array
    """(N, 3) Positions in the world frame [m]."""
    v: Array
    """(N, 3) Velocities in the world frame [m/s]."""
    a: Array
    """(N, 3) Accelerations in the world frame [m/s²]."""
    omega: Array
    """(N, 3) Angular velocities in the IMU frame [rad/s]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Sums of sines for position and for yaw, pitch and roll, as functions of a phase time.

    The phase time is constant at first and then grows smoothly until its rate is 1.
    """

    rest_s: float
    """Time at which the motion begins [s]. If it is negative, the vehicle is already in motion at t = 0."""
    ramp_s: float = 1.5
    """Time in which the rate of the phase time grows from 0 to 1 [s]."""
    positions_m: Array = field(default_factory=lambda: np.array([[1.5, 0.3], [1.3, 0.35], [0.5, 0.2]]))
    """(3, 2) Amplitudes of two sines for each of x, y, z [m]."""
    position_rates: Array = field(default_factory=lambda: np.array([[0.7, 1.9], [0.9, 1.7], [0.8, 2.3]]))
    """(3, 2) Angular frequencies of the sines for x, y, z [rad/s]."""
    angles_rad: Array = field(default_factory=lambda: np.array([[0.9, 0.15], [0.15, 0.08], [0.15, 0.08]]))
    """(3, 2) Amplitudes of two sines for each of yaw, pitch, roll [rad]."""
    angle_rates: Array = field(default_factory=lambda: np.array([[0.5, 1.3], [1.1, 2.7], [0.9, 2.3]]))
    """(3, 2) Angular frequencies of the sines for yaw, pitch, roll [rad/s]."""
    phases: Array = field(default_factory=lambda: np.zeros((2, 3, 2)))
    """(2, 3, 2) Phases of the sines for positions and angles [rad]."""
    R_vehicle_imu: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) Orientation of the IMU in the vehicle frame."""

    def at(self, t_s: Array) -> Kinematics:
        """Return the motion at times (N,) [s]."""
        tau, rate, acceleration = self._phase_time(t_s)
        rate, acceleration = rate[:, None], acceleration[:, None]
        p, dp, ddp = _sines(tau, self.positions_m, self.position_rates, self.phases[0])
        angle, d_angle, _ = _sines(tau, self.angles_rad, self.angle_rates, self.phases[1])
        yaw, pitch, roll = angle.T
        d_yaw, d_pitch, d_roll = (d_angle * rate).T
        z, y, x = np.eye(3)[::-1]
        R = exp_so3(yaw[:, None] * z) @ exp_so3(pitch[:, None] * y) @ exp_so3(roll[:, None] * x)
        omega = np.stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.sin(roll) * np.cos(pitch),
                -d_pitch * np.sin(roll) + d_yaw * np.cos(roll) * np.cos(pitch),
            ],
            axis=1,
        )
        B = self.R_vehicle_imu
        return Kinematics(R @ B, p, dp * rate, ddp * rate**2 + dp * acceleration, omega @ B)

    def _phase_time(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Return the phase time (N,) [s] and its first two derivatives."""
        s = t_s - self.rest_s
        u = np.clip(s / self.ramp_s, 0.0, 1.0)
        tau = self.ramp_s * (u**3 - 0.5 * u**4) + np.maximum(s - self.ramp_s, 0.0)
        return tau, u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u) / self.ramp_s


def _sines(tau: Array, amplitude: Array, rate: Array, phase: Array) -> tuple[Array, Array, Array]:
    """Return sums of sines (N, 3) and their first two derivatives."""
    x = rate * tau[:, None, None] + phase
    return (
        (amplitude * np.sin(x)).sum(axis=2),
        (amplitude * rate * np.cos(x)).sum(axis=2),
        -(amplitude * rate**2 * np.sin(x)).sum(axis=2),
    )


class SyntheticFrontEnd:
    """A `FrontEnd` that observes landmarks with noise; a landmark that was lost gets a new identity."""

    def __init__(self, flight: "SyntheticFlight") -> None:
        self._flight = flight
        self._model = flight.rig.cameras[0].model
        self._rng = np.random.default_rng([flight.seed, 2])
        n = len(flight.landmarks)
        self._ids, self._ages = np.full(n, -1), np.zeros(n, np.int64)
        self._visible = np.zeros(n, dtype=np.bool_)
        self._pixels = np.zeros((n, 2))
        self._next_id = 0
        self._R_world_cam: Array | None = None
        self._has_image = True
        self.prediction_errors_rad: list[float] = []
        """Angle of the error of each predicted rotation [rad]."""

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
    ) -> Observations:
        """Observe the landmarks that are tracked from the previous frame."""
        assert np.allclose(R_cur_prev @ R_cur_prev.T, np.eye(3), atol=1e-9)
        flight = self._flight
        middle_ns = frame.t_ns + round(flight.rig.time_offset_s * 1e9)
        T_world_cam = flight.Ts_world_cam(np.array([middle_ns]))[0]
        if self._R_world_cam is not None:
            error = log_so3(R_cur_prev.T @ T_world_cam[:3, :3].T @ self._R_world_cam)
            self.prediction_errors_rad.append(float(np.linalg.norm(error)))
        self._R_world_cam = T_world_cam[:3, :3]
        self._has_image = all(image.size for image in frame.images)
        if not self._has_image:
            return self._observations()
        p = self._at_exposure(middle_ns)
        pixels = self._model.project(p) + flight.pixel_noise * self._rng.normal(size=(len(p), 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            near_axis = np.linalg.norm(p[:, :2] / p[:, 2:], axis=1) < 1.1  # the distortion is not monotonic further out
        inside = np.all((pixels > 12) & (pixels < [self._model.width - 13, self._model.height - 13]), axis=1)
        self._visible = near_axis & inside & (p[:, 2] > 0.3) & (not flight.is_dark(frame.t_ns))
        self._pixels = pixels
        self._ids[~self._visible] = -1
        self._ages = np.where(self._ids >= 0, self._ages + 1, 0)
        return self._observations()

    def _at_exposure(self, middle_ns: int) -> Array:
        """Return the landmarks (L, 3) in the camera frame at the times when their image rows are exposed [m]."""
        flight, readout_s = self._flight, self._flight.rig.cameras[0].readout_s
        delay_ns, points = np.zeros(len(flight.landmarks), np.int64), flight.landmarks_at(middle_ns)
        for _ in range(5 if readout_s else 1):
            T_cam_world = inverse_pose(flight.Ts_world_cam(middle_ns + delay_ns))
            p = np.einsum("nij,nj->ni", T_cam_world[:, :3, :3], points) + T_cam_world[:, :3, 3]
            row = np.nan_to_num(self._model.project(p)[:, 1]).clip(0.0, self._model.height - 1.0)
            delay_ns = np.rint((row / (self._model.height - 1) - 0.5) * readout_s * 1e9).astype(np.int64)
        return np.asarray(p)

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Observe further visible landmarks, up to the largest number of features."""
        free = np.flatnonzero(self._visible & (self._ids < 0) & self._has_image)
        chosen = free[: max(self._flight.max_features - int((self._ids >= 0).sum()), 0)]
        self._ids[chosen] = self._next_id + np.arange(len(chosen))
        self._ages[chosen] = 1
        self._next_id += len(chosen)
        return self._observations()

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking features (N,)."""
        self._ids[np.isin(self._ids, ids)] = -1  # it may be detected again, as in an image

    @property
    def landmark_rows(self) -> Integers:
        """(N,) Rows of the observed landmarks, in the order of the observations."""
        return self._known_rows if self._has_image else self._known_rows[:0]

    @property
    def _known_rows(self) -> Integers:
        """(N,) Rows of the landmarks that have been observed and not lost, in the order of their identities."""
        rows = np.flatnonzero(self._ids >= 0)
        return np.asarray(rows[np.argsort(self._ids[rows])])

    def _observations(self) -> Observations:
        rows = self.landmark_rows
        pixels = self._pixels[rows]
        return Observations(self._ids[rows], pixels, self._model.normalize(pixels), self._ages[rows])


class VerifyingFrontEnd(SyntheticFrontEnd):
    """A synthetic front end that verifies images: a landmark is found where it is expected within two pixels."""

    def __init__(self, flight: "SyntheticFlight") -> None:
        super().__init__(flight)
        self.verified_ns: list[int] = []
        """Times of the frames that are verified [ns]."""
        self.expected_ns: list[int] = []
        """Times of the frames that are tracked from where features are expected [ns]."""

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
        expected: ExpectedFeatures | None = None,
    ) -> Observations:
        """Observe the landmarks that are tracked from the previous frame, wherever they are expected."""
        if expected is not None:
            self.expected_ns.append(frame.t_ns)
        return super().track(frame, R_cur_prev, rotation_sigma_rad, calibration)

    def verified(
        self,
        frame: CameraFrame,
        expected: ExpectedFeatures,
        R_cur_prev: Array,
        calibration: Calibration | None = None,
    ) -> Observations | None:
        """Return the landmarks that are observed where they are expected, if these are most of all."""
        rows = self._known_rows
        columns, known = common_rows(expected.ids, self._ids[rows])
        p = self._at_exposure(frame.t_ns + round(self._flight.rig.time_offset_s * 1e9))[rows[known]]
        pixels = self._model.project(expected.rays[0, columns])
        is_found = np.linalg.norm(pixels - self._model.project(p), axis=1) < 2.0
        if len(known) < 20 or is_found.mean() < 0.8:
            return None
        self.verified_ns.append(frame.t_ns)
        found, pixels = rows[known][is_found], pixels[is_found]
        return Observations(self._ids[found], pixels, self._model.normalize(pixels), self._ages[found])


@dataclass(frozen=True, eq=False)
class SyntheticFlight:
    """A recording without images, which satisfies the `Recording` protocol."""

    motion: Motion
    """The true motion of the IMU."""
    duration_s: float
    """Time of the last frame [s]."""
    seed: int
    """Seed of all random numbers."""
    rig: Rig
    """Calibration of the cameras and the IMU."""
    landmarks: Array
    """(L, 3) Positions of the landmarks in the world frame [m]."""
    imu_noise: float = 1.0
    """Factor on the noise densities of the rig's IMU."""
    pixel_noise: float = 0.2
    """Standard deviation of the observations [px]."""
    max_features: int = 60
    """Largest number of features in a frame."""
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) Gyroscope bias in the vehicle frame [rad/s]."""
    accel_bias: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) Accelerometer bias in the vehicle frame [m/s²]."""
    sampling: Sampling = "point"
    """What an IMU sample measures: "point" or "increment"."""
    dark_s: tuple[float, float] = (0.0, 0.0)
    """Begin and end of the time without any visible landmark [s]."""
    gravity_m_s2: float = GRAVITY_M_S2
    """Magnitude of gravity [m/s²]."""
    missing: frozenset[int] = frozenset()
    """Indices of the frames that have no image."""
    moving_share: float = 0.0
    """Share of the landmarks that move, up to 1."""
    name: str = "synthetic"
    """Name of the recording."""
    ground_truth: Trajectory | None = None
    """Always None; see `truth_at` for the true states."""

    @cached_property
    def imu(self) -> ImuSamples:
        """All samples; white noise is drawn in the vehicle frame and so is independent of the IMU's orientation."""
        n = int(self.duration_s * 1e9) // IMU_STEP_NS + 1
        t_ns = START_NS + IMU_STEP_NS * np.arange(n)
        k, gravity = self.motion.at(seconds(t_ns)), np.array([0.0, 0.0, -self.gravity_m_s2])
        gyro, accel = k.omega, np.einsum("nji,nj->ni", k.R, k.a - gravity)
        if self.sampling == "increment":
            dt = IMU_STEP_NS * 1e-9
            before = self.motion.at(seconds(t_ns) - dt)
            gyro = log_so3(np.swapaxes(before.R, 1, 2) @ k.R) / dt
            accel = np.einsum("nji,nj->ni", before.R, (k.v - before.v) / dt - gravity)
        rng = np.random.default_rng([self.seed, 1])
        B, model, root_rate = self.motion.R_vehicle_imu, self.rig.imu, np.sqrt(1e9 / IMU_STEP_NS)
        gyro_noise = rng.normal(size=(n, 3)) * self.imu_noise * model.gyro_noise_density * root_rate
        accel_noise = rng.normal(size=(n, 3)) * self.imu_noise * model.accel_noise_density * root_rate
        return ImuSamples(
            t_ns, gyro + (gyro_noise + self.gyro_bias) @ B, accel + (accel_noise + self.accel_bias) @ B, self.sampling
        )

    @cached_property
    def frame_times_ns(self) -> Times:
        """(N,) Time stamps of the frames [ns]."""
        return START_NS + FRAME_STEP_NS * np.arange(int(self.duration_s * 1e9) // FRAME_STEP_NS + 1)

    def frame(self, index: int) -> CameraFrame:
        """Return a frame by its index, without images, of which `NO_IMAGE` marks the missing ones."""
        return CameraFrame(int(self.frame_times_ns[index]), (NO_IMAGE,) if index in self.missing else ())

    def is_dark(self, t_ns: int) -> bool:
        """Return whether no landmark is visible at a time [ns]."""
        return self.dark_s[0] <= (t_ns - START_NS) * 1e-9 < self.dark_s[1]

    def landmarks_at(self, t_ns: int) -> Array:
        """Return the positions (L, 3) of the landmarks in the world frame [m]."""
        n = len(self.landmarks)
        moving = np.random.default_rng([self.seed, 3]).random(n) < self.moving_share
        displacement_m = 0.5 * np.sin((t_ns - START_NS) * 1e-9 + np.arange(n))
        return np.asarray(self.landmarks + (moving * displacement_m)[:, None])

    def truth_at(self, t_ns: Times) -> Trajectory:
        """Return the true states at times (N,) [ns], without covariances."""
        k = self.motion.at(seconds(t_ns))
        n, B = len(t_ns), self.motion.R_vehicle_imu
        biases = np.tile(self.gyro_bias @ B, (n, 1)), np.tile(self.accel_bias @ B, (n, 1))
        return Trajectory(t_ns, k.p, quat_wxyz_from_matrix(k.R), k.v, *biases)

    def state_at(self, t_ns: int) -> NavState:
        """Return the true state at a time [ns], without a covariance."""
        k, B = self.motion.at(np.array([(t_ns - START_NS) * 1e-9])), self.motion.R_vehicle_imu
        return NavState(t_ns, pose_matrix(k.R, k.p)[0], k.v[0], self.gyro_bias @ B, self.accel_bias @ B)

    def Ts_world_cam(self, t_ns: Times) -> Array:
        """Return the true poses (N, 4, 4) of the first camera at times (N,) [ns]."""
        k = self.motion.at(seconds(t_ns))
        return np.asarray(pose_matrix(k.R, k.p) @ self.rig.cameras[0].T_imu_cam)

    def front_end(self) -> SyntheticFrontEnd:
        """Return a new front end that observes the landmarks of the flight."""
        return SyntheticFrontEnd(self)

    def cut_after(self, frames: int) -> "SyntheticFlight":
        """Return the same flight, with the same noise, up to some number of frames."""
        flight = replace(self, duration_s=(frames - 1) * FRAME_STEP_NS * 1e-9)
        whole = self.imu.up_to(int(self.frame_times_ns[frames - 1]))
        flight.__dict__.update(imu=whole, frame_times_ns=self.frame_times_ns[:frames])
        return flight

    def run(
        self,
        front_end: SyntheticFrontEnd | None = None,
        config: VioConfig | None = None,
        observer: KeyframeObserver | None = None,
    ) -> list[Estimate]:
        """Return the odometry's estimate for each frame."""
        vio = VisualInertialOdometry(self.rig, config, front_end or self.front_end(), observer)
        estimates = []
        for measurement in measurements(self):
            if isinstance(measurement, ImuSamples):
                vio.add_imu(measurement)
            else:
                estimates.append(vio.add_frame(measurement))
        return estimates


def room(rng: np.random.Generator, n: int = 1200) -> Array:
    """Return landmarks (n, 3) on the six sides of a room of 9 × 9 × 5 m around the origin."""
    half = np.array([4.5, 4.5, 2.5])
    points = rng.uniform(-1.0, 1.0, (n, 3))
    side = rng.integers(0, 3, n)
    points[np.arange(n), side] = np.where(rng.random(n) < 0.5, -1.0, 1.0)
    return np.asarray(points * half)


@pytest.fixture(scope="session")
def known_calibration() -> VioConfig:
    """Settings by which the given calibration is exact, so that states are as uncertain as the smoother states."""
    c = VioConfig()
    parts = "time_offset", "rotation", "gravity", "focal", "principal", "radial"
    off = {part: replace(getattr(c.calibration, part), online=False) for part in parts}
    return replace(c, calibration=replace(c.calibration, **off))


@pytest.fixture(scope="session")
def make_flight() -> Callable[..., SyntheticFlight]:
    """Return a function that creates flights; with ``rest_s`` < 0 the drone is in motion when the recording begins."""

    def make(
        seed: int = 0,
        rest_s: float = 1.5,
        duration_s: float = 12.0,
        R_mount: Array | None = None,
        noisy: bool = True,
        motion: dict[str, Any] | None = None,
        **settings: Any,
    ) -> SyntheticFlight:
        rng = np.random.default_rng(seed)
        rig = euroc_rig()
        if R_mount is not None:  # rotate the IMU in the vehicle; the camera's pose in the vehicle is the same
            T_imu_new = pose_matrix(R_mount, np.zeros(3))
            camera = replace(rig.cameras[0], T_imu_cam=inverse_pose(T_imu_new) @ rig.cameras[0].T_imu_cam)
            rig = replace(rig, cameras=(camera,), T_vehicle_imu=rig.T_vehicle_imu @ T_imu_new)
        phases = rng.uniform(0.0, 2.0 * np.pi, (2, 3, 2))
        motion = {"phases": phases, "R_vehicle_imu": rig.T_vehicle_imu[:3, :3], **(motion or {})}
        landmarks = room(rng)
        biases = {
            "gyro_bias": noisy * rig.imu.gyro_turn_on_bias_rad_s * rng.normal(size=3),
            "accel_bias": noisy * rig.imu.accel_turn_on_bias_m_s2 * rng.normal(size=3),
        }
        noises = {"imu_noise": float(noisy), "pixel_noise": 0.2 * noisy}
        settings = {**biases, **noises, **settings}
        return SyntheticFlight(Motion(rest_s, **motion), duration_s, seed, rig, landmarks, **settings)

    return make


class KeyframeFeed:
    """Adds the keyframes of a flight to a smoother; iteration adds one after another and yields the feed itself."""

    def __init__(
        self,
        flight: SyntheticFlight,
        start: NavState,
        covariance: Array,
        config: SmootherConfig | None = None,
        params: Callable[[], PreintegrationParams] | None = None,
        frames_per_keyframe: int = 4,
        stationary: bool = False,
        assumed: Rig | None = None,
    ) -> None:
        """Create a smoother of one keyframe, the first frame of the flight.

        Args:
            flight: The flight.
            start: State of the first frame.
            covariance: (15, 15) Covariance of the first state.
            config: Settings of the smoother.
            params: Returns the noise of the IMU for each keyframe; by default that of the data sheet, inflated.
            frames_per_keyframe: Number of frames from one keyframe to the next.
            stationary: Whether zero-velocity updates are added to all keyframes.
            assumed: The calibration that the smoother assumes; by default that of the flight. Its lenses are the same.
        """
        self.flight = flight
        self.results: list[KeyframeResult] = []
        """Result of each keyframe, without the first."""
        self.states: list[NavState] = []
        """State of each keyframe when it was added, without the first."""
        self.points: list[Array] = []
        """(N, 3) Positions of the landmarks in the world frame after each keyframe [m]."""
        self._step, self._stationary = frames_per_keyframe, stationary
        default = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
        self._params = params or (lambda: default)
        self._front_end, self._buffer = flight.front_end(), ImuBuffer()
        self._buffer.add(flight.imu)
        self._buffer.take_until(start.t_ns)
        self._front_end.track(flight.frame(0), np.eye(3))
        observations, calibration = self._front_end.replenish(), Calibration(assumed or flight.rig)
        self.smoother = KeyframeSmoother(
            calibration, config or SmootherConfig(), LandmarkConfig(), start, covariance, observations
        )

    def __iter__(self) -> Iterator["KeyframeFeed"]:
        for index in range(self._step, len(self.flight.frame_times_ns), self._step):
            t_ns = int(self.flight.frame_times_ns[index])
            preintegration = Preintegration(self._params(), self.smoother.gtsam_state[1])
            increments = self._buffer.take_until(t_ns)
            preintegration.integrate(increments)
            rate = increments.angular_velocity(self.smoother.state.gyro_bias_rad_s)
            self._front_end.track(self.flight.frame(index), np.eye(3))
            observations = self._front_end.replenish()
            measurements = preintegration.measurements
            keyframe = Keyframe(t_ns, measurements, observations, self._stationary, rate)
            self.results.append(self.smoother.add_keyframe(keyframe))
            self._front_end.discard(self.results[-1].rejected)
            self.states.append(self.smoother.state)
            self.points.append(self.smoother.landmarks)
            yield self

    def finish(self) -> "KeyframeFeed":
        """Add all keyframes and return the feed."""
        for _ in self:
            pass
        return self

    @property
    def truth(self) -> Trajectory:
        """True states at the keyframes, without the first."""
        return self.flight.truth_at(np.array([state.t_ns for state in self.states]))


@pytest.fixture(scope="session")
def keyframe_feed() -> type[KeyframeFeed]:
    """Return the class that adds the keyframes of a flight to a smoother."""
    return KeyframeFeed


WALL_M, TEXEL_M = 3.0, 0.006


@pytest.fixture(scope="session")
def render_wall() -> Callable[[CameraModel, Array], npt.NDArray[np.uint8]]:
    """Return a function from (model, T_world_cam) to a grey image of a textured wall normal to the z axis."""
    rng = np.random.default_rng(11)
    shades = sum(
        strength
        * cv2.resize(rng.normal(size=(2000 // size, 2400 // size)), (2400, 2000), interpolation=cv2.INTER_CUBIC)
        for size, strength in ((5, 0.7), (12, 1.0), (40, 1.0))
    )
    texture = np.clip(128.0 + 38.0 * shades, 0, 255).astype(np.float32)
    rays: dict[CameraModel, Array] = {}

    def render(model: CameraModel, T_world_cam: Array) -> npt.NDArray[np.uint8]:
        if model not in rays:
            pixels = np.stack(np.meshgrid(np.arange(model.width), np.arange(model.height)), axis=-1).astype(float)
            rays[model] = model.unproject(pixels)
        ray = rays[model] @ T_world_cam[:3, :3].T
        depth = (WALL_M - T_world_cam[2, 3]) / ray[..., 2:]
        texels = ((T_world_cam[:2, 3] + ray[..., :2] * depth) / TEXEL_M + [1200.0, 1000.0]).astype(np.float32)
        grey = cv2.remap(texture, texels[..., 0], texels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))

    return render
