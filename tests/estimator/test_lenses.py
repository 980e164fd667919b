"""The whole odometry on a synthetic flight through every lens, with the same scale of the image near the axis."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.types import Calibration
from dronevio.eval.metrics.alignment import align
from dronevio.models.camera import CameraModel
from dronevio.models.lenses.lens import LENSES, LensName
from dronevio.models.state import Health, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

FOCAL_PX = 250.0


@pytest.mark.parametrize(
    ("lens", "coefficients"),
    [
        pytest.param("equidistant", (-0.01, 0.004, -0.002, 0.0002), marks=pytest.mark.slow),
        pytest.param("radtan", (-0.25, 0.07, 2e-4, -1e-4, -0.008), marks=pytest.mark.slow),
        ("radtan", (0.4, 0.05, 5e-4, -5e-4, 0.001, 0.5, 0.1, 0.002)),
        pytest.param("fov", (0.93,), marks=pytest.mark.slow),
        ("ds", (-0.172, 0.593)),
        pytest.param("eucm", (0.63, 1.04), marks=pytest.mark.slow),
        ("omni", (1.6, -0.2, 0.1, 1e-3, -1e-3)),
    ],
)
def test_a_flight_with_every_lens(
    make_flight: Callable[..., "SyntheticFlight"], lens: LensName, coefficients: tuple[float, ...]
) -> None:
    f = FOCAL_PX / LENSES[lens].central_scale(coefficients)
    flight = make_flight(0, duration_s=8.0)
    camera = replace(flight.rig.cameras[0], model=CameraModel(752, 480, f, 1.01 * f, 371.0, 242.0, coefficients, lens))
    flight = replace(flight, rig=replace(flight.rig, cameras=(camera,)))
    estimates = flight.run()
    assert all(e.health is Health.TRACKING for e in estimates[40:])
    found = Trajectory.from_states(e.state for e in estimates if e.state is not None)
    truth = flight.truth_at(found.t_ns)
    fit = align(truth.p_world_imu, found.p_world_imu, "yaw")
    errors = np.linalg.norm(truth.p_world_imu - fit.positions(found.p_world_imu), axis=1)
    assert np.sqrt(np.mean(errors**2)) < 0.008


def test_a_pixel_of_the_estimator_is_one_near_the_axis(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    """Thresholds in pixels are those of the image, whatever the focal length of the formulas is."""
    rig = make_flight().rig
    model = CameraModel(752, 480, 650.0, 650.0, 371.0, 242.0, (1.6, 0.0, 0.0, 0.0, 0.0), "omni")
    rig = replace(rig, cameras=(replace(rig.cameras[0], model=model),))
    assert Calibration(rig).focal_px == pytest.approx([250.0])
