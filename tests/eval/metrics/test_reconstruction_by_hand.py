"""Metrics of reconstructions: statistics, residual fields and position errors against values by hand."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.eval.metrics import compare_positions, reconstruction_statistics, residual_field
from dronevio.models.camera import CameraModel
from dronevio.models.errors import EvaluationError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rotation import exp_so3

if TYPE_CHECKING:
    from tests.eval.conftest import SyntheticReconstruction


def two_views() -> Reconstruction:
    """Return two cameras 1 m apart along x that look along z; the residuals are (0, 0), (-3, -4) and (0, 2) px."""
    Ts_world_cam = np.tile(np.eye(4), (2, 1, 1))
    Ts_world_cam[1, 0, 3] = 1.0
    return Reconstruction(
        cameras=(CameraModel(200, 100, 80.0, 80.0, 100.0, 50.0),),
        image_names=("left.png", "right.png"),
        image_camera=np.array([0, 0]),
        Ts_world_cam=Ts_world_cam,
        points=np.array([[0.0, 0.5, 4.0], [1.0, 0.0, 2.0]]),
        colours=np.array([[10, 20, 30], [40, 50, 60]], np.uint8),
        observation_image=np.array([0, 1, 1]),
        observation_point=np.array([0, 0, 1]),
        observation_px=np.array([[100.0, 60.0], [83.0, 64.0], [100.0, 48.0]]),
    )


def without_observations(reconstruction: Reconstruction) -> Reconstruction:
    """Return the points and cameras alone, as a file with points only has them."""
    none = np.zeros(0, np.int64)
    return replace(reconstruction, observation_image=none, observation_point=none, observation_px=np.zeros((0, 2)))


def test_statistics_by_hand() -> None:
    statistics = reconstruction_statistics([two_views()], images=3)
    assert (statistics.images, statistics.registered_images, statistics.components) == (3, 2, 1)
    assert (statistics.points, statistics.observations, statistics.invalid_observations) == (2, 3, 0)
    assert statistics.mean_track_length == 1.5
    assert statistics.mean_observations_per_image == 1.5
    # The errors are 0, 5 and 2 px; the 95th percentile is at 1.9 of 2 intervals, between 2 and 5.
    assert statistics.error_median_px == pytest.approx(2.0)
    assert statistics.error_rms_px == pytest.approx(np.sqrt(29.0 / 3.0))
    assert statistics.error_p95_px == pytest.approx(2.0 + 0.9 * 3.0)


def test_components_are_summed() -> None:
    other = replace(two_views(), image_names=("right.png", "third.png"))
    statistics = reconstruction_statistics([two_views(), other])
    assert (statistics.images, statistics.registered_images, statistics.components) == (3, 3, 2)
    assert (statistics.points, statistics.observations) == (4, 6)


def test_points_behind_a_camera_are_counted_as_invalid() -> None:
    points = np.array([[0.0, 0.5, -4.0], [1.0, 0.0, 2.0]])
    statistics = reconstruction_statistics([replace(two_views(), points=points)])
    assert statistics.invalid_observations == 2
    assert statistics.error_median_px == pytest.approx(2.0)


def test_numbers_that_do_not_exist_are_none() -> None:
    points_only = reconstruction_statistics([without_observations(two_views())])
    assert points_only.mean_track_length == 0.0
    assert points_only.error_median_px is None and points_only.error_rms_px is None
    nothing = reconstruction_statistics([], images=4)
    assert (nothing.images, nothing.registered_images, nothing.mean_track_length) == (4, 0, None)
    assert nothing.mean_observations_per_image is None


def test_residual_field_by_hand() -> None:
    field = residual_field(two_views(), 0, columns=2, min_observations=1)
    # The image of 200 x 100 px has two square cells: (83, 64) is in the left one, columns from 99.5 on in the other.
    np.testing.assert_allclose(field.centres_px, [[[49.5, 49.5], [149.5, 49.5]]])
    assert field.counts.tolist() == [[1, 2]]
    np.testing.assert_allclose(field.mean_px, [[[-3.0, -4.0], [0.0, 1.0]]], atol=1e-12)
    few = residual_field(two_views(), 0, columns=2, min_observations=2)
    assert np.isnan(few.mean_px[0, 0]).all() and np.isfinite(few.mean_px[0, 1]).all()


def test_cameras_have_fields_of_their_own() -> None:
    camera = two_views().cameras[0]
    two = replace(two_views(), cameras=(camera, camera), image_camera=np.array([0, 1]))
    assert [int(residual_field(two, index).counts.sum()) for index in (0, 1)] == [1, 2]


def test_a_wrong_focal_length_is_a_radial_field(synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    correct, camera = residual_field(r, 0, columns=8), r.cameras[0]
    wrong = residual_field(replace(r, cameras=(replace(camera, fx=1.02 * camera.fx, fy=1.02 * camera.fy),)), 0, 8)
    known = np.isfinite(wrong.mean_px[..., 0])
    outward = wrong.centres_px[known] - [camera.cx, camera.cy]
    np.testing.assert_allclose(wrong.mean_px[known], 0.02 * outward, atol=0.6)
    assert np.all(np.linalg.norm(correct.mean_px[known], axis=1) < 0.5)
    assert np.linalg.norm(wrong.mean_px[known], axis=1).max() > 2.0


def test_positions_are_aligned_by_a_similarity(synthetic: "SyntheticReconstruction") -> None:
    comparison = compare_positions(synthetic.reconstruction, synthetic.true_positions_m)
    assert comparison.image_names == synthetic.reconstruction.image_names
    assert comparison.alignment.scale == pytest.approx(5.0)
    assert comparison.rmse_m == pytest.approx(0.0, abs=1e-9)
    true = np.stack(list(synthetic.true_positions_m.values()))
    assert comparison.extent_m == pytest.approx(np.sqrt(np.sum(np.var(true, axis=0))))


def test_position_errors_by_hand() -> None:
    """Four true positions on a square of side 2 and estimates with alternating heights of 0.1."""
    square = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])
    estimated = square + np.array([[0.0, 0.0, 0.1], [0.0, 0.0, -0.1]] * 2)
    Ts_world_cam = np.tile(np.eye(4), (5, 1, 1))
    R = exp_so3(np.array([0.3, 0.2, -0.5]))
    Ts_world_cam[:4, :3, 3] = 3.0 * estimated @ R.T + [1.0, 2.0, 3.0]
    names = ("a", "b", "c", "d", "unknown")
    r = replace(
        without_observations(two_views()),
        image_names=names,
        image_camera=np.zeros(5, np.int64),
        Ts_world_cam=Ts_world_cam,
    )
    comparison = compare_positions(r, dict(zip(names, square, strict=False)))
    # The best scale is Σ a·b / Σ b·b = 8 / 8.04 of the estimate before its similarity.
    scale = 8.0 / 8.04
    assert comparison.image_names == names[:4]
    assert comparison.alignment.scale == pytest.approx(scale / 3.0)
    expected = np.sqrt(2.0 * (1.0 - scale) ** 2 + (0.1 * scale) ** 2)
    np.testing.assert_allclose(comparison.errors_m, expected)
    assert comparison.rmse_m == pytest.approx(expected)
    assert comparison.extent_m == pytest.approx(np.sqrt(2.0))
    assert comparison.rmse_percent == pytest.approx(100.0 * expected / np.sqrt(2.0))


def test_two_positions_are_not_compared() -> None:
    with pytest.raises(EvaluationError, match="2 registered images have a true position; expected at least 3"):
        compare_positions(two_views(), {name: np.zeros(3) for name in ("left.png", "right.png", "other.png")})
