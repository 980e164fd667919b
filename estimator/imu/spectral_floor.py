"""Upper bound of the white noise in IMU samples: the lowest density of their spectrum.

The spectrum of the samples is the sum of those of motion, vibration and noise. Motion is slow and vibration has lines,
so that there is a band in between with little but noise. White noise cannot exceed the density of that band, whatever
the calibration of the rig is. Vibration whose frequency wanders, or that is aliased, spreads over all bands
and acts like white noise (Welch, "The use of fast Fourier transform for the estimation of power spectra", 1967).
"""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples

SEGMENT = 64
"""Number of samples of one spectrum."""
SEGMENTS = 3
"""Number of spectra that are averaged: a second at 200 Hz."""
BANDS = 6
"""Number of bands, all of the same width, above an eighth of the sampling rate."""
_WINDOW = np.hanning(SEGMENT + 1)[:-1]
_LOWEST = SEGMENT // 8


class SpectralFloor:
    """Determines the lowest spectral density of a stream of samples."""

    def __init__(self) -> None:
        """Begin before the first sample."""
        self._values = np.zeros((0, 6))  # of the segment that is not complete
        self._times_ns = np.zeros(0, dtype=np.int64)
        self._powers: tuple[Array, ...] = ()  # (BANDS, 2) of the last segments
        self._interval_s, self._densities = 0.0, (0.0, 0.0)

    @property
    def interval_s(self) -> float:
        """Median interval of the samples [s]; zero before the first `SEGMENT` samples."""
        return self._interval_s

    @property
    def densities(self) -> tuple[float, float]:
        """Bounds for gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz]; zero before the first `SEGMENT` samples."""
        return self._densities

    def add(self, samples: ImuSamples) -> bool:
        """Add later samples and return whether they complete a segment, which changes the densities."""
        self._values = np.concatenate([self._values, np.hstack([samples.gyro_rad_s, samples.accel_m_s2])])
        self._times_ns = np.concatenate([self._times_ns, samples.t_ns])
        is_complete = len(self._values) >= SEGMENT
        while len(self._values) >= SEGMENT:
            self._interval_s = float(np.median(np.diff(self._times_ns[:SEGMENT]))) * 1e-9
            self._powers = (*self._powers, _band_powers(self._values[:SEGMENT], self._interval_s))[-SEGMENTS:]
            self._values, self._times_ns = self._values[SEGMENT:], self._times_ns[SEGMENT:]
        if is_complete:
            gyro, accel = np.sqrt(np.mean(self._powers, axis=0).min(axis=0)).tolist()
            self._densities = gyro, accel
        return is_complete


def _band_powers(values: Array, interval_s: float) -> Array:
    """Return the two-sided spectral densities (BANDS, 2) of the axes of gyroscope and accelerometer with most power."""
    spectrum = np.fft.rfft((values - values.mean(axis=0)) * _WINDOW[:, None], axis=0)[_LOWEST:-1]
    power = interval_s * np.abs(spectrum) ** 2 / (_WINDOW @ _WINDOW)
    bands = power.reshape(BANDS, -1, 2, 3).mean(axis=1)
    return np.asarray(bands.max(axis=2))
