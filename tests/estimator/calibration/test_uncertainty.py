"""The uncertainty of states due to a calibration that is known to some extent."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.calibration.uncertainty import Origin, calibration_covariance
from dronevio.estimator.config import VioConfig
from dronevio.estimator.types import CalibrationSigmas
from dronevio.models.arrays import Array
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import Estimate, NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

VELOCITY_M_S = np.array([2.0, 0.0, 0.0])
AT_ORIGIN = NavState(0, np.eye(4), VELOCITY_M_S, np.zeros(3), np.zeros(3))


def test_a_time_offset_acts_along_the_motion() -> None:
    """5 ms at 2 m/s are 10 mm, and at 0.4 rad/s 2 mrad, both of the same cause."""
    P = calibration_covariance(AT_ORIGIN, Origin(np.zeros(3)), np.array([0.0, 0.0, 0.4]), CalibrationSigmas(0.005))
    expected = np.zeros(15)
    expected[2], expected[3] = 0.002, 0.01
    np.testing.assert_allclose(P, np.outer(expected, expected), atol=1e-15)


def test_a_rotation_acts_across_the_displacement() -> None:
    """0.01 rad over 3 m to the north are 30 mm up and sideways, at 2 m/s to the east 20 mm/s up and sideways."""
    origin = Origin(np.array([0.0, -3.0, 0.0]))
    P = calibration_covariance(AT_ORIGIN, origin, np.zeros(3), CalibrationSigmas(rotation_rad=0.01))
    np.testing.assert_allclose(np.sqrt(np.diag(P)[3:9]), [0.03, 0.0, 0.03, 0.0, 0.02, 0.02], atol=1e-15)
    assert not P[:3].any() and not P[9:].any()


def test_a_focal_length_acts_along_the_displacement() -> None:
    """2 % of 3 m and of 2 m/s."""
    origin = Origin(np.array([0.0, -3.0, 0.0]))
    P = calibration_covariance(AT_ORIGIN, origin, np.zeros(3), CalibrationSigmas(focal=0.02))
    np.testing.assert_allclose(np.sqrt(np.diag(P)[3:9]), [0.0, 0.06, 0.0, 0.04, 0.0, 0.0], atol=1e-15)


def test_what_a_wrong_calibration_has_done_remains_after_its_correction() -> None:
    """A focal length that was uncertain by 5 % over 2 m leaves 0.1 m, however certain the corrected one is."""
    moved = replace(AT_ORIGIN, T_world_imu=pose_matrix(np.eye(3), np.array([2.0, 0.0, 0.0])))
    origin = Origin(np.zeros(3)).corrected(moved, CalibrationSigmas(focal=0.05))
    np.testing.assert_array_equal(origin.position_m, [2.0, 0.0, 0.0])
    later = replace(AT_ORIGIN, T_world_imu=pose_matrix(np.eye(3), np.array([2.0, 1.0, 0.0])))
    P = calibration_covariance(later, origin, np.zeros(3), CalibrationSigmas(focal=0.001))
    np.testing.assert_allclose(np.sqrt(np.diag(P)[3:6]), [0.1, 0.001, 0.0], atol=1e-15)


def position_sigmas(estimates: list[Estimate]) -> Array:
    """Return the largest standard deviation of the position in each estimate with a state [m]."""
    P = np.stack(
        [e.state.covariance[3:6, 3:6] for e in estimates if e.state is not None and e.state.covariance is not None]
    )
    return np.asarray(np.sqrt(np.linalg.eigvalsh(P)[:, -1]))


@pytest.mark.parametrize(("rest_s", "growth"), [(1.5, 1.5), (-5.0, 4.0)])
def test_windows_reduce_the_uncertainty_of_the_calibration(
    make_flight: MakeFlight, known_calibration: VioConfig, rest_s: float, growth: float
) -> None:
    """Positions are as uncertain as the calibration; poses do not depend on that.

    After a rest, parts of the first window reduce the uncertainty, which never vanishes.
    """
    flight = make_flight(0, rest_s=rest_s, duration_s=9.0)
    online, known = flight.run(), flight.run(config=known_calibration)
    assert not any("calibration corrected" in event for e in online for event in e.events)
    ratio = position_sigmas(online) / position_sigmas(known)
    assert growth < ratio.max() < 3.0 * growth
    assert 1.0 < ratio[-20:].min() <= ratio[-20:].max() < 0.8 * ratio.max()
    for a, b in zip(online, known, strict=True):
        assert (a.state is None) == (b.state is None)
        if a.state is not None and b.state is not None:
            np.testing.assert_array_equal(a.state.T_world_imu, b.state.T_world_imu)
