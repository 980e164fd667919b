"""What camera and IMU cannot observe: the smoother gains no information on global position and yaw while it runs.

Marginalization keeps the linearization points of the prior (first-estimates Jacobians): Huang, Mourikis, Roumeliotis,
"A first-estimates Jacobian EKF for improving SLAM consistency", ISER 2008; Hesch et al., "Consistency analysis and
improvement of vision-aided inertial navigation", T-RO 2014.
"""

from collections.abc import Callable, Iterator
from typing import Any

import gtsam
import numpy as np
import pytest

import dronevio.estimator.backend.smoother as smoother_module
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.marginal_prior import KeyframeState, MarginalPrior
from dronevio.estimator.backend.smoother import KeyframeSmoother, SmootherConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.types import Calibration
from dronevio.models.rotation import exp_so3
from dronevio.models.state import NavState

UP = np.array([0.0, 0.0, 1.0])
GAUGE_SIGMA = 0.1
"""Standard deviation of the first keyframe's position and yaw [m and rad]: much more than keyframes differ by."""
FRAMES_PER_KEYFRAME = 4


def gauge_directions(prior: MarginalPrior) -> np.ndarray:
    """Return how a prior's variables change (n, 4) when the world moves along x, y, z, or turns about z.

    Keyframes change by (δθ, δp) in the IMU's axes, the velocity in the world and the biases, landmarks in the world;
    all about the prior's linearization points.
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


def gauge_information(prior: MarginalPrior) -> np.ndarray:
    """Return what a prior knows (4, 4) of global position and yaw."""
    N = gauge_directions(prior)
    return np.asarray(N.T @ prior.H @ N)


def priors(flight: Any, config: SmootherConfig) -> Iterator[MarginalPrior]:
    """Yield the marginal prior after each keyframe of a flight whose first state is a bit off."""
    times = flight.frame_times_ns[::FRAMES_PER_KEYFRAME]
    truth = flight.truth_at(times[:1])
    T = truth.Ts_world_imu[0].copy()
    T[:3, :3] = T[:3, :3] @ exp_so3(np.array([0.02, -0.03, 0.02]))
    velocity = truth.velocity_m_s[0] + [0.03, -0.02, 0.04]
    start = NavState(int(times[0]), T, velocity, np.zeros(3), np.zeros(3))
    covariance = np.diag(np.repeat([0.1, GAUGE_SIGMA, 1.0, 0.01, 0.1], 3) ** 2)
    front_end, buffer = flight.front_end(), ImuBuffer()
    buffer.add(flight.imu)
    buffer.take_until(int(times[0]))
    front_end.track(flight.frame(0), np.eye(3))
    smoother = KeyframeSmoother(
        Calibration(flight.rig), config, LandmarkConfig(), start, covariance, front_end.replenish()
    )
    yield smoother._window._prior
    params = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
    for k, t_ns in enumerate(times[1:].tolist(), 1):
        pim = Preintegration(params, smoother.gtsam_state[1])
        pim.integrate(buffer.take_until(t_ns))
        front_end.track(flight.frame(FRAMES_PER_KEYFRAME * k), np.eye(3))
        result = smoother.add_keyframe(t_ns, pim.measurements, front_end.replenish(), stationary=False)
        assert not result.events
        front_end.discard(result.rejected)
        yield smoother._window._prior


@pytest.mark.parametrize(
    ("min_parallax_px", "persistent"),
    [(5.0, 0), (5.0, 20), (40.0, 20)],
    ids=["oldest leave", "oldest leave, landmarks stay", "some in between leave"],
)
def test_no_information_on_global_position_and_yaw(
    make_flight: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, min_parallax_px: float, persistent: int
) -> None:
    """What the prior knows of the gauge stays what it was given, within some percent.

    Neighbouring keyframes are known to each other a hundred times better than the gauge, so that little of its
    information is lost on the way. What is gained comes from the damping of landmarks whose depth is hardly known.
    Where Jacobians are taken at the present estimates, it is gained many times over.
    """
    monkeypatch.setattr(smoother_module, "GAUGE_SIGMA", GAUGE_SIGMA)
    flight = make_flight(3, rest_s=-5.0, duration_s=5.0, max_features=40)
    config = SmootherConfig(min_parallax_px=min_parallax_px, max_persistent=persistent)
    first, *later = priors(flight, config)
    root = np.linalg.cholesky(gauge_information(first))
    for prior in later:
        relative = np.linalg.solve(root, np.linalg.solve(root, gauge_information(prior)).T)
        least, *_, most = np.linalg.eigvalsh(relative)
        assert least > 0.95 and most < 1.1
    newest = max(prior.states)
    in_window = list(range(newest - len(prior.states) + 1, newest + 1))
    assert (list(prior.states) == in_window) == (min_parallax_px == 5.0)  # else some between have left
    assert 0 not in prior.states and newest == len(later)
    assert (len(prior.points) > 0) == (persistent > 0 and min_parallax_px == 5.0)


def test_gauge_directions_are_those_of_a_moved_world(make_flight: Callable[..., Any]) -> None:
    """A world that is moved and turned about its z axis by little changes all variables along the gauge directions."""
    flight = make_flight(3, rest_s=-5.0, duration_s=2.5, max_features=40)
    *_, prior = priors(flight, SmootherConfig(max_keyframes=4))
    shift, yaw_rad = np.array([1e-6, -2e-6, 3e-6]), 1.5e-6
    turn = exp_so3(yaw_rad * UP)
    changes = []
    for state in prior.states.values():
        pose = gtsam.Pose3(gtsam.Rot3(turn), shift).compose(state.pose)
        changes.append(state.local_coordinates(KeyframeState(pose, turn @ state.velocity, state.bias)))
    changes += [turn @ point + shift - point for point in prior.points.values()]
    assert len(prior.points) > 0
    expected = gauge_directions(prior) @ np.append(shift, yaw_rad)
    np.testing.assert_allclose(np.concatenate(changes), expected, atol=1e-10)
