"""Bundle adjustment of the photographs of the chapter."""

import matplotlib.image
import numpy as np
import pytest

from dronevio.estimator.book.sfm import POSITION_SIGMA, SfmExperiment, run_sfm_experiment
from dronevio.models.errors import ConfigError


@pytest.fixture(scope="module")
def experiment() -> SfmExperiment:
    return run_sfm_experiment(np.random.default_rng(0))


def test_perturbed_start_leads_to_the_error_of_the_book(experiment: SfmExperiment) -> None:
    assert experiment.Ts_world_cam.shape == (5, 4, 4)
    assert experiment.points.shape == (544, 3)
    assert experiment.bundler_error == pytest.approx(126.9, abs=0.05)
    assert experiment.initial_error > 1e5
    assert experiment.final_error == pytest.approx(125.5, abs=0.05)


def test_without_perturbation_errors_are_those_of_the_book(experiment: SfmExperiment) -> None:
    book = run_sfm_experiment(np.random.default_rng(0), perturbation=0.0)
    assert book.initial_error == book.bundler_error == experiment.bundler_error
    np.testing.assert_array_equal(book.points_initial, book.points_bundler)
    assert book.final_error == pytest.approx(experiment.final_error, abs=1e-3)
    np.testing.assert_allclose(np.median(np.abs(book.points - experiment.points)), 0.0, atol=1e-5)


def test_perturbation_is_seeded_and_spares_the_gauge(experiment: SfmExperiment) -> None:
    moved = experiment.points_initial - experiment.points_bundler
    np.testing.assert_array_equal(moved[0], 0.0)
    assert np.std(moved[1:]) == pytest.approx(POSITION_SIGMA, rel=0.1)
    other = run_sfm_experiment(np.random.default_rng(1))
    again = run_sfm_experiment(np.random.default_rng(0))
    np.testing.assert_array_equal(again.points_initial, experiment.points_initial)
    assert other.initial_error != experiment.initial_error
    np.testing.assert_allclose(other.Ts_world_cam_initial[0], experiment.Ts_world_cam_initial[0], atol=0.0)
    assert not np.allclose(other.Ts_world_cam_initial[1], experiment.Ts_world_cam_initial[1], atol=1e-3)


def test_adjustment_brings_points_and_pixels_together(experiment: SfmExperiment) -> None:
    assert experiment.initial_reprojection_rms_px > 10.0 > 1.0 > experiment.reprojection_rms_px
    assert experiment.initial_distance > 0.05 > 0.01 > experiment.final_distance


def test_negative_perturbation_is_refused() -> None:
    with pytest.raises(ConfigError, match="perturbation -1"):
        run_sfm_experiment(np.random.default_rng(0), perturbation=-1.0)


def test_error_is_half_the_squared_reprojection_error(experiment: SfmExperiment) -> None:
    """With a standard deviation of 1 px the residuals are in pixels; the gauge priors have no error."""
    squares = np.sum((experiment.observed_px - experiment.reprojected_px) ** 2)
    assert 0.5 * squares == pytest.approx(experiment.final_error, rel=1e-6)
    assert experiment.reprojection_rms_px == pytest.approx(np.sqrt(squares / len(experiment.observed_px)))


def test_a_pinhole_model_reprojects_the_points(experiment: SfmExperiment) -> None:
    """The test's own pinhole model, without the small distortion, agrees with the observations."""
    T = experiment.Ts_world_cam[experiment.observation_camera]
    p_world = experiment.points[experiment.observation_point]
    p_cam = np.einsum("nji,nj->ni", T[:, :3, :3], p_world - T[:, :3, 3])
    assert np.all(p_cam[:, 2] > 0.0)
    pixels = experiment.focal_px[experiment.observation_camera, None] * p_cam[:, :2] / p_cam[:, 2:]
    assert np.median(np.linalg.norm(pixels - experiment.observed_px, axis=1)) < 2.0


def test_every_point_is_observed_by_two_cameras_or_more(experiment: SfmExperiment) -> None:
    assert experiment.views.min() >= 2
    np.testing.assert_array_equal(np.bincount(experiment.observation_point), experiment.views)
    pairs = set(zip(experiment.observation_point, experiment.observation_camera, strict=True))
    assert len(pairs) == len(experiment.observed_px)


def test_point_colours_match_the_photographs(experiment: SfmExperiment) -> None:
    images = [matplotlib.image.imread(path) for path in experiment.photographs]
    height, width = images[0].shape[:2]
    columns, rows = np.round(experiment.observed_px + np.array([width, height]) / 2.0).astype(int).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    assert inside.all()
    observed = np.stack([images[c][y, x] for c, y, x in zip(experiment.observation_camera, rows, columns, strict=True)])
    stored = experiment.colours[experiment.observation_point].astype(float)
    for channel in ([1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 2.0, -1.0]):  # brightness, red-blue, green-magenta
        assert np.corrcoef(observed @ channel, stored @ channel)[0, 1] > 0.8
