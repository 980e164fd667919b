"""The smoother gains no information on the unobservable directions: global position and yaw.

The marginal prior keeps the linearization points of its variables (first-estimates Jacobians): Huang, Mourikis,
Roumeliotis, "A first-estimates Jacobian EKF for improving SLAM consistency", ISER 2008; Hesch et al., "Consistency
analysis and improvement of vision-aided inertial navigation", T-RO 2014.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest

import dronevio.estimator.backend.smoother as smoother_module
from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.marginal_prior import KeyframeState, MarginalPrior
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3

if TYPE_CHECKING:
    from tests.estimator.conftest import KeyframeFeed, SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
MakePriors = Callable[["SyntheticFlight", SmootherConfig], Iterator[MarginalPrior]]

UP = np.array([0.0, 0.0, 1.0])
GAUGE_SIGMA = 0.1
"""Standard deviation of the first keyframe's position and yaw [m and rad], larger than relative errors by far."""


def gauge_directions(prior: MarginalPrior) -> Array:
    """Return the tangent vectors (n, 4) of a prior's variables when the world moves along x, y, z or rotates about z.

    The tangent space of a keyframe is that of `KeyframeState`; landmarks change in the world frame. All are evaluated
    at the prior's linearization points.
    """
    blocks = []
    for state in prior.states.values():
        R, p = state.pose.rotation().matrix(), state.pose.translation()
        block = np.zeros((15, 4))
        block[3:6, :3] = R.T
        block[0:3, 3], block[3:6, 3], block[6:9, 3] = R.T @ UP, R.T @ np.cross(UP, p), np.cross(UP, state.velocity)
        blocks.append(block)
    blocks += [np.column_stack([np.eye(3), np.cross(UP, point)]) for point in prior.points.values()]
    return np.concatenate(blocks)


def gauge_information(prior: MarginalPrior) -> Array:
    """Return the information (4, 4) of a prior on global position and yaw."""
    N = gauge_directions(prior)
    return np.asarray(N.T @ prior.H @ N)


@pytest.fixture
def priors(keyframe_feed: "type[KeyframeFeed]") -> MakePriors:
    """Return a generator of the marginal priors of a flight, from the first keyframe on, whose state has an error."""

    def generate(flight: "SyntheticFlight", config: SmootherConfig) -> Iterator[MarginalPrior]:
        true = flight.state_at(int(flight.frame_times_ns[0]))
        T = true.T_world_imu.copy()
        T[:3, :3] = T[:3, :3] @ exp_so3(np.array([0.02, -0.03, 0.02]))
        velocity = true.velocity_m_s + [0.03, -0.02, 0.04]
        zero = np.zeros(3)
        start = replace(true, T_world_imu=T, velocity_m_s=velocity, gyro_bias_rad_s=zero, accel_bias_m_s2=zero)
        feed = keyframe_feed(flight, start, np.diag(np.repeat([0.1, GAUGE_SIGMA, 1.0, 0.01, 0.1], 3) ** 2), config)
        yield feed.smoother._window._prior
        for _ in feed:
            assert not feed.results[-1].events
            yield feed.smoother._window._prior

    return generate


@pytest.mark.parametrize(
    ("min_parallax_px", "persistent"),
    [(5.0, 0), (5.0, 20), (40.0, 20)],
    ids=["marginalize", "marginalize with persistent landmarks", "drop keyframes"],
)
def test_no_information_on_global_position_and_yaw(
    make_flight: MakeFlight,
    priors: MakePriors,
    monkeypatch: pytest.MonkeyPatch,
    min_parallax_px: float,
    persistent: int,
) -> None:
    """The information of the prior on the gauge stays that of the first keyframe, within some percent.

    Relative poses are a hundred times more accurate than the gauge, so that little of its information is lost. The
    damping of landmarks with an unconstrained depth adds a little. If Jacobians are evaluated at the current estimates,
    the information grows many times over.
    """
    monkeypatch.setattr(smoother_module, "GAUGE_SIGMA", GAUGE_SIGMA)
    flight = make_flight(3, rest_s=-5.0, duration_s=5.0, max_features=40)
    config = SmootherConfig(min_parallax_px=min_parallax_px, max_persistent=persistent)
    first, *others = priors(flight, config)
    root = np.linalg.cholesky(gauge_information(first))
    for prior in others:
        relative = np.linalg.solve(root, np.linalg.solve(root, gauge_information(prior)).T)
        eigenvalues = np.linalg.eigvalsh(relative)
        assert eigenvalues.min() > 0.95 and eigenvalues.max() < 1.1
    last, newest = others[-1], max(others[-1].states)
    consecutive = list(range(newest - len(last.states) + 1, newest + 1))
    assert (list(last.states) == consecutive) == (min_parallax_px == 5.0)
    assert 0 not in last.states and newest == len(others)
    assert (len(last.points) > 0) == (persistent > 0 and min_parallax_px == 5.0)


def test_gauge_directions_are_those_of_a_moved_world(make_flight: MakeFlight, priors: MakePriors) -> None:
    """A small motion of the world, with a rotation about its z axis, changes all variables along these directions."""
    flight = make_flight(3, rest_s=-5.0, duration_s=2.5, max_features=40)
    *_, prior = priors(flight, SmootherConfig(max_keyframes=4))
    shift, yaw_rad = np.array([1e-6, -2e-6, 3e-6]), 1.5e-6
    R = exp_so3(yaw_rad * UP)
    changes = []
    for state in prior.states.values():
        pose = gtsam.Pose3(gtsam.Rot3(R), shift).compose(state.pose)
        changes.append(state.local_coordinates(KeyframeState(pose, R @ state.velocity, state.bias)))
    changes += [R @ point + shift - point for point in prior.points.values()]
    assert len(prior.points) > 0
    expected = gauge_directions(prior) @ np.append(shift, yaw_rad)
    np.testing.assert_allclose(np.concatenate(changes), expected, atol=1e-10)
