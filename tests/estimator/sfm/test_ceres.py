"""Bundle adjustment by GTSAM and by Ceres, through pycolmap and pyceres, from the same initial values."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig
from dronevio.estimator.sfm.intrinsics import IntrinsicsPrior
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import exp_so3

if TYPE_CHECKING:
    from tests.estimator.sfm.conftest import MakeScene, SyntheticScene

LENSES = {
    "radtan": CameraModel(640, 480, 500.0, 505.0, 322.0, 238.0, (-0.1, 0.02, 1e-3, -5e-4)),
    "equidistant": CameraModel(640, 480, 300.0, 302.0, 322.0, 238.0, (0.02, -0.01, 1e-3, 0.0), lens="equidistant"),
    "unknown": CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0, (-0.1, 0.02, 0.0, 0.0)),
}


@pytest.mark.parametrize("cauchy_px", [None, 0.5], ids=["squared", "Cauchy"])
@pytest.mark.parametrize("lens", LENSES)
def test_both_solvers_reach_the_same_cost(
    lens: str, cauchy_px: float | None, make_scene: "MakeScene", script: Callable[[str], Any]
) -> None:
    pytest.importorskip("pyceres")
    ceres = script("ceres_adjustment")
    made = make_scene(images=5, points=60, camera=LENSES[lens])
    problem = ceres.Problem(*perturbed(made, lens != "unknown"), BundleAdjustmentConfig(cauchy_px=cauchy_px))
    costs = ceres.solve(problem)
    assert costs.ceres_start == pytest.approx(costs.start, rel=1e-9)
    assert costs.converged < 0.2 * costs.start
    assert costs.converged == pytest.approx(costs.ceres, rel=1e-4)


def perturbed(made: "SyntheticScene", is_calibrated: bool) -> tuple[Scene, SfmState, "np.ndarray[Any, Any]"]:
    """Return the measurements of a scene, initial values beside the true ones, and all observations."""
    rng = np.random.default_rng(0)
    image = np.concatenate([np.full(len(of), i) for i, of in enumerate(made.point_of)])
    point = np.concatenate(made.point_of)
    pixels = np.concatenate([features.pixels for features in made.features])
    order = np.lexsort([image, point])
    sigmas = np.random.default_rng(1).choice([1.0, 1.5, 3.0], len(order))
    tracks = Tracks(image[order], np.arange(len(order)), point[order])
    Ts_world_cam = made.Ts_world_cam.copy()
    for T in Ts_world_cam:
        T[:3, :3] @= exp_so3(rng.normal(scale=0.003, size=3))
        T[:3, 3] += rng.normal(scale=0.01, size=3)
    of_image, weak = np.zeros(len(made.features), np.int64), IntrinsicsPrior(made.camera, 10.0, (10.0, 10.0), 3)
    scene = Scene(tracks, pixels[order], sigmas, of_image, np.array([is_calibrated]), (weak,))
    points = made.points + rng.normal(scale=0.02, size=made.points.shape)
    selected = np.ones(len(order), np.bool_)
    return scene, SfmState((made.camera,), Ts_world_cam, points, selected), selected
