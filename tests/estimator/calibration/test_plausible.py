"""Corrections beyond the prior: images and calibration do not belong together, and the estimate is not trusted."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.config import VioConfig
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.eval.run import is_warning
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import Estimate, Health

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]


def turned(rig: Rig, degrees: float) -> Rig:
    """Return a rig whose camera is rotated about the optical axis."""
    T = rig.cameras[0].T_imu_cam @ pose_matrix(exp_so3(np.radians([0.0, 0.0, degrees])), np.zeros(3))
    return replace(rig, cameras=(replace(rig.cameras[0], T_imu_cam=T),))


def estimated(flight: "SyntheticFlight", degrees: float, health: HealthConfig | None = None) -> list[Estimate]:
    """Return the estimates of a flight by a calibration in which the camera is rotated."""
    config = VioConfig(health=health or HealthConfig())
    return replace(flight, rig=turned(flight.rig, degrees)).run(flight.front_end(), config)


@pytest.mark.parametrize(("degrees", "plausible"), [(2.0, True), (9.0, False)])
def test_health_is_tracking_after_plausible_corrections(
    make_flight: MakeFlight, degrees: float, plausible: bool
) -> None:
    """Nine degrees are eight standard deviations of the prior; five are plausible."""
    estimates = estimated(make_flight(0, rest_s=2.0, duration_s=22.0), degrees)
    is_corrected = [any(event.startswith("calibration corrected") for event in e.events) for e in estimates]
    warned = [k for k, e in enumerate(estimates) if any(Cause.IMPLAUSIBLE_CALIBRATION in event for event in e.events)]
    assert any(is_corrected) and len(warned) == (0 if plausible else 1)
    if plausible:
        assert estimates[-1].health is Health.TRACKING
    else:
        assert all(e.health is not Health.TRACKING for e in estimates[warned[0] :])
        assert any(is_warning(event) for event in estimates[warned[0]].events)


def test_correction_that_moves_the_position_is_distrusted(make_flight: MakeFlight) -> None:
    """At the frame of the correction, with a limit that any correction exceeds."""
    flight = make_flight(0, rest_s=2.0, duration_s=8.0)
    estimates = estimated(flight, 2.0, HealthConfig(max_change_sigmas=1e-6))
    first = next(e for e in estimates if any(event.startswith("calibration corrected") for event in e.events))
    assert first.health is Health.INERTIAL_ONLY


@pytest.mark.parametrize(("rest_s", "expected"), [(2.0, Health.TRACKING), (-5.0, Health.INERTIAL_ONLY)])
def test_a_start_in_motion_has_a_limit_of_the_bias(make_flight: MakeFlight, rest_s: float, expected: Health) -> None:
    estimates = estimated(make_flight(0, rest_s=rest_s, duration_s=5.0), 0.0, HealthConfig(max_first_bias_sigmas=1e-6))
    assert next(e for e in estimates if e.state is not None).health is expected
