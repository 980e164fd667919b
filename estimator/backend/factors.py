"""GTSAM's factors between keyframes, and their columns in the smoother's linear system."""

from collections.abc import Mapping
from typing import NamedTuple, Self

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState
from dronevio.models.arrays import Array, Integers

_COLUMNS = {"x": np.arange(6), "v": np.arange(6, 9), "b": np.arange(9, 15)}
"""Columns of pose, velocity and biases within a state, by the character of GTSAM's symbol."""


class KeyframeFactor(NamedTuple):
    """A factor of one keyframe or of two consecutive ones, and the variables that it constrains."""

    keyframes: frozenset[int]
    """Numbers of the keyframes."""
    factor: gtsam.NoiseModelFactor
    """GTSAM's factor of poses X(k), velocities V(k) and biases B(k)."""
    columns: Integers
    """(m,) Columns of its variables, in the order of its keys, among those of the states of its keyframes."""
    weight: float = 1.0
    """Factor on its information."""

    @classmethod
    def of(cls, factor: gtsam.NoiseModelFactor) -> Self:
        """Return a factor with the keyframes and columns of its keys."""
        keys = list(factor.keys())
        numbers = [gtsam.symbolIndex(key) for key in keys]
        states = [STATE_DIM * (number - min(numbers)) for number in numbers]
        columns = [state + _COLUMNS[chr(gtsam.symbolChr(key))] for state, key in zip(states, keys, strict=True)]
        return cls(frozenset(numbers), factor, np.concatenate(columns))

    def block(self, index: Mapping[int, int]) -> slice:
        """Return the columns of the states of its keyframes in the linear system.

        Args:
            index: Position of each keyframe in the linear system.
        """
        first = STATE_DIM * index[min(self.keyframes)]
        return slice(first, first + STATE_DIM * len(self.keyframes))


def state_values(states: Mapping[int, KeyframeState]) -> gtsam.Values:
    """Return the states of keyframes as GTSAM's values."""
    values = gtsam.Values()
    for k, state in states.items():
        # Named arguments, because the binding tries forty overloads otherwise and takes three times as long
        values.insert(X(k), pose3=state.pose)
        values.insert(V(k), vector=state.velocity)
        values.insert(B(k), constant_bias=state.bias)
    return values


def replaced_values(
    values: gtsam.Values, states: Mapping[int, KeyframeState], changed: Mapping[int, KeyframeState]
) -> gtsam.Values:
    """Return values with the variables that differ between two sets of states replaced.

    Args:
        values: GTSAM's values of the states.
        states: The states of the values.
        changed: States of the same keyframes; equal variables are the same objects.
    """
    replaced = gtsam.Values(values)
    for k, state in states.items():
        other = changed[k]
        if other.pose is not state.pose:
            replaced.update(X(k), pose3=other.pose)
        if other.velocity is not state.velocity:
            replaced.update(V(k), vector=other.velocity)
        if other.bias is not state.bias:
            replaced.update(B(k), constant_bias=other.bias)
    return replaced


def whitening_matrix(factor: gtsam.NoiseModelFactor) -> Array:
    """Return the upper triangular square root R of a factor's information RᵀR."""
    model = factor.noiseModel()
    assert isinstance(model, gtsam.noiseModel.Gaussian)
    return np.asarray(model.R())
