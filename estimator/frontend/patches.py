"""Patches of features as they were first seen, found again to a fraction of a pixel.

Following a corner from frame to frame adds up an error at every step. Here each feature keeps the patch around it from
the frame in which it was first seen, and in every later frame the patch is put where it fits best: displaced, and bent
by a 2 × 2 matrix, since it is seen from elsewhere. Brightness and contrast may change. This is the inverse
compositional algorithm (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004), whose derivatives are those of the
patch, computed once. The bend is held near what it was before, or patches with little in them would run away.
"""

from dataclasses import dataclass, fields, replace
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

MOST_CHANGE = 0.3  # of the bend in a step; twice as much could turn a patch inside out
PIXEL_BLUR_PX = 0.3  # a pixel's own area blurs an image by 1/√12
MARGIN_PX = 24  # how far patches reach beyond the image at most
FAR_PX = 1e4  # beyond any image, and within what OpenCV can be asked for
SPARSE_ROWS = 16  # every sixteenth row tells an image's noise
MEDIAN_OVER_SIGMA = 0.6745  # of the magnitude of a normal variable
FAINTEST = 1e-3  # contrast of a patch [grey levels]; below, there is none


@dataclass(frozen=True)
class PatchConfig:
    """Settings of the alignment of patches."""

    side_px: int = 13
    """Side of a patch [px]; odd. Larger ones are surer, but what is seen aslant changes in ways that a matrix does not
    describe: with 17, slow flights along corridors came out 0.8 to 1.7 % too long, with 13 half a percent."""
    steps: int = 3
    """Gauss-Newton steps in a frame."""
    noise: float = 3.0
    """Standard deviation of what remains between two patches that fit [grey levels]."""
    bend_sigma: float = 0.05
    """How much a patch bends from one frame to the next: standard deviation of the matrix's elements."""
    blur_px: float = 0.5
    """Images are blurred by so much before they are compared [px]: interpolation is more accurate then, and the stairs
    of pixels matter less. With 0.35, and patches of 15 px, tracks along corridors err by 0.14 px after 20 frames, not
    by 0.15 to 0.18, and yet slow flights there by up to 2.4 times as much."""
    scales: tuple[float, ...] = (1.0, 1.6)
    """What has come nearer looks sharper than it did; it is compared in images that are blurred so much more, for the
    zoom that is nearest."""
    min_zncc: float = 0.9
    """Correlation below which a patch was not found, or something has come before a part of it ..."""
    noise_left: float = 0.65
    """... where noise does not explain it, of which the blur leaves this share."""
    noisy: float = 6.0
    """Images of more noise are blurred more [grey levels, standard deviation] ..."""
    noisy_blur_px: float = 1.0
    """... by this [px]."""
    max_scale: float = 2.5
    """How much nearer or further a patch may come."""


@dataclass(frozen=True, eq=False)
class Patches:
    """N patches, and what aligning them needs."""

    values: Array32
    """(N, P) Grey levels, less their mean, divided by their norm."""
    slopes: Array32
    """(N, 6, P) Derivatives of the values by displacement (2) and bend (4, by rows), less what brightness explains."""
    inverse: Array32
    """(N, 6, 6) Inverse of the Gauss-Newton matrix, prior included."""
    prior: Array32
    """(N,) Weight of the prior on the bend."""
    norm: Array32
    """(N,) Norm of the grey levels, less their mean."""
    bend: Array
    """(N, 2, 2) How the patch is bent at present: maps its own pixels to the image's."""

    def __len__(self) -> int:
        return len(self.values)

    @property
    def scale(self) -> Array:
        """(N,) How many times larger each looks than when it was first seen."""
        return _scale(self.bend)

    def __getitem__(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> Self:
        return type(self)(*(getattr(self, each.name)[rows] for each in fields(self)))

    def rolled(self, R_cur_prev: Array) -> Self:
        """Return the patches bent as they are after the camera turned about its axis, as a rotation (3, 3) has it."""
        angle = np.arctan2(R_cur_prev[1, 0] - R_cur_prev[0, 1], R_cur_prev[0, 0] + R_cur_prev[1, 1])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return replace(self, bend=turn @ self.bend)

    def joined(self, others: Self) -> Self:
        """Return these patches and others after them."""
        pairs = ((getattr(self, each.name), getattr(others, each.name)) for each in fields(self))
        return type(self)(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class Fit:
    """Where patches were found."""

    pixels: Array
    """(N, 2) Where they are [px]."""
    patches: Patches
    """As they are bent there."""
    zncc: Array
    """(N,) How well they fit: correlation, up to 1."""
    good: npt.NDArray[np.bool_]
    """(N,) Whether they are to be believed."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """An image as it is compared."""

    atlas: Image
    """(L h, W) The image, blurred less and more, one below the other, each with a margin above and below."""
    height: int
    """h: rows of each."""
    noise: float
    """Standard deviation of the image's noise [grey levels], before the blur; fine texture counts as noise too."""


class PatchAligner:
    """Cuts patches and finds them again."""

    def __init__(self, config: PatchConfig) -> None:
        self._config = config
        reach = config.side_px // 2
        line = np.arange(-reach, reach + 1, dtype=np.float32)
        self._grid = np.stack(np.meshgrid(line, line), axis=0).reshape(2, -1)  # (2, P)

    def prepare(self, image: Image) -> Prepared:
        """Return an image as it is compared: blurred as each zoom wants it, one below the other."""
        c, noise, scales = self._config, noise_of(image), np.array(self._config.scales)
        blur_px = c.noisy_blur_px if noise > c.noisy else c.blur_px
        sigmas = np.sqrt(blur_px**2 * scales**2 + PIXEL_BLUR_PX**2 * (scales**2 - 1.0))
        height, width = image.shape[0] + 2 * MARGIN_PX, image.shape[1]
        padded = np.empty((height, width), np.uint8)  # OpenCV takes long for making room
        cv2.copyMakeBorder(image, MARGIN_PX, MARGIN_PX, 0, 0, cv2.BORDER_REPLICATE, dst=padded)
        atlas = np.empty((len(sigmas) * height, width), np.uint8)
        for level, sigma in enumerate(sigmas.tolist()):
            across = 2 * round(2.0 * sigma) + 1
            cv2.GaussianBlur(padded, (across, across), sigma, dst=atlas[level * height : (level + 1) * height])
        return Prepared(atlas, height, noise)

    def cut(self, prepared: Prepared, pixels: Array) -> Patches:
        """Return the patches around pixels (N, 2) of a prepared image."""
        c, n = self._config, len(pixels)
        values, norm = _normalized(self._sampled(prepared, pixels))
        right, down = np.eye(2)
        slope_x = 0.5 * (self._sampled(prepared, pixels + right) - self._sampled(prepared, pixels - right))
        slope_y = 0.5 * (self._sampled(prepared, pixels + down) - self._sampled(prepared, pixels - down))
        x, y = self._grid
        slopes = np.stack([slope_x, slope_y, slope_x * x, slope_x * y, slope_y * x, slope_y * y], axis=1)
        slopes /= norm[:, None, None]
        slopes -= slopes.mean(axis=2, keepdims=True)
        slopes -= (slopes @ values[:, :, None]) * values[:, None, :]
        prior = (c.noise / (norm * c.bend_sigma)) ** 2
        H = slopes @ slopes.transpose(0, 2, 1)
        H += prior[:, None, None] * np.diag(np.array([0, 0, 1, 1, 1, 1], np.float32)) + 1e-9 * np.eye(
            6, dtype=np.float32
        )
        return Patches(values, slopes, np.linalg.inv(H), prior, norm, np.tile(np.eye(2), (n, 1, 1)))

    def align(self, prepared: Prepared, patches: Patches, pixels: Array) -> Fit:
        """Find patches again.

        Args:
            prepared: Image in which they are looked for.
            patches: What is looked for, bent as it is expected.
            pixels: (N, 2) Where they are expected, to a pixel or two.
        """
        c, bend, expected = self._config, patches.bend, np.linalg.inv(patches.bend)
        for _ in range(c.steps):
            seen, _ = _normalized(self._sampled(prepared, pixels, bend))
            gain = (patches.slopes @ (seen - patches.values)[:, :, None])[..., 0]
            gain[:, 2:] += patches.prior[:, None] * (expected @ bend - np.eye(2)).reshape(-1, 4)
            step = (patches.inverse @ gain[..., None])[..., 0].astype(np.float64)
            change = np.clip(step[:, 2:], -MOST_CHANGE, MOST_CHANGE).reshape(-1, 2, 2)
            bend = bend @ np.linalg.inv(np.eye(2) + change)
            pixels = pixels - np.einsum("nij,nj->ni", bend, step[:, :2])
        zncc = np.sum(seen * patches.values, axis=1).astype(np.float64)
        zoom2 = np.linalg.det(bend)
        doubt = (c.noise_left * prepared.noise * c.side_px / patches.norm) ** 2
        good = (zncc > c.min_zncc - doubt) & (zoom2 > c.max_scale**-2) & (zoom2 < c.max_scale**2)
        return Fit(pixels, replace(patches, bend=bend), zncc, good & np.isfinite(pixels).all(axis=1))

    def _sampled(self, prepared: Prepared, pixels: Array, bend: Array | None = None) -> Array32:
        """Return the grey levels (N, P) around pixels (N, 2) of an image, on a bent grid."""
        n = len(pixels)
        if not n:  # which OpenCV refuses
            return np.zeros((0, self._grid.shape[1]), np.float32)
        bend = np.tile(np.eye(2), (n, 1, 1)) if bend is None else bend
        level = np.abs(_scale(bend)[:, None] - self._config.scales).argmin(axis=1)
        middle = np.clip(pixels, -FAR_PX, FAR_PX).astype(np.float32)
        axes = bend.astype(np.float32)
        x = axes[:, 0] @ self._grid + middle[:, :1]
        y = axes[:, 1] @ self._grid + middle[:, 1:]
        np.clip(y, -MARGIN_PX, prepared.height - MARGIN_PX - 1, out=y)
        y += (MARGIN_PX + level * prepared.height).astype(np.float32)[:, None]
        return np.asarray(
            cv2.remap(prepared.atlas, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
        )


def noise_of(image: Image) -> float:
    """Return the standard deviation of an image's noise [grey levels], from what neighbours mostly differ by."""
    few = image[::SPARSE_ROWS].astype(np.int16)
    differences = np.bincount(np.abs(few[:, 1:] - few[:, :-1]).ravel(), minlength=256)
    median = float(np.searchsorted(np.cumsum(differences), 0.5 * differences.sum()))
    return float(median / (MEDIAN_OVER_SIGMA * np.sqrt(2.0)))


def _scale(bend: Array) -> Array:
    """Return how many times larger (N,) what is bent by matrices (N, 2, 2) looks."""
    return np.asarray(np.sqrt(np.abs(np.linalg.det(bend))))


def _normalized(values: Array32) -> tuple[Array32, Array32]:
    """Return values (N, P) with the mean 0 and the norm 1 along P, and the norms (N,) that they had."""
    values = values - values.mean(axis=1, keepdims=True)
    norm = np.maximum(np.linalg.norm(values, axis=1), FAINTEST)
    return values / norm[:, None], norm
