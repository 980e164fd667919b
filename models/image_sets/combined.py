"""Subsets and unions of image sets, for images that are added to an earlier reconstruction."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.image_sets.geotags import joined_geotags
from dronevio.models.image_sets.image_set import FocalSource, ImageSet, Indices

Result = TypeVar("Result")


def subset(images: ImageSet, chosen: npt.ArrayLike) -> ImageSet:
    """Return some images of a set, in the given order, with all of its cameras.

    Args:
        images: The set.
        chosen: (N,) Different indices of images.
    """
    index = np.asarray(chosen, np.int64)
    return replace(
        images,
        names=tuple(images.names[i] for i in index),
        image_camera=images.image_camera[index],
        t_ns=None if images.t_ns is None else images.t_ns[index],
        frame=None if images.frame is None else images.frame[index],
        geotags=None if images.geotags is None else images.geotags[index],
        control_points=None if images.control_points is None else images.control_points.of_images(index),
        read=_indirect(images.read, index),
        read_mask=_indirect(images.read_mask, index),
    )


def joined(first: ImageSet, second: ImageSet) -> ImageSet:
    """Return the images of two sets, those of the first before those of the second, without an order in time.

    A camera of the second set that is not calibrated is taken to be one of the first set with the same initial model.
    Time stamps, rigs and IMU are dropped, because the clocks of two sets differ.

    Raises:
        ConfigError: An image of the second set has the name of one of the first.
    """
    repeated = sorted(set(first.names) & set(second.names))
    if repeated:
        raise ConfigError(
            f"{len(repeated)} images, such as {repeated[0]}, have the names of others; expected unique names"
        )
    cameras, calibrated = list(first.cameras), first.is_calibrated.tolist()
    sources = _sources(first)
    number = []
    for camera, is_calibrated, source in zip(second.cameras, second.is_calibrated, _sources(second), strict=True):
        same = [k for k, c in enumerate(first.cameras) if c == camera and first.is_calibrated[k] == is_calibrated]
        if not same:
            cameras.append(camera)
            calibrated.append(bool(is_calibrated))
            sources.append(source)
        number.append(same[0] if same else len(cameras) - 1)
    return ImageSet(
        names=first.names + second.names,
        image_camera=np.concatenate([first.image_camera, np.array(number, np.int64)[second.image_camera]]),
        cameras=tuple(cameras),
        is_calibrated=np.array(calibrated, np.bool_),
        is_ordered=False,
        t_ns=None,
        frame=None,
        Ts_imu_cam=None,
        read=_either(first.read, second.read, len(first)),
        read_mask=_either(first.read_mask, second.read_mask, len(first)),
        focal_source=tuple(sources),
        skipped={**first.skipped, **second.skipped},
        control_points=first.control_points,
        geotags=joined_geotags(first.geotags, len(first), second.geotags, len(second)),
    )


def with_earlier(images: ImageSet, earlier: Sequence[str], available: ImageSet, is_one_source: bool) -> ImageSet:
    """Return images together with those of an earlier reconstruction.

    Args:
        images: The images to add; of one source, those of the earlier reconstruction may be among them.
        earlier: Names of the images of the earlier reconstruction.
        available: The images among which those of the earlier reconstruction are found by their names.
        is_one_source: Whether `available` are all images of the source of `images`; names of another source are
            independent.

    Raises:
        ConfigError: An image of the earlier reconstruction is not available, no image is new, or two images have one
            name.
    """
    row = {name: i for i, name in enumerate(available.names)}
    missing = [name for name in earlier if name not in row]
    if missing:
        raise ConfigError(
            f"{len(missing)} of {len(earlier)} images of the earlier reconstruction, such as {missing[0]}, are not"
            " among the images; expected all of them, or their folder with the option --earlier-images"
        )
    wanted = set(earlier) | (set(images.names) if is_one_source else set())
    chosen = subset(available, [i for i, name in enumerate(available.names) if name in wanted])
    combined = chosen if is_one_source else joined(chosen, images)
    if len(combined) == len(earlier):
        raise ConfigError(f"all {len(earlier)} images are in the earlier reconstruction; expected new ones")
    return combined


def _sources(images: ImageSet) -> list[FocalSource]:
    """Return the source (K,) of the focal length of each camera."""
    unknown: FocalSource = "assumed"
    return list(images.focal_source) or [unknown] * len(images.cameras)


def _indirect(read: Callable[[int], Result], index: Indices) -> Callable[[int], Result]:
    """Return a function of a position in an array of indices."""
    return lambda position: read(int(index[position]))


def _either(first: Callable[[int], Result], second: Callable[[int], Result], count: int) -> Callable[[int], Result]:
    """Return a function that calls the first for indices below a count, and the second for the others."""
    return lambda index: first(index) if index < count else second(index - count)
