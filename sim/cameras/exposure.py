"""Exposure control: exposure time and gain of each frame, fixed or from the brightness of earlier frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol, Self

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings, require

WHITE = 255.0
"""Grey level at which the converter saturates."""
_SETTLING_STEPS = 100  # iterations of the exposure control before the first frame, each of which halves its error


@dataclass(frozen=True)
class Exposure:
    """True exposure time and gain of one frame."""

    time_s: float
    """Exposure time [s]."""
    gain: float
    """Gain, 1 or more."""


@dataclass(frozen=True, eq=False)
class Exposures:
    """True exposure time and gain of each frame."""

    time_s: Array
    """(M,) Exposure times [s]."""
    gain: Array
    """(M,) Gains, 1 or more."""

    @classmethod
    def of(cls, frames: Sequence[Exposure]) -> Self:
        """Return the exposures of M frames."""
        return cls(np.array([frame.time_s for frame in frames]), np.array([frame.gain for frame in frames]))

    def __len__(self) -> int:
        return len(self.time_s)


class ExposureSequence(Protocol):
    """Interface of the exposures of successive frames, computed one at a time."""

    def expose(self, histogram: Array, irradiance: float) -> Exposure:
        """Return exposure time and gain of the next frame.

        They depend on earlier frames only, except those of the first frame, on which the control has settled.

        Args:
            histogram: (256,) Fraction of the frame's pixels on each grey level in a well-lit world at nominal exposure.
            irradiance: Irradiance relative to a well-lit world during the frame.
        """


class ExposureControl(Protocol):
    """Interface of an exposure control, which sets exposure time and gain of every frame."""

    @property
    def needs_histograms(self) -> bool:
        """Whether it uses the histograms of the frames."""

    @property
    def longest_s(self) -> float:
        """Longest exposure time that it sets [s]."""

    def sequence(self, nominal_s: float) -> ExposureSequence:
        """Return the exposures of the frames of a flight, from the first frame on.

        Args:
            nominal_s: Exposure time at which a well-lit world appears as painted [s].
        """


@dataclass(frozen=True)
class FixedExposure(Settings):
    """Constant exposure time and gain."""

    time_s: Annotated[float, Range(above=0.0, high=1.0)] = 0.002
    """Exposure time of all frames [s]."""
    gain: Annotated[float, Range(1.0, 1e3)] = 1.0
    """Gain of all frames, 1 or more."""

    @property
    def needs_histograms(self) -> bool:
        """False, since the exposure is constant."""
        return False

    @property
    def longest_s(self) -> float:
        """The constant exposure time [s]."""
        return self.time_s

    def sequence(self, nominal_s: float) -> ExposureSequence:
        """Return constant values."""
        return _ConstantSequence(Exposure(self.time_s, self.gain))


@dataclass(frozen=True)
class AutoExposure(Settings):
    """Automatic exposure: controls the mean level of the image by the exposure time and, at its limit, by the gain.

    A measurement on one frame takes effect two frames later, as in sensors that apply settings during readout. The
    control is integral on the logarithm of exposure × gain,

        x[k + 2] = x[k + 1] + speed · log(target / mean[k]),

    whose characteristic polynomial z² − z + speed has the double root ½ at speed = ¼: the fastest response without
    overshoot. A frame that is mostly saturated underestimates its error, so that up to three times the correction is
    applied then; the loop is stable below a speed of 1.
    """

    target_level: Annotated[float, Range(above=0.0, below=255.0)] = 110.0
    """Desired mean grey level of the image."""
    tolerance: Annotated[float, Range(0.0, 10.0)] = 0.05
    """Relative error of the mean that is not corrected, which prevents oscillation."""
    speed: Annotated[float, Range(above=0.0, below=1.0 / 3.0)] = 0.25
    """Fraction of the logarithmic error that is corrected with each frame."""
    shortest_s: Annotated[float, Range(above=0.0, high=1.0)] = 2e-5
    """Shortest exposure time [s]."""
    longest_s: Annotated[float, Range(above=0.0, high=1.0)] = 0.010
    """Longest exposure time [s]: a compromise between noise and motion blur."""
    largest_gain: Annotated[float, Range(1.0, 1e3)] = 16.0
    """Largest gain (24 dB, common for global-shutter sensors)."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: One of them is out of range, or the shortest exposure is longer than the longest.
        """
        super().__post_init__()
        require(self, self.shortest_s <= self.longest_s, "shortest_s", f"at most longest_s, {self.longest_s:g}")

    @property
    def needs_histograms(self) -> bool:
        """True, since the mean level is computed from histograms."""
        return True

    def sequence(self, nominal_s: float) -> ExposureSequence:
        """Return a control that settles on the first frame."""
        return _ControlledSequence(self, nominal_s)


@dataclass(frozen=True)
class _ConstantSequence:
    """Equal exposures of all frames."""

    exposure: Exposure

    def expose(self, histogram: Array, irradiance: float) -> Exposure:
        """Return the constant values."""
        return self.exposure


class _ControlledSequence:
    """Exposures of an automatic control; its state is the logarithm x of exposure time × gain."""

    def __init__(self, control: AutoExposure, nominal_s: float) -> None:
        """Start at the nominal exposure."""
        self._control, self._nominal_s = control, nominal_s
        self._limits = np.log([control.shortest_s, control.longest_s * control.largest_gain])
        self._levels = np.arange(int(WHITE) + 1)
        self._start = float(np.log(np.clip(nominal_s, control.shortest_s, control.longest_s)))
        self._states: tuple[float, float] | None = None  # x of the next frame and of the one after it

    def expose(self, histogram: Array, irradiance: float) -> Exposure:
        """Return the exposure of the next frame, and correct that of the frame two frames later."""
        now, later = self._states or (self._settled(histogram, irradiance),) * 2
        self._states = later, self._corrected(later, now, histogram, irradiance)
        product_s = float(np.exp(now))
        time_s = min(product_s, self._control.longest_s)
        return Exposure(time_s, product_s / time_s)

    def _settled(self, histogram: Array, irradiance: float) -> float:
        """Return the state at which the control does not correct the first frame."""
        x = self._start
        for _ in range(_SETTLING_STEPS):
            x = self._corrected(x, x, histogram, irradiance)
        return x

    def _corrected(self, x: float, seen_at: float, histogram: Array, irradiance: float) -> float:
        """Return a state after a correction by the histogram of a frame that was exposed at the state ``seen_at``."""
        control = self._control
        image = np.minimum(self._levels * irradiance * np.exp(seen_at) / self._nominal_s, WHITE)
        error = np.log(control.target_level / max(float(histogram @ image), 1.0))
        white = float(histogram @ (image >= WHITE))
        speed = control.speed * (1.0 + 2.0 * max(2.0 * white - 1.0, 0.0))
        return float(np.clip(x + speed * error * (abs(error) > control.tolerance), *self._limits))
