"""Image sensor: grey levels from light and exposure.

Grey levels are linear in light, as machine vision cameras deliver them: textures are painted as such a camera shows
them when well exposed, so that a rendered level *is* light, relative to saturation at the nominal exposure and a gain
of 1. No gamma curve is applied.

The order follows the EMVA standard 1288 (release 4.0, linear, eq. 2-11): irradiance × exposure time, lens, photon noise
and read noise; then the gain, which amplifies both, saturation and quantization.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.models.ranges import Range, Settings
from dronevio.sim.cameras.exposure import WHITE, AutoExposure, Exposures, ExposureSequence, FixedExposure

Array = npt.NDArray[np.float64]
Light = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
GreyImage = npt.NDArray[np.uint8]


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

    def exposure_sequence(self) -> ExposureSequence:
        """Return the exposures of the frames of a flight, one at a time; see `ExposureControl.sequence`."""
        return self.control.sequence(self.nominal_exposure_s)

    def exposures(self, histograms: Array, irradiance: Array) -> Exposures:
        """Return exposure time and gain of M frames.

        Args:
            histograms: (M, 256) Fraction of the pixels on each grey level in a well-lit world at nominal exposure.
            irradiance: (M,) Irradiance relative to a well-lit world.
        """
        sequence = self.exposure_sequence()
        return Exposures.of([sequence.expose(*frame) for frame in zip(histograms, irradiance.tolist(), strict=True)])

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
        noise = self.shot_sigma**2 / WHITE * signal
        noise += self.read_sigma**2
        np.sqrt(noise, out=noise)
        noise *= rng.standard_normal(light.shape, dtype=np.float32)
        signal += noise
        signal *= np.float32(gain)
        return np.asarray(np.clip(np.rint(signal, out=signal), 0.0, WHITE, out=signal), dtype=np.uint8)


@lru_cache(maxsize=8)
def _lens(height: int, width: int, vignetting: float) -> npt.NDArray[np.float32]:
    """Return the relative transmission (H, W) of the lens."""
    y, x = np.ogrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.asarray(1.0 - vignetting * (x**2 + y**2) / 2.0, dtype=np.float32)
