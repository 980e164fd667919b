"""GTSAM's factors between keyframes, and their columns in the smoother's linear system."""

from collections.abc import Mapping
from typing import NamedTuple, Self

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState
from dronevio.estimator.backend.observations import Integers

Array = npt.NDArray[np.float64]

_COLUMNS = {"x": np.arange(6), "v": np.arange(6, 9), "b": np.arange(9, 15)}
"""Columns of pose, velocity and biases within a state, by the character of GTSAM's symbol."""


class KeyframeFactor(NamedTuple):
    """A factor, and the keyframes whose variables it constrains."""

    keyframes: frozenset[int]
    """Numbers of the keyframes."""
    factor: gtsam.NoiseModelFactor
    """GTSAM's factor of poses X(k), velocities V(k) and biases B(k)."""

    @classmethod
    def of(cls, factor: gtsam.NoiseModelFactor) -> Self:
        """Return a factor with the keyframes of its keys."""
        return cls(frozenset(map(gtsam.symbolIndex, factor.keys())), factor)


def state_values(states: Mapping[int, KeyframeState]) -> gtsam.Values:
    """Return the states of keyframes as GTSAM's values."""
    values = gtsam.Values()
    for k, state in states.items():
        # Named arguments, because the binding tries forty overloads otherwise and takes three times as long
        values.insert(X(k), pose3=state.pose)
        values.insert(V(k), vector=state.velocity)
        values.insert(B(k), constant_bias=state.bias)
    return values


def columns_of(factor: gtsam.NoiseModelFactor, index: Mapping[int, int]) -> Integers:
    """Return the columns of a factor's variables in the linear system, in the order of its keys.

    Args:
        factor: The factor.
        index: Position of each keyframe in the linear system.
    """
    keys = list(factor.keys())
    return np.concatenate([STATE_DIM * index[gtsam.symbolIndex(k)] + _COLUMNS[chr(gtsam.symbolChr(k))] for k in keys])


def whitening_matrix(factor: gtsam.NoiseModelFactor) -> Array:
    """Return the upper triangular square root R of a factor's information RᵀR."""
    model = factor.noiseModel()
    assert isinstance(model, gtsam.noiseModel.Gaussian)
    return np.asarray(model.R())
