"""How noisy the IMU really is, learnt in flight.

Data sheets tell the noise of a unit at rest on a bench. A drone shakes it, mounts twist it and clocks jitter: the
accelerometer of a real flight may be ten times noisier than its sheet says, that of another may be as good as new. Both
must not be smoothed alike. So the intervals of the IMU are compared with what a whole window of keyframes says of the
same motion: over many of them, the squares of the residuals are what the noise makes them, less what the estimate has
followed of it (variance component estimation; Förstner, "Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten", 1979; Förstner and Wrobel, "Photogrammetric Computer Vision", 2016, section 4.2.4).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.preintegration import PreintegrationConfig, preintegration_params
from dronevio.models.imu import ImuModel

Array = npt.NDArray[np.float64]

MAX_NORMALIZED_SQUARE = 9.0
"""A squared residual counts for no more than so many times what it should be: a jolt is no noise."""


@dataclass(frozen=True)
class NoiseEstimationConfig:
    """How fast the noise is learnt."""

    memory: float = 50.0
    """So many intervals count, later ones more: about ten seconds of flight."""
    prior_weight: float = 1.0
    """What is assumed at first counts as so many intervals that tell the noise fully."""
    min_factor: float = 0.5
    """No sensor is better than its data sheet by more than this factor ..."""
    max_factor: float = 30.0
    """... nor noisier than by this one."""


@dataclass(frozen=True)
class VarianceComponent:
    """How well one kind of residual of an interval fits what was assumed of its noise."""

    normalized_square: float
    """Its square, relative to its expectation where nothing but the IMU told the motion."""
    redundancy: float
    """The share of that expectation that remains after the estimate has followed the residual as far as it may: one
    where others tell the motion exactly, zero where nothing else does."""
    assumed_density2: float
    """The squared density of white noise from which that expectation comes: of the sensor, and of all doubts about
    it."""


@dataclass(frozen=True)
class ImuVarianceComponents:
    """How well an interval of the IMU fits what else is known of the motion."""

    gyroscope: VarianceComponent
    """Of the turn: the gyroscope's noise."""
    accelerometer: VarianceComponent
    """Of the change of velocity: the accelerometer's noise."""

    @classmethod
    def from_residual(cls, residual: Array, assumed: Array, followed: Array, dt_s: float) -> "ImuVarianceComponents":
        """Compare the residual of an interval with its covariance.

        Args:
            residual: (9,) Of turn, position and velocity, as GTSAM has them.
            assumed: (9, 9) Its covariance by the IMU's noise alone.
            followed: (9, 9) How much smaller its covariance is after the estimate has followed it.
            dt_s: Length of the interval [s].
        """

        def misfit(part: slice) -> VarianceComponent:
            expected = float(np.trace(assumed[part, part]))
            told = 1.0 - float(np.trace(followed[part, part])) / expected
            return VarianceComponent(
                float(residual[part] @ residual[part]) / expected, max(told, 0.0), expected / (3.0 * dt_s)
            )

        return cls(misfit(slice(0, 3)), misfit(slice(6, 9)))


class NoiseDensityEstimator:
    """The white noise of one sensor."""

    def __init__(self, data_sheet: float, inflation: float, config: NoiseEstimationConfig) -> None:
        """Begin with an assumption.

        Args:
            data_sheet: Density of the noise by the data sheet.
            inflation: How many times larger it is taken to be at first.
            config: How fast that is unlearnt.
        """
        self._data_sheet, self._config = data_sheet, config
        self._squared, self._told = (inflation * data_sheet) ** 2 * config.prior_weight, config.prior_weight

    @property
    def density(self) -> float:
        """Density of the noise, in the data sheet's unit."""
        c = self._config
        learnt = np.sqrt(self._squared / self._told)
        return float(np.clip(learnt, c.min_factor * self._data_sheet, c.max_factor * self._data_sheet))

    def update(self, misfit: VarianceComponent) -> None:
        """Take what an interval says, unless it was assumed to be noisier than any sensor: then it was in doubt."""
        c = self._config
        if misfit.assumed_density2 > 1.1 * (c.max_factor * self._data_sheet) ** 2:
            return
        kept = 1.0 - 1.0 / c.memory
        squared = misfit.assumed_density2 * min(misfit.normalized_square, MAX_NORMALIZED_SQUARE * misfit.redundancy)
        self._squared, self._told = kept * self._squared + squared, kept * self._told + misfit.redundancy


class ImuNoiseEstimator:
    """Keeps the parameters of preintegration up to date."""

    def __init__(self, imu: ImuModel, inertial: PreintegrationConfig, config: NoiseEstimationConfig) -> None:
        """Begin with the data sheet, inflated as configured.

        Args:
            imu: The data sheet.
            inertial: How far it is trusted at first.
            config: How fast the noise is learnt.
        """
        self._gyro = NoiseDensityEstimator(imu.gyro_noise_density, inertial.gyro_noise_inflation, config)
        self._accel = NoiseDensityEstimator(imu.accel_noise_density, inertial.accel_noise_inflation, config)
        self.params = preintegration_params(imu, inertial)
        """With these the IMU is preintegrated; their noise changes as it is learnt."""

    @property
    def densities(self) -> tuple[float, float]:
        """Those of the white noise of gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz]."""
        return self._gyro.density, self._accel.density

    def update(self, misfit: ImuVarianceComponents | None) -> None:
        """Take what an interval says, if there is one."""
        if misfit is None:
            return
        self._gyro.update(misfit.gyroscope)
        self._accel.update(misfit.accelerometer)
        gyro, accel = self.densities
        self.params.setGyroscopeCovariance(np.eye(3) * gyro**2)
        self.params.setAccelerometerCovariance(np.eye(3) * accel**2)
