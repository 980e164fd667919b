"""Every option of the odometry has an effect: estimates or tracks with another value differ from those without."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.cli.settings.named_fields import changed
from dronevio.cli.settings.option_tables import ESTIMATOR
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.tracker import FeatureTracker
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import CameraFrame

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

RenderWall = Callable[[CameraModel, Array], npt.NDArray[np.uint8]]

CAMERA = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
TRACKING: dict[str, Any] = {
    "tracker.corners.cell-px": 80,
    "tracker.corners.min-score": 0.05,
    "tracker.window-px": 21,
    "tracker.pyramid-levels": 0,
    "tracker.ransac-threshold-px": 0.02,
}
"""Options of the front end, with values far from the defaults."""
STARTED: dict[str, Any] = {
    "gravity-m-s2": 9.7,
    "preintegration.gyro-noise-inflation": 20.0,
    "preintegration.accel-noise-inflation": 20.0,
    "zero-velocity.max-flow-px": 0.0,
    "initialization.static-window-s": 0.3,
    "keyframe.interval-s": 0.4,
    "smoother.max-keyframes": 4,
    "smoother.pixel-sigma": 1.0,
    "landmarks.max-distance-m": 4.0,
    "calibration.time-offset.online": False,
    "calibration.time-offset.sigma": 0.1,
    "calibration.rotation.online": False,
    "calibration.rotation.sigma": 0.2,
    "calibration.translation.online": True,
    "calibration.focal.online": False,
    "calibration.principal.online": False,
}
"""Options that show on a flight from rest with one camera."""
OTHERS: dict[str, Any] = {
    "calibration.gravity.online": False,
    "initialization.dynamic.window-s": 0.8,
    "smoother.stereo-pixel-sigma": 1.0,
    "health.max-inertial-sigma-m": 1e-3,
}
"""Options that show with wrong gravity, in motion from the beginning, with two cameras, and in darkness."""


def config_with(name: str, value: Any) -> VioConfig:
    """Return the settings of the odometry with another value of an option."""
    config = changed(VioConfig(), {tuple(name.replace("-", "_").split(".")): value})
    assert isinstance(config, VioConfig)
    return config


def states(flight: "SyntheticFlight", config: VioConfig | None = None) -> bytes:
    """Return poses, velocities and covariances of all frames of a flight."""
    found = b""
    for estimate in flight.run(config=config):
        state = estimate.state
        if state is not None:
            assert state.covariance is not None
            found += b"".join(array.tobytes() for array in (state.T_world_imu, state.velocity_m_s, state.covariance))
    return found


@pytest.fixture(scope="module")
def flight(make_flight: Callable[..., "SyntheticFlight"]) -> "SyntheticFlight":
    return make_flight(rest_s=0.9, duration_s=2.4)


@pytest.fixture(scope="module")
def default_states(flight: "SyntheticFlight") -> bytes:
    return states(flight)


def tracks(render_wall: RenderWall, config: VioConfig) -> bytes:
    """Return the tracks of a camera that moves in front of a wall, and rotates by 3° a frame unpredicted."""
    tracker = FeatureTracker(CAMERA, config.tracker)
    found = b""
    for k in range(4):
        T_world_cam = pose_matrix(exp_so3(np.array([0.0, 0.05 * k, 0.0])), np.array([0.05 * k, 0.0, 0.0]))
        image = render_wall(CAMERA, T_world_cam)
        noisy = np.clip(image + np.random.default_rng(k).normal(scale=4.0, size=image.shape), 0, 255).astype(np.uint8)
        tracker.track(CameraFrame(10**18 + k * 50_000_000, (noisy,)), np.eye(3))
        observations = tracker.replenish()
        found += observations.ids.tobytes() + observations.pixels.tobytes()
    return found


def test_all_options_are_tested() -> None:
    assert {*TRACKING, *STARTED, *OTHERS} == set(ESTIMATOR)


@pytest.mark.parametrize("name", TRACKING)
def test_options_change_the_tracks(name: str, render_wall: RenderWall) -> None:
    assert tracks(render_wall, config_with(name, TRACKING[name])) != tracks(render_wall, VioConfig())


@pytest.mark.parametrize("name", STARTED)
def test_options_change_the_estimates(name: str, flight: "SyntheticFlight", default_states: bytes) -> None:
    assert states(flight, config_with(name, STARTED[name])) != default_states


@pytest.mark.slow  # flights of seconds
@pytest.mark.parametrize("name", OTHERS)
def test_options_change_the_estimates_of_other_flights(
    name: str, make_flight: Callable[..., "SyntheticFlight"]
) -> None:
    flight = {
        "calibration.gravity.online": lambda: make_flight(rest_s=-5.0, duration_s=8.0, gravity_m_s2=9.7),
        "initialization.dynamic.window-s": lambda: make_flight(rest_s=-1.0, duration_s=2.5),
        "smoother.stereo-pixel-sigma": lambda: replace(
            make_flight(rest_s=0.9, duration_s=2.0), rig=rig_named("euroc-stereo")
        ),
        "health.max-inertial-sigma-m": lambda: make_flight(rest_s=0.9, duration_s=3.0, dark_s=(2.0, 3.0)),
    }[name]()
    default = states(flight)
    assert len(default) > 1000
    assert states(flight, config_with(name, OTHERS[name])) != default
