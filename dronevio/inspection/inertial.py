"""Measurements in the samples of an IMU alone: rest, gravity, the axes of the accelerometer, noise and vibration."""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.rotation import integrated_rotations

WINDOW_S = 8.0
"""Duration over which specific forces are compared in one frame [s]: a bias of 0.1 °/s turns it by less than 1°."""
MIN_WINDOW_SAMPLES = 20
"""Smallest number of samples of such a window."""
BIN_S = 0.1
"""Duration over which samples are averaged [s]; vibration is faster and motion is slower."""
REST_S = 0.2
"""Duration of the parts of a flight that are judged to be at rest or moving [s]."""
REST_RATE_RAD_S, REST_FORCE_M_S2 = 0.02, 0.15
"""Largest mean rate, and largest change of the mean specific force to the next part, at rest: 1 °/s and 1 % of gravity;
hands and a hovering drone move more."""
MIN_REST_S = 1.0
"""Shortest rest that is reported [s]."""
VIBRATION_HZ = 20.0
"""Frequency above which accelerations are vibration and not motion [Hz]."""
SPECTRUM_SAMPLES = 256
"""Number of samples of a section of the spectrum."""
ALLAN_SAMPLES = 8
"""Smallest number of clusters of the Allan deviation at its longest time."""

AXES = tuple(
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
)
"""The 48 ways in which the axes of a sensor can be exchanged or reversed; the first changes nothing."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Power spectral density, summed over the three axes."""

    frequency_hz: Array
    """(F,) Frequencies of the densities [Hz]."""
    gyro: Array
    """(F,) Density of the gyroscope [(rad/s)²/Hz]."""
    accel: Array
    """(F,) Density of the accelerometer [(m/s²)²/Hz]."""

    def vibration(self) -> tuple[float, float, float]:
        """Return root mean squares of gyroscope and accelerometer above `VIBRATION_HZ`, and the loudest frequency."""
        above = self.frequency_hz > VIBRATION_HZ
        if not above.any():
            return 0.0, 0.0, float("nan")
        step = float(self.frequency_hz[1] - self.frequency_hz[0])
        gyro, accel = (float(np.sqrt(each[above].sum() * step)) for each in (self.gyro, self.accel))
        return gyro, accel, float(self.frequency_hz[above][np.argmax(self.accel[above])])


@dataclass(frozen=True, eq=False)
class AllanDeviation:
    """Allan deviation of an IMU at rest, the root mean square over the axes."""

    tau_s: Array
    """(K,) Averaging times [s]."""
    gyro: Array
    """(K,) Deviation of the gyroscope [rad/s]."""
    accel: Array
    """(K,) Deviation of the accelerometer [m/s²]."""

    def density(self) -> tuple[float, float]:
        """Return the white noise densities, σ √τ at the shortest times [rad/s/√Hz, m/s²/√Hz]."""
        short = self.tau_s <= 8.0 * self.tau_s[0]
        root = np.sqrt(self.tau_s[short])
        return float(np.median(self.gyro[short] * root)), float(np.median(self.accel[short] * root))


def spectrum_of(imu: ImuSamples) -> Spectrum | None:
    """Return the spectrum by Welch's method with Hann windows; None for fewer samples than a section has."""
    n = SPECTRUM_SAMPLES
    if len(imu) < n:
        return None
    rate_hz = 1e9 / float(np.median(np.diff(imu.t_ns)))
    window = np.hanning(n)
    starts = np.arange(0, len(imu) - n + 1, n // 2)
    density = []
    for values in (imu.gyro_rad_s, imu.accel_m_s2):
        sections = np.lib.stride_tricks.sliding_window_view(values, n, axis=0)[starts]  # (S, 3, n)
        sections = sections - sections.mean(axis=2, keepdims=True)
        power = (np.abs(np.fft.rfft(sections * window, axis=2)) ** 2).mean(axis=0).sum(axis=0)
        density.append(2.0 * power / (rate_hz * float(window @ window)))
    return Spectrum(np.asarray(np.fft.rfftfreq(n, 1.0 / rate_hz), np.float64), density[0], density[1])


def resting(imu: ImuSamples, bias_rad_s: Array | None) -> list[tuple[int, int]]:
    """Return the intervals of rest, as the first and the last time stamp of each [ns].

    Args:
        imu: The samples.
        bias_rad_s: (3,) Bias of the gyroscope; None to take the part of the flight that turns most evenly.
    """
    if len(imu) < 10:
        return []
    starts, counts = _parts(imu.t_ns, REST_S)
    gyro = np.add.reduceat(imu.gyro_rad_s, starts, axis=0) / counts[:, None]
    force = np.add.reduceat(imu.accel_m_s2, starts, axis=0) / counts[:, None]
    change = np.linalg.norm(np.diff(gyro, axis=0, append=gyro[-1:]), axis=1)
    bias = gyro[np.argsort(change)[: max(1, len(gyro) // 10)]].mean(axis=0) if bias_rad_s is None else bias_rad_s
    level = np.median(np.linalg.norm(force, axis=1))
    still = np.linalg.norm(gyro - bias, axis=1) < REST_RATE_RAD_S
    still &= np.linalg.norm(np.diff(force, axis=0, append=force[-1:]), axis=1) < REST_FORCE_M_S2
    still &= np.abs(np.linalg.norm(force, axis=1) - level) < 0.1 * level
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    ends = np.append(starts[1:], len(imu)) - 1
    intervals = [(int(imu.t_ns[starts[a]]), int(imu.t_ns[ends[b - 1]])) for a, b in edges.reshape(-1, 2).tolist()]
    return [(a, b) for a, b in intervals if b - a >= MIN_REST_S * 1e9]


def mean_force_m_s2(imu: ImuSamples, bias_rad_s: Array) -> float:
    """Return the magnitude of the mean specific force in a frame that does not turn: gravity, over times of any motion.

    The mean over T of the acceleration is the change of velocity divided by T, so that windows of some seconds suffice.

    Args:
        imu: Samples over a second or more.
        bias_rad_s: (3,) Bias of the gyroscope.
    """
    means = [products.mean(axis=0) for products in _levelled(imu, bias_rad_s)]
    return float(np.median([np.linalg.norm(np.einsum("ijj->i", mean)) for mean in means]))


def spread_of_axes(imu: ImuSamples, bias_rad_s: Array) -> Array:
    """Return the variance of the specific force in a frame that does not turn, for each of `AXES` (48,) [(m/s²)²].

    In such a frame, gravity is constant, and the rest is the acceleration of the vehicle. If the axes of the
    accelerometer are not those of the gyroscope, gravity turns with the vehicle and adds to the variance. A reversal of
    all axes leaves it unchanged.

    Args:
        imu: Samples over a second or more.
        bias_rad_s: (3,) Bias of the gyroscope.
    """
    windows = _levelled(imu, bias_rad_s)
    forces = (np.einsum("bijk,ajk->abi", products, np.array(AXES)) for products in windows)
    return np.asarray(np.mean([force.var(axis=1).sum(axis=1) for force in forces], axis=0))


def _levelled(imu: ImuSamples, bias_rad_s: Array) -> list[Array]:
    """Return the means (B, 3, 3, 3) of R_ij f_k of each window: Σ R_ij A_jk f_k is the force with axes A, levelled.

    R turns vectors into the frame at the beginning of the window.
    """
    means = imu.increments()
    dt_s = np.diff(means.t_ns, prepend=means.t_ns[:1] - int(np.median(np.diff(means.t_ns)))) * 1e-9
    windows = max(1, int((means.t_ns[-1] - means.t_ns[0]) * 1e-9 / WINDOW_S))
    ends = np.searchsorted(means.t_ns, np.linspace(means.t_ns[0], means.t_ns[-1] + 1, windows + 1))
    means_by_window = []
    for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if b - a < MIN_WINDOW_SAMPLES:  # within a gap
            continue
        R = integrated_rotations((means.gyro_rad_s[a:b] - bias_rad_s) * dt_s[a:b, None])[:-1]
        products = R[:, :, :, None] * means.accel_m_s2[a:b, None, None]
        bins, counts = _parts(means.t_ns[a:b], BIN_S)
        means_by_window.append(np.add.reduceat(products, bins, axis=0) / counts[:, None, None, None])
    return means_by_window


def allan_deviation(imu: ImuSamples) -> AllanDeviation | None:
    """Return the overlapping Allan deviation of samples at rest (IEEE Std 952-1997, annex C); None for few samples."""
    n = len(imu)
    sizes = np.unique(np.round(np.logspace(0.0, np.log10(max(n / ALLAN_SAMPLES, 1.0)), 24)).astype(int))
    if n < 64:
        return None
    step_s = float(np.median(np.diff(imu.t_ns))) * 1e-9
    integral = np.concatenate([np.zeros((1, 6)), np.cumsum(np.hstack([imu.gyro_rad_s, imu.accel_m_s2]), axis=0)])
    variance = []
    for m in sizes.tolist():
        mean = (integral[m:] - integral[:-m]) / m
        variance.append(0.5 * np.mean((mean[m:] - mean[:-m]) ** 2, axis=0))
    deviation = np.sqrt(np.array(variance).reshape(-1, 2, 3).mean(axis=2))
    return AllanDeviation(sizes * step_s, deviation[:, 0], deviation[:, 1])


def _parts(t_ns: npt.NDArray[np.int64], duration_s: float) -> tuple[npt.NDArray[np.int64], ...]:
    """Return the first sample and the number of samples of each part of a duration."""
    part = (t_ns - t_ns[0]) // round(duration_s * 1e9)
    starts = np.flatnonzero(np.diff(part, prepend=-1))
    return starts, np.diff(np.append(starts, len(t_ns)))
