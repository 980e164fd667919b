"""The random walk of the window's orientation relative to what has left it."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.drift import with_rotation_error
from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.arrays import Array
from dronevio.models.rig import euroc_rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, pose_matrix

if TYPE_CHECKING:
    from tests.estimator.conftest import KeyframeFeed, SyntheticFlight


PIVOT_M = np.array([1.0, -2.0, 0.5])
SIGMA_RAD = 0.01


def random_state(rng: np.random.Generator) -> KeyframeState:
    pose = gtsam.Pose3(pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3)))
    bias = gtsam.imuBias.ConstantBias(0.1 * rng.normal(size=3), 0.01 * rng.normal(size=3))
    return KeyframeState(pose, rng.normal(size=3), bias)


@pytest.fixture
def prior() -> MarginalPrior:
    """Return a prior of two keyframes and three landmarks."""
    rng = np.random.default_rng(0)
    n = 2 * STATE_DIM + 9
    A = rng.normal(size=(n, 2 * n))
    states = {k: random_state(rng) for k in (4, 7)}
    return MarginalPrior(A @ A.T, rng.normal(size=n), states, {i: rng.normal(size=3) for i in (3, 5, 8)})


def rotated(prior: MarginalPrior, rotation_rad: Array) -> Array:
    """Return the tangent vector (n,) of the prior's variables when all are rotated about the pivot."""
    R = exp_so3(rotation_rad)
    T = gtsam.Pose3(pose_matrix(R, PIVOT_M - R @ PIVOT_M))
    changes = [
        state.local_coordinates(KeyframeState(T.compose(state.pose), R @ state.velocity, state.bias))
        for state in prior.states.values()
    ]
    return np.concatenate([*changes, *(T.transformFrom(point) - point for point in prior.points.values())])


def test_covariance_has_the_common_rotation(prior: MarginalPrior) -> None:
    """By numerical differentiation of the rotation of all variables; the mean stays."""
    J = np.stack([(rotated(prior, d) - rotated(prior, -d)) / 2e-5 for d in 1e-5 * np.eye(3)], axis=1)
    found = with_rotation_error(prior, PIVOT_M, SIGMA_RAD)
    expected = np.linalg.inv(prior.H) + SIGMA_RAD**2 * J @ J.T
    np.testing.assert_allclose(np.linalg.inv(found.H), expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(found.H, found.b), np.linalg.solve(prior.H, prior.b), atol=1e-9)
    assert found.states == prior.states and found.points == prior.points


@pytest.mark.parametrize(("rig_name", "walks"), [("euroc", False), ("euroc-stereo", True)])
def test_yaw_walks_with_several_cameras(
    make_flight: Callable[..., "SyntheticFlight"], keyframe_feed: "type[KeyframeFeed]", rig_name: str, walks: bool
) -> None:
    """The variance of the yaw grows by that of the random walk, whatever the interval of the keyframes."""
    flight = make_flight(1, rest_s=-5.0, duration_s=9.0)
    start, drift_rad = flight.state_at(int(flight.frame_times_ns[0])), 0.002
    covariance = InitialSigmas().covariance(start.T_world_imu[:3, :3])
    rig = replace(euroc_rig(), cameras=rig_named(rig_name).cameras)

    def growth(frames_per_keyframe: int) -> float:
        def yaw_variance(drift_rad: float) -> float:
            config = SmootherConfig(drift_rad=drift_rad)
            feed = keyframe_feed(
                flight, start, covariance, config, frames_per_keyframe=frames_per_keyframe, assumed=rig
            )
            state = feed.finish().states[-1]
            R, P = state.T_world_imu[:3, :3], state.covariance
            assert P is not None
            return float((R @ P[:3, :3] @ R.T)[2, 2])

        return yaw_variance(drift_rad) - yaw_variance(0.0)

    for frames_per_keyframe in (4, 8):
        window_s = SmootherConfig().max_keyframes * 0.05 * frames_per_keyframe
        expected = drift_rad**2 * (flight.duration_s - window_s)
        assert growth(frames_per_keyframe) == pytest.approx(walks * expected, rel=0.25, abs=1e-15)
