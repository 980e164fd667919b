"""The covariance of the corrected pose: the anchor's marginal in the map, and what the odometry has added since."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.correction import Correction
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z
from dronevio.models.state import NavState
from tests.estimator.slam.mapping.conftest import NoRecognizer

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight


R_ODOM_IMU = exp_so3(np.array([0.4, -1.1, 0.7]))


BLOCKS = slice(0, 3), slice(3, 6)
"""Rows of rotation and of position."""


def state_with(sigmas: Array, t_ns: int = 0, position_m: tuple[float, float, float] = (1.0, 2.0, 3.0)) -> NavState:
    """Return a state whose pose has standard deviations (6,) of δθ in the IMU frame and δp in the odometry frame."""
    covariance = np.zeros((15, 15))
    covariance[:6, :6] = np.diag(np.square(sigmas))
    T = pose_matrix(R_ODOM_IMU, np.array(position_m))
    return NavState(t_ns, T, np.zeros(3), np.zeros(3), np.zeros(3), covariance)


def test_at_the_anchor_it_is_the_marginal_in_the_map() -> None:
    state = state_with(np.array([0.01, 0.01, 0.02, 0.1, 0.2, 0.3]))
    T_map_odom = pose_matrix(rotation_z(np.pi / 2.0), np.array([5.0, 0.0, 0.0]))
    S = np.eye(6)
    S[3:, 3:] = R_ODOM_IMU.T
    marginal = S @ np.diag([1e-6, 2e-6, 3e-6, 1e-4, 4e-4, 9e-4]) @ S.T  # δp given in the odometry frame
    correction = Correction(T_map_odom, KeyframeEstimate.of_state(state), marginal)
    covariance = correction.covariance_at(state)
    # A yaw of 90° exchanges the two horizontal axes.
    assert covariance is not None
    np.testing.assert_allclose(covariance[3:, 3:], np.diag([4e-4, 1e-4, 9e-4]), atol=1e-12)
    np.testing.assert_allclose(covariance[:3, :3], marginal[:3, :3], atol=1e-12)


def test_growth_since_the_anchor_is_that_of_the_odometry() -> None:
    before, after = (np.array([1e-6, 1e-6, 1e-6, s, s, s]) for s in (0.3, 0.5))
    anchor = KeyframeEstimate.of_state(state_with(before))
    correction = Correction(np.eye(4), anchor, np.diag([1e-12, 1e-12, 1e-12, 1e-4, 1e-4, 1e-4]))
    covariance = correction.covariance_at(state_with(after, 10**9))
    # 0.01² of the map, and 0.5² - 0.3² that the odometry has added
    assert covariance is not None
    np.testing.assert_allclose(np.diag(covariance)[3:], 1e-4 + 0.25 - 0.09, rtol=1e-6)


def test_uncertain_yaw_of_the_anchor_moves_later_positions() -> None:
    sigmas = np.full(6, 1e-6)
    anchor = KeyframeEstimate.of_state(state_with(sigmas, position_m=(0.0, 0.0, 0.0)))
    up = R_ODOM_IMU[2]
    marginal = np.zeros((6, 6))
    marginal[:3, :3] = 0.02**2 * np.outer(up, up) + 1e-12 * np.eye(3)  # yaw alone
    correction = Correction(np.eye(4), anchor, marginal)
    covariance = correction.covariance_at(state_with(sigmas, 10**9, position_m=(10.0, 0.0, 0.0)))
    assert covariance is not None
    np.testing.assert_allclose(np.diag(covariance)[3:], [0.0, 0.2**2, 0.0], atol=1e-8)  # 10 m · 0.02 rad


def test_without_a_pose_or_covariance_there_is_none() -> None:
    state = state_with(np.full(6, 0.1))
    correction = Correction(np.eye(4), KeyframeEstimate.of_state(state), np.eye(6))
    assert correction.covariance_at(state) is not None
    assert correction.covariance_at(replace(state, covariance=None)) is None
    assert replace(correction, T_map_odom=None).covariance_at(state) is None


def test_without_loops_it_is_that_of_the_odometry(odometry_flight: "OdometryFlight") -> None:
    corrections = odometry_flight.mapped(NoRecognizer()).corrections
    states = [estimate.state for estimate in odometry_flight.estimates if estimate.state is not None]
    ratios = []
    for correction in corrections[20:-10:5]:
        state = next(s for s in states if s.t_ns >= correction.anchor.t_ns + 1_500_000_000)
        covariance = correction.covariance_at(state)
        assert covariance is not None and state.covariance is not None
        ratios.append(
            [np.trace(covariance[block, block]) / np.trace(state.covariance[block, block]) for block in BLOCKS]
        )
    assert len(ratios) > 10 and np.sqrt(np.mean(ratios, axis=0)) == pytest.approx(1.0, abs=0.2)


def test_loops_make_it_smaller(odometry_flight: "OdometryFlight") -> None:
    _, mapped = odometry_flight.with_loops(every=3, sigma=1e-5)
    last, without = mapped.corrections[-1], odometry_flight.mapped(NoRecognizer()).corrections[-1]
    state = next(e.state for e in odometry_flight.estimates if e.state is not None and e.t_ns >= last.anchor.t_ns)
    covariance, of_odometry = last.covariance_at(state), without.covariance_at(state)
    assert covariance is not None and of_odometry is not None
    assert np.trace(covariance[3:, 3:]) < 0.8 * np.trace(of_odometry[3:, 3:])
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
