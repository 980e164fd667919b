"""Image sensor: grey levels from light and exposure.

Grey levels are linear in light, as machine vision cameras deliver them: textures are painted as such a camera shows
them when well exposed, so that a rendered level *is* light, relative to saturation at the nominal exposure and a gain
of 1. No gamma curve is applied.

The order follows the EMVA standard 1288 (release 4.0, linear, eq. 2-11): irradiance × exposure time, lens, photon noise
and read noise; then the gain, which amplifies both, saturation and quantization.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError

Array = npt.NDArray[np.float64]
Light = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
GreyImage = npt.NDArray[np.uint8]

WHITE = 255.0
"""Grey level at which the converter saturates."""
_SETTLING_STEPS = 100  # iterations of the exposure control before the first frame, each of which halves its error


@dataclass(frozen=True, eq=False)
class Exposures:
    """True exposure time and gain of each frame."""

    time_s: Array
    """(M,) Exposure times [s]."""
    gain: Array
    """(M,) Gains, 1 or more."""

    def __len__(self) -> int:
        return len(self.time_s)


class ExposureControl(Protocol):
    """Interface of an exposure control, which sets exposure time and gain of every frame."""

    @property
    def needs_histograms(self) -> bool:
        """Whether it uses the histograms of the frames."""

    @property
    def longest_s(self) -> float:
        """Longest exposure time that it sets [s]."""

    def exposures(self, histograms: Array, irradiance: Array, nominal_s: float) -> Exposures:
        """Return exposure time and gain of M frames, each computed from earlier frames only.

        Args:
            histograms: (M, 256) Fraction of the pixels on each grey level in a well-lit world at nominal exposure.
            irradiance: (M,) Irradiance relative to a well-lit world.
            nominal_s: Exposure time at which a well-lit world appears as painted [s].
        """


@dataclass(frozen=True)
class FixedExposure:
    """Constant exposure time and gain."""

    time_s: float = 0.002
    """Exposure time of all frames [s]."""
    gain: float = 1.0
    """Gain of all frames, 1 or more."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: One of them is out of range.
        """
        _check(self.time_s > 0.0, "time_s", self.time_s, "more than 0")
        _check(self.gain >= 1.0, "gain", self.gain, "1 or more")

    @property
    def needs_histograms(self) -> bool:
        """False, since the exposure is constant."""
        return False

    @property
    def longest_s(self) -> float:
        """The constant exposure time [s]."""
        return self.time_s

    def exposures(self, histograms: Array, irradiance: Array, nominal_s: float) -> Exposures:
        """Return constant values for as many frames as there are irradiances (M,)."""
        return Exposures(np.full(len(irradiance), self.time_s), np.full(len(irradiance), self.gain))


@dataclass(frozen=True)
class AutoExposure:
    """Automatic exposure: controls the mean level of the image by the exposure time and, at its limit, by the gain.

    A measurement on one frame takes effect two frames later, as in sensors that apply settings during readout. The
    control is integral on the logarithm of exposure × gain,

        x[k + 2] = x[k + 1] + speed · log(target / mean[k]),

    whose characteristic polynomial z² − z + speed has the double root ½ at speed = ¼: the fastest response without
    overshoot. A frame that is mostly saturated underestimates its error, so that up to three times the correction is
    applied then; the loop is stable below a speed of 1.
    """

    target_level: float = 110.0
    """Desired mean grey level of the image."""
    tolerance: float = 0.05
    """Relative error of the mean that is not corrected, which prevents oscillation."""
    speed: float = 0.25
    """Fraction of the logarithmic error that is corrected with each frame."""
    shortest_s: float = 2e-5
    """Shortest exposure time [s]."""
    longest_s: float = 0.010
    """Longest exposure time [s]: a compromise between noise and motion blur."""
    largest_gain: float = 16.0
    """Largest gain (24 dB, common for global-shutter sensors)."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: One of them is out of range.
        """
        _check(0.0 < self.target_level < WHITE, "target_level", self.target_level, "between 0 and 255")
        _check(self.tolerance >= 0.0, "tolerance", self.tolerance, "0 or more")
        _check(0.0 < self.speed < 1.0 / 3.0, "speed", self.speed, "between 0 and 1/3, where the loop is stable")
        _check(0.0 < self.shortest_s <= self.longest_s, "shortest_s", self.shortest_s, "within (0, longest_s]")
        _check(self.largest_gain >= 1.0, "largest_gain", self.largest_gain, "1 or more")

    @property
    def needs_histograms(self) -> bool:
        """True, since the mean level is computed from histograms."""
        return True

    def exposures(self, histograms: Array, irradiance: Array, nominal_s: float) -> Exposures:
        """Return exposure time and gain of M frames; the control has settled on the first one."""
        frames = len(irradiance)
        limits = np.log([self.shortest_s, self.longest_s * self.largest_gain])
        levels = np.arange(histograms.shape[1])
        x = np.full(frames + 2, np.log(np.clip(nominal_s, self.shortest_s, self.longest_s)))

        def corrected(now: float, seen: int, when_seen: float) -> float:
            image = np.minimum(levels * irradiance[seen] * np.exp(when_seen) / nominal_s, WHITE)
            error = np.log(self.target_level / max(float(histograms[seen] @ image), 1.0))
            white = float(histograms[seen] @ (image >= WHITE))
            speed = self.speed * (1.0 + 2.0 * max(2.0 * white - 1.0, 0.0))
            return float(np.clip(now + speed * error * (abs(error) > self.tolerance), *limits))

        if frames:
            for _ in range(_SETTLING_STEPS):
                x[0] = corrected(x[0], 0, x[0])
            x[1] = x[0]
        for k in range(frames):
            x[k + 2] = corrected(x[k + 1], k, x[k])
        product_s = np.exp(x[:frames])
        time_s = np.minimum(product_s, self.longest_s)
        return Exposures(time_s, product_s / time_s)


@dataclass(frozen=True)
class Imaging:
    """Image sensor with vignetting: the linear model of EMVA 1288, in grey levels."""

    control: FixedExposure | AutoExposure = field(default_factory=FixedExposure)
    """Control of exposure time and gain."""
    nominal_exposure_s: float = 0.002
    """Exposure time at which a well-lit world appears as painted, at gain 1 [s]."""
    read_sigma: float = 1.2
    """Standard deviation of the noise of a black image at gain 1 [grey levels]."""
    shot_sigma: float = 2.2
    """Standard deviation of the photon noise of a white image at gain 1 [grey levels]; 2.2 corresponds to a full-well
    capacity of (255 / 2.2)² = 13 000 electrons, typical of pixels of 5 µm."""
    vignetting: float = 0.18
    """Relative loss of light at the corner farthest from the centre."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: One of them is out of range.
        """
        _check(self.nominal_exposure_s > 0.0, "nominal_exposure_s", self.nominal_exposure_s, "more than 0")
        _check(self.read_sigma >= 0.0, "read_sigma", self.read_sigma, "0 or more")
        _check(self.shot_sigma >= 0.0, "shot_sigma", self.shot_sigma, "0 or more")
        _check(0.0 <= self.vignetting <= 1.0, "vignetting", self.vignetting, "between 0 and 1")

    def exposures(self, histograms: Array, irradiance: Array) -> Exposures:
        """Return exposure time and gain of M frames; see `ExposureControl.exposures`."""
        return self.control.exposures(histograms, irradiance, self.nominal_exposure_s)

    def digitize(
        self, light: Light, irradiance: float, exposure_s: float, gain: float, rng: np.random.Generator
    ) -> GreyImage:
        """Return the grey image (H, W) that the sensor delivers for some light.

        The noise before the gain is σ² = read² + shot² · signal / 255; quantization adds 1/12 after it.

        Args:
            light: (H, W) Image of the well-lit world at nominal exposure [grey levels].
            irradiance: Irradiance relative to a well-lit world.
            exposure_s: Exposure time [s].
            gain: Gain of the sensor.
            rng: Generator of the noise.
        """
        lens = _lens(*light.shape, self.vignetting)
        signal = light * (lens * np.float32(irradiance * exposure_s / self.nominal_exposure_s))
        sigma = np.sqrt(self.read_sigma**2 + self.shot_sigma**2 / WHITE * signal)
        signal += sigma * rng.standard_normal(light.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(signal * np.float32(gain)), 0.0, WHITE), dtype=np.uint8)


@lru_cache(maxsize=8)
def _lens(height: int, width: int, vignetting: float) -> npt.NDArray[np.float32]:
    """Return the relative transmission (H, W) of the lens."""
    y, x = np.ogrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.asarray(1.0 - vignetting * (x**2 + y**2) / 2.0, dtype=np.float32)


def _check(holds: bool, name: str, value: float, expected: str) -> None:
    """Raise ConfigError unless a value is in its range."""
    if not holds:
        raise ConfigError(f"imaging: {name} {value}; expected {expected}")
