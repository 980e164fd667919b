"""Images that repeat the image before are left out while the vehicle rotates."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.frontend.repetition import MIN_ROTATION_RAD, ROTATION_SIGMAS, RepetitionFilter
from dronevio.models.arrays import Image
from dronevio.models.rotation import exp_so3
from dronevio.models.state import NO_IMAGE, CameraFrame

LEFT, RIGHT, OTHER = (np.arange(24, dtype=np.uint8).reshape(4, 6) + np.uint8(k) for k in range(3))
REST, TURNED = np.eye(3), exp_so3(np.array([0.0, 2.0 * MIN_ROTATION_RAD, 0.0]))


def filtered(images: RepetitionFilter, *frame: Image) -> tuple[tuple[Image, ...], bool]:
    """Return the images that are used of a frame of a rotating vehicle, and whether one was left out."""
    return images.filtered(CameraFrame(0, frame), TURNED, 0.0).images, images.repeats


def test_copies_are_left_out_while_the_vehicle_rotates() -> None:
    images = RepetitionFilter()
    used, repeats = filtered(images, LEFT, RIGHT)
    assert used[0] is LEFT and used[1] is RIGHT and not repeats
    used, repeats = filtered(images, LEFT.copy(), OTHER)
    assert used[0] is NO_IMAGE and used[1] is OTHER and repeats
    used, repeats = filtered(images, LEFT.copy(), RIGHT)  # compared with the image before, which was left out
    assert used[0] is NO_IMAGE and used[1] is RIGHT and repeats
    used, repeats = filtered(images, RIGHT, LEFT)
    assert used[0] is RIGHT and used[1] is LEFT and not repeats


def test_copies_are_used_while_the_vehicle_may_be_stationary() -> None:
    images, frame = RepetitionFilter(), CameraFrame(0, (LEFT,))
    uncertain_rad = MIN_ROTATION_RAD / ROTATION_SIGMAS * 1.01
    for k, (R, sigma_rad) in enumerate([(REST, 0.0), (REST, 0.0), (TURNED, uncertain_rad)]):
        again = replace(frame, t_ns=k)
        assert images.filtered(again, R, sigma_rad) is again and not images.repeats


@pytest.mark.parametrize("image", [NO_IMAGE, LEFT // 3], ids=["missing", "dark"])
def test_missing_and_dark_images_are_no_copies(image: Image) -> None:
    images, frame = RepetitionFilter(), CameraFrame(0, (image,))
    for k in range(3):
        again = replace(frame, t_ns=k)
        assert images.filtered(again, TURNED, 0.0) is again and not images.repeats


def test_rotations_add_up_while_an_image_is_shown() -> None:
    """A slow rotation moves the image after some frames; from then on it is a copy, even if it turns back."""
    images, frame = RepetitionFilter(), CameraFrame(0, (LEFT,))
    slow = exp_so3(np.array([0.0, 0.4 * MIN_ROTATION_RAD, 0.0]))
    repeats = []
    for R in (REST, slow, slow, slow, slow.T, slow.T, REST):
        images.filtered(frame, R, 0.0)
        repeats.append(images.repeats)
    assert repeats == [False, False, False, True, True, True, True]
    images.filtered(CameraFrame(1, (RIGHT,)), REST, 0.0)
    images.filtered(CameraFrame(2, (RIGHT,)), slow, 0.0)
    assert not images.repeats  # rotations count from the new image on


def test_copies_are_left_out_in_motion_without_rotation() -> None:
    images, frame = RepetitionFilter(), CameraFrame(0, (LEFT, RIGHT))
    assert images.filtered(frame, REST, 0.0, moves=True) is frame
    assert all(image is NO_IMAGE for image in images.filtered(frame, REST, 0.0, moves=True).images)
