"""Shutter: the light that each row of the sensor integrates while the camera moves.

Row r of H is exposed for the exposure time around ``middle + (r / (H − 1) − ½) readout``: all rows at once with a
global shutter (readout 0), one after the other with a rolling shutter. The light of a row is the mean over its
exposure, which is integrated here as

    light(u) = Σ_s g_s Σ_k w_k(t) I_k(π(R_kᵀ R(t) π⁻¹(u))),   t = the s-th instant within the exposure of u's row,

from few images I_k rendered at key poses. Between them the rotation of the camera is exact, since each key image is
looked up through the camera model π, and the parallax is interpolated: the weights w_k are the hat functions between
the keys, whose spacing keeps the parallax between neighbours small. Of each key image only the required rows are
rendered, and static frames are rendered once. For motion of up to 3 px, instants and weights g_s are those of
Gauss-Legendre quadrature, which has the second and third moment of the blur with two samples; for faster motion, the
instants are evenly spaced.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.imu import Times
from dronevio.models.rig import RigCamera

GreyImage = npt.NDArray[np.uint8]
FloatImage = npt.NDArray[np.float32]
Light = GreyImage | FloatImage

Poses = Callable[[Times], Array]
"""Function from true times (M,) [ns] to camera poses T_world_cam (M, 4, 4)."""
RowView = Callable[[int, slice], GreyImage]
"""Function that renders some rows of `Shutter.drawn` at a true time [ns]."""

LARGEST_TURN_PX = 32
"""Largest image motion by the rotation between two key poses [px]."""
SUPPORT_PX = 2
"""Margin of a key image beyond that motion, for the interpolation [px]."""
_STATIC_BLUR_PX = 0.3  # widens an edge, whose σ is ½ px, by 1.5 %
_STATIC_SKEW_PX = 0.1  # over the whole image, that is ± 0.05 px
_STATIC_PARALLAX_PX = 0.2  # within the readout, that is ± 0.1 px
_KEY_SPACING_PX = 1.5  # parallax between key poses
_SAMPLE_SPACING_PX = 0.75  # image motion between samples of the integral, below the blur of the lens
_GAUSS_SPACING_PX, _MOST_GAUSS = 1.0, 3  # the same, on average, of Gauss-Legendre quadrature and its largest order
_MOST_KEYS, _MOST_SAMPLES = 33, 64
_GRID_PX = 16  # the curvature of the displacement is 1 / f², so bilinear interpolation errs by 1e-3 px


@dataclass(frozen=True, eq=False)
class ExposurePlan:
    """Times at which a frame is rendered and integrated."""

    middle_ns: int
    """True middle of the exposure of the middle row [ns]."""
    keys_ns: Times
    """(K,) Times of the key images [ns]."""
    samples_ns: Times
    """(S,) Sample times of the integral, relative to the middle of the exposure of a row [ns]."""
    weights: Array
    """(S,) Weights of the samples in the integral; their sum is 1."""
    reach_px: int
    """Largest image motion by the rotation between a key pose and the samples looked up in its image [px]."""
    static: bool
    """Whether the frame equals the key image."""


class Shutter:
    """Shutter of one camera of a rig."""

    def __init__(self, camera: RigCamera, margin_px: int = LARGEST_TURN_PX + SUPPORT_PX) -> None:
        """Prepare the look-up grid.

        Args:
            camera: The camera.
            margin_px: Margin of the key images around the image [px]. It bounds the image motion by the rotation
                between two key poses; of a faster rotation, more key images are rendered.
        """
        model = camera.model
        self.drawn: CameraModel = replace(
            model,
            width=model.width + 2 * margin_px,
            height=model.height + 2 * margin_px,
            cx=model.cx + margin_px,
            cy=model.cy + margin_px,
        )
        """The camera model with a margin on all sides."""
        self._model, self._margin_px, self._readout_ns = model, margin_px, camera.readout_s * 1e9
        # The grid points are the pixel centres of `cv2.resize`, one beyond each border.
        self._columns_px, self._rows_px = _grid_px(model.width), _grid_px(model.height)
        u, v = np.meshgrid(self._columns_px, self._rows_px)
        self._grid_px = np.stack([u, v], axis=-1)
        self._bearings = model.unproject(self._grid_px)
        self._largest_turn_px = max(margin_px - SUPPORT_PX, 1)
        self._row_delays_ns = self._delays_ns(np.arange(model.height, dtype=np.float64))

    def plan(
        self, poses: Poses, middle_ns: int, exposure_s: float, nearest_m: float, swept_rad: float = 0.0
    ) -> ExposurePlan:
        """Return the exposure plan of a frame with as few images as its motion allows.

        Args:
            poses: Poses of the camera.
            middle_ns: True middle of the exposure of the middle row [ns].
            exposure_s: Exposure time [s].
            nearest_m: Depth of near surfaces [m]; infinite if there are none.
            swept_rad: Largest motion of moving objects during the exposure as seen from the camera [rad].
        """
        exposure_ns = exposure_s * 1e9
        span_ns = exposure_ns + self._readout_ns
        first, last = poses(np.array([middle_ns - round(0.5 * span_ns), middle_ns + round(0.5 * span_ns)]))
        turn_px = turn_in_pixels(self._model, first, last)
        path_m = float(np.linalg.norm(last[:3, 3] - first[:3, 3]))
        parallax_px = (path_m / nearest_m + swept_rad) * max(self._model.central_focal_px)
        within_exposure = exposure_ns / span_ns
        blur, skew = (share * (turn_px + parallax_px) for share in (within_exposure, 1.0 - within_exposure))
        rolling = (1.0 - within_exposure) * parallax_px > _STATIC_PARALLAX_PX
        spacings = max(parallax_px / _KEY_SPACING_PX, turn_px / self._largest_turn_px)
        # The first and last rows of a rolling shutter require keys of their own; the ends of a blur do not.
        keys = min(int(np.ceil(max(spacings, 1.0))) + rolling, _MOST_KEYS)
        samples, weights = _quadrature(blur)
        return ExposurePlan(
            middle_ns,
            middle_ns + _spread(span_ns, keys, ends=rolling),
            np.rint(exposure_ns * samples).astype(np.int64),
            weights,
            reach_px=int(np.ceil(turn_px / max(keys - rolling, 1))) + SUPPORT_PX,
            static=blur <= _STATIC_BLUR_PX and skew <= _STATIC_SKEW_PX,
        )

    def expose(self, plan: ExposurePlan, poses: Poses, view: RowView) -> Light:
        """Return the light (H, W) that the rows integrate [grey levels]."""
        height, margin = self._model.height, self._margin_px
        if plan.static:
            return view(plan.middle_ns, slice(margin, margin + height))[:, margin : margin + self._model.width]
        weights = self._weights(plan)
        starts_ns = plan.middle_ns + plan.samples_ns
        grid_delays_ns = np.rint(self._delays_ns(self._rows_px)).astype(np.int64)
        R_world_rows = poses((starts_ns[:, None] + grid_delays_ns).ravel())[:, :3, :3]
        R_world_rows = R_world_rows.reshape(len(starts_ns), len(grid_delays_ns), 3, 3)
        light = np.zeros((height, self._model.width), np.float32)
        for key_ns, R_world_key, weight in zip(
            plan.keys_ns.tolist(), poses(plan.keys_ns)[:, :3, :3], weights, strict=True
        ):
            low, high = _extent(weight.any(axis=0))
            drawn = slice(max(low + margin - plan.reach_px, 0), min(high + margin + plan.reach_px, self.drawn.height))
            image = view(key_ns, drawn).astype(np.float32)  # which OpenCV interpolates faster than integers
            for row_weight, R_world_row in zip(weight, R_world_rows, strict=True):
                rows = slice(*_extent(row_weight > 0.0))
                if rows.stop > rows.start:
                    seen = self._looked_up(image, drawn.start, R_world_key.T @ R_world_row, rows)
                    light[rows] += seen * row_weight[rows, None]
        return np.asarray(np.clip(light, 0.0, 255.0, out=light))  # cubic interpolation overshoots

    def _weights(self, plan: ExposurePlan) -> npt.NDArray[np.float32]:
        """Return the weight (K, S, H) of each key image for each row at each sample time."""
        since_ns = plan.samples_ns[:, None] + self._row_delays_ns
        keys_ns = plan.keys_ns - plan.middle_ns
        hats = [np.interp(since_ns, keys_ns, hat) for hat in np.eye(len(keys_ns))]
        return (np.stack(hats) * plan.weights[:, None]).astype(np.float32)

    def _delays_ns(self, rows_px: Array) -> Array:
        """Return the delay of the exposure of each row relative to the middle row [ns]."""
        return _delays_ns(rows_px, self._model.height, self._readout_ns)

    def _looked_up(self, image: FloatImage, first: int, R_key_rows: Array, rows: slice) -> FloatImage:
        """Return rows of the frame looked up in a key image.

        Args:
            image: Rows of the key image, with its margin.
            first: First of these rows.
            R_key_rows: (G, 3, 3) Rotation from the camera at the time of each grid row to the camera at the key.
            rows: Rows of the frame.
        """
        low = (2 * rows.start + 1 + _GRID_PX) // (2 * _GRID_PX)  # grid row at or above the first row
        high = (2 * rows.stop - 1 + _GRID_PX) // (2 * _GRID_PX) + 1
        grid = slice(low, high + 1)
        seen = self.drawn.project(np.einsum("gij,gcj->gci", R_key_rows[grid], self._bearings[grid]))
        seen = np.where(np.isnan(seen), self._grid_px[grid] + self._margin_px, seen) - np.array([0.0, first])
        size = (_GRID_PX * seen.shape[1], _GRID_PX * seen.shape[0])
        top = rows.start - (low - 1) * _GRID_PX
        at = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        at = at[top : top + rows.stop - rows.start, _GRID_PX : _GRID_PX + self._model.width]
        border = cv2.BORDER_REPLICATE
        return np.asarray(cv2.remap(image, at, None, cv2.INTER_CUBIC, borderMode=border))  # type: ignore[call-overload]


def half_span_ns(camera: RigCamera, exposure_s: float) -> int:
    """Return the largest time between the middle of a frame and a pose that `Shutter.expose` requires [ns]."""
    height = camera.model.height
    delays_ns = np.abs(_delays_ns(_grid_px(height), height, camera.readout_s * 1e9))
    return int(np.ceil(0.5e9 * exposure_s + delays_ns.max() + 1e9 * abs(camera.time_offset_s))) + 1


def margin_px(turn_px: float) -> int:
    """Return the margin of the key images for the image motion by the rotation during a frame [px]."""
    return int(np.ceil(min(turn_px, LARGEST_TURN_PX))) + SUPPORT_PX


def turn_in_pixels(model: CameraModel, Ts_world_a: Array, Ts_world_b: Array) -> float:
    """Return the largest image motion by the rotations between poses (…, 4, 4) of a camera [px]."""
    u, v = np.meshgrid(np.linspace(0.0, model.width - 1.0, 3), np.linspace(0.0, model.height - 1.0, 3))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    Rs_b_a = np.swapaxes(Ts_world_b[..., :3, :3], -1, -2) @ Ts_world_a[..., :3, :3]
    seen = model.project(model.unproject(pixels) @ np.swapaxes(Rs_b_a, -1, -2))
    return float(np.max(np.nan_to_num(np.linalg.norm(seen - pixels, axis=-1))))


def _grid_px(size: int) -> Array:
    """Return the coordinates of the look-up grid along an axis of an image with ``size`` pixels [px]."""
    return (np.arange((size - 1) // _GRID_PX + 3, dtype=np.float64) - 0.5) * _GRID_PX - 0.5


def _delays_ns(rows_px: Array, height: int, readout_ns: float) -> Array:
    """Return the delay of the exposure of each row relative to the middle row [ns]."""
    return np.asarray((rows_px / max(height - 1, 1) - 0.5) * readout_ns)


def _quadrature(blur_px: float) -> tuple[Array, Array]:
    """Return the instants (S,) of an exposure from −½ to ½ and their weights (S,) for an image motion [px]."""
    if blur_px <= _STATIC_BLUR_PX:
        return np.zeros(1), np.ones(1)
    if blur_px <= _GAUSS_SPACING_PX * _MOST_GAUSS:
        nodes, weights = np.polynomial.legendre.leggauss(max(2, int(np.ceil(blur_px / _GAUSS_SPACING_PX))))
        return 0.5 * nodes, 0.5 * weights
    count = min(int(np.ceil(blur_px / _SAMPLE_SPACING_PX)), _MOST_SAMPLES)
    return (np.arange(count) + 0.5) / count - 0.5, np.full(count, 1.0 / count)


def _spread(length_ns: float, count: int, ends: bool) -> Times:
    """Return ``count`` times evenly spaced around 0 [ns], including both ends, or at the centres of equal parts."""
    if ends and count > 1:
        return np.rint(np.linspace(-0.5, 0.5, count) * length_ns).astype(np.int64)
    return np.rint(((np.arange(count) + 0.5) / count - 0.5) * length_ns).astype(np.int64)


def _extent(flags: npt.NDArray[np.bool_]) -> tuple[int, int]:
    """Return the index of the first True and the index after the last; 0, 0 if there is none."""
    indices = np.flatnonzero(flags)
    return (int(indices[0]), int(indices[-1]) + 1) if len(indices) else (0, 0)
