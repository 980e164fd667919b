"""The inertial measurement unit: its samples, and the densities that describe its noise."""

import math
from dataclasses import dataclass, fields
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Sampling = Literal["increment", "point"]

GRAVITY_M_S2 = 9.81
"""Magnitude of gravity [m/s²]; in the world frame it acts along −z."""
STANDARD_GRAVITY_M_S2 = 9.80665
"""The g of data sheets [m/s²] (CGPM, 1901)."""


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """A batch of IMU samples in time order."""

    t_ns: Times
    """(N,) Time stamps [ns], strictly increasing."""
    gyro_rad_s: Array
    """(N, 3) Angular velocity in the IMU frame [rad/s]."""
    accel_m_s2: Array
    """(N, 3) Specific force in the IMU frame [m/s²]: +9.81 up at rest, 0 in free fall."""
    sampling: Sampling = "point"
    """``point``: row i is the value at t[i] (EuRoC). ``increment``: row i is the mean over (t[i−1], t[i]], that is
    Δθ = log(R₀ᵀR₁) and Δv in the frame at the interval's start, each divided by the interval."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: The arrays do not belong together, or time does not increase.
        """
        n = len(self.t_ns)
        if self.t_ns.shape != (n,) or self.gyro_rad_s.shape != (n, 3) or self.accel_m_s2.shape != (n, 3):
            raise ConfigError(
                f"IMU batch with shapes {self.t_ns.shape}, {self.gyro_rad_s.shape}, {self.accel_m_s2.shape};"
                " expected (N,), (N, 3), (N, 3)"
            )
        if n > 1 and not np.all(np.diff(self.t_ns) > 0):
            raise ConfigError("IMU batch whose time stamps do not increase")

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: slice) -> Self:
        """Return the batch of the given rows."""
        return type(self)(self.t_ns[rows], self.gyro_rad_s[rows], self.accel_m_s2[rows], self.sampling)

    @classmethod
    def empty(cls, sampling: Sampling = "point") -> Self:
        """Return a batch of no samples."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), sampling)

    def after(self, t_ns: int) -> Self:
        """Return the samples stamped later than ``t_ns``."""
        return self[int(np.searchsorted(self.t_ns, t_ns, side="right")) :]

    def up_to(self, t_ns: int) -> Self:
        """Return the samples stamped at ``t_ns`` or earlier."""
        return self[: int(np.searchsorted(self.t_ns, t_ns, side="right"))]

    def extended(self, later: Self) -> Self:
        """Return this batch followed by a later one of the same sampling."""
        if later.sampling != self.sampling and len(self) and len(later):
            raise ConfigError(f"IMU batches of two kinds, {self.sampling} and {later.sampling}")
        return type(self)(
            np.concatenate([self.t_ns, later.t_ns]),
            np.concatenate([self.gyro_rad_s, later.gyro_rad_s]),
            np.concatenate([self.accel_m_s2, later.accel_m_s2]),
            later.sampling,
        )

    def increments(self) -> Self:
        """Return the same motion as means over the intervals between stamps.

        Increments stay as they are. Points are averaged pairwise (the midpoint rule), the later acceleration first
        turned into the frame at the interval's start: left out, that turn costs ½ω × a, 2 cm/s² at 50 °/s and 200 Hz.
        The interval before the first point is unknown, so N points give N − 1 increments.
        """
        if self.sampling == "increment":
            return self
        dt_s = (np.diff(self.t_ns) * 1e-9)[:, None]
        gyro = 0.5 * (self.gyro_rad_s[1:] + self.gyro_rad_s[:-1])
        R_start_end = exp_so3(gyro * dt_s)
        accel_end = np.einsum("nij,nj->ni", R_start_end, self.accel_m_s2[1:])
        return type(self)(self.t_ns[1:], gyro, 0.5 * (self.accel_m_s2[:-1] + accel_end), "increment")


@dataclass(frozen=True)
class ImuModel:
    """An IMU's rate and errors: noise as continuous-time densities (IEEE 952; Kalibr's conventions), others as spreads.

    A triad measures, of a true angular velocity ω and specific force f, with its output filter, range and resolution,

        gyro  = (I + S_g) ω + G f + b_g + n_g        accel = (I + S_a) f + b_a + n_a

    S holds scale errors on, and misalignments off its diagonal, G is the gyroscope's g-sensitivity; both are constants
    of one unit, drawn at switch-on (`ImuConstants`). The biases b are what an estimator estimates: turn-on bias, random
    walk and bias instability together. The defaults of all but the first eight fields are those of a perfect sensor.
    """

    name: str = "ADIS16448"
    """Which sensor this is."""
    rate_hz: float = 200.0
    """Sampling rate [Hz]."""
    gyro_noise_density: float = 1.6968e-4
    """White noise of the gyroscope [rad/s/√Hz]."""
    gyro_random_walk: float = 1.9393e-5
    """Random walk of the gyroscope's bias [rad/s²/√Hz]."""
    accel_noise_density: float = 2.0e-3
    """White noise of the accelerometer [m/s²/√Hz]."""
    accel_random_walk: float = 3.0e-3
    """Random walk of the accelerometer's bias [m/s³/√Hz]."""
    gyro_turn_on_bias_rad_s: float = 0.01
    """Standard deviation of the gyroscope's bias at switch-on [rad/s]."""
    accel_turn_on_bias_m_s2: float = 0.05
    """Standard deviation of the accelerometer's bias at switch-on [m/s²]."""
    gyro_bias_instability_rad_s: float = 0.0
    """In-run bias stability of the gyroscope [rad/s]: the floor of the Allan deviation of its flicker noise."""
    accel_bias_instability_m_s2: float = 0.0
    """In-run bias stability of the accelerometer [m/s²]: the floor of the Allan deviation of its flicker noise."""
    gyro_scale_error: float = 0.0
    """Standard deviation of each axis's scale error of the gyroscope, relative."""
    accel_scale_error: float = 0.0
    """Standard deviation of each axis's scale error of the accelerometer, relative."""
    gyro_misalignment_rad: float = 0.0
    """Standard deviation of the tilt of each axis of the gyroscope towards each of the others [rad]."""
    accel_misalignment_rad: float = 0.0
    """Standard deviation of the tilt of each axis of the accelerometer towards each of the others [rad]."""
    gyro_g_sensitivity_rad_s_per_m_s2: float = 0.0
    """Standard deviation of each element of the gyroscope's g-sensitivity [rad/s per m/s²]."""
    gyro_range_rad_s: float = math.inf
    """Where the gyroscope saturates, either way [rad/s]."""
    accel_range_m_s2: float = math.inf
    """Where the accelerometer saturates, either way [m/s²]."""
    gyro_resolution_rad_s: float = 0.0
    """The gyroscope's least significant bit [rad/s]; 0 for no quantization."""
    accel_resolution_m_s2: float = 0.0
    """The accelerometer's least significant bit [m/s²]; 0 for no quantization."""
    gyro_bandwidth_hz: float = math.inf
    """Where the gyroscope's output filter is 3 dB down [Hz]: what it lets through of the rotors' vibration."""
    accel_bandwidth_hz: float = math.inf
    """Where the accelerometer's output filter is 3 dB down [Hz]."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: A rate or a bandwidth is not above zero, or another number is negative or no number.
        """
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            least = "above zero" if field.name in _POSITIVE else "zero or more"
            if not (value > 0.0 if field.name in _POSITIVE else value >= 0.0):
                raise ConfigError(f"IMU {self.name}: {field.name} {value}; expected a number, {least}")


_POSITIVE = ("rate_hz", "gyro_range_rad_s", "accel_range_m_s2", "gyro_bandwidth_hz", "accel_bandwidth_hz")


@dataclass(frozen=True, eq=False)
class ImuConstants:
    """What distinguishes one unit of an IMU model from the next, and stays as it is while it is switched on.

    It is truth for which no ground truth has a column: with it, and the biases, every sample can be explained.
    """

    gyro_matrix: Array
    """(3, 3) I + S_g: what the gyroscope reads of an angular velocity."""
    accel_matrix: Array
    """(3, 3) I + S_a: what the accelerometer reads of a specific force."""
    gyro_g_sensitivity: Array
    """(3, 3) G: what the gyroscope reads of a specific force [rad/s per m/s²]."""
    gyro_turn_on_bias_rad_s: Array
    """(3,) The gyroscope's bias at switch-on [rad/s]."""
    accel_turn_on_bias_m_s2: Array
    """(3,) The accelerometer's bias at switch-on [m/s²]."""

    def respond(self, gyro_rad_s: Array, accel_m_s2: Array) -> tuple[Array, Array]:
        """Return what the unit reads without biases and noise.

        Args:
            gyro_rad_s: (N, 3) True angular velocities in the IMU frame [rad/s].
            accel_m_s2: (N, 3) True specific forces in the IMU frame [m/s²].

        Returns:
            The same, with scale errors, misalignments and g-sensitivity.
        """
        gyro = gyro_rad_s @ self.gyro_matrix.T + accel_m_s2 @ self.gyro_g_sensitivity.T
        return np.asarray(gyro), np.asarray(accel_m_s2 @ self.accel_matrix.T)


EUROC_IMU = ImuModel(
    gyro_range_rad_s=math.radians(1000.0),
    accel_range_m_s2=18.0 * STANDARD_GRAVITY_M_S2,
    gyro_resolution_rad_s=math.radians(0.04),
    accel_resolution_m_s2=STANDARD_GRAVITY_M_S2 / 1200.0,
    gyro_bandwidth_hz=330.0,
    accel_bandwidth_hz=330.0,
)
"""The IMU of EuRoC's rig, an ADIS16448 with the densities of the data set's ``imu0/sensor.yaml`` (Burri et al., IJRR
2016). Range (±1000 °/s, ±18 g), resolution (0.04 °/s, 1/1200 g: the steps that the data set's samples are multiples of)
and bandwidth (330 Hz) are the data sheet's (Analog Devices, ADIS16448). It is taken for calibrated: without errors of
scale, alignment and g-sensitivity."""
