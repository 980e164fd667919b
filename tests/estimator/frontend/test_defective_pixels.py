"""Defective pixels: found on images that move, left alone on images that do not, replaced by their neighbours."""

from collections.abc import Callable

import numpy as np

from dronevio.estimator.frontend.defective_pixels import MIN_FRAMES, MIN_IMAGES, DefectivePixels
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import CameraFrame

HEIGHT, WIDTH = 120, 160
STUCK = {(40, 50): 255, (41, 51): 255, (0, 0): 0, (90, 159): 255, (70, 20): 200}
"""Levels of the defective pixels by row and column: a pair of neighbours, a corner, an edge and a dim one."""
TURN = exp_so3(np.array([0.0, 0.003, 0.0]))
"""Rotation from frame to frame; that of ten frames suffices for an examination."""


def seen_at(offset: int, stuck: bool = True) -> Image:
    """Return the image of a speckled wall that has moved by some columns, with defective pixels."""
    speckles = np.random.default_rng(3).random((HEIGHT, 4 * WIDTH)) < 0.002
    image = np.where(speckles[:, offset : offset + WIDTH], 220, 100).astype(np.uint8)
    for (row, column), level in STUCK.items() if stuck else ():
        image[row, column] = level
    return image


def after(frames: int, moving: bool, R_cur_prev: Array = TURN) -> tuple[DefectivePixels, Image]:
    """Return the defects that are known after some frames, and the corrected last image."""
    defects, corrected = DefectivePixels(), seen_at(0)
    for k in range(frames):
        image = defects.corrected(seen_at(k if moving else 0), R_cur_prev)
        assert image is not None
        corrected = image
        defects.examine(corrected)
    return defects, corrected


def test_defective_pixels_are_found_and_replaced() -> None:
    """Four examinations, ten frames apart, find all of them; the wall's speckles, which move, are none."""
    needed = (MIN_IMAGES - 1) * MIN_FRAMES + 1
    assert after(needed - 1, moving=True)[0].count == 0
    defects, _ = after(needed, moving=True)
    assert defects.count == len(STUCK)
    _, corrected = after(needed + 1, moving=True)
    clean = seen_at(needed, stuck=False)
    for pixel in STUCK:
        assert corrected[pixel] == 100
    others = np.ones(clean.shape, np.bool_)
    others[tuple(np.array(list(STUCK)).T)] = False
    np.testing.assert_array_equal(corrected[others], clean[others])


def test_texture_of_a_camera_at_rest_is_kept() -> None:
    defects, corrected = after(20 * MIN_FRAMES, moving=False, R_cur_prev=np.eye(3))
    assert defects.count == 0
    np.testing.assert_array_equal(corrected, seen_at(0))


def test_images_of_noise_have_no_defects() -> None:
    """With so many pixels that differ, none is examined, even if the image does not change."""
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    defects = DefectivePixels()
    for _ in range(20 * MIN_FRAMES):
        assert defects.corrected(noise, TURN) is noise
        defects.examine(noise)
    assert defects.count == 0


def test_frames_without_an_image_count_as_motion() -> None:
    defects = DefectivePixels()
    for k in range(4 * MIN_IMAGES * MIN_FRAMES):
        image = defects.corrected(seen_at(k % (3 * WIDTH)) if k % MIN_FRAMES == 0 else None, TURN)
        if image is not None:
            defects.examine(image)
    assert defects.count == len(STUCK)


def test_features_avoid_defective_pixels(render_wall: Callable[[CameraModel, Array], Image]) -> None:
    """Many of the first features are at defective pixels; when these are known, no more than by chance."""
    camera = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0)
    dead = np.random.default_rng(1).random((camera.height, camera.width)) < 0.002
    rows, columns = np.nonzero(dead)
    tracker = RigTracker(Rig((RigCamera(camera, np.eye(4)),)), TrackerConfig())
    shares = []
    for k in range(MIN_IMAGES * MIN_FRAMES + 1):
        T = pose_matrix(exp_so3(np.array([0.0, 0.003 * k, 0.0])), np.array([0.01 * k, 0.0, 0.0]))
        image = np.where(dead, np.uint8(255), 96 + render_wall(camera, T) // 4)
        seen = tracker.track(CameraFrame(50_000_000 * k, (image,)), TURN.T if k else np.eye(3))
        tracker.discard(seen.ids)
        new = tracker.replenish().pixels
        shares.append(np.mean(np.hypot(new[:, :1] - columns, new[:, 1:] - rows).min(axis=1) < 2.5))
    assert np.mean(shares[:MIN_FRAMES]) > 0.3
    assert shares[-1] < 0.1
