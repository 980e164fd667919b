"""Image sensor: grey levels from light and exposure.

Grey levels are linear in light, as machine vision cameras deliver them: textures are painted as such a camera shows
them when well exposed, so that a rendered level *is* light, relative to saturation at the nominal exposure and a gain
of 1. No gamma curve is applied. Real scenes have a wider range of light than painted textures, which
`Imaging.contrast` widens.

The order follows the EMVA standard 1288 (release 4.0, linear, eq. 2-11): irradiance × exposure time, lens, photon noise
and read noise; then the gain, which amplifies both, saturation and quantization.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings
from dronevio.sim.cameras.exposure import (
    WHITE,
    AutoExposure,
    Exposure,
    Exposures,
    ExposureSequence,
    FixedExposure,
)

Light = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
GreyImage = npt.NDArray[np.uint8]

MIDDLE_GREY = np.float32(128.0)
"""Grey level that the contrast leaves as it is."""


_LEVELS = 65536  # of the noise before quantization


@dataclass(frozen=True)
class Imaging(Settings):
    """Image sensor with vignetting: the linear model of EMVA 1288, in grey levels."""

    control: FixedExposure | AutoExposure = field(default_factory=FixedExposure)
    """Control of exposure time and gain."""
    nominal_exposure_s: Annotated[float, Range(above=0.0)] = 0.002
    """Exposure time at which a well-lit world appears as painted, at gain 1 [s]."""
    read_sigma: Annotated[float, Range(0.0, 255.0)] = 1.2
    """Standard deviation of the noise of a black image at gain 1 [grey levels]."""
    shot_sigma: Annotated[float, Range(0.0, 255.0)] = 2.2
    """Standard deviation of the photon noise of a white image at gain 1 [grey levels]; 2.2 corresponds to a full-well
    capacity of (255 / 2.2)² = 13 000 electrons, typical of pixels of 5 µm."""
    vignetting: Annotated[float, Range(0.0, 1.0)] = 0.18
    """Relative loss of light at the corner farthest from the centre."""
    blur_sigma_px: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Standard deviation of the Gaussian point spread of lens and pixels, beyond the area of a pixel [px]."""
    response_sigma: Annotated[float, Range(0.0, 0.2)] = 0.0
    """Relative standard deviation of the response of pixels (PRNU of EMVA 1288), a pattern that is fixed for each
    camera."""
    contrast: Annotated[float, Range(0.1, 10.0)] = 1.0
    """Exponent of the light of the world relative to grey level 128; above 1, shadows are darker and bright surfaces
    saturate. It applies to the light of a whole exposure."""

    def exposure_sequence(self) -> ExposureSequence:
        """Return the exposures of the frames of a flight, one at a time; see `ExposureControl.sequence`."""
        sequence = self.control.sequence(self.nominal_exposure_s)
        if self.contrast == 1.0:
            return sequence
        light = self._light_of(np.arange(WHITE + 1.0, dtype=np.float32))
        return _ContrastedSequence(sequence, np.minimum(np.rint(light), WHITE).astype(np.int64))

    def _light_of(self, levels: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the light of painted grey levels [grey levels]."""
        return np.asarray(MIDDLE_GREY * np.power(levels / MIDDLE_GREY, self.contrast), dtype=np.float32)

    def exposures(self, histograms: Array, irradiance: Array) -> Exposures:
        """Return exposure time and gain of M frames.

        Args:
            histograms: (M, 256) Fraction of the pixels on each grey level in a well-lit world at nominal exposure.
            irradiance: (M,) Irradiance relative to a well-lit world.
        """
        sequence = self.exposure_sequence()
        return Exposures.of([sequence.expose(*frame) for frame in zip(histograms, irradiance.tolist(), strict=True)])

    def digitize(
        self,
        light: Light,
        irradiance: float,
        exposure_s: float,
        gain: float,
        rng: np.random.Generator,
        pixels: int = 0,
    ) -> GreyImage:
        """Return the grey image (H, W) that the sensor delivers for some light.

        The noise before the gain is σ² = read² + shot² · signal / 255; quantization adds 1/12 after it.

        Args:
            light: (H, W) Image of the well-lit world at nominal exposure [grey levels].
            irradiance: Irradiance relative to a well-lit world.
            exposure_s: Exposure time [s].
            gain: Gain of the sensor.
            rng: Generator of the noise.
            pixels: Seed of the pattern of the pixels' response, another one for each camera.
        """
        lens = _lens(*light.shape, self.vignetting)
        if self.contrast != 1.0:
            light = self._light_of(light.astype(np.float32))
        if self.blur_sigma_px > 0.0:
            import cv2  # 0.05 s, for which help texts would wait

            light = cv2.GaussianBlur(light.astype(np.float32), (0, 0), self.blur_sigma_px)  # type: ignore[assignment]
        signal = light * (lens * np.float32(irradiance * exposure_s / self.nominal_exposure_s))
        if self.response_sigma > 0.0:
            signal *= _response(*light.shape, self.response_sigma, pixels)
        noise = self.shot_sigma**2 / WHITE * signal
        noise += self.read_sigma**2
        np.sqrt(noise, out=noise)
        noise *= _standard_normal(rng, light.shape)
        signal += noise
        signal *= np.float32(gain)
        return np.asarray(np.clip(np.rint(signal, out=signal), 0.0, WHITE, out=signal), dtype=np.uint8)


VI_SENSOR = Imaging(
    control=AutoExposure(target_level=120.0, longest_s=0.020),
    nominal_exposure_s=0.018,
    read_sigma=0.3,
    shot_sigma=2.4,
    blur_sigma_px=0.6,
    response_sigma=0.006,
    contrast=2.0,
)
"""The image sensor of EuRoC's drone in a hall with windows, by real images of the flight MH_01: exposures up to 20 ms,
bright surfaces that saturate, and a pattern of the pixels' response that does not move with the scene."""

IMAGE_SENSORS: Mapping[str, Imaging] = {"standard": Imaging(), "vi-sensor": VI_SENSOR}
"""Image sensors by name: that of the scenarios, with short exposures, and that of EuRoC's drone."""


def image_sensor_named(name: str) -> Imaging:
    """Return an image sensor by its name.

    Raises:
        ConfigError: There is no image sensor of this name.
    """
    if name not in IMAGE_SENSORS:
        raise ConfigError(f"no image sensor {name!r}; expected one of {', '.join(IMAGE_SENSORS)}")
    return IMAGE_SENSORS[name]


@dataclass(frozen=True)
class _ContrastedSequence:
    """Exposures of a control for the light of painted grey levels."""

    sequence: ExposureSequence
    levels: npt.NDArray[np.int64]  # (256,) level of the light of each painted level

    def expose(self, histogram: Array, irradiance: float) -> Exposure:
        """Return the exposure of the next frame."""
        light = np.bincount(self.levels, weights=histogram, minlength=len(histogram)).astype(np.float64)
        return self.sequence.expose(light, irradiance)


def _standard_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return standard normal noise, drawn from 65536 equally probable values in a fifth of the time of NumPy's."""
    return np.take(_normal_quantiles(), rng.integers(_LEVELS, size=shape, dtype=np.uint16))


@lru_cache(maxsize=1)
def _normal_quantiles() -> npt.NDArray[np.float32]:
    """Return the quantiles of the standard normal distribution at the centres of equally probable intervals."""
    from scipy.special import ndtri

    return np.asarray(ndtri((np.arange(_LEVELS) + 0.5) / _LEVELS), dtype=np.float32)


@lru_cache(maxsize=8)
def _lens(height: int, width: int, vignetting: float) -> npt.NDArray[np.float32]:
    """Return the relative transmission (H, W) of the lens."""
    y, x = np.ogrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.asarray(1.0 - vignetting * (x**2 + y**2) / 2.0, dtype=np.float32)


@lru_cache(maxsize=8)
def _response(height: int, width: int, sigma: float, seed: int) -> npt.NDArray[np.float32]:
    """Return the relative response (H, W) of the pixels of a camera."""
    pattern = np.random.default_rng([seed, 1288]).standard_normal((height, width), dtype=np.float32)
    return np.asarray(1.0 + sigma * pattern, dtype=np.float32)
