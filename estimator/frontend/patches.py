"""Alignment of image patches with the frame in which their feature was first observed.

Frame-to-frame tracking accumulates an error at every step. Here each feature keeps the reference patch of the frame in
which it was first observed, and every later frame is aligned with that patch by an affine warp: a displacement and a
2 × 2 matrix, because the viewpoint changes. The comparison is invariant to gain and offset of the brightness. The
method is the inverse compositional algorithm (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004), whose
steepest-descent images are those of the reference patch and are computed once. A prior keeps the warp near that of the
previous frame, as a random walk does; without it, patches of little texture diverge.
"""

from dataclasses import dataclass, fields, replace
from typing import Annotated, Self

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import rotation_z, yaw_rad_from_matrix

Array32 = npt.NDArray[np.float32]

MAX_WARP_STEP = 0.3  # largest change of a warp element per iteration; with 0.5 the warp could become singular
PIXEL_BLUR_PX = 0.3  # the area of a pixel blurs an image by 1/√12
WARP = np.arange(2, 6)  # rows of the Hessian that belong to the warp
MARGIN_PX = 24  # rows of padding above and below the image
MAX_COORDINATE_PX = 1e4  # outside any image, within the range of cv2.remap
NOISE_ROW_STRIDE = 16  # every sixteenth row suffices to estimate the noise of an image
MEDIAN_OVER_SIGMA = 0.6745  # median of the absolute value of a standard normal variable
WALK_S = 0.05  # time of the random walk to which `PatchConfig.warp_sigma` refers [s]
BLURRED_NOISE_RATIO = 0.65  # standard deviation of the image noise after the blur relative to that before
RESIDUAL_SIGMA = 3.0
"""Standard deviation of the difference between two aligned patches [grey levels], which weights the warp prior."""
NOISE_THRESHOLD = 6.0
"""Standard deviation of the image noise above which `NOISY_BLUR_PX` replaces `PatchConfig.blur_px` [grey levels]."""
NOISY_BLUR_PX = 1.0  # standard deviation of the Gaussian blur applied to noisy images
ROUND, SETTLED_PX = 3, 0.01
"""Number of iterations after which patches leave the alignment whose last displacement was smaller [px]: two thirds."""
UNALIGNED_LOSS = 0.05
"""Allowance for the ZNCC of a patch that is compared with an image and not aligned with it; 0.1 % of the patches that
can be aligned lose more."""
MIN_NORM = 1e-3  # smallest norm of a patch [grey levels], so that uniform patches cause no division by zero


@dataclass(frozen=True)
class PatchConfig(Settings):
    """Settings of the patch alignment."""

    side_px: Annotated[int, Range(5, 41, odd=True)] = 13
    """Side of a patch [px], an odd number. A larger patch has more texture, but an affine warp describes it less well
    where the surface is oblique."""
    iterations: Annotated[int, Range(1, 50)] = 6
    """Number of Gauss-Newton iterations per keyframe."""
    tracking_iterations: Annotated[int, Range(0, 50)] = 0
    """Number of them at every frame between keyframes. With none, patches are only compared with the image there, and
    errors of Lucas-Kanade accumulate up to the next keyframe."""
    warp_sigma: Annotated[float, Range(above=0.0, high=1e3)] = 0.08
    """Standard deviation of the change of each element of the affine warp within 50 ms, of a random walk."""
    blur_px: Annotated[float, Range(0.0, 10.0)] = 0.5
    """Standard deviation of the Gaussian blur applied before the comparison [px], which reduces interpolation errors
    and aliasing."""
    scales: Annotated[tuple[float, ...], Range(1.0, 10.0)] = (1.0, 1.6)
    """Factors on the blur for features that appear larger than at first, and therefore sharper: the copy of the image
    whose factor is nearest to the scale of the warp is compared."""
    min_zncc: Annotated[float, Range(-1.0, 1.0)] = 0.9
    """Smallest ZNCC (zero-mean normalized cross-correlation) of a successful alignment, before the allowance for image
    noise; a partly occluded patch has less."""
    max_scale: Annotated[float, Range(1.0, 10.0)] = 2.5
    """Largest scale of the warp, and the reciprocal of the smallest, of a successful alignment."""


EVERY_FRAME = PatchConfig(iterations=3, tracking_iterations=1, warp_sigma=0.05)
"""Settings where the features of every frame are used, not of keyframes alone."""


@dataclass(frozen=True, eq=False)
class Templates:
    """N reference patches of P pixels, with the quantities that the alignment needs."""

    values: Array32
    """(N, P) Grey levels with zero mean and unit norm."""
    steepest_descent: Array32
    """(N, 6, P) Steepest-descent images: derivatives of the values with respect to the displacement (2) and to the
    warp (4, row by row), with the components of constant brightness and of contrast removed."""
    hessian: Array32
    """(N, 6, 6) Gauss-Newton approximation of the Hessian, without the warp prior."""
    prior_weight: Array32
    """(N,) Weight of the prior on the warp after 50 ms."""
    norm: Array32
    """(N,) Norm of the grey levels after subtraction of the mean [grey levels]."""

    def __getitem__(self, rows: npt.NDArray[np.int64]) -> Self:
        return type(self)(*(getattr(self, each.name)[rows] for each in fields(self)))

    def joined(self, others: Self) -> Self:
        """Return these templates followed by others."""
        pairs = ((getattr(self, each.name), getattr(others, each.name)) for each in fields(self))
        return type(self)(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class Patches:
    """N patches with their current warps. A selection of them shares the large arrays of their templates."""

    templates: Templates
    """The reference patches of these and possibly of other patches."""
    rows: npt.NDArray[np.int64]
    """(N,) Row of the reference patch of each patch."""
    warp: Array
    """(N, 2, 2) Current affine warp: maps coordinates of the patch to coordinates of the image."""

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def scale(self) -> Array:
        """(N,) Ratio of the current size of each patch to its size in the reference frame."""
        return _scale(self.warp)

    def __getitem__(self, rows: slice | npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> Self:
        return type(self)(self.templates, self.rows[rows], self.warp[rows])

    def rolled(self, R_cur_prev: Array) -> Self:
        """Return the patches with the warp predicted for a rotation of the camera about its optical axis.

        Args:
            R_cur_prev: (3, 3) Rotation of the previous camera frame into the current one.
        """
        rotation = rotation_z(yaw_rad_from_matrix(R_cur_prev))[:2, :2]
        return replace(self, warp=rotation @ self.warp)

    def joined(self, others: Self) -> Self:
        """Return these patches followed by others, with the templates of no other patches."""
        templates = self.templates[self.rows].joined(others.templates[others.rows])
        return type(self)(templates, np.arange(len(self) + len(others)), np.concatenate([self.warp, others.warp]))


@dataclass(frozen=True, eq=False)
class PatchAlignment:
    """Result of the alignment of N patches with an image."""

    pixels: Array
    """(N, 2) Positions of the patch centres in the image [px]."""
    patches: Patches
    """The patches with their new warps."""
    zncc: Array
    """(N,) Zero-mean normalized cross-correlation with the template, in [-1, 1]."""
    valid: npt.NDArray[np.bool_]
    """(N,) Whether the correlation and the scale are within the limits."""


@dataclass(frozen=True, eq=False)
class ScaleSpace:
    """An image at several levels of Gaussian blur, all of the original resolution."""

    image: Image
    """(h, W) The image."""
    stack: Image
    """(L H, W) The L levels, one below the other, each padded above and below."""
    height: int
    """H: number of rows of a padded level."""
    noise: float
    """Standard deviation of the image noise before the blur [grey levels]; fine texture contributes to it."""


class PatchAligner:
    """Extracts reference patches from images and aligns them with other images."""

    def __init__(self, config: PatchConfig) -> None:
        self._config = config
        self._grid = _grid(config.side_px)  # (2, P)
        self._sparse = np.flatnonzero(((self._grid - self._grid[:, :1]) % 2 == 0).all(axis=0))  # every second one
        self._surroundings = _grid(config.side_px + 2)  # with one pixel around the patch, for central differences

    def scale_space(self, image: Image) -> ScaleSpace:
        """Return an image (H, W) blurred once for each of the configured scales."""
        c, noise, scales = self._config, noise_sigma(image), np.array(self._config.scales)
        blur_px = NOISY_BLUR_PX if noise > NOISE_THRESHOLD else c.blur_px
        sigmas = np.sqrt(blur_px**2 * scales**2 + PIXEL_BLUR_PX**2 * (scales**2 - 1.0))
        height, width = image.shape[0] + 2 * MARGIN_PX, image.shape[1]
        padded = np.empty((height, width), np.uint8)  # OpenCV allocates an output more slowly than numpy does
        cv2.copyMakeBorder(image, MARGIN_PX, MARGIN_PX, 0, 0, cv2.BORDER_REPLICATE, dst=padded)
        stack = np.empty((len(sigmas) * height, width), np.uint8)
        for level, sigma in enumerate(sigmas.tolist()):
            kernel_px = 2 * round(2.0 * sigma) + 1
            cv2.GaussianBlur(padded, (kernel_px, kernel_px), sigma, dst=stack[level * height : (level + 1) * height])
        return ScaleSpace(image, stack, height, noise)

    def extract(self, image: ScaleSpace, pixels: Array) -> Patches:
        """Return the patches around pixels (N, 2) of an image, with identity warps."""
        c, n = self._config, len(pixels)
        surroundings = self._sampled(image, pixels, grid=self._surroundings).reshape(n, c.side_px + 2, c.side_px + 2)
        template, norm = _normalized(surroundings[:, 1:-1, 1:-1].reshape(n, c.side_px**2))
        gradient_x = 0.5 * (surroundings[:, 1:-1, 2:] - surroundings[:, 1:-1, :-2]).reshape(n, c.side_px**2)
        gradient_y = 0.5 * (surroundings[:, 2:, 1:-1] - surroundings[:, :-2, 1:-1]).reshape(n, c.side_px**2)
        x, y = self._grid
        derivatives = [gradient_x, gradient_y, gradient_x * x, gradient_x * y, gradient_y * x, gradient_y * y]
        steepest_descent = np.stack(derivatives, axis=1)
        steepest_descent /= norm[:, None, None]
        steepest_descent -= steepest_descent.mean(axis=2, keepdims=True)
        steepest_descent -= (steepest_descent @ template[:, :, None]) * template[:, None, :]
        prior_weight = (RESIDUAL_SIGMA / (norm * c.warp_sigma)) ** 2
        H = steepest_descent @ steepest_descent.transpose(0, 2, 1)
        H += 1e-9 * np.eye(6, dtype=np.float32)
        warp = np.tile(np.eye(2), (n, 1, 1))
        return Patches(Templates(template, steepest_descent, H, prior_weight, norm), np.arange(n), warp)

    def align(
        self,
        image: ScaleSpace,
        patches: Patches,
        pixels: Array,
        iterations: int | None = None,
        elapsed_s: float = WALK_S,
    ) -> PatchAlignment:
        """Align patches with an image.

        Args:
            image: The image to align with.
            patches: N patches with their predicted warps.
            pixels: (N, 2) Predicted positions [px], which may be off by one to two pixels.
            iterations: Number of Gauss-Newton iterations, 1 or more; that of a keyframe by default.
            elapsed_s: Time since the image of the predicted warps [s].
        """
        c, norm = self._config, patches.templates.norm[patches.rows]
        remaining, rows = c.iterations if iterations is None else iterations, np.arange(len(patches))
        pixels, warp, zncc = pixels.copy(), patches.warp.copy(), np.zeros(len(patches))
        # Inverse compositional Gauss-Newton; most patches settle in the first round
        while remaining and len(rows):
            count, moving = min(remaining, ROUND), patches[rows]
            pixels[rows], warp[rows], zncc[rows], step_px = self._stepped(
                image, moving, pixels[rows], warp[rows], count, elapsed_s
            )
            remaining, rows = remaining - count, rows[step_px > SETTLED_PX]
        # Correlation and scale decide whether the alignment has succeeded
        scale_squared = _determinant(warp)
        noise_loss = (BLURRED_NOISE_RATIO * image.noise * c.side_px / norm) ** 2  # of correlation
        valid = (zncc > c.min_zncc - noise_loss) & (scale_squared > c.max_scale**-2) & (scale_squared < c.max_scale**2)
        return PatchAlignment(pixels, replace(patches, warp=warp), zncc, valid & np.isfinite(pixels).all(axis=1))

    def _stepped(
        self, image: ScaleSpace, patches: Patches, pixels: Array, warp: Array, iterations: int, elapsed_s: float
    ) -> tuple[Array, Array, Array, Array]:
        """Return the pixels (N, 2), warps (N, 2, 2), ZNCC (N,) and last displacements (N,) [px] after iterations.

        Args:
            image: The image to align with.
            patches: N patches with the predicted warps, to which the prior holds them.
            pixels: (N, 2) Positions before [px].
            warp: (N, 2, 2) Warps before.
            iterations: Number of Gauss-Newton iterations, 1 or more.
            elapsed_s: Time since the image of the predicted warps [s].
        """
        # Templates, and the Hessian with the prior on the change of the warp
        templates, rows = patches.templates, patches.rows
        values, prior_weight = templates.values[rows], templates.prior_weight[rows] * np.float32(WALK_S / elapsed_s)
        H = templates.hessian[rows]
        H[:, WARP, WARP] += prior_weight[:, None]
        H_inverse, predicted_inverse = np.linalg.inv(H), _inverse(patches.warp)
        # The steepest-descent images are large: if most are needed, all are multiplied, and none is copied
        is_copied = 2 * len(rows) < len(templates.values)
        steepest_descent = templates.steepest_descent[rows] if is_copied else templates.steepest_descent
        used = np.arange(len(rows)) if is_copied else rows
        difference = np.zeros((len(steepest_descent), values.shape[1]), np.float32)
        for _ in range(iterations):
            current, _ = _normalized(self._sampled(image, pixels, warp))
            difference[used] = current - values
            gradient = (steepest_descent @ difference[:, :, None])[used, :, 0]
            gradient[:, 2:] += prior_weight[:, None] * (predicted_inverse @ warp - np.eye(2)).reshape(-1, 4)
            step = (H_inverse @ gradient[..., None])[..., 0].astype(np.float64)
            warp_step = np.clip(step[:, 2:], -MAX_WARP_STEP, MAX_WARP_STEP).reshape(-1, 2, 2)
            warp = warp @ _inverse(np.eye(2) + warp_step)
            displacement = np.einsum("nij,nj->ni", warp, step[:, :2])
            pixels = pixels - displacement
        return pixels, warp, np.sum(current * values, axis=1), np.hypot(*displacement.T)

    def compare(
        self, image: Image, noise: float, patches: Patches, pixels: Array
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the ZNCC (N,) of patches with an image at pixels (N, 2), without an alignment, and which resemble it.

        Every second pixel in each direction is compared with the image, which is not blurred, at the predicted warps.

        Args:
            image: The image (H, W).
            noise: Standard deviation of its noise [grey levels].
            patches: N patches with their predicted warps.
            pixels: (N, 2) Positions [px].
        """
        templates, rows = patches.templates, patches.rows
        if not len(rows):  # cv2.remap refuses empty maps
            return np.zeros(0), np.zeros(0, np.bool_)
        values, _ = _normalized(templates.values[rows][:, self._sparse])
        x, y = _warped(self._grid[:, self._sparse], pixels, patches.warp)
        samples = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        current, _ = _normalized(np.asarray(samples, np.float32))
        zncc = np.sum(current * values, axis=1).astype(np.float64)
        noise_loss = (noise * self._config.side_px / templates.norm[rows]) ** 2
        return zncc, zncc > self._config.min_zncc - UNALIGNED_LOSS - noise_loss

    def _sampled(
        self, image: ScaleSpace, pixels: Array, warp: Array | None = None, grid: Array32 | None = None
    ) -> Array32:
        """Return the grey levels (N, P) of an image on warped grids (2, P), by default of patches, at pixels (N, 2)."""
        n, grid = len(pixels), self._grid if grid is None else grid
        if not n:  # cv2.remap refuses empty maps
            return np.zeros((0, grid.shape[1]), np.float32)
        warp = np.tile(np.eye(2), (n, 1, 1)) if warp is None else warp
        level = np.abs(_scale(warp)[:, None] - self._config.scales).argmin(axis=1)
        x, y = _warped(grid, pixels, warp)
        np.clip(y, -MARGIN_PX, image.height - MARGIN_PX - 1, out=y)
        y += (MARGIN_PX + level * image.height).astype(np.float32)[:, None]
        return np.asarray(cv2.remap(image.stack, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def noise_sigma(image: Image) -> float:
    """Return the standard deviation of the noise of an image [grey levels].

    The estimate is the median absolute difference of horizontal neighbours, scaled to a normal distribution.
    """
    rows = image[::NOISE_ROW_STRIDE]
    differences = cv2.absdiff(rows[:, 1:], rows[:, :-1])
    counts = np.cumsum(cv2.calcHist([differences], [0], None, [256], [0, 256]), dtype=np.float64)
    return float(np.searchsorted(counts, 0.5 * counts[-1]) / (MEDIAN_OVER_SIGMA * np.sqrt(2.0)))


def _grid(side_px: int) -> Array32:
    """Return the coordinates (2, P) of the pixels of a square patch relative to its centre, row by row [px]."""
    line = np.arange(side_px, dtype=np.float32) - side_px // 2
    return np.stack(np.meshgrid(line, line), axis=0).reshape(2, -1)


def _warped(grid: Array32, pixels: Array, warp: Array) -> tuple[Array32, Array32]:
    """Return the coordinates (N, P) of grids (2, P) that are warped by (N, 2, 2) around pixels (N, 2) [px]."""
    centre = np.clip(pixels, -MAX_COORDINATE_PX, MAX_COORDINATE_PX).astype(np.float32)
    axes = warp.astype(np.float32)
    x, y = axes[:, 0] @ grid, axes[:, 1] @ grid
    x += centre[:, :1]
    y += centre[:, 1:]
    return x, y


def _scale(warp: Array) -> Array:
    """Return the scales (N,) of warps (N, 2, 2): the square roots of their determinants."""
    return np.asarray(np.sqrt(np.abs(_determinant(warp))))


def _determinant(warp: Array) -> Array:
    """Return the determinants (N,) of warps (N, 2, 2); much faster than `numpy.linalg.det`."""
    return np.asarray(warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0])


def _inverse(warp: Array) -> Array:
    """Return the inverses (N, 2, 2) of regular warps (N, 2, 2); much faster than `numpy.linalg.inv`."""
    adjugate = np.stack([warp[:, 1, 1], -warp[:, 0, 1], -warp[:, 1, 0], warp[:, 0, 0]], axis=1)
    return np.asarray((adjugate / _determinant(warp)[:, None]).reshape(-1, 2, 2))


def _normalized(values: Array32) -> tuple[Array32, Array32]:
    """Return values (N, P) with zero mean and unit norm along P, and the norms (N,) before the division."""
    values = values - values.mean(axis=1, keepdims=True)
    norm = np.maximum(np.sqrt(np.add.reduce(values * values, axis=1)), MIN_NORM)  # faster than `numpy.linalg.norm`
    values /= norm[:, None]
    return values, norm
