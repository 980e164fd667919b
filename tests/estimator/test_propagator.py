"""The interval since a keyframe: what may be a rest, and where the drone is during one."""

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from dronevio.estimator.backend.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.propagator import Propagator
from dronevio.estimator.types import NO_FEATURES, FramePacket
from dronevio.models.imu import GRAVITY_M_S2, ImuModel
from dronevio.models.state import NavState

FRAME_NS = 50_000_000
IMU = ImuModel()


def interval(velocity_m_s: np.ndarray, sigma_m_s: float) -> Propagator:
    """Return an interval since a keyframe at the origin, upright, of a velocity that is known as well as that."""
    covariance = 1e-6 * np.eye(15)
    covariance[6:9, 6:9] = sigma_m_s**2 * np.eye(3)
    state = NavState(0, np.eye(4), velocity_m_s, np.zeros(3), np.zeros(3), covariance)
    keyframe = SimpleNamespace(
        state=state, gtsam_state=(gtsam.NavState(gtsam.Pose3(), velocity_m_s), gtsam.imuBias.ConstantBias())
    )
    params = PreintegrationParams.of(IMU, PreintegrationConfig())
    return Propagator(params, IMU, KeyframePolicy(KeyframeConfig()), keyframe, NO_FEATURES)


def packet(k: int) -> FramePacket:
    """Return a frame before which the IMU has felt gravity and nothing else."""
    n = 10
    force = np.tile([0.0, 0.0, GRAVITY_M_S2], (n, 1))
    return FramePacket(k * FRAME_NS, Increments(np.full(n, 0.005), np.zeros((n, 3)), force), NO_FEATURES)


@pytest.mark.parametrize(("sigma_m_s", "rests"), [(0.002, False), (0.009, False), (0.011, True), (0.1, True)])
def test_what_surely_moves_does_not_rest_though_its_image_stands(sigma_m_s: float, rests: bool) -> None:
    """A drone that drifts at 5 cm/s, a far wall before it."""
    drifting = interval(np.array([0.0, 0.03, 0.04]), sigma_m_s)
    for k in range(1, 8):
        still = drifting.would_be_stationary(packet(k), stationary_s=10.0)
        assert still == rests
        drifting.add(packet(k), still)
    moved_m = drifting.state_at(7 * FRAME_NS).T_world_imu[:3, 3]
    if rests:  # settled 0.2 s ago
        np.testing.assert_allclose(moved_m, 0.0, atol=1e-9)
    else:
        np.testing.assert_allclose(moved_m, 0.35 * np.array([0.0, 0.03, 0.04]), atol=1e-9)
    assert drifting.is_keyframe_due(10.0, NO_FEATURES, None) == (not rests)  # rests have fewer keyframes


def test_a_drone_that_stands_rests() -> None:
    standing = interval(np.zeros(3), 0.002)
    assert standing.would_be_stationary(packet(1), stationary_s=0.05)
    assert not standing.would_be_stationary(packet(1), stationary_s=0.04)
