"""Features of images: positions and descriptors of scale-invariant keypoints.

Keypoints and descriptors are SIFT (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004),
compared as RootSIFT (Arandjelović and Zisserman, "Three things everyone should know to improve object retrieval",
CVPR 2012): the inner product of two descriptors is the Bhattacharyya coefficient of their histograms.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.config import FeatureConfig
from dronevio.models.arrays import Array

DESCRIPTOR_SCALE = 512.0
"""A stored descriptor is the unit vector times this number, rounded to a byte."""

EDGE_THRESHOLD = 10.0
"""Largest ratio of the principal curvatures of a keypoint."""

CANDIDATES = 2
"""Number of keypoints, the largest ones, that compete for each feature that is kept."""

UNCERTAIN_SIZE_PX = 8.0
"""Diameter at which the variance of the position of a feature is twice that of small features [px]."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image."""

    pixels: Array
    """(N, 2) Positions; pixel centres have integer coordinates [px]."""
    sizes_px: Array
    """(N,) Diameters of the described neighbourhoods [px]."""
    descriptors: npt.NDArray[np.uint8]
    """(N, 128) Descriptors of length `DESCRIPTOR_SCALE`."""
    colours: npt.NDArray[np.uint8]
    """(N, 3) Colours at the features: red, green, blue."""

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.pixels)

    @property
    def sigmas(self) -> Array:
        """(N,) Standard deviations of the positions, relative to that of small features.

        A large feature is detected in an image of low resolution. The values are rounded to an eighth in the logarithm.
        """
        sigmas = np.hypot(1.0, self.sizes_px / UNCERTAIN_SIZE_PX)
        return np.asarray(np.exp(np.round(8.0 * np.log(sigmas)) / 8.0))


NO_FEATURES = Features(np.empty((0, 2)), np.empty(0), np.empty((0, 128), np.uint8), np.empty((0, 3), np.uint8))
"""Features of an image without any."""


def detect_features(
    image: npt.NDArray[np.uint8], config: FeatureConfig, mask: npt.NDArray[np.bool_] | None = None
) -> Features:
    """Detect and describe the features of an image.

    Args:
        image: (H, W) Grey image, or (H, W, 3) image with channels red, green, blue.
        config: Settings of the detection.
        mask: (H, W) False where no feature is detected; None for the whole image.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    (rows, columns), most = grey.shape, max(grey.shape)
    if most > config.max_side_px:
        size = tuple(max(round(side * config.max_side_px / most), 1) for side in (columns, rows))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        mask = None if mask is None else cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) != 0
    detector = cv2.SIFT.create(
        contrastThreshold=config.contrast_threshold, edgeThreshold=EDGE_THRESHOLD, enable_precise_upscale=True
    )
    found = detector.detect(grey, None if mask is None else mask.astype(np.uint8))
    if not found:
        return NO_FEATURES
    keypoints, described = detector.compute(grey, _strongest(found, config.max_features))
    # Keypoints of one position have several orientations: an order without ties keeps the result deterministic.
    reduced = np.array([columns, rows]) / grey.shape[::-1]
    pixels = (np.asarray(cv2.KeyPoint.convert(keypoints), np.float64) + 0.5) * reduced - 0.5
    sizes = np.array([keypoint.size for keypoint in keypoints]) * reduced.max()
    angles = np.array([keypoint.angle for keypoint in keypoints])
    order = np.lexsort([angles, pixels[:, 0], pixels[:, 1], -sizes])
    column, row = np.round(pixels[order]).astype(int).T
    colours = image[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    if colours.ndim == 1:
        colours = np.repeat(colours[:, None], 3, axis=1)
    return Features(pixels[order], sizes[order], _root_sift(np.asarray(described, np.float32)[order]), colours)


def _strongest(keypoints: Sequence[cv2.KeyPoint], count: int) -> Sequence[cv2.KeyPoint]:
    """Return the keypoints of highest contrast among the largest ones.

    In photographs of sand, grass or foliage, the strongest of all are specks, which no other image shows.
    """
    if len(keypoints) <= count:
        return keypoints
    sizes = np.array([keypoint.size for keypoint in keypoints])
    contrasts = np.array([keypoint.response for keypoint in keypoints])
    largest = np.argsort(-sizes, kind="stable")[: CANDIDATES * count]
    return [keypoints[i] for i in largest[np.argsort(-contrasts[largest], kind="stable")[:count]]]


def _root_sift(described: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Return RootSIFT descriptors (N, 128) of SIFT descriptors (N, 128)."""
    total = np.maximum(described.sum(axis=1, keepdims=True), 1e-6)
    scaled = np.round(DESCRIPTOR_SCALE * np.sqrt(described / total))
    return np.asarray(np.minimum(scaled, 255.0), np.uint8)
