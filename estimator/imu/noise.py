"""Online estimation of the IMU's noise densities by variance components.

A data sheet describes a unit at rest on a bench. Vibration, a flexible mount and clock jitter make the accelerometer of
a real flight ten times noisier; another one is as good as specified. The squared residuals of the IMU factors that
leave the window are therefore compared with their expectation under the assumed noise. The estimate is fitted to the
same measurements, so that the expectation counts in proportion to the redundancy of the residual (variance component
estimation: Förstner, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten", 1979; Förstner and Wrobel,
"Photogrammetric Computer Vision", 2016, section 4.2.4).

Before the first interval has left the window, the noise is that of the data sheet, inflated, or that of a stationary
initialization if it is larger: the Allan variance of the means between frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dronevio.estimator.imu.buffer import Increments, joined
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.imu.random_walk import RandomWalkEstimator
from dronevio.estimator.imu.spectral_floor import SpectralFloor
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
from dronevio.models.ranges import Range, Settings
from dronevio.models.state import NavState

NOISY_RATIO = 1.3
"""Ratio of the noise at rest to the data sheet beyond which the random walks are larger, too. The noise of 0.8 s at 20
frames per second is known to a tenth (one standard deviation)."""
WHITE_SAMPLES = (2, 4)
"""Numbers of samples over which noise at rest is averaged to find out whether it is white. Over single intervals, the
density would be halved where increments are means of two readings."""
MAX_COLOUR = 1.6
"""Ratio between the densities of the noise at different intervals beyond which it is not white."""
NOISE_SHARE = 0.5
"""Noise density that is expected for a spectral floor, relative to the floor; the rest is motion. On EuRoC's flights,
the estimates end there."""
GROSS_RATIO = 4.0
"""Ratio by which this expectation must exceed both the estimate and the initial noise to replace the estimate."""
FLOOR_STEP = 1.5
"""Ratio by which a spectral floor must exceed all before it for that: the noise has changed."""
LEFT_OUT_INTERVALS = 1.5
"""Ratio between the interval of the samples and that of the data sheet beyond which samples are left out, as by
loggers."""
LEFT_OUT_RATIO = 4.0
"""Factor on the spectral floor of such samples: on EuRoC's flights with every second sample, vibration at 90 to 100 Hz
appears at 0 to 10 Hz, below the bands of the floor, with up to four times its density."""
EXCESSIVE_RATIO = 20.0
"""Ratio of the estimated noise to the data sheet beyond which it is excessive. On EuRoC's flights it reaches 15."""
EXCESSIVE_SHARE = 0.25
"""Share of such noise that the samples themselves must show; otherwise a wrong calibration may be the reason."""
MIN_REDUNDANCY = 0.5
"""Smallest sum of the redundancies of intervals, three residuals each, that show a noise density."""
MAX_NORMALIZED_SQUARE = 9.0
"""Largest ratio of a squared residual to its expectation, so that a shock is not taken for noise."""


@dataclass(frozen=True)
class NoiseEstimationConfig(Settings):
    """Settings of the estimation of the IMU's noise densities."""

    memory: Annotated[float, Range(low=1.0, infinite=True)] = 50.0
    """Number of intervals between keyframes that are averaged, with exponential forgetting: about ten seconds."""
    prior_weight: Annotated[float, Range(above=0.0)] = 1.0
    """Weight of the initial noise density, as a number of intervals with full redundancy."""
    min_factor: Annotated[float, Range(above=0.0, high=1.0)] = 0.5
    """Smallest ratio of a noise density to its data sheet value."""
    max_factor: Annotated[float, Range(1.0, 1e4)] = 30.0
    """Largest ratio of a noise density to its data sheet value."""
    max_walk_factor: Annotated[float, Range(1.0, 1e4)] = 10.0
    """Largest ratio of a bias's estimated random walk to that of the data sheet, inflated; 1 keeps the latter."""


@dataclass(frozen=True)
class VarianceComponent:
    """The squared residual of an interval in one of its quantities, with its expectation."""

    normalized_square: float
    """Squared residual relative to its expectation under the assumed noise and full redundancy."""
    redundancy: float
    """Share of that expectation which remains after the estimate is fitted, from 0 (only the IMU determines the motion)
    to 1 (the other measurements determine it exactly)."""
    assumed_density2: float
    """Square of the assumed noise density, of the sensor and of all excess noise of the interval."""


@dataclass(frozen=True)
class ImuVarianceComponents:
    """The variance components of a preintegrated interval of the IMU."""

    gyroscope: VarianceComponent
    """Variance component of the rotation."""
    accelerometer: VarianceComponent
    """Variance component of the velocity."""

    @classmethod
    def from_residual(cls, residual: Array, assumed: Array, estimated: Array, dt_s: float) -> "ImuVarianceComponents":
        """Compute the variance components from the residual of an IMU factor at the optimum of a window.

        Args:
            residual: (9,) Residual of rotation, position and velocity, in GTSAM's order.
            assumed: (9, 9) Covariance of the preintegrated measurement by the assumed noise.
            estimated: (9, 9) Covariance of the same quantities by the optimized window, J P Jᵀ.
            dt_s: Length of the interval [s].
        """

        def component(part: slice) -> VarianceComponent:
            expected = float(np.trace(assumed[part, part]))
            redundancy = 1.0 - float(np.trace(estimated[part, part])) / expected
            normalized_square = float(residual[part] @ residual[part]) / expected
            return VarianceComponent(normalized_square, max(redundancy, 0.0), expected / (3.0 * dt_s))

        return cls(component(slice(0, 3)), component(slice(6, 9)))


def stationary_densities(parts: Sequence[Increments]) -> tuple[float, float]:
    """Return the densities of the white noise of a stationary IMU: its Allan variance at the interval of the frames.

    The difference between the means of white noise of density N over two successive intervals of lengths T₁ and T₂ has
    the variance N² (1/T₁ + 1/T₂). Constant biases and gravity cancel, and vibration above the rate of the frames has
    little influence (IEEE Std 952-1997, annex C).

    Args:
        parts: Increments between successive frames, none of them empty.

    Returns:
        Densities of gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz]; zero for fewer than two intervals.
    """
    durations_s = np.array([part.duration_s for part in parts])
    rates = np.array([part.dt_s @ np.hstack([part.gyro_rad_s, part.accel_m_s2]) for part in parts]).reshape(-1, 6)
    differences = np.diff(rates / durations_s[:, None], axis=0)
    if not len(differences):
        return 0.0, 0.0
    inverse_s = np.sum(1.0 / durations_s[1:] + 1.0 / durations_s[:-1])
    squares = np.sum(differences**2, axis=0).reshape(2, 3).mean(axis=1)
    gyro, accel = np.sqrt(squares / inverse_s).tolist()
    return gyro, accel


def is_white(parts: Sequence[Increments]) -> bool:
    """Return whether the noise of a stationary gyroscope and of its accelerometer is white.

    The Allan variance of white noise has the same density at all intervals: here of `WHITE_SAMPLES` and of the frames.

    Args:
        parts: Increments between successive frames, none of them empty. Without any, the noise is not white.
    """
    if not parts:
        return False
    samples = joined(parts)
    groups = ([samples[i : i + n] for i in range(0, len(samples.dt_s) - n + 1, n)] for n in WHITE_SAMPLES)
    densities = np.array([stationary_densities(each) for each in (*groups, parts)])
    return bool(np.all(densities.max(axis=0) <= MAX_COLOUR * densities.min(axis=0)))


def pooled_density(components: Sequence[VarianceComponent]) -> float:
    """Return the noise density that explains the squared residuals of intervals together; 0 if nothing shows it."""
    redundancy = sum(each.redundancy for each in components)
    squares = sum(
        each.assumed_density2 * min(each.normalized_square, MAX_NORMALIZED_SQUARE * each.redundancy)
        for each in components
    )
    return math.sqrt(squares / redundancy) if redundancy > MIN_REDUNDANCY else 0.0


class NoiseDensityEstimator:
    """Estimates the white noise density of one sensor."""

    def __init__(self, data_sheet: float, initial: float, config: NoiseEstimationConfig) -> None:
        """Create an estimator.

        Args:
            data_sheet: Noise density of the data sheet.
            initial: Initial noise density.
            config: Settings.
        """
        self._data_sheet, self._config, self._largest = data_sheet, config, max(config.max_factor * data_sheet, initial)
        # Sums over intervals with exponential forgetting: squared residuals in units of squared density, redundancy
        self._squares = initial**2 * config.prior_weight
        self._redundancy = config.prior_weight

    @property
    def density(self) -> float:
        """Estimated noise density in the unit of the data sheet."""
        c = self._config
        estimated = math.sqrt(self._squares / self._redundancy)
        return float(min(max(estimated, c.min_factor * self._data_sheet), self._largest))

    def raise_limit(self, density: float) -> None:
        """Raise the largest possible estimate to another density."""
        self._largest = max(self._largest, density)

    def raise_to(self, density: float) -> None:
        """Raise the estimated noise density to another one."""
        self._squares = max(self._squares, density**2 * self._redundancy)

    def update(self, component: VarianceComponent) -> None:
        """Add an interval, unless its assumed noise exceeds the range of the estimate because of excess noise."""
        c = self._config
        if component.assumed_density2 > 1.1 * self._largest**2:
            return
        kept = 1.0 - 1.0 / c.memory
        limited = min(component.normalized_square, MAX_NORMALIZED_SQUARE * component.redundancy)
        self._squares = kept * self._squares + component.assumed_density2 * limited
        self._redundancy = kept * self._redundancy + component.redundancy


class ImuNoiseEstimator:
    """Estimates the white noise of gyroscope and accelerometer, and keeps the preintegration parameters current."""

    def __init__(
        self,
        imu: ImuModel,
        inertial: PreintegrationConfig,
        config: NoiseEstimationConfig,
        gravity_m_s2: float = GRAVITY_M_S2,
    ) -> None:
        """Create an estimator whose initial noise densities are those of the data sheet, inflated, or the smallest.

        Args:
            imu: Data sheet of the IMU.
            inertial: Settings of the preintegration, with the initial inflation.
            config: Settings of the estimation.
            gravity_m_s2: Magnitude of gravity [m/s²].
        """
        of_data_sheet = PreintegrationParams.of(imu, inertial, gravity_m_s2)
        inflated = np.sqrt([of_data_sheet.gyro_variance, of_data_sheet.accel_variance])
        smallest = inertial.min_gyro_noise_density, inertial.min_accel_noise_density
        gyro, accel = np.maximum(inflated, smallest).tolist()
        self._gyro = NoiseDensityEstimator(imu.gyro_noise_density, gyro, config)
        self._accel = NoiseDensityEstimator(imu.accel_noise_density, accel, config)
        self._initial = self._params = of_data_sheet.with_noise(gyro, accel)
        self._walks = tuple(
            RandomWalkEstimator(math.sqrt(variance), config.max_walk_factor)
            for variance in (of_data_sheet.gyro_walk_variance, of_data_sheet.accel_walk_variance)
        )
        self._data_sheet = imu.gyro_noise_density, imu.accel_noise_density
        self._at_rest, self._floor = (0.0, 0.0), SpectralFloor()
        self._highest_floor, self._interval_s = np.zeros(2), 1.0 / imu.rate_hz
        self._is_compared = False  # whether an interval has left the window

    @property
    def at_rest(self) -> tuple[float, float]:
        """Noise densities at the last stationary initialization, in the units of `densities`; zero before."""
        return self._at_rest

    @property
    def params(self) -> PreintegrationParams:
        """The noise with which the next interval is preintegrated."""
        return self._params

    def set_gravity(self, gravity_m_s2: float) -> None:
        """Preintegrate from the next interval on with another magnitude of gravity [m/s²]."""
        self._params = replace(self._params, gravity_m_s2=gravity_m_s2)

    @property
    def densities(self) -> tuple[float, float]:
        """Noise densities of gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz]."""
        return self._gyro.density, self._accel.density

    @property
    def measured(self) -> tuple[float, float]:
        """Noise densities that the samples themselves show, whatever the calibration: at rest, or by their spectrum."""
        gyro, accel = zip(self._at_rest, self._shown, strict=True)
        return max(gyro), max(accel)

    @property
    def is_aliased(self) -> bool:
        """Whether samples are left out and vibration therefore appears as slow motion, which is no white noise.

        Before the images have shown the noise of an interval, what the samples show decides.
        """
        return self._are_left_out and (self.is_excessive or (not self._is_compared and self._show_excess))

    @property
    def _show_excess(self) -> bool:
        return any(x > EXCESSIVE_RATIO * sheet > 0.0 for x, sheet in zip(self._shown, self._data_sheet, strict=True))

    @property
    def _are_left_out(self) -> bool:
        return self._floor.interval_s > LEFT_OUT_INTERVALS * self._interval_s

    @property
    def _shown(self) -> tuple[float, float]:
        """Noise densities by the spectrum, larger where vibration may be aliased."""
        gyro, accel = self._floor.densities
        return (LEFT_OUT_RATIO * gyro, LEFT_OUT_RATIO * accel) if self._are_left_out else (gyro, accel)

    @property
    def is_excessive(self) -> bool:
        """Whether images and samples agree that the noise is far above that of the data sheet."""
        densities = zip(self.densities, self._shown, self._data_sheet, strict=True)
        return any(x > EXCESSIVE_RATIO * sheet > 0.0 and floor > EXCESSIVE_SHARE * x for x, floor, sheet in densities)

    def add_imu(self, samples: ImuSamples) -> None:
        """Add samples later than those before.

        Where strong vibration begins, the noise grows at once, and the images show it some seconds later. Until then
        the estimate is what the spectrum suggests.
        """
        if not self._floor.add(samples):
            return
        floor = np.array(self._shown)
        for sensor, limit in zip((self._gyro, self._accel), floor.tolist(), strict=True):
            sensor.raise_limit(limit)
        if not np.any(has_risen := floor > FLOOR_STEP * self._highest_floor):
            return
        self._highest_floor = np.where(has_risen, floor, self._highest_floor)
        known = np.maximum(self.densities, np.sqrt([self._initial.gyro_variance, self._initial.accel_variance]))
        raised = np.where(NOISE_SHARE * floor > GROSS_RATIO * known, NOISE_SHARE * floor, 0.0)
        for sensor, density in zip((self._gyro, self._accel), raised.tolist(), strict=True):
            sensor.raise_to(density)
        self._params = self._params.with_noise(*self.densities)

    def add_stationary(self, parts: Sequence[Increments]) -> None:
        """Raise the noise to that of a stationary interval, given its increments between successive frames.

        Noise of the airframe is absent there, so that the estimate is not reduced. If the noise is white and exceeds
        that of the data sheet by more than `NOISY_RATIO`, the random walks of the biases are those of the data sheet
        times the ratio.
        """
        measured = [part for part in parts if len(part.dt_s)]
        self._at_rest = gyro, accel = stationary_densities(measured)
        self._gyro.raise_to(gyro)
        self._accel.raise_to(accel)
        white, densities = is_white(measured), zip(self._at_rest, self._data_sheet, strict=True)
        gyro_ratio, accel_ratio = (
            density / given if white and density > NOISY_RATIO * given > 0.0 else 1.0 for density, given in densities
        )
        gyro_walk, accel_walk = self._walks
        gyro_walk.set_smallest(gyro_ratio * math.sqrt(self._initial.gyro_walk_variance))
        accel_walk.set_smallest(accel_ratio * math.sqrt(self._initial.accel_walk_variance))
        self._params = self._params.with_noise(*self.densities).with_walks(*(each.density for each in self._walks))

    def begin_in_motion(self) -> None:
        """Raise the noise to what the spectrum suggests, because the first state depends on it.

        With one camera it determines how certain the scale is, and images show the noise of an interval only after it.
        At rest, the vibration of the flight is absent, and the first state does not depend on it.
        """
        if self._is_compared:
            return
        for sensor, density in zip((self._gyro, self._accel), self._shown, strict=True):
            sensor.raise_to(NOISE_SHARE * density)
        self._params = self._params.with_noise(*self.densities)

    def raise_initial(self, components: Sequence[ImuVarianceComponents]) -> bool:
        """Raise the noise if the first intervals show more, but to no more than the samples themselves show.

        Args:
            components: Variance components of the intervals of an initial adjustment.

        Returns:
            Whether the noise has increased by more than a factor of `NOISY_RATIO`.
        """
        before, limits = self.densities, self.measured
        for sensor, limit, parts in (
            (self._gyro, limits[0], [each.gyroscope for each in components]),
            (self._accel, limits[1], [each.accelerometer for each in components]),
        ):
            sensor.raise_to(min(pooled_density(parts), limit))
        self._params = self._params.with_noise(*self.densities)
        return any(now > NOISY_RATIO * then for now, then in zip(self.densities, before, strict=True))

    def add_biases(self, state: NavState, *, are_corrected: bool) -> None:
        """Add the biases of a keyframe, and update the random walks of the preintegration parameters.

        Args:
            state: The state of the keyframe, with its covariance.
            are_corrected: Whether another calibration has changed them.
        """
        if state.covariance is None:
            return
        variances = np.diag(state.covariance)
        gyro_walk, accel_walk = self._walks
        if are_corrected:
            gyro_walk.forget_bias()
            accel_walk.forget_bias()
        gyro_walk.add(state.t_ns, state.gyro_bias_rad_s, variances[9:12])
        accel_walk.add(state.t_ns, state.accel_bias_m_s2, variances[12:15])
        self._params = self._params.with_walks(gyro_walk.density, accel_walk.density)

    def update(self, components: ImuVarianceComponents | None) -> None:
        """Add an interval, if there is one, and update the preintegration parameters."""
        if components is None:
            return
        self._is_compared = True
        self._gyro.update(components.gyroscope)
        self._accel.update(components.accelerometer)
        self._params = self._params.with_noise(*self.densities)
