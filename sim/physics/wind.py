"""Wind: a constant mean and Dryden gusts near the ground.

MIL-F-8785C ("Flying qualities of piloted airplanes", 1980, §3.7) describes turbulence as a frozen field: its spectra
are functions of distance. The filters here are functions of distance, too, and their steps are exact for any distance
(Van Loan 1978), so that variances and spectra do not depend on the time step.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import rotation_z
from dronevio.sim.physics.vehicle_states import Rows, Table

_FOOT_M = 0.3048
_LOW_FT, _HIGH_FT = 10.0, 1000.0  # validity of the standard's low-altitude model
_GAUGE_FT, _ROUGHNESS_FT = 20.0, 0.15  # reference height of the wind; roughness for approach and landing
_DIRECT = np.sqrt([2.0, 3.0, 3.0])
_DELAYED = np.array([0.0, 1.0 - np.sqrt(3.0), 1.0 - np.sqrt(3.0)])
_LEAST = 1e-300  # avoids 0 / 0 for a distance of 0


@dataclass(frozen=True)
class Wind(Settings):
    """Mean wind and strength of gusts."""

    mean_m_s: Annotated[tuple[float, float, float], Range(-50.0, 50.0)] = (0.0, 0.0, 0.0)
    """Mean velocity of the air in the world frame [m/s]."""
    gusts: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Strength of the gusts relative to the standard at this wind: 1 is typical outdoors, 0 means no gusts."""
    height_m: Annotated[float, Range(_LOW_FT * _FOOT_M, _HIGH_FT * _FOOT_M)] = 3.048
    """Height above the ground for which gusts are computed [m]; the standard covers 3.048 to 304.8 m."""

    @property
    def speed_m_s(self) -> float:
        """Horizontal speed of the mean wind [m/s]."""
        return float(np.hypot(self.mean_m_s[0], self.mean_m_s[1]))

    @property
    def gust_lengths_m(self) -> Array:
        """(3,) Scale lengths of the gusts along the wind, across it and upwards [m] (figure 10)."""
        h = self.height_m / _FOOT_M
        along = h / (0.177 + 0.000823 * h) ** 1.2
        return np.array([along, along, h]) * _FOOT_M

    @property
    def gust_deviations_m_s(self) -> Array:
        """(3,) Standard deviations of the gusts along the wind, across it and upwards [m/s] (figure 11).

        The reference wind at 20 ft follows from the wind at this height by the standard's logarithmic profile.
        """
        h = self.height_m / _FOOT_M
        at_gauge = self.speed_m_s * np.log(_GAUGE_FT / _ROUGHNESS_FT) / np.log(h / _ROUGHNESS_FT)
        upward = 0.1 * at_gauge
        along = upward / (0.177 + 0.000823 * h) ** 0.4
        return self.gusts * np.array([along, along, upward])

    @property
    def axes(self) -> Array:
        """(3, 3) Axes of the gusts as rows in the world frame: along the wind, across it to the left, up."""
        heading = np.arctan2(self.mean_m_s[1], self.mean_m_s[0])
        c, s = np.cos(heading), np.sin(heading)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


CALM = Wind()
"""Still air."""


@dataclass(frozen=True, eq=False)
class Winds(Table):
    """Mean winds and strengths of gusts at n vehicles."""

    mean_m_s: Array
    """(n, 3) Mean velocities of the air in the world frame [m/s]."""
    gusts: Array
    """(n,) Strengths of the gusts relative to the standard at this wind, as in `Wind`."""

    @classmethod
    def of(cls, wind: Wind, count: int) -> Self:
        """Return the same wind at ``count`` vehicles."""
        return cls(np.tile(np.array(wind.mean_m_s), (count, 1)), np.full(count, wind.gusts))


class Air:
    """Air around one vehicle, or around many in the same wind: the mean wind, and Dryden gusts if it has some.

    With p the derivative with respect to distance in scale lengths, the component along the wind is √2 / (1 + p)
    applied to white noise, the others (1 + √3 p) / (1 + p)², all scaled by their standard deviations. In the states x₁'
    = −x₁ + n and x₂' = −x₂ + x₁ these are √2 x₁ and √3 x₁ + (1 − √3) x₂.
    """

    def __init__(self, wind: Wind, rng: np.random.Generator | None = None, shape: tuple[int, ...] = ()) -> None:
        """Draw the initial gusts.

        Args:
            wind: Mean wind and strength of gusts.
            rng: Generator of the gusts.
            shape: Shape of the batch of vehicles, each with independent gusts.

        Raises:
            ConfigError: There are gusts, but no random generator.
        """
        self._mean, self._axes = np.array(wind.mean_m_s), wind.axes
        self._lengths, self._scales = wind.gust_lengths_m, wind.gust_deviations_m_s
        if self._scales.any() and rng is None:
            raise ConfigError("gusts without a random generator; expected one")
        self._rng = rng if self._scales.any() else None
        self._first = self._second = np.zeros((*shape, 3))
        self.reset()

    def reset(self) -> None:
        """Start a new flight with gusts from the stationary distribution."""
        if self._rng is not None:
            self._first, self._second = _stationary(self._rng.standard_normal((2, *self._first.shape)))

    def velocity_m_s(self) -> Array:
        """Return the current velocity (…, 3) of the air in the world frame [m/s]."""
        if self._rng is None:
            return self._mean
        return np.asarray(self._mean + self._scales * _gust(self._first, self._second) @ self._axes)

    def move_through(self, distance_m: Array) -> None:
        """Advance by distances (…) through the air [m]."""
        if self._rng is not None:
            n = self._rng.standard_normal((2, *self._first.shape))
            distance = np.asarray(distance_m)[..., None] / self._lengths
            self._first, self._second = _moved(self._first, self._second, distance, n)


@dataclass(frozen=True, eq=False)
class AirState:
    """Complete state of a `BatchAir`."""

    winds: Winds
    """Mean winds and strengths of gusts."""
    first: Array
    """(n, 3) First states of the gusts."""
    second: Array
    """(n, 3) Second states of the gusts."""
    generators: tuple[Mapping[str, Any], Mapping[str, Any]]
    """States of the generators of steps and of renewals."""


class BatchAir:
    """Air around n vehicles, each with its own wind and independent gusts.

    Renewals and steps draw from two generators, so that the gusts at a vehicle do not depend on the times at which
    others are renewed.
    """

    def __init__(self, winds: Winds, rng: np.random.Generator, height_m: float = CALM.height_m) -> None:
        """Draw the initial gusts.

        Args:
            winds: Mean winds and strengths of gusts.
            rng: Generator of the gusts.
            height_m: Height above the ground for which gusts are computed [m], as in `Wind`.
        """
        self._unit = Wind((1.0, 0.0, 0.0), 1.0, height_m)
        self._rng, self._renewal_rng = rng.spawn(2)
        self._winds = winds
        n = len(winds)
        self._scales, self._axes = np.zeros((n, 3)), np.zeros((n, 3, 3))
        self._first, self._second = np.zeros((n, 3)), np.zeros((n, 3))
        self._gusty = False
        self.renew(np.arange(n), winds)

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw from streams of another generator from now on."""
        self._rng, self._renewal_rng = rng.spawn(2)

    def save(self) -> AirState:
        """Return the state of winds, gusts and random numbers."""
        generators = (self._rng.bit_generator.state, self._renewal_rng.bit_generator.state)
        return AirState(self._winds, self._first.copy(), self._second.copy(), generators)

    def restore(self, saved: AirState) -> None:
        """Return to a state of as many vehicles."""
        everyone = np.arange(len(saved.winds))
        self.renew(everyone, saved.winds)
        self._first[:], self._second[:] = saved.first, saved.second
        self._rng.bit_generator.state, self._renewal_rng.bit_generator.state = saved.generators

    @property
    def winds(self) -> Winds:
        """Mean winds and strengths of gusts."""
        return self._winds

    def renew(self, rows: npt.NDArray[np.intp], winds: Winds) -> None:
        """Draw gusts from the stationary distribution of new winds, for k rows.

        Args:
            rows: (k,) Indices of the vehicles.
            winds: The winds of all vehicles after the renewal; those of other rows are unchanged.
        """
        self._winds = winds
        mean = winds.mean_m_s[rows]
        speed = np.hypot(mean[:, 0], mean[:, 1])
        self._scales[rows] = (winds.gusts[rows] * speed)[:, None] * self._unit.gust_deviations_m_s
        self._axes[rows] = np.swapaxes(rotation_z(np.arctan2(mean[:, 1], mean[:, 0])), 1, 2)
        self._gusty = bool(self._scales.any())
        if self._gusty:
            self._first[rows], self._second[rows] = _stationary(self._renewal_rng.standard_normal((2, len(rows), 3)))

    def velocity_m_s(self, rows: Rows = slice(None)) -> Array:
        """Return the current velocities (k, 3) of the air in the world frame [m/s] at the selected vehicles."""
        if not self._gusty:
            return self._winds.mean_m_s[rows]
        gust = self._scales[rows] * _gust(self._first[rows], self._second[rows])
        return np.asarray(self._winds.mean_m_s[rows] + np.vecmat(gust, self._axes[rows]))

    def move_through(self, distance_m: Array, rows: Rows = slice(None)) -> None:
        """Advance the gusts at the selected vehicles by distances (k,) through the air [m]."""
        if not self._gusty:
            return
        rng = self._rng if isinstance(rows, slice) else self._renewal_rng
        n = rng.standard_normal((2, len(distance_m), 3))
        distance = distance_m[:, None] / self._unit.gust_lengths_m
        self._first[rows], self._second[rows] = _moved(self._first[rows], self._second[rows], distance, n)


def _gust(first: Array, second: Array) -> Array:
    """Return the gusts (…, 3) of unit variance, along the wind, across it and upwards, given both states (…, 3)."""
    return np.asarray(_DIRECT * first + _DELAYED * second)


def _stationary(n: Array) -> tuple[Array, Array]:
    """Return both states of gusts of unit variance, (…, 3) each, drawn by standard normal numbers (2, …, 3)."""
    # the stationary covariance is [[1/2, 1/4], [1/4, 1/4]]
    return np.sqrt(0.5) * n[0], np.sqrt(0.125) * (n[0] + n[1])


def _moved(first: Array, second: Array, distance: Array, n: Array) -> tuple[Array, Array]:
    """Return both states of gusts after distances (…, 3) in scale lengths, by standard normal numbers (2, …, 3)."""
    decay = np.exp(-distance)
    left = decay * decay
    # noise covariance P − Φ P Φᵀ of the transition Φ = e⁻ᵈ [[1, 0], [d, 1]] and stationary covariance P
    q11 = 0.5 * (1.0 - left)
    q12 = 0.25 - left * (0.5 * distance + 0.25)
    q22 = 0.25 - left * (0.5 * distance * (distance + 1.0) + 0.25)
    l11 = np.sqrt(q11)
    l21 = q12 / np.maximum(l11, _LEAST)
    l22 = np.sqrt(np.maximum(q22 - l21 * l21, 0.0))
    return decay * first + l11 * n[0], decay * (distance * first + second) + l21 * n[0] + l22 * n[1]
