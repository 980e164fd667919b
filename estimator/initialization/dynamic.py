"""Dynamic initialization: gyroscope bias, velocity, gravity and landmarks from a second of tracks and IMU measurements.

The gyroscope bias comes first, from epipolar geometry, which needs neither scale nor velocity (`gyro_bias`). Velocity
and gravity follow in closed form (`closed_form`), and Gauss-Newton steps refine all of them, with the accelerometer
bias (`refinement`). Outliers have nearly no weight in any of the three (`robust`). The result is accepted by its
covariance and by the share of the landmarks that agree with it.

A landmark that several cameras observe at the same time has a depth from the first frame on. The equations are the
same, with more observations; a shorter window and any motion then suffice, where a single camera needs parallax and
acceleration.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.estimator.initialization.closed_form import MIN_START_DEPTH_M, NoiseModel, solve_closed_form
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.gyro_bias import EpipolarSolution, epipolar_gyro_bias
from dronevio.estimator.initialization.not_observable import (
    NotObservable,
    implausible_imu,
    rounded_down,
    uncertain_velocity,
)
from dronevio.estimator.initialization.refinement import RefinedState, refine
from dronevio.estimator.initialization.static import level_rotation
from dronevio.estimator.initialization.views import Motion, WindowMeasurements
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.types import FramePacket
from dronevio.models.arrays import Array, Integers
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import NavState

TIME_OFFSET_SIGMA_S = 0.1
"""Standard deviation of the time offset of camera and IMU, where it is tested [s]: that of clocks that differ."""
MIN_TIME_OFFSET_S = 0.01
"""Smallest time offset that speaks against a start [s]: somewhat more than the smallest one that the search adopts.
The online calibration finds smaller ones."""
TIME_OFFSET_SIGMAS = 3.0
"""Smallest significance of such an offset, in standard deviations."""


@dataclass(frozen=True)
class DynamicInitializationConfig(Settings):
    """Settings of the dynamic initialization."""

    window_s: Annotated[float, Range(0.1, 30.0)] = 1.5
    """Length of the window with a single camera [s]."""
    max_window_s: Annotated[float, Range(0.1, 30.0)] = 3.0
    """Largest length of a second window of a single camera [s], with all frames since the start, which is used if the
    state is not observable in the first. The effect of an acceleration grows with the square of the time."""
    attempt_interval_s: Annotated[float, Range(0.01, 30.0)] = 0.25
    """Time between the first attempts [s]; later ones are rarer."""
    stereo_window_s: Annotated[float, Range(0.1, 30.0)] = 0.5
    """Length of the window where several cameras observe the same landmarks, which makes the scale observable [s]."""
    max_frames: Annotated[int, Range(3, 200)] = 16
    """Largest number of frames that are used, spread evenly over the window."""
    min_observations: Annotated[int, Range(2, 200)] = 6
    """Smallest number of used frames in which a landmark must be observed."""
    min_landmarks: Annotated[int, Range(5, 100_000)] = 20
    """Smallest number of such landmarks."""
    pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 0.5
    """Standard deviation of an image observation [px]. The errors of one track are taken as fully correlated."""
    outlier_sigmas: Annotated[float, Range(0.1, 1e3)] = 2.0
    """Root mean square residual of a track from which it is an outlier, in standard deviations."""
    accel_bias_sigma_m_s2: Annotated[float, Range(1e-6, 100.0)] = 0.1
    """Standard deviation of the accelerometer bias before it is estimated [m/s²]."""
    min_parallax_sigmas: Annotated[float, Range(low=0.0)] = 30.0
    """Smallest median displacement of the features over the window, compensated for rotation, in standard deviations
    of an image observation."""
    max_residual_sigmas: Annotated[float, Range(above=0.0)] = 2.5
    """Largest root mean square residual of a landmark that agrees with the solution, in standard deviations of an image
    observation."""
    max_rotation_residual_sigmas: Annotated[float, Range(above=0.0)] = 0.75
    """Largest median residual of the epipolar geometry at which the gyroscope agrees with the images, in standard
    deviations of an image observation. This and the next two only determine the cause that is stated where there is no
    solution."""
    max_gyro_bias_sigmas: Annotated[float, Range(above=0.0)] = 6.0
    """Largest distance of the gyroscope bias from its prior at which the gyroscope agrees with the images, in standard
    deviations."""
    min_rotation_rad_s: Annotated[float, Range(low=0.0)] = 0.2
    """Smallest standard deviation of the angular velocity over the window at which that agreement is significant
    [rad/s]. A bias explains slower rotations."""
    min_inliers: Annotated[float, Range(0.0, 1.5)] = 0.5
    """Smallest share of the landmarks that must agree with the solution."""
    min_in_front: Annotated[float, Range(0.0, 1.0)] = 0.9
    """Smallest share of these landmarks that must lie in front of the camera."""
    max_velocity_sigma: Annotated[float, Range(low=0.0)] = 0.15
    """Largest standard deviation of the velocity by its covariance, relative to the speed."""
    max_velocity_sigma_m_s: Annotated[float, Range(low=0.0)] = 0.1
    """Standard deviation of the velocity that suffices at any speed [m/s]."""
    max_gyro_bias_rad_s: Annotated[float, Range(above=0.0)] = 0.2
    """Largest plausible gyroscope bias [rad/s]."""
    max_accel_bias_m_s2: Annotated[float, Range(above=0.0)] = 0.6
    """Largest plausible accelerometer bias [m/s²]."""
    min_excitation: Annotated[float, Range(low=0.0)] = 3.0
    """Smallest ratio between the deviation of the path from constant velocity and that which the accelerometer bias
    causes. At constant velocity the scale of a single camera is not observable."""


@dataclass(frozen=True, eq=False)
class ObservedRotation:
    """The first half of a dynamic initialization: a window, and the gyroscope bias by its images."""

    t_ns: int
    """Time of the first frame of the window [ns]."""
    measured: WindowMeasurements
    """The tracks and the IMU of the window."""
    epipolar: EpipolarSolution
    """The gyroscope bias by epipolar geometry."""
    is_stereo: bool
    """Whether several cameras observe the landmarks at once; see `is_stereo`."""


@dataclass(frozen=True, eq=False)
class DynamicStart:
    """The result of a dynamic initialization."""

    state: NavState
    """State at the first frame of the window."""
    outliers: Integers
    """(N,) Identities of the features that disagree with it."""
    clocks: NotObservable | None = None
    """The evidence that the time offset of camera and IMU is another one, if there is any."""


def is_stereo(window: Sequence[FramePacket], config: DynamicInitializationConfig) -> bool:
    """Return whether enough landmarks are observed by several cameras at once, so that the scale is observable."""
    return any(len(packet.observations.matches) >= config.min_landmarks for packet in window)


def observed_rotation(
    window: Sequence[FramePacket],
    Ts_imu_cam: Array,
    focal_px: float,
    config: DynamicInitializationConfig,
    gyro_bias: BiasPrior,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> ObservedRotation | NotObservable:
    """Return the gyroscope bias in a window by its images, or the reason why the motion is not observable.

    Args:
        window: Consecutive frame packets.
        Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras in the IMU frame.
        focal_px: Focal length [px].
        config: Settings.
        gyro_bias: What is known of the gyroscope bias [rad/s].
        gravity_m_s2: Magnitude of gravity [m/s²].
    """
    c, stereo = config, is_stereo(window, config)
    measured = WindowMeasurements.of(window, Ts_imu_cam, c.max_frames, c.min_observations)
    increments = measured.imu.increments
    implausible = implausible_imu(increments.gyro_rad_s, increments.accel_m_s2, gravity_m_s2)
    if implausible is not None:
        return implausible
    if len(measured.tracks) < c.min_landmarks:
        return NotObservable(
            f"{len(measured.tracks)} features are tracked for long enough, {c.min_landmarks} are needed: more texture"
            " or light, and slower motion, help"
        )
    epipolar = epipolar_gyro_bias(measured, gyro_bias, c.pixel_sigma / focal_px, c.outlier_sigmas)
    parallax_px = measured.median_parallax_rad(epipolar.bias_rad_s) * focal_px
    needed_px = c.min_parallax_sigmas * c.pixel_sigma
    if not stereo and parallax_px < needed_px:
        return NotObservable(
            f"a parallax of {rounded_down(parallax_px)} px, {needed_px:g} px are needed: motion sideways helps, or rest"
        )
    return ObservedRotation(window[0].t_ns, measured, epipolar, stereo)


def dynamic_start(
    rotation: ObservedRotation,
    focal_px: float,
    config: DynamicInitializationConfig,
    gyro_bias: BiasPrior,
    accel_bias: BiasPrior,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> DynamicStart | NotObservable:
    """Return the state at the first frame of a window, or the reason why it is not observable.

    Args:
        rotation: The window with the gyroscope bias by its images.
        focal_px: Focal length [px].
        config: Settings.
        gyro_bias: What is known of the gyroscope bias without them [rad/s].
        accel_bias: What is known of the accelerometer bias [m/s²].
        gravity_m_s2: Magnitude of gravity [m/s²].
    """
    c, measured, epipolar = config, rotation.measured, rotation.epipolar
    noise = NoiseModel(c.pixel_sigma / focal_px, c.outlier_sigmas, accel_bias, gravity_m_s2)
    angular_velocity_rad_s = float(np.sqrt(np.var(measured.imu.increments.gyro_rad_s, axis=0).sum()))
    cause = probable_cause(epipolar, angular_velocity_rad_s, c)
    try:
        initial = solve_closed_form(measured, epipolar.bias_rad_s, epipolar.weights, noise)
        refined = refine(measured, initial, gyro_bias, noise)
        state = refined.state
        motion = measured.imu.integrated(state.gyro_bias).motion()
        reason = _reason_against(refined, cause, motion, rotation.is_stereo, accel_bias.sigma, c)
        if reason is not None:
            return reason
        free = refine(measured, state, gyro_bias, noise, TIME_OFFSET_SIGMA_S)
    except np.linalg.LinAlgError:
        return NotObservable("no motion explains images and IMU together", cause)
    R_world_imu = level_rotation(-state.gravity)
    pose, velocity = pose_matrix(R_world_imu, np.zeros(3)), R_world_imu @ state.velocity
    start = NavState(rotation.t_ns, pose, velocity, state.gyro_bias, state.accel_bias)
    return DynamicStart(start, measured.tracks.ids[~refined.inliers], _evidence_of_time_offset(free))


def _evidence_of_time_offset(free: RefinedState) -> NotObservable | None:
    """Return what a state says against the time offset in use, if it was estimated with the time offset as unknown."""
    offset_s, sigma_s = free.state.time_offset_s, free.time_offset_sigma_s
    if not abs(offset_s) >= max(MIN_TIME_OFFSET_S, TIME_OFFSET_SIGMAS * sigma_s):
        return None
    return NotObservable(
        f"a time offset of camera and IMU of {1e3 * offset_s:+.0f} ± {1e3 * sigma_s:.0f} ms explains them much better",
        Cause.CLOCKS_DISAGREE,
    )


def probable_cause(
    rotation: EpipolarSolution, angular_velocity_rad_s: float, config: DynamicInitializationConfig
) -> Cause:
    """Return the probable cause where the landmarks disagree with the IMU.

    Args:
        rotation: The gyroscope bias by epipolar geometry.
        angular_velocity_rad_s: Standard deviation of the angular velocity over the window [rad/s].
        config: Settings.
    """
    c = config
    if rotation.residual_sigmas > c.max_rotation_residual_sigmas or rotation.bias_sigmas > c.max_gyro_bias_sigmas:
        return Cause.ROTATION_DISAGREES
    rotates, agrees = angular_velocity_rad_s > c.min_rotation_rad_s, 2.0 * rotation.bias_sigmas < c.max_gyro_bias_sigmas
    return Cause.ACCEL_DISAGREES if rotates and agrees else Cause.MOTION_DISAGREES


def _reason_against(
    refined: RefinedState,
    cause: Cause,
    motion: Motion,
    stereo: bool,
    accel_bias_sigma_m_s2: float,
    config: DynamicInitializationConfig,
) -> NotObservable | None:
    """Return the first reason why a state cannot be used, or None."""
    c, state, t_s = config, refined.state, motion.t_s[:, None]
    inliers = refined.squares < c.max_residual_sigmas**2
    if inliers.mean() <= c.min_inliers:
        return NotObservable(f"{1.0 - inliers.mean():.0%} of the landmarks disagree with the IMU", cause)
    accel_bias, gyro_bias = float(np.linalg.norm(state.accel_bias)), float(np.linalg.norm(state.gyro_bias))
    if accel_bias > c.max_accel_bias_m_s2:
        return NotObservable(
            f"an accelerometer bias of {accel_bias:.2f} m/s² explains the images, {c.max_accel_bias_m_s2:g} m/s² are"
            " plausible",
            cause,
        )
    curvature_m = _deviation_from_line(motion.dp + 0.5 * state.gravity * t_s**2, t_s)
    curvature_of_bias_m = _deviation_from_line(0.5 * accel_bias_sigma_m_s2 * t_s**2, t_s)
    behind = float(np.mean(refined.depth_m[inliers] <= MIN_START_DEPTH_M))
    sigma_m_s = float(np.sqrt(np.linalg.eigvalsh(refined.velocity_covariance)[-1]))
    speed_m_s = float(np.linalg.norm(state.velocity))
    allowed_m_s = max(c.max_velocity_sigma_m_s, c.max_velocity_sigma * speed_m_s)
    if behind >= 1.0 - c.min_in_front:
        return NotObservable(f"{behind:.0%} of the landmarks would lie behind the camera: motion sideways helps")
    if sigma_m_s >= allowed_m_s:
        return uncertain_velocity(speed_m_s, sigma_m_s, allowed_m_s)
    if gyro_bias >= c.max_gyro_bias_rad_s:
        return NotObservable(
            f"a gyroscope bias of {gyro_bias:.2f} rad/s explains the images, {c.max_gyro_bias_rad_s:g} rad/s are"
            " plausible: a second at rest would show it"
        )
    if not stereo and curvature_m <= c.min_excitation * curvature_of_bias_m:
        return NotObservable(
            "too little acceleration, without which one camera does not show the scale: speeding up, braking and turns"
            " help"
        )
    return None


def _deviation_from_line(positions: Array, t_s: Array) -> float:
    """Return the RMS deviation [m] of positions (V, n) at times (V, 1) from the closest constant velocity."""
    velocity = (t_s * positions).sum(axis=0) / np.sum(t_s**2)
    return float(np.sqrt(np.sum((positions - velocity * t_s) ** 2) / len(positions)))
