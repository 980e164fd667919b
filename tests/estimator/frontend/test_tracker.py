"""The tracker, on pictures of a wall for which every pixel's motion is known."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.types import Observations
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import CameraFrame

CAMERA = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
CONFIG = TrackerConfig()
FRAME_NS = 50_000_000
WALL_M = 3.0  # ahead of the first camera


class Wall:
    """Sees the wall from a moving camera, and knows where each of its points went."""

    def __init__(self, see: Callable[..., np.ndarray]) -> None:
        self._see = see
        self.k = -1

    def frame(self, R_world_cam: np.ndarray, p_m: np.ndarray | None = None) -> CameraFrame:
        self.k += 1
        T = pose_matrix(R_world_cam, np.zeros(3) if p_m is None else p_m)
        return CameraFrame(10**18 + self.k * FRAME_NS, (self._see(CAMERA, T),))


@pytest.fixture
def wall(see_wall: Callable[..., np.ndarray]) -> Wall:
    return Wall(see_wall)


def moved(pixels: np.ndarray, R_world_cam: np.ndarray, p_m: np.ndarray | None = None) -> np.ndarray:
    """Return where pixels (N, 2) of the camera at the origin are seen from another pose."""
    rays = CAMERA.unproject(pixels)
    points = rays * (WALL_M / rays[:, 2:])
    return CAMERA.project((points - (0.0 if p_m is None else p_m)) @ R_world_cam)


def follow(
    wall: Wall,
    R: np.ndarray,
    p_m: np.ndarray | None = None,
    R_told: np.ndarray | None = None,
    config: TrackerConfig = CONFIG,
) -> tuple[Observations, Observations, np.ndarray]:
    """Return features before and after one motion, and how far the latter are from where they should be [px]."""
    tracker = FeatureTracker(CAMERA, config)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    after = tracker.track(wall.frame(R, p_m), R.T if R_told is None else R_told)
    rows = np.searchsorted(before.ids, after.ids)
    return before, after, np.linalg.norm(after.pixels - moved(before.pixels[rows], R, p_m), axis=1)


@pytest.mark.parametrize(
    ("turn_deg", "step_m"),
    [
        ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, -3.0, 0.0], [0.0, 0.0, 0.0]),
        ([1.0, 2.0, -4.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.08, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.02, -0.05, 0.1]),
        ([1.0, -2.0, 2.0], [0.05, 0.05, -0.06]),
    ],
)
def test_features_are_followed_to_where_they_went(wall: Wall, turn_deg: list[float], step_m: list[float]) -> None:
    before, after, error_px = follow(wall, exp_so3(np.radians(turn_deg)), np.array(step_m))
    assert len(after) > 0.7 * len(before) > 15
    assert np.median(error_px) < 0.15
    assert np.mean(error_px < 0.5) > 0.9


def test_coordinates_are_the_undistorted_ones_of_the_pixels(wall: Wall) -> None:
    _, after, _ = follow(wall, exp_so3(np.radians([1.0, 2.0, -2.0])), np.array([0.05, 0.0, 0.02]))
    back = CAMERA.project(np.column_stack([after.xy, np.ones(len(after))]))
    np.testing.assert_allclose(back, after.pixels, atol=1e-9)


def test_prediction_bears_fast_turns(wall: Wall) -> None:
    """13° between frames are 260 °/s: 53 pixels of this little camera, beyond what the pyramid reaches by itself."""
    R = exp_so3(np.radians([0.0, 13.0, 0.0]))
    before, after, error_px = follow(wall, R)
    still_seen = np.all((moved(before.pixels, R) > 14.0) & (moved(before.pixels, R) < [361.0, 225.0]), axis=1).sum()
    assert len(after) > 0.9 * still_seen > 15
    assert np.median(error_px) < 0.15
    trusting = replace(CONFIG, min_found=0.0, min_agreeing=0.0)
    _, _, blind_error_px = follow(wall, R, R_told=np.eye(3), config=trusting)
    assert np.sum(blind_error_px < 1.0) < 0.3 * len(after)


@pytest.mark.parametrize("told_deg", [[0.0, 0.0, 0.0], [0.0, -8.0, 0.0], [6.0, 0.0, 8.0]])
def test_wrong_prediction_is_survived(wall: Wall, told_deg: list[float]) -> None:
    """A gyroscope at its limit tells too little of a fast turn; one that is broken tells of another."""
    R, step_m = exp_so3(np.radians([0.0, 11.0, 2.0])), np.array([0.05, 0.02, 0.1])
    _, right, _ = follow(wall, R, step_m)
    _, after, error_px = follow(wall, R, step_m, R_told=exp_so3(np.radians(told_deg)).T)
    assert len(after) > 0.6 * len(right) > 12
    assert np.median(error_px) < 0.15 and np.mean(error_px < 0.5) > 0.9


def run_along(wall: Wall, frames: int = 14) -> list[tuple[Observations, Observations]]:
    """Fly sideways and turn; return what was tracked and what was seen after new ones were taken, frame by frame."""
    tracker = FeatureTracker(CAMERA, CONFIG)
    seen, R_before = [], np.eye(3)
    for k in range(frames):
        R = exp_so3(np.radians([0.5 * k, -1.2 * k, 0.4 * k]))
        tracked = tracker.track(wall.frame(R, np.array([0.03, 0.01, 0.02]) * k), R.T @ R_before)
        seen.append((tracked, tracker.replenish()))
        R_before = R
    return seen


def test_identities_increase_and_are_never_used_again(wall: Wall) -> None:
    seen = run_along(wall)
    newest, gone, alive = -1, set(), set()
    for tracked, after in seen:
        assert np.all(np.diff(after.ids) > 0)
        new = after.ids[~np.isin(after.ids, tracked.ids)]
        assert np.all(new > newest)
        newest = max([newest, *new.tolist()])
        gone |= alive - set(tracked.ids.tolist())
        alive = set(after.ids.tolist())
        assert not gone & alive
    assert gone and newest > len(seen[0][1])


def test_ages_count_the_frames(wall: Wall) -> None:
    born: dict[int, int] = {}
    for k, (_, after) in enumerate(run_along(wall)):
        for i, age in zip(after.ids.tolist(), after.ages.tolist(), strict=True):
            assert age == k - born.setdefault(i, k) + 1


def cells_of(pixels: np.ndarray) -> list[tuple[int, int]]:
    side = CONFIG.corners.cell_px
    rows, columns = CAMERA.height // side, CAMERA.width // side
    corner = (np.array([CAMERA.width, CAMERA.height]) - np.array([columns, rows]) * side) // 2
    cells = np.clip((pixels - corner) // side, 0, [columns - 1, rows - 1]).astype(int)
    return [tuple(cell) for cell in cells.tolist()]


def test_each_empty_cell_gets_one_corner_at_most(wall: Wall) -> None:
    for tracked, after in run_along(wall):
        new = ~np.isin(after.ids, tracked.ids)
        new_cells, old_cells = cells_of(after.pixels[new]), set(cells_of(tracked.pixels))
        assert len(set(new_cells)) == len(new_cells)
        assert not set(new_cells) & old_cells
        np.testing.assert_array_equal(after.ages[new], 1)


def test_replenishing_twice_adds_nothing(wall: Wall) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    first = tracker.replenish()
    again = tracker.replenish()
    assert len(first) > 25  # of 40 cells
    np.testing.assert_array_equal(first.ids, again.ids)


def test_border_is_kept_free(wall: Wall) -> None:
    low, high = CONFIG.border_px, np.array([CAMERA.width, CAMERA.height]) - 1 - CONFIG.border_px
    pixels = np.concatenate([p.pixels for pair in run_along(wall) for p in pair])
    assert np.all((pixels >= low) & (pixels <= high))


def test_discarded_features_are_not_seen_again(wall: Wall) -> None:
    tracker: FrontEnd = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    dropped = before.ids[::3]
    tracker.discard(np.append(dropped, 10_000))  # one that never was does no harm
    after = tracker.track(wall.frame(np.eye(3)), np.eye(3))
    assert not set(after.ids.tolist()) & set(dropped.tolist())
    assert len(after) > 0.9 * (len(before) - len(dropped))
    assert not set(tracker.replenish().ids.tolist()) & set(dropped.tolist())


def test_what_moves_by_itself_is_dropped(wall: Wall) -> None:
    """A patch of the picture that moves its own way, while the camera flies sideways."""
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    (image,) = (frame := wall.frame(np.eye(3), np.array([0.1, 0.0, 0.0]))).images
    box = (slice(70, 190), slice(100, 220))
    image = image.copy()
    image[box] = np.roll(image, (9, 3), axis=(0, 1))[box]
    after = tracker.track(replace(frame, images=(image,)), np.eye(3))

    def inside(pixels: np.ndarray) -> np.ndarray:
        return np.all((pixels > [125, 90]) & (pixels < [195, 170]), axis=1)  # well inside

    assert inside(before.pixels).sum() >= 2
    assert inside(after.pixels).sum() <= 0.34 * inside(before.pixels).sum()
    assert len(after) > 0.5 * len(before)


def test_nothing_to_see_is_no_reason_to_fail() -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    assert len(tracker.replenish()) == 0  # before any frame
    for k, level in enumerate((0, 255, 90)):
        blank = np.full((CAMERA.height, CAMERA.width), level, np.uint8)
        assert len(tracker.track(CameraFrame(k, (blank,)), np.eye(3))) == 0
        assert len(tracker.replenish()) == 0


def test_lights_out_and_on_again(wall: Wall) -> None:
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


def noise(seed: int, level: float = 6.0, sigma: float = 1.6) -> np.ndarray:
    """What a camera sees in the dark."""
    grey = np.random.default_rng(seed).normal(level, sigma, (CAMERA.height, CAMERA.width))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("level", [0.0, 6.0])
def test_noise_in_the_dark_is_no_feature(wall: Wall, level: float) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    assert len(tracker.replenish()) > 20
    for k in range(5):
        assert len(tracker.track(CameraFrame(10**18 + 60 + k, (noise(k, level),)), np.eye(3))) == 0
        assert len(tracker.replenish()) == 0


@pytest.mark.parametrize(("gain", "offset"), [(0.4, 0.0), (0.55, 30.0), (1.5, -30.0), (1.3, 20.0)])
def test_jumping_exposure_does_not_matter(wall: Wall, gain: float, offset: float) -> None:
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    before = tracker.replenish()
    R, p_m = exp_so3(np.radians([0.5, 1.0, -1.0])), np.array([0.05, 0.0, 0.05])
    (image,) = (frame := wall.frame(R, p_m)).images
    jumped = np.clip(np.rint(gain * image.astype(float) + offset), 0, 255).astype(np.uint8)
    after = tracker.track(replace(frame, images=(jumped,)), R.T)
    error_px = np.linalg.norm(
        after.pixels - moved(before.pixels[np.searchsorted(before.ids, after.ids)], R, p_m), axis=1
    )
    assert len(after) > 0.7 * len(before)
    assert np.median(error_px) < 0.15


def test_errors_do_not_add_up(wall: Wall) -> None:
    """After 20 frames of a flight that turns and comes nearer, tracks are where the landmarks are."""
    tracker, R_before, seen = FeatureTracker(CAMERA, CONFIG), np.eye(3), []
    for k in range(21):
        R = exp_so3(np.radians([0.3 * k, -0.5 * k, 0.6 * k]))
        p_m = np.array([0.03, 0.01, 0.04]) * k
        seen.append(tracker.track(wall.frame(R, p_m), R.T @ R_before))
        R_before = R
        if k == 0:
            before = tracker.replenish()
    last = seen[-1]
    error_px = np.linalg.norm(last.pixels - moved(before.pixels[np.searchsorted(before.ids, last.ids)], R, p_m), axis=1)
    assert len(last) > 15 and np.all(last.ages == 21)
    assert np.median(error_px) < 0.05 and np.mean(error_px < 0.3) > 0.95
    assert np.all(last.zncc > 0.75) and np.all(last.zncc <= 1.0 + 1e-6)
    assert np.all(before.scale == 1.0)
    at = before.pixels[np.searchsorted(before.ids, last.ids)]
    right, down = (0.5 * (moved(at + d, R, p_m) - moved(at - d, R, p_m)) for d in np.eye(2))
    np.testing.assert_allclose(last.scale, np.sqrt(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]), rtol=0.05)


def test_picture_smaller_than_a_cell_has_no_features() -> None:
    tiny = CameraModel(30, 20, 20.0, 20.0, 14.5, 9.5)
    noise = np.random.default_rng(0).integers(0, 255, (20, 30), dtype=np.uint8)
    tracker = FeatureTracker(tiny, CONFIG)
    tracker.track(CameraFrame(0, (noise,)), np.eye(3))
    assert len(tracker.replenish()) == 0


def test_same_pictures_same_features(wall: Wall, see_wall: Callable[..., np.ndarray]) -> None:
    cv2.setNumThreads(1)
    one, other = run_along(wall, 6), run_along(Wall(see_wall), 6)
    for pair, again in zip(one, other, strict=True):
        for seen, seen_again in zip(pair, again, strict=True):
            for name in ("ids", "pixels", "xy", "ages"):
                np.testing.assert_array_equal(getattr(seen, name), getattr(seen_again, name))


def test_observations_are_not_changed_afterwards(wall: Wall) -> None:
    """What was handed out stays as it was, though the tracker goes on."""
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
    ids=["no image", "None", "turned", "floats"],
)
def test_refuses_what_is_no_image_of_the_camera(wall: Wall, images: tuple[object, ...]) -> None:
    """OpenCV looks for ever for features in an image that is None."""
    tracker = FeatureTracker(CAMERA, CONFIG)
    tracker.track(wall.frame(np.eye(3)), np.eye(3))
    tracker.replenish()
    with pytest.raises(ConfigError, match="expected uint8 of shape"):
        tracker.track(CameraFrame(2 * 10**18, images), np.eye(3))  # type: ignore[arg-type]
