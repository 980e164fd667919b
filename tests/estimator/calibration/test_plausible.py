"""Corrections beyond the prior: images and calibration do not belong together, and the estimate is not trusted."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.vio import IMPLAUSIBLE_CALIBRATION, VisualInertialOdometry
from dronevio.eval.run import is_warning
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
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


def estimated(flight: "SyntheticFlight", degrees: float) -> list[Estimate]:
    """Return the estimates of a flight by a calibration in which the camera is rotated."""
    vio, estimates = VisualInertialOdometry(turned(flight.rig, degrees), front_end=flight.front_end()), []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimates.append(vio.add_frame(measurement))
    return estimates


@pytest.mark.parametrize(("degrees", "plausible"), [(2.0, True), (9.0, False)])
def test_health_is_tracking_after_plausible_corrections(
    make_flight: MakeFlight, degrees: float, plausible: bool
) -> None:
    """Nine degrees are eight standard deviations of the prior; five are plausible."""
    estimates = estimated(make_flight(0, rest_s=2.0, duration_s=22.0), degrees)
    is_corrected = [any(event.startswith("calibration corrected") for event in e.events) for e in estimates]
    warned = [k for k, e in enumerate(estimates) if any(IMPLAUSIBLE_CALIBRATION in event for event in e.events)]
    assert any(is_corrected) and len(warned) == (0 if plausible else 1)
    if plausible:
        assert estimates[-1].health is Health.TRACKING
    else:
        assert all(e.health is not Health.TRACKING for e in estimates[warned[0] :])
        assert any(is_warning(event) for event in estimates[warned[0]].events)
        assert CalibrationConfig().max_correction_sigmas * CalibrationConfig().rotation.sigma < np.radians(9.0)
