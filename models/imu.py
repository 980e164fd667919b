"""Inertial measurement unit: samples, and the parameters of its errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3

Times = npt.NDArray[np.int64]
Sampling = Literal["increment", "point"]

GRAVITY_M_S2 = 9.81
"""Magnitude of gravity, which acts along −z in the world frame [m/s²]."""
IMU_GAP_INTERVALS = 4.0
"""A time without samples is a gap of the IMU if it is longer than this many sampling intervals."""
STANDARD_GRAVITY_M_S2 = 9.80665
"""Standard gravity, the unit g of data sheets (CGPM, 1901) [m/s²]."""


_SAME_STAMP = "samples that arrive with one stamp are spread over the time before it by recordings.bursts.spread_bursts"
_EARLIER_STAMP = "late samples are sorted before they are added, and where the clock steps, a new estimator begins"


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """A batch of IMU samples in time order.

    Drivers of serial ports give one stamp to several samples that they read at once: see
    `dronevio.models.recordings.bursts.spread_bursts`.
    """

    t_ns: Times
    """(N,) Time stamps, strictly increasing [ns]."""
    gyro_rad_s: Array
    """(N, 3) Angular velocity in the IMU frame [rad/s]."""
    accel_m_s2: Array
    """(N, 3) Specific force in the IMU frame: 9.81 upwards if stationary, 0 in free fall [m/s²]."""
    sampling: Sampling = "point"
    """Meaning of a row. ``point``: row i is the value at t[i] (EuRoC). ``increment``: row i is the mean over the
    interval (t[i−1], t[i]], that is Δθ = log(R₀ᵀR₁) and Δv in the frame at the start, each divided by the interval."""

    def __post_init__(self) -> None:
        """Check types, shapes and time stamps. Values that are not finite are for estimators to refuse.

        Raises:
            ConfigError: A field is no array of numbers, time stamps are not whole numbers or do not increase, or the
                shapes do not match.
        """
        for name, values in (("t_ns", self.t_ns), ("gyro_rad_s", self.gyro_rad_s), ("accel_m_s2", self.accel_m_s2)):
            if not isinstance(values, np.ndarray):
                raise ConfigError(f"ImuSamples.{name} of type {type(values).__name__}; expected an array of NumPy")
        if self.t_ns.dtype.kind != "i":
            raise ConfigError(f"ImuSamples.t_ns of type {self.t_ns.dtype}; expected whole nanoseconds, int64")
        if self.gyro_rad_s.dtype.kind not in "fiu" or self.accel_m_s2.dtype.kind not in "fiu":
            raise ConfigError(
                f"IMU batch of types {self.gyro_rad_s.dtype} and {self.accel_m_s2.dtype}; expected numbers, float64"
            )
        n = self.t_ns.size
        if self.t_ns.shape != (n,) or self.gyro_rad_s.shape != (n, 3) or self.accel_m_s2.shape != (n, 3):
            raise ConfigError(
                f"IMU batch with shapes {self.t_ns.shape}, {self.gyro_rad_s.shape}, {self.accel_m_s2.shape};"
                " expected (N,), (N, 3), (N, 3)"
            )
        if n > 1 and not (is_later := self.t_ns[1:] > self.t_ns[:-1]).all():
            row = int(is_later.argmin())
            is_equal = self.t_ns[row + 1] == self.t_ns[row]
            raise ConfigError(
                f"IMU batch whose time stamps do not increase: {self.t_ns[row + 1]} ns after {self.t_ns[row]} ns;"
                f" expected a later one; {_SAME_STAMP if is_equal else _EARLIER_STAMP}"
            )

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: slice) -> Self:
        """Return a slice of the batch."""
        return type(self)(self.t_ns[rows], self.gyro_rad_s[rows], self.accel_m_s2[rows], self.sampling)

    @classmethod
    def empty(cls, sampling: Sampling = "point") -> Self:
        """Return a batch without samples."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), sampling)

    def after(self, t_ns: int) -> Self:
        """Return the samples later than ``t_ns``."""
        return self[int(np.searchsorted(self.t_ns, t_ns, side="right")) :]

    def up_to(self, t_ns: int) -> Self:
        """Return the samples at ``t_ns`` or earlier."""
        return self[: int(np.searchsorted(self.t_ns, t_ns, side="right"))]

    def check_order(self, later: Self) -> None:
        """Check that another batch can follow this one; neither is empty.

        Raises:
            ConfigError: The batches differ in `sampling`, or the other one does not begin later.
        """
        if self.sampling != later.sampling or later.t_ns[0] <= self.t_ns[-1]:
            self[-1:].extended(later[:1])

    def extended(self, later: Self) -> Self:
        """Return this batch followed by a later one.

        Raises:
            ConfigError: The batches differ in `sampling`, or their time stamps do not increase.
        """
        return self.concatenated([self, later])

    @classmethod
    def concatenated(cls, batches: Sequence[Self]) -> Self:
        """Return batches in succession, one or more, as one.

        Raises:
            ConfigError: The batches differ in `sampling`, or their time stamps do not increase.
        """
        if len(batches) == 1:
            return batches[0]
        samplings = list(dict.fromkeys(batch.sampling for batch in batches if len(batch)))
        if len(samplings) > 1:
            found = " and ".join(map(repr, samplings))
            raise ConfigError(f"IMU batches with sampling {found}; expected the same for all")
        return cls(
            np.concatenate([batch.t_ns for batch in batches]),
            np.concatenate([batch.gyro_rad_s for batch in batches]),
            np.concatenate([batch.accel_m_s2 for batch in batches]),
            samplings[0] if samplings else batches[-1].sampling,
        )

    def increments(self) -> Self:
        """Return the samples as means over the intervals between time stamps (sampling ``increment``).

        Increments are returned unchanged. Points are averaged in pairs (midpoint rule), after rotation of the later
        specific force into the frame at the start of the interval; without the rotation the error is ½ Δt ω × a, 2
        cm/s² at 50 °/s and 200 Hz. The interval before the first point is unknown, so N points yield N − 1 increments.
        """
        if self.sampling == "increment":
            return self
        dt_s = ((self.t_ns[1:] - self.t_ns[:-1]) * 1e-9)[:, None]
        gyro = 0.5 * (self.gyro_rad_s[1:] + self.gyro_rad_s[:-1])
        R_start_end = exp_so3(gyro * dt_s)
        accel_end = np.einsum("nij,nj->ni", R_start_end, self.accel_m_s2[1:])
        return type(self)(self.t_ns[1:], gyro, 0.5 * (self.accel_m_s2[:-1] + accel_end), "increment")


@dataclass(frozen=True)
class ImuModel:
    """Rate and error model of an IMU.

    Noise is given as continuous-time densities (IEEE 952, with Kalibr's conventions), constant errors by their standard
    deviations. For a true angular velocity ω and specific force f the IMU measures, before output filter, range and
    resolution,

        gyro  = (I + S_g) ω + G f + b_g + n_g        accel = (I + S_a) f + b_a + n_a

    S contains scale errors on its diagonal and misalignments off it, G is the g-sensitivity of the gyroscope; both are
    constants of an individual unit (`ImuConstants`). The biases b, which an estimator estimates, are the sum of turn-on
    bias, random walk and bias instability. The defaults of all but the first eight fields are those of an ideal sensor.
    """

    name: str = "ADIS16448"
    """Name of the sensor model."""
    rate_hz: float = 200.0
    """Sampling rate [Hz]."""
    gyro_noise_density: float = 1.6968e-4
    """White noise density of the gyroscope [rad/s/√Hz]."""
    gyro_random_walk: float = 1.9393e-5
    """Random walk density of the gyroscope bias [rad/s²/√Hz]."""
    accel_noise_density: float = 2.0e-3
    """White noise density of the accelerometer [m/s²/√Hz]."""
    accel_random_walk: float = 3.0e-3
    """Random walk density of the accelerometer bias [m/s³/√Hz]."""
    gyro_turn_on_bias_rad_s: float = 0.01
    """Standard deviation of the turn-on bias of the gyroscope [rad/s]."""
    accel_turn_on_bias_m_s2: float = 0.05
    """Standard deviation of the turn-on bias of the accelerometer [m/s²]."""
    gyro_bias_instability_rad_s: float = 0.0
    """In-run bias instability of the gyroscope: the floor of the Allan deviation of its flicker noise [rad/s]."""
    accel_bias_instability_m_s2: float = 0.0
    """In-run bias instability of the accelerometer: the floor of the Allan deviation of its flicker noise [m/s²]."""
    gyro_scale_error: float = 0.0
    """Standard deviation of the relative scale error of each gyroscope axis."""
    accel_scale_error: float = 0.0
    """Standard deviation of the relative scale error of each accelerometer axis."""
    gyro_misalignment_rad: float = 0.0
    """Standard deviation of the misalignment of each gyroscope axis towards each of the others [rad]."""
    accel_misalignment_rad: float = 0.0
    """Standard deviation of the misalignment of each accelerometer axis towards each of the others [rad]."""
    gyro_g_sensitivity_rad_s_per_m_s2: float = 0.0
    """Standard deviation of each element of the g-sensitivity of the gyroscope [rad/s per m/s²]."""
    gyro_range_rad_s: float = math.inf
    """Largest absolute angular velocity that the gyroscope measures on each axis [rad/s]."""
    accel_range_m_s2: float = math.inf
    """Largest absolute specific force that the accelerometer measures on each axis [m/s²]."""
    gyro_resolution_rad_s: float = 0.0
    """Least significant bit of the gyroscope, 0 for no quantization [rad/s]."""
    accel_resolution_m_s2: float = 0.0
    """Least significant bit of the accelerometer, 0 for no quantization [m/s²]."""
    gyro_bandwidth_hz: float = math.inf
    """Bandwidth (−3 dB) of the output filter of the gyroscope, which attenuates rotor vibration [Hz]."""
    accel_bandwidth_hz: float = math.inf
    """Bandwidth (−3 dB) of the output filter of the accelerometer [Hz]."""

    def __post_init__(self) -> None:
        """Check the values of the fields.

        Raises:
            ConfigError: A rate, range or bandwidth is not positive, or another number is negative or NaN.
        """
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            required = "positive" if field.name in _POSITIVE else "non-negative"
            in_range = value > 0.0 if field.name in _POSITIVE else value >= 0.0
            if not in_range or (field.name not in _INFINITE and math.isinf(value)):
                raise ConfigError(f"IMU {self.name}: {field.name} {value}; expected a {required} number")


_INFINITE = ("gyro_range_rad_s", "accel_range_m_s2", "gyro_bandwidth_hz", "accel_bandwidth_hz")
_POSITIVE = ("rate_hz", *_INFINITE)


@dataclass(frozen=True, eq=False)
class ImuConstants:
    """Constant errors of one unit of an IMU model, drawn when it is switched on.

    They complete the ground truth, whose files have columns for the biases only.
    """

    gyro_matrix: Array
    """(3, 3) I + S_g: response of the gyroscope to an angular velocity."""
    accel_matrix: Array
    """(3, 3) I + S_a: response of the accelerometer to a specific force."""
    gyro_g_sensitivity: Array
    """(3, 3) G: response of the gyroscope to a specific force [rad/s per m/s²]."""
    gyro_turn_on_bias_rad_s: Array
    """(3,) Turn-on bias of the gyroscope [rad/s]."""
    accel_turn_on_bias_m_s2: Array
    """(3,) Turn-on bias of the accelerometer [m/s²]."""

    def response(self, gyro_rad_s: Array, accel_m_s2: Array) -> tuple[Array, Array]:
        """Return the measurements of the unit without biases and noise.

        Args:
            gyro_rad_s: (N, 3) True angular velocities in the IMU frame [rad/s].
            accel_m_s2: (N, 3) True specific forces in the IMU frame [m/s²].

        Returns:
            Angular velocities (N, 3) and specific forces (N, 3) with scale errors, misalignments and g-sensitivity.
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
"""The IMU of EuRoC's rig, an ADIS16448 with the noise densities of the data set's ``imu0/sensor.yaml`` (Burri et al.,
IJRR 2016). Range (±1000 °/s, ±18 g), resolution (0.04 °/s and 1/1200 g, of which the samples of the data set are
multiples) and bandwidth (330 Hz) are those of the data sheet (Analog Devices, ADIS16448). The unit is regarded as
calibrated, without scale errors, misalignments and g-sensitivity."""
UNKNOWN_IMU = replace(EUROC_IMU, name="unknown")
"""The IMU of a rig that has none, or none that is known."""
