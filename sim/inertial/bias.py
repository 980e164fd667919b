"""Simulation of IMU biases: turn-on bias, random walk, and bias instability."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel, Times

FLICKER_TIMES_S = np.logspace(-1.0, 4.0, 6)
"""(P,) Correlation times of the Gauss-Markov processes that approximate flicker noise [s]: one per decade, from below
the crossing with white noise to beyond the duration of any flight."""
FLICKER_FLOOR = float(np.sqrt(2.0 * np.log(2.0) / np.pi))
"""Ratio of the floor of the Allan deviation of flicker noise to its coefficient B, 0.664 (IEEE 952, annex C)."""
FLICKER_SHARE = float(np.log(10.0) / np.pi)
"""Ratio of the variance of each process to B². Processes of variance v whose correlation times differ by factors r sum
to the one-sided density v / (f ln r); flicker noise has B² / (π f)."""
_BLOCK_S = 30.0 * float(FLICKER_TIMES_S[0])  # within a block no decay factor underflows the precision of a double


@dataclass(frozen=True, eq=False)
class BiasModel:
    """Size and duration of the biases of an IMU: three axes of the gyroscope, then three of the accelerometer."""

    turn_on: Array
    """(6,) Standard deviations of the turn-on biases."""
    walk: Array
    """(6,) Densities of the random walks."""
    flicker: Array
    """(6,) Standard deviations of each Gauss-Markov process of the bias instability."""
    times_s: Array
    """(P,) Correlation times of these processes [s]; none without bias instability."""

    @classmethod
    def of(cls, imu: ImuModel) -> Self:
        """Return the biases of an IMU."""
        floor = np.repeat([imu.gyro_bias_instability_rad_s, imu.accel_bias_instability_m_s2], 3)
        return cls(
            turn_on=np.repeat([imu.gyro_turn_on_bias_rad_s, imu.accel_turn_on_bias_m_s2], 3),
            walk=np.repeat([imu.gyro_random_walk, imu.accel_random_walk], 3),
            flicker=np.sqrt(FLICKER_SHARE) * floor / FLICKER_FLOOR,
            times_s=FLICKER_TIMES_S if floor.any() else np.zeros(0),
        )


class Biases:
    """The biases of one IMU from switch-on: three axes of the gyroscope, then three of the accelerometer.

    A random walk of density σ has increments of standard deviation σ √dt (Crassidis, "Sigma-point Kalman filtering for
    integrated GPS and inertial navigation", 2006; the convention of Kalibr). Bias instability (flicker noise) is the
    sum of first-order Gauss-Markov processes, one per decade, each started in its stationary state and propagated
    exactly.
    """

    def __init__(self, model: ImuModel, rng: np.random.Generator, flicker_rng: np.random.Generator) -> None:
        """Draw the turn-on biases and the initial states.

        Args:
            model: Standard deviations and noise densities of the IMU.
            rng: Generator of turn-on biases and random walks.
            flicker_rng: Generator of the bias instability.
        """
        self._rng = rng
        self._flicker_rng = flicker_rng
        self._model = BiasModel.of(model)
        self.turn_on = self._model.turn_on * rng.standard_normal(6)
        self._walked = self.turn_on
        self._flicker = self._model.flicker * flicker_rng.standard_normal((len(self._model.times_s), 1, 6))
        self._t_ns: int | None = None

    def advance_to(self, t_ns: Times) -> Array:
        """Return the biases (N, 6) at N ≥ 1 times [ns] after those of the last call; constant before the first."""
        start_ns = int(t_ns[0]) if self._t_ns is None else self._t_ns
        dt_s = np.diff(t_ns, prepend=start_ns) * 1e-9
        steps = self._model.walk * np.sqrt(dt_s)[:, None] * self._rng.standard_normal((len(t_ns), 6))
        walked = self._walked + np.cumsum(steps, axis=0)
        self._walked, self._t_ns = walked[-1], int(t_ns[-1])
        return np.asarray(walked + self._flickering(dt_s))

    def _flickering(self, dt_s: Array) -> Array:
        """Return the bias instability (N, 6) after N steps."""
        if len(self._model.times_s) == 0:
            return np.zeros((len(dt_s), 6))
        block = np.floor(np.cumsum(dt_s) / _BLOCK_S)
        starts = np.flatnonzero(np.diff(block)) + 1
        return np.concatenate([self._flickering_block(part) for part in np.split(dt_s, starts)])

    def _flickering_block(self, dt_s: Array) -> Array:
        """Return the bias instability (N, 6) within one block: x_k = d_k (x_0 + Σ w_j / d_j), d_k the decay."""
        dt, times_s = dt_s[:, None], self._model.times_s[:, None, None]
        noise = self._model.flicker * np.sqrt(-np.expm1(-2.0 * dt / times_s))
        noise = noise * self._flicker_rng.standard_normal((len(times_s), len(dt_s), 6))
        decay = np.exp(-(np.cumsum(dt, axis=0) - dt[0]) / times_s)
        first = np.exp(-dt[0] / times_s) * self._flicker
        x = decay * (first + np.cumsum(noise / decay, axis=1))
        self._flicker = x[:, -1:]
        return np.asarray(x.sum(axis=0))
