"""Distributions of scalars, from which domain randomization draws."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError


class Distribution(Protocol):
    """Interface of a distribution of scalars."""

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return independent samples of a shape."""


@dataclass(frozen=True)
class Constant:
    """A value that does not vary; implements `Distribution`. It takes no random numbers."""

    value: float
    """Value of all samples."""

    def __post_init__(self) -> None:
        """Check the value.

        Raises:
            ConfigError: It is not finite.
        """
        _require_finite("Constant", self.value)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return the value in an array of a shape."""
        return np.full(shape, float(self.value))


@dataclass(frozen=True)
class Uniform:
    """Uniform distribution; implements `Distribution`."""

    low: float
    """Smallest possible value."""
    high: float
    """Largest possible value."""

    def __post_init__(self) -> None:
        """Check the bounds.

        Raises:
            ConfigError: A bound is not finite, or they are in the wrong order.
        """
        _require_finite("Uniform", self.low, self.high)
        _require_order("Uniform", self.low, self.high)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return independent samples of a shape."""
        return np.asarray(rng.uniform(self.low, self.high, shape))


@dataclass(frozen=True)
class LogUniform:
    """Distribution whose logarithm is uniform, for positive scale factors; implements `Distribution`."""

    low: float
    """Smallest possible value, greater than 0."""
    high: float
    """Largest possible value."""

    def __post_init__(self) -> None:
        """Check the bounds.

        Raises:
            ConfigError: A bound is not finite, the lower is not positive, or they are in the wrong order.
        """
        _require_finite("LogUniform", self.low, self.high)
        _require_order("LogUniform", self.low, self.high)
        if self.low <= 0.0:
            raise ConfigError(f"LogUniform from {self.low:g}; expected a bound greater than 0")

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return independent samples of a shape."""
        return np.asarray(np.exp(rng.uniform(np.log(self.low), np.log(self.high), shape)))


@dataclass(frozen=True)
class Normal:
    """Normal distribution whose samples are clipped to bounds; implements `Distribution`."""

    mean: float
    """Mean of the distribution before clipping."""
    deviation: float
    """Standard deviation of the distribution before clipping."""
    low: float = -np.inf
    """Smallest possible value; smaller samples are replaced by it."""
    high: float = np.inf
    """Largest possible value; larger samples are replaced by it."""

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            ConfigError: Mean or deviation is not finite, the deviation is negative, or the bounds are in the wrong
                order.
        """
        _require_finite("Normal", self.mean, self.deviation)
        _require_order("Normal", self.low, self.high)
        if self.deviation < 0.0:
            raise ConfigError(f"Normal with deviation {self.deviation:g}; expected 0 or more")

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return independent samples of a shape."""
        return np.clip(rng.normal(self.mean, self.deviation, shape), self.low, self.high)


def _require_finite(name: str, *values: float) -> None:
    """Raise ConfigError unless all values are finite."""
    if not np.all(np.isfinite(values)):
        raise ConfigError(f"{name}{values}; expected finite numbers")


def _require_order(name: str, low: float, high: float) -> None:
    """Raise ConfigError unless low ≤ high; NaN is refused."""
    if not low <= high:
        raise ConfigError(f"{name} from {low:g} to {high:g}; expected the smaller bound first")
