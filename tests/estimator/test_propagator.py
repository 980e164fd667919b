"""Propagation since a keyframe: when the drone is stationary, and its predicted state then."""

import numpy as np
import pytest

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.propagator import Propagator
from dronevio.estimator.types import NO_FEATURES, Calibration, FramePacket
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuModel
from dronevio.models.rig import euroc_rig
from dronevio.models.state import NavState

FRAME_NS = 50_000_000
IMU = ImuModel()


def propagator(velocity_m_s: Array, sigma_m_s: float) -> Propagator:
    """Return a propagator from a level keyframe at the origin, with a velocity (3,) and its standard deviation."""
    covariance = 1e-6 * np.eye(15)
    covariance[6:9, 6:9] = sigma_m_s**2 * np.eye(3)
    state = NavState(0, np.eye(4), velocity_m_s, np.zeros(3), np.zeros(3), covariance)
    smoother = KeyframeSmoother(
        Calibration(euroc_rig()), SmootherConfig(), LandmarkConfig(), state, covariance, NO_FEATURES
    )
    params = PreintegrationParams.of(IMU, PreintegrationConfig())
    return Propagator(params, IMU, KeyframePolicy(KeyframeConfig()), smoother, NO_FEATURES)


def packet(k: int, stationary_s: float = 10.0) -> FramePacket:
    """Return the k-th frame, before which the IMU measures gravity alone."""
    n = 10
    force = np.tile([0.0, 0.0, GRAVITY_M_S2], (n, 1))
    return FramePacket(
        k * FRAME_NS, Increments(np.full(n, 0.005), np.zeros((n, 3)), force), NO_FEATURES, stationary_s=stationary_s
    )


@pytest.mark.parametrize(("sigma_m_s", "stationary"), [(0.002, False), (0.009, False), (0.011, True), (0.1, True)])
def test_significant_velocity_excludes_stationary(sigma_m_s: float, stationary: bool) -> None:
    """A drone drifts at 5 cm/s in front of a distant wall, so that the image does not show the motion."""
    drifting = propagator(np.array([0.0, 0.03, 0.04]), sigma_m_s)
    for k in range(1, 8):
        found = drifting.would_be_stationary(packet(k))
        assert found == stationary
        drifting.add(packet(k), found)
    displacement_m = drifting.state_at(7 * FRAME_NS).T_world_imu[:3, 3]
    if stationary:  # settled 0.2 s ago
        np.testing.assert_allclose(displacement_m, 0.0, atol=1e-9)
    else:
        np.testing.assert_allclose(displacement_m, 0.35 * np.array([0.0, 0.03, 0.04]), atol=1e-9)
    # Keyframes are less frequent while the drone is stationary
    assert drifting.is_keyframe_due(packet(7), None) == (not stationary)


def test_stationary_needs_the_whole_time_since_the_keyframe() -> None:
    hovering = propagator(np.zeros(3), 0.002)
    assert hovering.would_be_stationary(packet(1, stationary_s=0.05))
    assert not hovering.would_be_stationary(packet(1, stationary_s=0.04))
