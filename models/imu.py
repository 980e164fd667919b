"""The inertial measurement unit: its samples, and the densities that describe its noise."""

from dataclasses import dataclass
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
    """An IMU's rate and noise, as continuous-time densities (IEEE 952; Kalibr's conventions)."""

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


ADIS16448 = ImuModel()
"""The IMU of EuRoC's rig; densities from the data set's ``imu0/sensor.yaml`` (Burri et al., IJRR 2016)."""
