"""Properties of images that a feature tracker responds to: grey levels, noise, sharpness, motion blur, brightness.

All are computed from images alone, so that real and simulated recordings can be compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.klt import match_brightness
from dronevio.models.arrays import Array, Image

LEVELS = (20, 60, 100, 140, 180, 220)
"""Centres of the ranges of grey levels for which the noise is estimated."""
_LAPLACIAN = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0  # noise of σ 1 stays σ 1
_BLOCK_PX = 12  # side of the blocks in which noise is estimated
_TEXTURE = 6.0  # high frequencies beyond this are texture [grey levels]
_SMOOTH_PERCENTILE = 10  # the smoothest blocks of each range of grey levels show noise alone
_EDGE_SCALES = (1.0, 2.0)  # standard deviations of the derivatives that yield the blur of edges [px]
_STRONG_EDGE = 8.0  # smallest gradient of edges whose blur is measured, at the fine scale [grey levels / px]
_DIFFERENCE_VARIANCE = 1.0 / 3.0  # of the central difference, a box of two pixels [px²]
_ISOLATION_PX = 5  # distance from an edge at which there is no other
_FLOW_BINS_PX = np.array([0.0, 1.5, 3.0, 4.5, 6.0, 8.0, 10.0, 12.0, 15.0])
_MIN_EDGES = 300  # fewer edges of a flow are not evaluated


@dataclass(frozen=True)
class ImageProperties:
    """Properties of the images of one camera."""

    percentiles: tuple[float, ...]
    """Grey levels below which 5, 25, 50, 75 and 95 % of the pixels are."""
    dark_percent: float
    """Share of the pixels below grey level 10 [%]."""
    saturated_percent: float
    """Share of the pixels above grey level 250 [%]."""
    contrast: float
    """Standard deviation of the grey levels of an image."""
    noise: tuple[float, ...]
    """Standard deviation of the noise at the grey levels `LEVELS`; NaN where there are too few pixels."""
    fixed_pattern: float
    """Standard deviation of the pattern of the pixels' response, which does not move with the scene [grey levels]."""
    gradient: tuple[float, ...]
    """50th, 90th and 99th percentile of the gradient [grey levels / px]."""
    spectral_slope: float
    """Exponent of the power spectrum between 0.03 and 0.3 cycles per pixel."""
    edge_blur_px: float
    """Standard deviation of the blur of isolated edges (median), extrapolated to an edge that does not move [px]."""
    exposure_s: float
    """Exposure time by the additional blur of edges that move; NaN if the images move too little [s]."""
    gain_change_percent: float
    """95th percentile of the change of brightness between consecutive frames, over all tracked patches [%]."""
    patch_change_percent: float
    """Median over patches of their change of brightness relative to that of the image, after 10 frames [%]."""


def noise_by_level(images: Sequence[Image]) -> tuple[float, ...]:
    """Return the standard deviation of the noise at `LEVELS` (Immerkær, CVIU 1996, in the smoothest blocks)."""
    means, sigmas, roughness = [], [], []
    for image in images:
        grey = image.astype(np.float32)
        noise = np.abs(cv2.filter2D(grey, -1, _LAPLACIAN)) * np.sqrt(np.pi / 2.0)
        smooth = cv2.GaussianBlur(grey, (0, 0), 2.0)
        gradient = np.hypot(cv2.Sobel(smooth, -1, 1, 0), cv2.Sobel(smooth, -1, 0, 1))
        means.append(_blocks(grey))
        sigmas.append(_blocks(noise))
        roughness.append(_blocks(gradient))
    mean, sigma, rough = map(np.concatenate, (means, sigmas, roughness))
    found = []
    for level in LEVELS:
        near = np.abs(mean - level) < 20.0
        if near.sum() < 20 * _SMOOTH_PERCENTILE:
            found.append(float("nan"))
            continue
        smooth_blocks = near & (rough <= np.percentile(rough[near], _SMOOTH_PERCENTILE))
        found.append(float(np.median(sigma[smooth_blocks])))
    return tuple(found)


def fixed_pattern(images: Sequence[Image]) -> float:
    """Return the standard deviation of the pattern that all images have in common at the same pixels [grey levels].

    The pattern is that of the response of pixels. It is what the means of even and of odd images have in common, in
    high spatial frequencies, so that noise has no effect. The camera must move, or the scene counts as the pattern.
    """
    high = [np.clip(cv2.filter2D(image.astype(np.float32), -1, _LAPLACIAN), -_TEXTURE, _TEXTURE) for image in images]
    means = [np.mean(high[k::2], axis=0) for k in (0, 1)]
    common = float(np.mean((means[0] - means[0].mean()) * (means[1] - means[1].mean())))
    return float(np.sqrt(max(common, 0.0)))


def _blocks(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the means over blocks of an image."""
    height, width = (size // _BLOCK_PX for size in values.shape)
    cropped = values[: height * _BLOCK_PX, : width * _BLOCK_PX]
    return np.asarray(cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA).ravel(), np.float32)


def edge_blurs(image: Image) -> tuple[npt.NDArray[np.int64], Array, Array]:
    """Return pixels (N, 2), unit normals (N, 2) and variance of the blur (N,) of strong, isolated edges [px²].

    A step that is blurred by a Gaussian of variance b² has the largest gradient 1 / √(b² + s²) under a derivative of
    scale s; two scales yield b (Zhuo and Sim, Pattern Recognition 2011). Pixels integrate light over their area, which
    adds 1/12 to the variance.
    """
    grey = image.astype(np.float32)
    scaled = [cv2.GaussianBlur(grey, (0, 0), s) for s in _EDGE_SCALES]
    dx, dy = ([cv2.Sobel(s, cv2.CV_32F, *order, ksize=1, scale=0.5) for s in scaled] for order in ((1, 0), (0, 1)))
    fine, coarse = (np.hypot(x, y) for x, y in zip(dx, dy, strict=True))
    kernel = np.ones((7, 7), np.uint8)
    strong = (cv2.Canny(image, 60, 160, L2gradient=True) > 0) & (fine > _STRONG_EDGE)
    strong &= (cv2.dilate(image, kernel) < 245) & (cv2.erode(image, kernel) > 4)  # saturated edges look sharper
    rows, columns = np.nonzero(strong)
    normals = np.stack([dx[0][rows, columns], dy[0][rows, columns]], axis=1) / fine[rows, columns, None]
    along = [
        _at(fine, columns + k * normals[:, 0], rows + k * normals[:, 1]) for k in (-_ISOLATION_PX, -1, 1, _ISOLATION_PX)
    ]
    peak = fine[rows, columns]
    isolated = (np.maximum(along[0], along[3]) < 0.25 * peak) & (np.maximum(along[1], along[2]) <= 1.05 * peak)
    ratio = (peak / np.maximum(coarse[rows, columns], 1e-6)).astype(np.float64) ** 2
    isolated &= ratio > 1.02
    s, big = (scale**2 + _DIFFERENCE_VARIANCE for scale in _EDGE_SCALES)
    variance = (big - ratio[isolated] * s) / (ratio[isolated] - 1.0)
    return np.stack([columns, rows], axis=1).astype(np.int64)[isolated], normals[isolated].astype(np.float64), variance


def _at(values: npt.NDArray[np.float32], x: Array, y: Array) -> Array:
    """Return the values of an image at pixels, by linear interpolation."""
    if not len(x):
        return np.zeros(0)
    found = cv2.remap(values, x.astype(np.float32)[None], y.astype(np.float32)[None], cv2.INTER_LINEAR)
    return np.asarray(found[0], np.float64)


def blur_and_exposure(images: Sequence[tuple[Image, Image]], interval_s: float) -> tuple[float, float]:
    """Return the blur of edges without motion [px] and the exposure time [s], from pairs of consecutive images.

    An exposure of τ blurs an edge that moves by u pixels along its normal between frames by a box of width u τ /
    interval, whose variance is a twelfth of its square. Since a box has steeper edges than a Gaussian of the same
    variance, the result of long exposures is about a fifth too large.

    Args:
        images: Pairs of consecutive images.
        interval_s: Interval of the images of a pair [s].
    """
    flows: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    moved, variances = [], []
    for image, following in images:
        pixels, normals, variance = edge_blurs(image)
        flow = flows.calc(image, following, None)[pixels[:, 1], pixels[:, 0]]
        moved.append(np.abs(np.einsum("ij,ij->i", flow, normals)))
        variances.append(variance)
    motion, variance = np.concatenate(moved), np.concatenate(variances)
    u2, b2 = [], []
    for low, high in pairwise(_FLOW_BINS_PX):
        inside = (motion >= low) & (motion < high)
        if inside.sum() >= _MIN_EDGES:
            u2.append(float(np.mean(motion[inside] ** 2)))
            b2.append(float(np.median(variance[inside])))
    if len(u2) < 3:
        return (float(np.sqrt(max(np.median(variance), 0.0))) if len(variance) else float("nan")), float("nan")
    slope, offset = np.polyfit(u2, b2, 1)
    return float(np.sqrt(max(offset, 0.0))), float(interval_s * np.sqrt(12.0 * max(slope, 0.0)))


def spectral_slope(images: Sequence[Image]) -> float:
    """Return the exponent of the mean power spectrum between 0.03 and 0.3 cycles per pixel."""
    side = min(images[0].shape)
    window = np.outer(np.hanning(side), np.hanning(side))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    power = np.zeros((side, side))
    for image in images:
        left = (image.shape[1] - side) // 2
        patch = image[:side, left : left + side].astype(np.float64)
        power += np.abs(np.fft.fft2((patch - patch.mean()) * window)) ** 2
    edges = np.geomspace(0.03, 0.3, 13)
    centres = np.sqrt(edges[:-1] * edges[1:])
    ring = np.digitize(frequency, edges)
    mean = [power[ring == k + 1].mean() for k in range(len(centres))]
    return float(np.polyfit(np.log(centres), np.log(mean), 1)[0])


def brightness_changes(images: Sequence[Image], gap: int) -> tuple[Array, Array]:
    """Return common (M,) and patches' own (K,) relative changes of brightness between images ``gap`` frames apart.

    Patches are tracked frame by frame.
    """
    common, own = [], []
    for start in range(0, len(images) - gap, max(gap, 4)):
        points: Any = cv2.goodFeaturesToTrack(images[start], 200, 0.01, 15)
        if points is None:
            continue
        current, alive = points, np.ones(len(points), bool)
        for k in range(start, start + gap):
            before = match_brightness(images[k], images[k + 1])
            found: Any
            current, found, _ = cv2.calcOpticalFlowPyrLK(before, images[k + 1], current, None)  # type: ignore[call-overload]
            alive &= found.ravel() > 0
        means = [cv2.blur(images[k].astype(np.float32), (11, 11)) for k in (start, start + gap)]
        first, last = (
            cv2.remap(mean, at, np.zeros(0), cv2.INTER_LINEAR).ravel()
            for mean, at in zip(means, (points, current), strict=True)
        )
        alive &= (first > 10.0) & (first < 240.0) & (last > 10.0) & (last < 240.0)
        if alive.sum() < 20:
            continue
        ratio = np.log(last[alive] / first[alive])
        common.append(float(np.median(ratio)))
        own.append(np.abs(ratio - common[-1]))
    return np.array(common), np.concatenate(own) if own else np.zeros(0)


def image_properties(images: Sequence[Image], interval_s: float, every: int = 8) -> ImageProperties:
    """Return the properties of consecutive images (H, W) of one camera.

    Args:
        images: The images, in order.
        interval_s: Interval of the images [s].
        every: Interval of the images of which noise, sharpness and grey levels are computed.
    """
    chosen = images[::every]
    grey = np.stack(chosen)
    smooth = [cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0) for image in chosen]
    gradient = np.stack(
        [np.hypot(cv2.Sobel(s, -1, 1, 0, ksize=1), cv2.Sobel(s, -1, 0, 1, ksize=1)) / 2 for s in smooth]
    )
    pairs = [(images[k], images[k + 1]) for k in range(0, len(images) - 1, every)]
    blur, exposure_s = blur_and_exposure(pairs, interval_s)
    frame_change, _ = brightness_changes(images, 1)
    _, patch_change = brightness_changes(images, 10)
    return ImageProperties(
        tuple(np.percentile(grey, [5, 25, 50, 75, 95]).tolist()),
        100.0 * float(np.mean(grey < 10)),
        100.0 * float(np.mean(grey > 250)),
        float(np.mean([image.std() for image in chosen])),
        noise_by_level(chosen),
        fixed_pattern(images),
        tuple(np.percentile(gradient, [50, 90, 99]).tolist()),
        spectral_slope(chosen),
        blur,
        exposure_s,
        100.0 * float(np.percentile(np.abs(frame_change), 95)) if len(frame_change) else float("nan"),
        100.0 * float(np.median(patch_change)) if len(patch_change) else float("nan"),
    )
