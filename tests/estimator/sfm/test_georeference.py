"""World frames by measured positions of photographs and of ground control points."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.sfm.config import GpsConfig, SfmConfig
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.estimator.sfm.placement.positions import MeasuredPositions, PositionAlignment, align_with_positions
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.image_sets import GeoTags, ImageSet
from dronevio.models.image_sets.control_points import ControlPoints
from dronevio.models.rotation import exp_so3, log_so3

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, MakeScene, SyntheticScene

ORIGIN = GeodeticPoint(47.4, 8.5, 400.0)
SCALE, R_ENU_SCENE = 20.0, exp_so3(np.array([0.3, -1.2, 2.0]))
NO_ROTATIONS = np.empty((0, 3, 3))


def measured(count: int, sigma_m: float, seed: int = 0, on_a_line: bool = False) -> tuple[MeasuredPositions, Array]:
    """Return noisy positions of points of a known similarity transformation, and the positions without noise."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * ([5.0, 0.0, 0.0] if on_a_line else [5.0, 4.0, 0.5])
    exact = SCALE * points @ R_ENU_SCENE.T + [3.0, 4.0, 5.0]
    noisy = exact + rng.normal(scale=sigma_m, size=exact.shape)
    return MeasuredPositions(points, noisy, np.full((count, 3), max(sigma_m, 1e-3)), NO_ROTATIONS), exact


def aligned(positions: MeasuredPositions, known_scale: bool = False) -> PositionAlignment:
    """Return the alignment, which exists."""
    found = align_with_positions(positions, known_scale)
    assert isinstance(found, PositionAlignment), found
    return found


def rotation_error_rad(alignment: PositionAlignment) -> Array:
    """Return the rotation vector (3,) of the error in the world frame."""
    return np.asarray(log_so3(alignment.R @ R_ENU_SCENE.T))


def test_exact_positions_give_the_transformation() -> None:
    positions, _ = measured(10, 0.0)
    found = aligned(positions)
    assert found.scale == pytest.approx(SCALE, rel=1e-9)
    np.testing.assert_allclose(found.R, R_ENU_SCENE, atol=1e-9)
    np.testing.assert_allclose(found.t, [3.0, 4.0, 5.0], atol=1e-7)
    assert found.noise_factor == 1.0 and not found.is_outlier.any()
    shrunk = replace(positions, points=SCALE * positions.points)
    assert aligned(shrunk, known_scale=True).scale == 1.0 and aligned(shrunk, known_scale=True).scale_sigma == 0.0


@pytest.mark.parametrize("wrong", [1, 15])
def test_wrong_positions_are_harmless(wrong: int) -> None:
    positions, exact = measured(50, 1.0, seed=3)
    without = aligned(replace(positions, positions_m=positions.positions_m.copy()))
    moved = positions.positions_m.copy()
    moved[:wrong] += np.random.default_rng(1).normal(size=(wrong, 3)) * 100.0
    found = aligned(replace(positions, positions_m=moved))
    assert found.is_outlier[:wrong].mean() > 0.9 and not found.is_outlier[wrong:].any()
    errors = found.scale * positions.points @ found.R.T + found.t - exact
    best = without.scale * positions.points @ without.R.T + without.t - exact
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 1.5 * np.sqrt(np.mean(np.sum(best**2, axis=1)))


def test_the_stated_deviations_are_those_of_many_trials() -> None:
    found = measured(20, 0.5, seed=0)
    same = [
        aligned(replace(found[0], positions_m=found[1] + np.random.default_rng(s).normal(scale=0.5, size=(20, 3))))
        for s in range(300)
    ]
    north = np.std([rotation_error_rad(each)[2] for each in same])
    scale = np.std([np.log(each.scale / SCALE) for each in same])
    assert north == pytest.approx(np.median([each.yaw_sigma_rad for each in same]), rel=0.25)
    assert scale == pytest.approx(np.median([each.scale_sigma for each in same]), rel=0.25)


def test_understated_deviations_are_noticed() -> None:
    positions, _ = measured(40, 2.0)
    stated = replace(positions, sigmas_m=positions.sigmas_m / 20.0)
    found, right = aligned(stated), aligned(positions)
    assert found.noise_factor == pytest.approx(20.0, rel=0.3)
    assert found.yaw_sigma_rad == pytest.approx(right.yaw_sigma_rad, rel=0.4)
    assert found.is_outlier.sum() <= 1


def test_a_line_leaves_a_rotation_open_that_gimbals_close() -> None:
    positions, exact = measured(12, 0.3, on_a_line=True)
    assert np.degrees(aligned(positions).tilt_sigma_rad) > 45.0
    assert aligned(positions).scale_sigma < 0.01
    tilted = exp_so3(np.random.default_rng(2).normal(scale=0.005, size=(12, 3))) @ R_ENU_SCENE
    found = aligned(replace(positions, Rs=tilted))
    assert np.degrees(found.tilt_sigma_rad) < 2.0
    assert np.degrees(np.linalg.norm(rotation_error_rad(found))) < 1.5
    errors = found.scale * positions.points @ found.R.T + found.t - exact
    assert np.abs(errors).max() < 1.0


def test_a_wrong_compass_does_not_turn_the_result() -> None:
    positions, _ = measured(50, 0.5)
    compass = exp_so3(np.array([0.0, 0.0, np.radians(30.0)])) @ R_ENU_SCENE
    found = aligned(replace(positions, Rs=np.tile(compass, (50, 1, 1))))
    assert np.degrees(np.linalg.norm(rotation_error_rad(found))) < 0.5


def test_positions_that_determine_nothing() -> None:
    positions, _ = measured(2, 0.1)
    assert align_with_positions(positions) == "2 measured positions; at least 3 are needed"
    same = replace(measured(5, 0.1)[0], positions_m=np.tile([1.0, 2.0, 3.0], (5, 1)))
    found = align_with_positions(same)
    assert isinstance(found, str) or found.scale_sigma > 0.5


def with_positions(
    images: ImageSet, scene: "SyntheticScene", sigma_m: float, stated_m: float | None = None
) -> ImageSet:
    """Return a set of images with noisy positions of the cameras of a scene, which is turned and scaled."""
    rng = np.random.default_rng(4)
    exact = true_positions_m(scene)
    geodetic = ORIGIN.from_enu(exact + rng.normal(scale=sigma_m, size=exact.shape))
    count = len(images)
    stated = np.full((count, 3), sigma_m if stated_m is None else stated_m)
    return replace(images, geotags=GeoTags(geodetic, stated, np.full((count, 3, 3), np.nan), "ellipsoid"))


def true_positions_m(scene: "SyntheticScene") -> Array:
    """Return the true positions (I, 3) of the cameras in east, north, up of `ORIGIN`."""
    return np.asarray(SCALE * scene.Ts_world_cam[:, :3, 3] @ R_ENU_SCENE.T)


@pytest.fixture(scope="module")
def wide_scene(make_scene: "MakeScene") -> "SyntheticScene":
    """A scene whose cameras are not on a line."""
    scene: SyntheticScene = make_scene(images=10)
    return scene


def test_the_result_is_in_east_north_up(
    wide_scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(wide_scene, tmp_path)
    tagged = with_positions(images, wide_scene, 0.01)
    result = reconstruct(tagged, None, workspace)
    [found], [world] = result.reconstructions, result.worlds
    assert world.scale == "gps" and world.is_metric and world.is_vertical and world.geo is not None
    assert world.origin == tagged.geotags.origin if tagged.geotags is not None else False
    assert world.origin is not None
    placed = ORIGIN.to_enu(world.origin.from_enu(found.positions))
    errors = np.linalg.norm(placed - true_positions_m(wide_scene), axis=1)
    assert np.sqrt(np.mean(errors**2)) < 0.03
    assert world.geo.residuals_m.shape == (10, 3) and np.abs(world.geo.residuals_m).max() < 0.05
    assert world.geo.noise_factor < 2.0


def test_an_outlier_and_a_missing_altitude(
    wide_scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(wide_scene, tmp_path)
    tagged = with_positions(images, wide_scene, 0.01)
    assert tagged.geotags is not None
    geodetic = tagged.geotags.geodetic.copy()
    geodetic[2, 0] += 100.0 / 111_000.0
    geodetic[5, 2] = np.nan
    geodetic[7] = np.nan
    result = reconstruct(replace(tagged, geotags=replace(tagged.geotags, geodetic=geodetic)), None, workspace)
    [found], [world] = result.reconstructions, result.worlds
    assert world.geo is not None and world.origin is not None
    assert world.geo.image_names == tuple(name for name in images.names if name != images.names[7])
    assert world.geo.is_outlier.tolist() == [i == 2 for i in range(9)]
    assert np.isnan(world.geo.residuals_m[5, 2]) and np.isfinite(world.geo.residuals_m[5, :2]).all()
    errors = ORIGIN.to_enu(world.origin.from_enu(found.positions)) - true_positions_m(wide_scene)
    assert np.linalg.norm(errors, axis=1).max() < 0.1


def test_positions_can_be_ignored_or_required(
    wide_scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(wide_scene, tmp_path)
    off = reconstruct(with_positions(images, wide_scene, 0.01), SfmConfig(gps=GpsConfig("off")), workspace)
    assert off.worlds[0].scale == "arbitrary" and off.worlds[0].geo is None
    vague = with_positions(images, wide_scene, 0.01, stated_m=1000.0)
    kept = reconstruct(vague, None, workspace)
    assert kept.worlds[0].scale == "arbitrary" and "too close together for their errors" in kept.worlds[0].note
    np.testing.assert_array_equal(kept.reconstructions[0].positions, off.reconstructions[0].positions)
    required = SfmConfig(gps=GpsConfig("required"))
    with pytest.raises(ConfigError, match="do not determine the world frame: the positions are too close"):
        reconstruct(vague, required, workspace)
    with pytest.raises(ConfigError, match="images without positions, which are required"):
        reconstruct(images, required, workspace)


def control_points(scene: "SyntheticScene", chosen: list[int], sigma_m: float) -> ControlPoints:
    """Return points of a scene with their exact pixels in all images, and their positions in east, north, up."""
    rows = [
        (g, i, scene.camera.project((scene.points[[p]] - T[:3, 3]) @ T[:3, :3])[0])
        for g, p in enumerate(chosen)
        for i, T in enumerate(scene.Ts_world_cam)
    ]
    inside = [row for row in rows if np.all((row[2] > 0.0) & (row[2] < [scene.camera.width, scene.camera.height]))]
    return ControlPoints(
        names=tuple(f"G{g}" for g in range(len(chosen))),
        geodetic=ORIGIN.from_enu(SCALE * scene.points[chosen] @ R_ENU_SCENE.T),
        sigmas_m=np.full(len(chosen), sigma_m),
        point=np.array([row[0] for row in inside], np.int64),
        image=np.array([row[1] for row in inside], np.int64),
        pixels=np.array([row[2] for row in inside]),
    )


def test_control_points_alone_give_the_frame(
    wide_scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(wide_scene, tmp_path)
    points = control_points(wide_scene, [3, 50, 120, 200, 301], 0.02)
    result = reconstruct(replace(images, control_points=points), None, workspace)
    [found], [world] = result.reconstructions, result.worlds
    assert world.scale == "control points" and world.geo is not None and world.origin is not None
    assert world.geo.point_names == points.names and world.geo.point_errors_px.max() < 1.0
    placed = ORIGIN.to_enu(world.origin.from_enu(found.positions))
    assert np.linalg.norm(placed - true_positions_m(wide_scene), axis=1).max() < 0.3  # 20 m × 20 from the points
    # They add no points to the reconstruction
    without = reconstruct(images, None, workspace).reconstructions[0]
    assert len(found.points) == len(without.points) and len(found.observation_px) == len(without.observation_px)


def test_control_points_correct_the_offset_of_gps(
    wide_scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(wide_scene, tmp_path)
    tagged = with_positions(images, wide_scene, 2.0)
    assert tagged.geotags is not None
    shifted = ORIGIN.from_enu(ORIGIN.to_enu(tagged.geotags.geodetic) + [3.0, -2.0, 5.0])
    tagged = replace(tagged, geotags=replace(tagged.geotags, geodetic=shifted))
    points = control_points(wide_scene, [3, 50, 120, 200, 301], 0.02)
    result = reconstruct(replace(tagged, control_points=points), None, workspace)
    [found], [world] = result.reconstructions, result.worlds
    assert world.scale == "gps and control points" and world.origin is not None
    placed = ORIGIN.to_enu(world.origin.from_enu(found.positions))
    assert np.linalg.norm(placed - true_positions_m(wide_scene), axis=1).max() < 0.5


def test_a_rig_keeps_its_scale(make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path") -> None:
    scene = make_scene(images=10, baseline_m=0.4)
    images, workspace = make_images(scene, tmp_path, 0.4)
    # Positions that are spread by 2 % too much, in the frame of the scene, whose unit is the metre
    exact = scene.Ts_world_cam[:, :3, 3] @ R_ENU_SCENE.T
    geodetic = ORIGIN.from_enu(exact.mean(axis=0) + 1.02 * (exact - exact.mean(axis=0)))
    tags = GeoTags(geodetic, np.full((10, 3), 0.02), np.full((10, 3, 3), np.nan), "ellipsoid")
    result = reconstruct(replace(images, geotags=tags), None, workspace)
    [found], [world] = result.reconstructions, result.worlds
    assert world.scale == "rig" and world.is_vertical and world.geo is not None and world.geo.scale_sigma == 0.0
    assert world.origin is not None
    baselines = np.linalg.norm(found.positions[1::2] - found.positions[::2], axis=1)
    np.testing.assert_allclose(baselines, 0.4, atol=1e-3)
    errors = ORIGIN.to_enu(world.origin.from_enu(found.positions)) - exact
    assert np.linalg.norm(errors, axis=1).max() < 0.06
