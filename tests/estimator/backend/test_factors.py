"""Factors between keyframes: their columns in the linear system, and GTSAM's values of states."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.backend.factors import KeyframeFactor, replaced_values, state_values
from dronevio.estimator.backend.marginal_prior import KeyframeState


def state(x_m: float) -> KeyframeState:
    """Return a state whose position, velocity and accelerometer bias along x are a number."""
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([x_m, 0.0, 0.0]))
    return KeyframeState(
        pose, np.array([x_m, 0.0, 0.0]), gtsam.imuBias.ConstantBias(np.array([x_m, 0.0, 0.0]), np.zeros(3))
    )


def test_columns_of_an_imu_factor() -> None:
    """The keys are pose and velocity of both keyframes, then their biases; a state has 6, 3 and 6 columns of these."""
    pim = gtsam.PreintegratedCombinedMeasurements(gtsam.PreintegrationCombinedParams.MakeSharedU(9.81))
    factor = KeyframeFactor.of(gtsam.CombinedImuFactor(X(7), V(7), X(8), V(8), B(7), B(8), pim))
    assert factor.keyframes == {7, 8}
    np.testing.assert_array_equal(factor.columns, np.r_[0:9, 15:24, 9:15, 24:30])
    assert factor.block({6: 0, 7: 1, 8: 2}) == slice(15, 45)


def test_columns_of_a_factor_of_one_keyframe() -> None:
    factor = KeyframeFactor.of(gtsam.PriorFactorVector(V(3), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    assert factor.keyframes == {3}
    np.testing.assert_array_equal(factor.columns, [6, 7, 8])
    assert factor.block({2: 0, 3: 1}) == slice(15, 30)


@pytest.mark.parametrize("part", ["pose", "velocity", "bias"])
def test_replaced_values(part: str) -> None:
    """Only the variables that differ are replaced, and the given values stay as they are."""
    before, other = {4: state(1.0), 5: state(2.0)}, state(3.0)
    parts = {name: getattr(before[5], name) for name in ("pose", "velocity", "bias")} | {part: getattr(other, part)}
    changed = {4: before[4], 5: KeyframeState(**parts)}
    values = state_values(before)
    found = replaced_values(values, before, changed)
    assert found.equals(state_values(changed), 0.0)
    assert values.equals(state_values(before), 0.0)
