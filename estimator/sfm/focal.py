"""First focal length of fisheyes without a calibration, which no metadata state.

The right focal length lets the essential matrices of pairs of images explain the most matches. With a pinhole, a
fundamental matrix verifies matches for any focal length; with a fisheye, there is none.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dronevio.estimator.sfm.config import MatchingConfig, VerificationConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.matching import Matches, match_features
from dronevio.estimator.sfm.two_view import verify, view_of
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import ImageSet

FOCAL_RATIOS = np.geomspace(0.24, 0.7, 12)
"""Focal lengths that are tried, relative to the longer side: fields of view along it from 240° to 82°."""
MATCHED_PAIRS = 24
"""Largest number of pairs of images of a camera that are matched."""
USED_PAIRS = 8
"""Number of these, those with the most matches, that decide on the focal length."""


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
        pairs: Pairs of images, of which some are used.
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
        candidates = [_with_focal(camera, ratio * max(camera.width, camera.height)) for ratio in FOCAL_RATIOS]
        scores = [
            sum(_inliers(pair, candidate, features, verification) for pair in matched) for candidate in candidates
        ]
        if matched and max(scores) > 0:
            cameras[k] = candidates[int(np.argmax(scores))]
    return tuple(cameras)


def _with_focal(camera: CameraModel, focal_px: float) -> CameraModel:
    return replace(camera, fx=float(focal_px), fy=float(focal_px))


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
