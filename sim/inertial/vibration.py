"""Vibration of the airframe by the rotors, as an IMU measures it."""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig


class Tones:
    """The harmonics of R rotors as an IMU measures them, given the angles of the rotors."""

    def __init__(self, quadrotor: Quadrotor, rig: Rig) -> None:
        """Define the rotors with their vibration, and mounting and bandwidths of the IMU."""
        vibration = quadrotor.vibration
        self._imu = rig.imu
        self._R_imu_vehicle = rig.T_vehicle_imu[:3, :3].T
        orders = vibration.blades * np.arange(1, vibration.harmonics + 1)
        fading = 1.0 / np.arange(1, vibration.harmonics + 1) ** 2
        self._orders = np.concatenate([[1.0, 1.0], orders])  # imbalance along two axes, then the blade-pass harmonics
        self._lags = np.concatenate([[0.0, -0.5 * np.pi], np.zeros(len(orders))])
        self._linear = _linear_amplitudes(quadrotor, fading)
        self._angular = _angular_amplitudes(quadrotor, fading)

    def at(self, angle_rad: Array, turned_rad: Array, rotor_speeds_rad_s: Array) -> tuple[Array, Array]:
        """Return angular velocities (N, 3) [rad/s] and specific forces (N, 3) [m/s²] in the IMU frame.

        Args:
            angle_rad: (N, R) Angles of the rotors amid each sample [rad].
            turned_rad: (N, R) Rotation during each sample [rad]; 0 for points.
            rotor_speeds_rad_s: (N, R) Speeds of the rotors [rad/s].
        """
        phase = self._orders * angle_rad[..., None] + self._lags
        tone = np.cos(phase) * np.sinc(self._orders * turned_rad[..., None] / (2.0 * np.pi))
        frequency_hz = self._orders * rotor_speeds_rad_s[..., None] / (2.0 * np.pi)
        gyro_tone = tone * rotor_speeds_rad_s[..., None] * _filter_gain(frequency_hz, self._imu.gyro_bandwidth_hz)
        accel_tone = (
            tone * rotor_speeds_rad_s[..., None] ** 2 * _filter_gain(frequency_hz, self._imu.accel_bandwidth_hz)
        )
        gyro = np.einsum("nrt,rta->na", gyro_tone, self._angular)
        accel = np.einsum("nrt,rta->na", accel_tone, self._linear)
        return gyro @ self._R_imu_vehicle.T, accel @ self._R_imu_vehicle.T


class RotorHarmonics:
    """Harmonics of each rotor's true speed and of its blade-pass frequency.

    Rotor speeds are constant between two IMU samples, so the phase of a harmonic, the integral of the speed, is known
    at all times. A point sample is the value at the time stamp, an increment the exact mean over the interval.
    Frequencies above half the sampling rate therefore alias as in a real IMU, attenuated by the output filter
    (second-order Butterworth) and, in increments, by the averaging.

    The displacement of the IMU by vibration is a few micrometres; the true motion does not contain it.
    """

    def __init__(self, quadrotor: Quadrotor, rig: Rig, rng: np.random.Generator) -> None:
        """Draw the initial angles of the rotors.

        Args:
            quadrotor: Positions, directions of rotation and vibration parameters of the rotors.
            rig: Mounting, rate and bandwidths of the IMU.
            rng: Generator of the angles.
        """
        self._interval_s = 1.0 / rig.imu.rate_hz
        self._tones = Tones(quadrotor, rig)
        self._angle = rng.uniform(0.0, 2.0 * np.pi, quadrotor.rotor_count)
        self._speed = np.zeros(quadrotor.rotor_count)
        self._t_ns: int | None = None

    def sensed(self, samples: ImuSamples, rotor_speeds_rad_s: Array | None) -> tuple[Array, Array]:
        """Return the vibration at the times of a batch of samples, later than those of the last call.

        Args:
            samples: N samples, of which only times and sampling are used.
            rotor_speeds_rad_s: (N, R) Rotor speeds [rad/s]: for points, the speeds from each time stamp on; for
                increments, the speeds during each interval. None is standstill.

        Returns:
            Angular velocities (N, 3) [rad/s] and specific forces (N, 3) [m/s²] in the IMU frame.
        """
        if len(samples) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3))
        speeds = np.zeros((len(samples), len(self._speed))) if rotor_speeds_rad_s is None else rotor_speeds_rad_s
        middle, turned = self._turn(samples, speeds)
        return self._tones.at(middle, turned, speeds)

    def _turn(self, samples: ImuSamples, speeds: Array) -> tuple[Array, Array]:
        """Advance the rotors; return their angles (N, R) amid each sample and their rotation during it [rad]."""
        if samples.sampling == "increment":
            start_ns = int(samples.t_ns[0]) - round(1e9 * self._interval_s) if self._t_ns is None else self._t_ns
            turned = speeds * (np.diff(samples.t_ns, prepend=start_ns) * 1e-9)[:, None]
            angles = self._angle + np.cumsum(turned, axis=0)
            middle = angles - 0.5 * turned
        else:
            start_ns = int(samples.t_ns[0]) if self._t_ns is None else self._t_ns
            held = np.vstack([self._speed, speeds[:-1]])
            angles = self._angle + np.cumsum(held * (np.diff(samples.t_ns, prepend=start_ns) * 1e-9)[:, None], axis=0)
            middle, turned = angles, np.zeros_like(speeds)
        self._angle, self._speed, self._t_ns = angles[-1], speeds[-1], int(samples.t_ns[-1])
        return middle, turned


def _linear_amplitudes(quadrotor: Quadrotor, fading: Array) -> Array:
    """Return (R, T, 3) acceleration amplitudes of the T harmonics divided by ω² [m], in the vehicle frame."""
    vibration = quadrotor.vibration
    swing = np.zeros((quadrotor.rotor_count, 2 + len(fading), 3))
    swing[:, 0, 0] = vibration.imbalance_m
    swing[:, 1, 1] = vibration.imbalance_m * quadrotor.rotor_directions
    swing[:, 2:, 2] = vibration.blade_pass_m * fading
    return swing


def _angular_amplitudes(quadrotor: Quadrotor, fading: Array) -> Array:
    """Return (R, T, 3) angular velocity amplitudes of the T harmonics divided by ω [rad], in the vehicle frame."""
    x, y = quadrotor.rotor_positions_m[:, 0], quadrotor.rotor_positions_m[:, 1]
    arm = np.hypot(x, y)
    across = np.stack([y, -x], axis=1) / np.where(arm > 0.0, arm, 1.0)[:, None]  # axis of the torque of a force there
    vibration = quadrotor.vibration
    rocking = np.zeros((quadrotor.rotor_count, 2 + len(fading), 3))
    rocking[:, 0, 0] = vibration.imbalance_rad * quadrotor.rotor_directions
    rocking[:, 1, 1] = vibration.imbalance_rad
    rocking[:, 2:, :2] = vibration.blade_pass_rad * fading[:, None] * across[:, None]
    return rocking


def _filter_gain(frequency_hz: Array, bandwidth_hz: float) -> Array:
    """Return the gain of a second-order Butterworth filter whose gain at the bandwidth is −3 dB."""
    return np.asarray(1.0 / np.sqrt(1.0 + (frequency_hz / bandwidth_hz) ** 4))
