"""Feature tracker on images of a textured wall, for which the motion of every pixel is known."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NO_IMAGE, CameraFrame

RenderWall = Callable[[CameraModel, Array], Image]

CAMERA = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
CONFIG = TrackerConfig()
FRAME_NS = 50_000_000
WALL_M = 3.0  # depth of the wall in the first camera frame


class WallSequence:
    """Renders consecutive frames of the wall from given poses."""

    def __init__(self, render: RenderWall) -> None:
        self._render = render
        self.k = -1

    def frame(self, R_world_cam: Array, p_m: Array | None = None) -> CameraFrame:
        self.k += 1
        T = pose_matrix(R_world_cam, np.zeros(3) if p_m is None else p_m)
        return CameraFrame(10**18 + self.k * FRAME_NS, (self._render(CAMERA, T),))


@pytest.fixture
def wall(render_wall: RenderWall) -> WallSequence:
    return WallSequence(render_wall)


def true_pixels(pixels: Array, R_world_cam: Array, p_m: Array | None = None) -> Array:
    """Return the projections (N, 2) into another pose of the points seen at pixels (N, 2) from the origin."""
    rays = CAMERA.unproject(pixels)
    points = rays * (WALL_M / rays[:, 2:])
    return CAMERA.project((points - (0.0 if p_m is None else p_m)) @ R_world_cam)


def with_iterations(tracking_iterations: int) -> TrackerConfig:
    """Return the settings with a number of iterations of the alignment between keyframes."""
    return replace(CONFIG, patches=replace(CONFIG.patches, tracking_iterations=tracking_iterations))


def track_once(
    wall: WallSequence,
    R: Array,
    p_m: Array | None = None,
    R_predicted: Array | None = None,
    config: TrackerConfig = CONFIG,
) -> tuple[Observations, Observations, Array]:
    """Return the features before and after one motion, and the errors (N,) of the latter [px]."""
    tracker = FeatureTracker(CAMERA, config)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    after = tracker.track(wall.frame(R, p_m), R.T if R_predicted is None else R_predicted)
    rows = np.searchsorted(before.ids, after.ids)
    return before, after, np.linalg.norm(after.pixels - true_pixels(before.pixels[rows], R, p_m), axis=1)


@pytest.mark.parametrize(
    ("rotation_deg", "translation_m"),
    [
        ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, -3.0, 0.0], [0.0, 0.0, 0.0]),
        ([1.0, 2.0, -4.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.08, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.02, -0.05, 0.1]),
        ([1.0, -2.0, 2.0], [0.05, 0.05, -0.06]),
    ],
)
def test_features_are_tracked_to_their_true_pixels(
    wall: WallSequence, rotation_deg: list[float], translation_m: list[float]
) -> None:
    before, after, error_px = track_once(wall, exp_so3(np.radians(rotation_deg)), np.array(translation_m))
    assert len(after) > 0.7 * len(before) > 15
    assert np.median(error_px) < 0.15
    assert np.mean(error_px < 0.5) > 0.9


def test_coordinates_are_the_normalized_pixels(wall: WallSequence) -> None:
    _, after, _ = track_once(wall, exp_so3(np.radians([1.0, 2.0, -2.0])), np.array([0.05, 0.0, 0.02]))
    back = CAMERA.project(np.column_stack([after.xy, np.ones(len(after))]))
    np.testing.assert_allclose(back, after.pixels, atol=1e-9)


def test_prediction_enables_fast_rotations(wall: WallSequence) -> None:
    """13° between frames are 260 °/s and 53 pixels of this camera, beyond the reach of the pyramid alone."""
    R = exp_so3(np.radians([0.0, 13.0, 0.0]))
    before, after, error_px = track_once(wall, R)
    expected = true_pixels(before.pixels, R)
    visible = np.all((expected > 14.0) & (expected < [361.0, 225.0]), axis=1).sum()
    assert len(after) > 0.9 * visible > 15
    assert np.median(error_px) < 0.15
    without_retry = replace(CONFIG, min_tracked_ratio=0.0, min_inlier_ratio=0.0)
    _, _, unpredicted_error_px = track_once(wall, R, R_predicted=np.eye(3), config=without_retry)
    assert np.sum(unpredicted_error_px < 1.0) < 0.3 * len(after)


@pytest.mark.parametrize("predicted_deg", [[0.0, 0.0, 0.0], [0.0, -8.0, 0.0], [6.0, 0.0, 8.0]])
def test_tracking_recovers_from_a_wrong_prediction(wall: WallSequence, predicted_deg: list[float]) -> None:
    """A saturated gyroscope underestimates a fast rotation; a faulty one measures another rotation."""
    R, p_m = exp_so3(np.radians([0.0, 11.0, 2.0])), np.array([0.05, 0.02, 0.1])
    _, reference, _ = track_once(wall, R, p_m)
    _, after, error_px = track_once(wall, R, p_m, R_predicted=exp_so3(np.radians(predicted_deg)).T)
    assert len(after) > 0.6 * len(reference) > 12
    assert np.median(error_px) < 0.15 and np.mean(error_px < 0.5) > 0.9


@pytest.mark.parametrize(
    ("rotation_deg", "approach_m", "median_px"), [([0.0, 0.0, 2.0], 0.05, 0.15), ([0.0, 0.0, 20.0], 0.3, 0.1)]
)
def test_patches_are_aligned_between_keyframes_where_lucas_kanade_errs(
    wall: WallSequence, rotation_deg: list[float], approach_m: float, median_px: float
) -> None:
    """Within one frame: a slow motion, and a fast one, after which a quarter of the tracks would disagree."""
    R, p_m = exp_so3(np.radians(rotation_deg)), np.array([0.0, 0.0, approach_m])
    _, aligned, _ = track_once(wall, R, p_m, config=with_iterations(1))
    _, after, error_px = track_once(wall, R, p_m)
    assert np.median(error_px) < median_px and len(after) > 0.95 * len(aligned) > 20


@pytest.mark.parametrize("seed", range(6))
def test_images_of_another_place_share_no_features(wall: WallSequence, seed: int) -> None:
    """As after a gap: some patches are similar by chance, and any two of them agree with some translation."""
    elsewhere = np.append(np.random.default_rng(seed).uniform(3.0, 6.0, 2), 0.0)
    before, after, _ = track_once(wall, np.eye(3), elsewhere)
    assert len(before) > 15 and len(after) == 0


def test_warps_follow_time_and_not_frames(wall: WallSequence) -> None:
    """The same two images, a millisecond or a second apart, admit smaller and larger changes of scale."""
    first, second = wall.frame(np.eye(3)), wall.frame(np.eye(3), np.array([0.0, 0.0, 0.25]))
    scales = []
    for elapsed_ns in (1_000_000, 1_000_000_000):
        tracker = FeatureTracker(CAMERA, CONFIG)
        tracker.track(first, np.eye(3))
        tracker.replenish()
        later = replace(second, t_ns=first.t_ns + elapsed_ns)
        ids = tracker.track(later, np.eye(3)).ids
        aligned = tracker.replenish()
        scales.append(float(np.median(aligned.scale[np.isin(aligned.ids, ids)])))
    assert scales[0] < scales[1] - 0.01 < WALL_M / (WALL_M - 0.25)


def track_sequence(wall: WallSequence, frames: int = 14) -> list[tuple[Observations, Observations]]:
    """Move sideways with a rotation, and return for each frame the features before and after replenishment."""
    tracker = FeatureTracker(CAMERA, CONFIG)
    observations, R_previous = [], np.eye(3)
    for k in range(frames):
        R = exp_so3(np.radians([0.5 * k, -1.2 * k, 0.4 * k]))
        tracked = tracker.track(wall.frame(R, np.array([0.03, 0.01, 0.02]) * k), R.T @ R_previous)
        observations.append((tracked, tracker.replenish()))
        R_previous = R
    return observations


def test_identities_increase_and_are_not_reused(wall: WallSequence) -> None:
    observations = track_sequence(wall)
    newest = -1
    lost: set[int] = set()
    tracked_ids: set[int] = set()
    for tracked, after in observations:
        assert np.all(np.diff(after.ids) > 0)
        new = after.ids[~np.isin(after.ids, tracked.ids)]
        assert np.all(new > newest)
        newest = max([newest, *new.tolist()])
        lost |= tracked_ids - set(tracked.ids.tolist())
        tracked_ids = set(after.ids.tolist())
        assert not lost & tracked_ids
    assert lost and newest > len(observations[0][1])


def test_age_is_the_number_of_observations(wall: WallSequence) -> None:
    first_frame: dict[int, int] = {}
    for k, (_, after) in enumerate(track_sequence(wall)):
        for i, age in zip(after.ids.tolist(), after.ages.tolist(), strict=True):
            assert age == k - first_frame.setdefault(i, k) + 1


def cells_of(pixels: Array) -> list[tuple[int, ...]]:
    """Return the grid cells of pixels (N, 2)."""
    side = CONFIG.corners.cell_px
    rows, columns = CAMERA.height // side, CAMERA.width // side
    corner = (np.array([CAMERA.width, CAMERA.height]) - np.array([columns, rows]) * side) // 2
    cells = np.clip((pixels - corner) // side, 0, [columns - 1, rows - 1]).astype(int)
    return [tuple(cell) for cell in cells.tolist()]


def test_an_empty_cell_gets_at_most_one_corner(wall: WallSequence) -> None:
    for tracked, after in track_sequence(wall):
        new = ~np.isin(after.ids, tracked.ids)
        new_cells, old_cells = cells_of(after.pixels[new]), set(cells_of(tracked.pixels))
        assert len(set(new_cells)) == len(new_cells)
        assert not set(new_cells) & old_cells
        np.testing.assert_array_equal(after.ages[new], 1)


def test_replenishing_twice_adds_nothing(wall: WallSequence) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    first = tracker.replenish()
    again = tracker.replenish()
    assert len(first) > 25  # of 40 cells
    np.testing.assert_array_equal(first.ids, again.ids)


def test_no_feature_is_near_the_border(wall: WallSequence) -> None:
    low, high = CONFIG.border_px, np.array([CAMERA.width, CAMERA.height]) - 1 - CONFIG.border_px
    pixels = np.concatenate([each.pixels for pair in track_sequence(wall) for each in pair])
    assert np.all((pixels >= low) & (pixels <= high))


def test_discarded_features_do_not_return(wall: WallSequence) -> None:
    tracker: FrontEnd = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    dropped = before.ids[::3]
    tracker.discard(np.append(dropped, 10_000))  # an unknown identity is ignored
    after = tracker.track(wall.frame(np.eye(3)), np.eye(3))
    assert not set(after.ids.tolist()) & set(dropped.tolist())
    assert len(after) > 0.9 * (len(before) - len(dropped))
    assert not set(tracker.replenish().ids.tolist()) & set(dropped.tolist())


def test_independently_moving_features_are_rejected(wall: WallSequence) -> None:
    """A part of the image moves on its own while the camera moves sideways."""
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    (image,) = (frame := wall.frame(np.eye(3), np.array([0.1, 0.0, 0.0]))).images
    box = (slice(70, 190), slice(100, 220))
    image = image.copy()
    image[box] = np.roll(image, (9, 3), axis=(0, 1))[box]
    after = tracker.track(replace(frame, images=(image,)), np.eye(3))

    def inside(pixels: Array) -> npt.NDArray[np.bool_]:
        return np.asarray(np.all((pixels > [125, 90]) & (pixels < [195, 170]), axis=1))  # away from its edges

    assert inside(before.pixels).sum() >= 2
    assert inside(after.pixels).sum() <= 0.34 * inside(before.pixels).sum()
    assert len(after) > 0.5 * len(before)


def test_blank_images_have_no_features() -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    assert len(tracker.replenish()) == 0  # before any frame
    for k, level in enumerate((0, 255, 90)):
        blank = np.full((CAMERA.height, CAMERA.width), level, np.uint8)
        assert len(tracker.track(CameraFrame(k, (blank,)), np.eye(3))) == 0
        assert len(tracker.replenish()) == 0


def test_a_dark_frame_ends_all_tracks(wall: WallSequence) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    dark = CameraFrame(10**18 + 10, (np.zeros((CAMERA.height, CAMERA.width), np.uint8),))
    tracker.track(dark, np.eye(3))
    assert len(tracker.replenish()) < 0.2 * len(before)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    after = tracker.replenish()
    assert len(after) > 0.8 * len(before)
    assert set(after.ids[after.ages == 1].tolist()).isdisjoint(before.ids.tolist())


def test_features_are_kept_over_missing_images(wall: WallSequence) -> None:
    """The prediction accumulates the rotation over frames without an image, in which nothing is observed."""
    tracker = FeatureTracker(CAMERA, replace(CONFIG, min_tracked_ratio=0.0))  # no search without the prediction
    step = exp_so3(np.radians([0.0, 3.0, 2.0]))
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    for k in range(3):
        assert len(tracker.track(CameraFrame(10**18 + 1 + k, (NO_IMAGE,)), step.T)) == 0
        assert len(tracker.replenish()) == 0
    R = step @ step @ step @ step
    after = tracker.track(wall.frame(R), step.T)
    assert len(after) > 0.6 * len(before) and np.isin(after.ids, before.ids).all()
    expected = true_pixels(before.pixels[np.isin(before.ids, after.ids)], R)
    assert np.median(np.linalg.norm(after.pixels - expected, axis=1)) < 0.2


def dark_image(seed: int, level: float = 6.0, sigma: float = 1.6) -> Image:
    """Return the image of a dark scene: a grey level with noise."""
    grey = np.random.default_rng(seed).normal(level, sigma, (CAMERA.height, CAMERA.width))
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


@pytest.mark.parametrize("level", [0.0, 6.0])
def test_noise_of_dark_images_yields_no_features(wall: WallSequence, level: float) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    assert len(tracker.replenish()) > 20
    for k in range(5):
        assert len(tracker.track(CameraFrame(10**18 + 60 + k, (dark_image(k, level),)), np.eye(3))) == 0
        assert len(tracker.replenish()) == 0


@pytest.mark.parametrize(("gain", "offset"), [(0.4, 0.0), (0.55, 30.0), (1.5, -30.0), (1.3, 20.0)])
def test_exposure_changes_are_compensated(wall: WallSequence, gain: float, offset: float) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    R, p_m = exp_so3(np.radians([0.5, 1.0, -1.0])), np.array([0.05, 0.0, 0.05])
    (image,) = (frame := wall.frame(R, p_m)).images
    changed = np.clip(np.rint(gain * image.astype(float) + offset), 0, 255).astype(np.uint8)
    after = tracker.track(replace(frame, images=(changed,)), R.T)
    error_px = np.linalg.norm(
        after.pixels - true_pixels(before.pixels[np.searchsorted(before.ids, after.ids)], R, p_m), axis=1
    )
    assert len(after) > 0.7 * len(before)
    assert np.median(error_px) < 0.15


@pytest.mark.parametrize("tracking_iterations", [0, 1])
def test_replenishing_takes_the_remaining_iterations(wall: WallSequence, tracking_iterations: int) -> None:
    """Few iterations of the alignment keep a track; those that remain lead to the result of all iterations at once."""
    R, p_m = exp_so3(np.radians([1.0, -2.0, 8.0])), np.array([0.05, 0.05, 0.12])

    def tracked_and_replenished(config: TrackerConfig) -> tuple[Observations, Observations]:
        tracker = FeatureTracker(CAMERA, config)
        tracker.track(wall.frame(np.eye(3)), np.eye(3))
        tracker.replenish()
        return tracker.track(wall.frame(R, p_m), R.T), tracker.replenish()

    tracked, refined = tracked_and_replenished(with_iterations(tracking_iterations))
    at_once, _ = tracked_and_replenished(with_iterations(CONFIG.patches.iterations))
    ids = np.intersect1d(np.intersect1d(tracked.ids, refined.ids), at_once.ids)
    begin, end, expected = (found.pixels[np.isin(found.ids, ids)] for found in (tracked, refined, at_once))
    distance_px = [np.median(np.linalg.norm(pixels - expected, axis=1)) for pixels in (begin, end)]
    assert len(ids) > 15 and distance_px[1] < 0.3 * distance_px[0]
    np.testing.assert_allclose(refined.xy, CAMERA.normalize(refined.pixels), atol=1e-12)


def test_the_correlation_shows_that_patches_are_not_aligned(wall: WallSequence) -> None:
    """Health compares frames between keyframes with a prediction, and weights tracks by their correlation."""
    tracker, p_m = FeatureTracker(CAMERA, CONFIG), np.array([0.0, 0.0, 0.1])
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    tracker.replenish()
    between, aligned = tracker.track(wall.frame(np.eye(3), p_m), np.eye(3)), tracker.replenish()
    aligned = aligned.without(np.setdiff1d(aligned.ids, between.ids))
    assert len(aligned) > 15 and np.median(aligned.zncc) > np.median(between.zncc) > 0.85
    assert np.median(between.zncc) < 1.0 - 2.0 * (1.0 - np.median(aligned.zncc))


@pytest.mark.parametrize("tracking_iterations", [0, 1])
def test_errors_do_not_accumulate(wall: WallSequence, tracking_iterations: int) -> None:
    """After 20 frames with rotation and approach, the tracks are still at the projections of their landmarks.

    Where patches are not aligned between keyframes, they are at the next one.
    """
    tracker, R_previous = FeatureTracker(CAMERA, with_iterations(tracking_iterations)), np.eye(3)
    for k in range(21):
        R = exp_so3(np.radians([0.3 * k, -0.5 * k, 0.6 * k]))
        p_m = np.array([0.03, 0.01, 0.04]) * k
        last = tracker.track(wall.frame(R, p_m), R.T @ R_previous)
        R_previous = R
        if k == 0:
            before = tracker.replenish()
    if not tracking_iterations:
        last = tracker.replenish()
        last = last.without(last.ids[last.ages < 21])
    first_pixels = before.pixels[np.searchsorted(before.ids, last.ids)]
    error_px = np.linalg.norm(last.pixels - true_pixels(first_pixels, R, p_m), axis=1)
    assert len(last) > 15 and np.all(last.ages == 21)
    assert np.median(error_px) < 0.05 and np.mean(error_px < 0.3) > 0.95
    assert np.all(last.zncc > 0.75) and np.all(last.zncc <= 1.0 + 1e-6)
    assert np.all(before.scale == 1.0)
    right, down = (
        0.5 * (true_pixels(first_pixels + d, R, p_m) - true_pixels(first_pixels - d, R, p_m)) for d in np.eye(2)
    )
    np.testing.assert_allclose(last.scale, np.sqrt(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]), rtol=0.05)


def test_an_image_smaller_than_a_cell_has_no_features() -> None:
    tiny = CameraModel(30, 20, 20.0, 20.0, 14.5, 9.5)
    noise = np.random.default_rng(0).integers(0, 255, (20, 30), dtype=np.uint8)
    tracker = FeatureTracker(tiny, CONFIG)
    tracker.track(CameraFrame(0, (noise,)), np.eye(3))
    assert len(tracker.replenish()) == 0


def test_same_images_give_the_same_features(wall: WallSequence, render_wall: RenderWall) -> None:
    cv2.setNumThreads(1)
    one, other = track_sequence(wall, 6), track_sequence(WallSequence(render_wall), 6)
    for pair, other_pair in zip(one, other, strict=True):
        for observations, others in zip(pair, other_pair, strict=True):
            for name in ("ids", "pixels", "xy", "ages"):
                np.testing.assert_array_equal(getattr(observations, name), getattr(others, name))


def test_returned_observations_are_not_modified(wall: WallSequence) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    first = tracker.replenish()
    kept = [values.copy() for values in (first.ids, first.pixels, first.xy, first.ages)]
    R = exp_so3(np.radians([0.0, 2.0, 0.0]))
    tracker.track(wall.frame(R), R.T)
    tracker.replenish()
    tracker.discard(first.ids[:5])
    for values, copy in zip((first.ids, first.pixels, first.xy, first.ages), kept, strict=True):
        np.testing.assert_array_equal(values, copy)


@pytest.mark.parametrize(
    "images",
    [(), (None,), (np.zeros((CAMERA.width, CAMERA.height), np.uint8),), (np.zeros((CAMERA.height, CAMERA.width)),)],
    ids=["no image", "None", "transposed", "floats"],
)
def test_invalid_images_are_refused(wall: WallSequence, images: tuple[object, ...]) -> None:
    """OpenCV does not return if an image is None."""
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    tracker.replenish()
    with pytest.raises(ConfigError, match="expected uint8 of shape"):
        tracker.track(CameraFrame(2 * 10**18, images), np.eye(3))  # type: ignore[arg-type]
