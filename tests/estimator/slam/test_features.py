"""Corners for the recognition of places: spread, the same twice, and described independently of the camera's roll."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.slam.map.keyframe import KeyframeFeatures
from dronevio.estimator.slam.places.features import (
    PlaceFeatureConfig,
    PlaceFeatureExtractor,
    detect_spread_corners,
    gravity_angles,
)
from dronevio.estimator.types import NO_FEATURES, Observations
from dronevio.models.camera import CameraModel
from dronevio.models.rig import EUROC_CAM0, Rig, RigCamera
from dronevio.models.state import NO_IMAGE

Array = npt.NDArray[Any]

NO_POINTS = np.zeros((0, 2))
CAMERA = CameraModel(width=401, height=401, fx=300.0, fy=300.0, cx=200.0, cy=200.0)
RIG = Rig(cameras=(RigCamera(CAMERA, np.eye(4)),))
R_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Orientation of a level camera that looks along the world's x axis; it is that of the IMU, too."""


def texture(shape: tuple[int, int], seed: int = 0) -> Array:
    """Return a smooth random image with many corners."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255), np.uint8)


def roll(angle_rad: float) -> Array:
    """Return the rotation (3, 3) of a camera about its optical axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def tracked_at(pixels: Array) -> Observations:
    """Return tracked features at given pixels."""
    n = len(pixels)
    return Observations(10 + np.arange(n), pixels, CAMERA.normalize(pixels), np.ones(n, np.int64))


def distances(first: KeyframeFeatures, second: KeyframeFeatures) -> Array:
    """Return the Hamming distances of the descriptors of the same landmarks."""
    _, i, j = np.intersect1d(first.landmark, second.landmark, return_indices=True)
    return np.asarray(np.bitwise_count(first.descriptors[i] ^ second.descriptors[j]).sum(axis=1))


@pytest.mark.parametrize("degrees", [90.0, 180.0, 30.0, -55.0])
def test_descriptors_do_not_depend_on_the_roll(degrees: float) -> None:
    image = texture((401, 401))
    pixels = detect_spread_corners(image, NO_POINTS, PlaceFeatureConfig(corners=300))
    pixels = pixels[np.linalg.norm(pixels - 200.0, axis=1) < 160.0]
    # A camera that is rolled by an angle sees the scene rotated by the opposite angle.
    M = roll(-np.radians(degrees))[:2, :2]
    warp = np.column_stack([M, [200.0, 200.0] - M @ [200.0, 200.0]])
    rolled_image = np.asarray(cv2.warpAffine(image, warp, (401, 401), flags=cv2.INTER_LINEAR), np.uint8)
    rolled_pixels = (pixels - 200.0) @ M.T + 200.0
    extractor, only_tracked = PlaceFeatureExtractor(PlaceFeatureConfig(corners=0)), tracked_at
    level = extractor.extract([image], RIG, R_FORWARD, only_tracked(pixels))
    R_rolled = R_FORWARD @ roll(np.radians(degrees))
    rolled = extractor.extract([rolled_image], RIG, R_rolled, only_tracked(rolled_pixels))
    assert len(level) > 100
    same = distances(level, rolled)
    assert np.median(same) < 25
    assert np.mean(same < 64) > 0.98
    # Without the roll in the direction of gravity, the descriptors are unrelated.
    unaware = extractor.extract([rolled_image], RIG, R_FORWARD, only_tracked(rolled_pixels))
    assert np.median(distances(level, unaware)) > 70


def test_gravity_points_down_in_a_level_image() -> None:
    camera = CameraModel(width=401, height=401, fx=300.0, fy=300.0, cx=200.0, cy=200.0)
    xy = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [-0.4, -0.3]])
    angles, is_defined = gravity_angles(camera, xy, np.array([0.0, 1.0, 0.0]), 0.1)
    assert is_defined.all()
    assert np.allclose(angles, np.pi / 2)  # vertical lines are vertical in the image of a level camera
    # A camera that looks down sees gravity point to the nadir, at the centre of the image, where it is not defined.
    angles, is_defined = gravity_angles(camera, xy, np.array([0.0, 0.0, 1.0]), 0.1)
    assert is_defined.tolist() == [False, True, True, True]
    assert np.allclose(angles[1:], [np.pi, -np.pi / 2, np.arctan2(0.3, 0.4)])


def test_a_lens_distorts_the_direction_of_gravity() -> None:
    xy = np.array([[0.6, 0.35]])
    down = np.array([0.1, 0.97, 0.2])
    down /= np.linalg.norm(down)
    angle, _ = gravity_angles(EUROC_CAM0, xy, down, 0.1)
    # The image of a vertical line through the corner.
    ray = np.append(xy[0], 1.0)
    ahead, behind = (EUROC_CAM0.project(ray + step * down) for step in (1e-4, -1e-4))
    assert angle[0] == pytest.approx(np.arctan2(*(ahead - behind)[::-1]), abs=1e-3)
    pinhole, _ = gravity_angles(CAMERA, xy, down, 0.1)
    assert abs(angle[0] - pinhole[0]) > 0.05


def test_corners_are_spread_and_keep_their_distance() -> None:
    image = texture((480, 752))
    image[:, :376] //= 8  # one half has hardly any contrast
    config = PlaceFeatureConfig(corners=300, min_score=0.0)
    occupied = np.array([[100.0, 100.0], [600.0, 300.0]])
    corners = detect_spread_corners(image, occupied, config)
    assert len(corners) == 300
    assert 0.4 < np.mean(corners[:, 0] < 376) < 0.6
    apart = np.abs(corners[:, None] - corners[None]).max(axis=2)
    assert np.min(apart[~np.eye(300, dtype=bool)]) >= config.spacing_px - 2  # positions are refined by up to a pixel
    assert np.abs(corners[:, None] - occupied[None]).max(axis=2).min() >= config.spacing_px - 2


def test_a_corner_is_found_where_it_is() -> None:
    image = np.full((200, 200), 40, np.uint8)
    squares = [(60, 50), (120, 90), (70, 130)]
    for x, y in squares:
        image[y : y + 24, x : x + 24] = 220
    image = np.asarray(cv2.GaussianBlur(image, (3, 3), 0.8), np.uint8)
    corners = detect_spread_corners(image, NO_POINTS, PlaceFeatureConfig(min_score=1e-3))
    true = np.array([(x + dx - 0.5, y + dy - 0.5) for x, y in squares for dx in (0, 24) for dy in (0, 24)])
    distance = np.linalg.norm(corners[:, None] - true[None], axis=2)
    assert np.all(distance.min(axis=0) < 2.0)


def test_the_features_have_the_same_bytes_twice() -> None:
    image = texture((401, 401), 3)
    tracked = tracked_at(detect_spread_corners(image, NO_POINTS, PlaceFeatureConfig(corners=30)))
    first, second = (PlaceFeatureExtractor().extract([image], RIG, R_FORWARD, tracked) for _ in range(2))
    for name in ("pixels", "xy", "camera", "descriptors", "landmark"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert len(first) > 200
    assert np.isin(first.landmark[first.landmark >= 0], tracked.ids).all()
    is_tracked = first.landmark >= 0
    rows = np.searchsorted(tracked.ids, first.landmark[is_tracked])
    assert np.array_equal(first.pixels[is_tracked], tracked.pixels[rows])
    assert np.allclose(first.xy, CAMERA.normalize(first.pixels))


def test_missing_and_blank_images_have_no_corners() -> None:
    extractor, blank = PlaceFeatureExtractor(), np.full((401, 401), 90, np.uint8)
    pixels = np.array([[200.0, 210.0]])
    assert len(extractor.extract([NO_IMAGE], RIG, R_FORWARD, tracked_at(pixels))) == 0
    assert len(extractor.extract([blank], RIG, R_FORWARD, NO_FEATURES)) == 0
    assert len(extractor.extract([blank], RIG, R_FORWARD, NO_FEATURES, cameras=[0])) == 0
    assert extractor.extract([blank], RIG, R_FORWARD, tracked_at(pixels)).landmark.tolist() == [10]
    near_border = tracked_at(np.array([[5.0, 200.0], [200.0, 396.0]]))
    assert len(extractor.extract([blank], RIG, R_FORWARD, near_border)) == 0
