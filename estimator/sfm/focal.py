"""First focal length of cameras without a calibration, which no metadata state.

The right focal length lets the essential matrices of pairs of images explain the most matches, and the more so the
tighter the bound on their errors. With a pinhole, a fundamental matrix verifies matches for any focal length, and their
pairs decide; with a fisheye, there is none, and some pairs are matched beforehand. The adjustment needs a value
near the right one: where a camera flies straight ahead, it ends in a wrong minimum from twice that.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dronevio.estimator.sfm.config import MatchingConfig, VerificationConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.matching import Matches, match_features
from dronevio.estimator.sfm.two_view import Geometry, TwoView, verify, view_of
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import ImageSet

FISHEYE_RATIOS = np.geomspace(0.24, 0.7, 12)
"""Focal lengths of a fisheye that are tried, relative to the longer side: fields of view along it from 240° to 82°."""
PINHOLE_RATIOS = np.geomspace(0.35, 2.5, 14)
"""Those of a pinhole: fields of view from 110° to 23°."""
PINHOLE_ERROR_PX = 0.5
"""Distance from the epipolar line below which an essential matrix explains a match of a pinhole [px]."""
WIDE_ANGLE_DEG = 16.0
"""Angle between the rays of the matches of a pair from which it counts no more [deg]."""
MATCHED_PAIRS = 24
"""Largest number of pairs of images of a fisheye that are matched."""
USED_PAIRS = 8
"""Number of pairs that decide on the focal length."""


def guess_fisheyes(
    images: ImageSet,
    features: Sequence[Features],
    pairs: Sequence[tuple[int, int]],
    matching: MatchingConfig,
    verification: VerificationConfig,
) -> tuple[CameraModel, ...]:
    """Return the cameras (K,) of a set of images, with a first focal length of fisheyes without a calibration.

    Args:
        images: The images.
        features: (I,) Features of all images.
        pairs: Pairs of images, of which some are used: those with the most matches.
        matching: Settings of the matching.
        verification: Settings of the verification.
    """
    cameras = list(images.cameras)
    for k, camera in enumerate(images.cameras):
        if images.is_calibrated[k] or camera.lens != "equidistant":
            continue
        of_camera = [(i, j) for i, j in pairs if images.image_camera[i] == k and images.image_camera[j] == k]
        spread = np.unique(np.linspace(0, max(len(of_camera) - 1, 0), MATCHED_PAIRS).astype(np.int64)).tolist()
        tried = [of_camera[n] for n in spread if of_camera]
        matched = [(i, j, match_features(features[i], features[j], matching)) for i, j in tried]
        matched = sorted(matched, key=lambda pair: -len(pair[2]))[:USED_PAIRS]
        cameras[k] = _best(camera, FISHEYE_RATIOS, matched, features, verification)
    return tuple(cameras)


def guess_pinholes(
    images: ImageSet, features: Sequence[Features], pairs: Sequence[TwoView], verification: VerificationConfig
) -> tuple[CameraModel, ...]:
    """Return the cameras (K,) of a set of images, with a first focal length of pinholes of which nothing is known.

    Args:
        images: The images.
        features: (I,) Features of all images.
        pairs: Verified pairs of images, of which some are used: those with the most matches and the widest angles.
        verification: Settings of the verification.
    """
    cameras = list(images.cameras)
    for k, (camera, source) in enumerate(zip(images.cameras, images.focal_source, strict=False)):
        if images.is_calibrated[k] or camera.lens != "radtan" or source != "assumed":
            continue
        of_camera = [
            pair
            for pair in pairs
            if pair.geometry is Geometry.GENERAL
            and images.image_camera[pair.first] == images.image_camera[pair.second] == k
        ]
        of_camera.sort(key=lambda pair: -len(pair.matches) * min(np.degrees(pair.angle_rad) / WIDE_ANGLE_DEG, 1.0))
        matched = [(pair.first, pair.second, pair.matches) for pair in of_camera[:USED_PAIRS]]
        tight = replace(verification, max_error_px=PINHOLE_ERROR_PX)
        cameras[k] = _best(camera, PINHOLE_RATIOS, matched, features, tight)
    return tuple(cameras)


def _best(
    camera: CameraModel,
    ratios: Array,
    matched: Sequence[tuple[int, int, Matches]],
    features: Sequence[Features],
    verification: VerificationConfig,
) -> CameraModel:
    """Return a camera with the focal length that explains the most matches, unchanged if none explains any."""
    longer = max(camera.width, camera.height)
    candidates = [replace(camera, fx=float(ratio * longer), fy=float(ratio * longer)) for ratio in ratios]
    scores = [sum(_inliers(pair, candidate, features, verification) for pair in matched) for candidate in candidates]
    return candidates[int(np.argmax(scores))] if max(scores) > 0 else camera


def _inliers(
    pair: tuple[int, int, Matches],
    camera: CameraModel,
    features: Sequence[Features],
    config: VerificationConfig,
) -> int:
    """Return the number of matches of a pair that an essential matrix explains."""
    i, j, matches = pair
    views = view_of(features[i].pixels, camera, True), view_of(features[j].pixels, camera, True)
    verified = verify(i, j, views, matches, config)
    return 0 if verified is None else len(verified.matches)
