"""From light to grey levels: what a sensor makes of what falls on it while its shutter is open.

Grey levels are linear in light, as machine vision cameras deliver them: the worlds' textures are painted as such a
camera shows them when it is well exposed, so that a drawn level *is* light, relative to saturation at the nominal
exposure and a gain of 1. No gamma curve is applied on the way in or out.

The order is that of the EMVA standard 1288 (release 4.0, linear, eq. 2-11): irradiance × exposure time, lens, photon
noise and read noise, then the gain, which amplifies both, saturation, quantization.
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
"""The level at which the converter saturates [grey levels]."""
_SETTLING_STEPS = 100  # of the exposure control before the first frame: it halves its error with each


@dataclass(frozen=True, eq=False)
class Exposures:
    """How long each frame was exposed, and how much it was amplified: known truth."""

    time_s: Array
    """(M,) Exposure times [s]."""
    gain: Array
    """(M,) Amplifications, 1 or more."""

    def __len__(self) -> int:
        return len(self.time_s)


class ExposureControl(Protocol):
    """Chooses exposure time and gain of every frame."""

    @property
    def needs_histograms(self) -> bool:
        """Whether it wants to see the frames' histograms."""

    @property
    def longest_s(self) -> float:
        """The longest exposure that it chooses [s]."""

    def exposures(self, histograms: Array, irradiance: Array, nominal_s: float) -> Exposures:
        """Return what is chosen for M frames, from earlier ones alone.

        Args:
            histograms: (M, 256) Share of the pixels on each grey level in a well lit world, nominally exposed.
            irradiance: (M,) Light that falls in, relative to a well lit world.
            nominal_s: Exposure that shows such a world as it is painted [s].
        """


@dataclass(frozen=True)
class FixedExposure:
    """The same exposure for every frame."""

    time_s: float = 0.002
    """Exposure time [s]."""
    gain: float = 1.0
    """Amplification, 1 or more."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: One of them is out of range.
        """
        _check(self.time_s > 0.0, "time_s", self.time_s, "more than 0")
        _check(self.gain >= 1.0, "gain", self.gain, "1 or more")

    @property
    def needs_histograms(self) -> bool:
        """False: it looks at nothing."""
        return False

    @property
    def longest_s(self) -> float:
        """The exposure time [s]."""
        return self.time_s

    def exposures(self, histograms: Array, irradiance: Array, nominal_s: float) -> Exposures:
        """Return the same for as many frames as there are irradiances (M,)."""
        return Exposures(np.full(len(irradiance), self.time_s), np.full(len(irradiance), self.gain))


@dataclass(frozen=True)
class AutoExposure:
    """Holds the mean level of the image: first by the exposure time, then, where that is at its limit, by the gain.

    What is measured on one frame takes effect two frames later, as in sensors that shift their settings in during
    readout. The control is integral on the logarithm of exposure × gain,

        x[k + 2] = x[k + 1] + speed · log(target / mean[k]),

    whose characteristic polynomial z² − z + speed has the double root ½ at speed = ¼: the fastest response that does
    not overshoot. A frame that is mostly white does not tell how much too bright it is, so up to three times as much is
    corrected then; the loop stays stable below a speed of 1.
    """

    target_level: float = 110.0
    """Mean grey level that it aims at."""
    tolerance: float = 0.05
    """Relative error of the mean that is left alone, so that the image does not pump."""
    speed: float = 0.25
    """Share of the logarithmic error that is corrected with each frame."""
    shortest_s: float = 2e-5
    """Least exposure time [s]."""
    longest_s: float = 0.010
    """Greatest exposure time [s]: a compromise between noise and motion blur."""
    largest_gain: float = 16.0
    """Greatest amplification (24 dB, usual for global-shutter sensors)."""

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
        """True: it needs the frames' histograms."""
        return True

    def exposures(self, histograms: Array, irradiance: Array, nominal_s: float) -> Exposures:
        """Return what is chosen for M frames; the camera has been looking at the first one for a while already."""
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
    """A sensor behind a lens: EMVA 1288's linear model, in grey levels."""

    control: FixedExposure | AutoExposure = field(default_factory=FixedExposure)
    """Chooses exposure time and gain of every frame."""
    nominal_exposure_s: float = 0.002
    """Exposure that shows a well lit world as it is painted, at gain 1 [s]."""
    read_sigma: float = 1.2
    """Noise of a black image at gain 1 [grey levels]."""
    shot_sigma: float = 2.2
    """Photon noise of a white image at gain 1 [grey levels]; 2.2 means that (255 / 2.2)² = 13 000 electrons fill a
    pixel, typical of pixels of 5 µm."""
    vignetting: float = 0.18
    """How much less light falls on the furthest corner, relative."""

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
        """Return exposure time and gain of M frames, from `ExposureControl.exposures`' arguments."""
        return self.control.exposures(histograms, irradiance, self.nominal_exposure_s)

    def digitize(
        self, light: Light, irradiance: float, exposure_s: float, gain: float, rng: np.random.Generator
    ) -> GreyImage:
        """Return the grey image (H, W) that the sensor delivers.

        Noise before the gain: σ² = read² + shot² · signal / 255; quantization adds 1/12 after it.

        Args:
            light: (H, W) What a well lit world shows at the nominal exposure [grey levels].
            irradiance: Light that falls in, relative to a well lit world.
            exposure_s: Exposure time [s].
            gain: Amplification.
            rng: Draws the noise.
        """
        lens = _lens(*light.shape, self.vignetting)
        signal = light * (lens * np.float32(irradiance * exposure_s / self.nominal_exposure_s))
        sigma = np.sqrt(self.read_sigma**2 + self.shot_sigma**2 / WHITE * signal)
        signal += sigma * rng.standard_normal(light.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(signal * np.float32(gain)), 0.0, WHITE), dtype=np.uint8)


@lru_cache(maxsize=8)
def _lens(height: int, width: int, vignetting: float) -> npt.NDArray[np.float32]:
    """Return the share of light (H, W) that comes through the lens."""
    y, x = np.ogrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.asarray(1.0 - vignetting * (x**2 + y**2) / 2.0, dtype=np.float32)


def _check(holds: bool, name: str, value: float, expected: str) -> None:
    """Raise ConfigError unless a value is as expected."""
    if not holds:
        raise ConfigError(f"imaging: {name} {value}; expected {expected}")
