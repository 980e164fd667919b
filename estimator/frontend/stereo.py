"""Stereo matching: features of one camera of a rig are matched in a second camera.

The relative pose of the two cameras is known, so at one instant a feature of the first camera lies on its epipolar line
in the second, at a position that depends on its inverse depth (Hartley and Zisserman, "Multiple View Geometry", 2004,
ch. 9).
Lucas-Kanade tracking starts at an estimate of that depth and is not constrained to the line. A match is accepted if it
lies close to the line, has a positive depth in the allowed range, and leads back to the feature when tracked backwards.

Where most matches are off their epipolar lines, and a small rotation of the second camera moves them there, the
extrinsic calibration is wrong. Matches are then flagged as miscalibrated: only those that agree with one rotation are
returned, for online calibration to use.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend import klt
from dronevio.estimator.frontend.common_scale import CommonScale
from dronevio.estimator.frontend.protocol import is_inside
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array, Image
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import cross, exp_so3, inverse_pose

ITERATIONS = 10
"""Number of iterations of weighted least squares; later ones change residuals by far less than a pixel."""
MIN_SHARE = 0.1
"""Smallest share of the features in view of the second camera that are matched. Fewer agree by chance, where an error
of the calibration leads the search elsewhere; with real images, a third is matched at least."""
NOISE_PX = 0.3
"""Distance of a correct match from its epipolar line that noise alone explains [px]."""


@dataclass(frozen=True)
class StereoConfig(Settings):
    """Settings of the stereo matching."""

    window_px: Annotated[int, Range(5, 41, odd=True)] = 15
    """Side of the patch that is compared [px]."""
    pyramid_levels: Annotated[int, Range(0, 6)] = 3
    """Number of pyramid levels above the image; the predicted position may be off by about window/2 · 2^levels [px]."""
    max_epipolar_error_px: Annotated[float, Range(above=0.0)] = 1.0
    """Largest distance of a match from its epipolar line [px], due to tracking and to residual calibration errors."""
    max_backward_error_px: Annotated[float, Range(above=0.0)] = 0.5
    """Largest distance between a feature and its match tracked back into the first image [px]."""
    min_depth_m: Annotated[float, Range(above=0.0)] = 0.15
    """Smallest depth of a match in the first camera [m]."""
    border_px: Annotated[int, Range(1, 200)] = 8
    """Smallest distance of a match from the border of the image [px]."""
    neighbours: Annotated[int, Range(1, 100)] = 3
    """Number of features with a known depth, nearest in the image, whose median predicts an unknown depth."""
    rotation_sigma_rad: Annotated[float, Range(above=0.0, high=1.0)] = 0.02
    """Prior standard deviation of an error in the relative orientation of the cameras [rad]; a bad mount errs by 1°."""
    min_matches: Annotated[int, Range(1, 10_000)] = 20
    """Number of matches from which on the calibration is checked; with fewer, the last result is kept."""


@dataclass(frozen=True, eq=False)
class StereoMatches:
    """The features that were matched in the second camera."""

    rows: npt.NDArray[np.int64]
    """(M,) Indices of the matched features among those of the first camera."""
    pixels: Array
    """(M, 2) Positions in the second image [px]."""
    xy: Array
    """(M, 2) Undistorted, normalized coordinates in the second camera, by the given intrinsics."""
    inverse_depth: Array
    """(M,) Inverse depths along the optical axis of the first camera [1/m]; 0 where no parallax is measurable."""


class StereoMatcher:
    """Matches features from one camera of a rig to another."""

    def __init__(self, calibration: Calibration, first: int, second: int, config: StereoConfig) -> None:
        """Derive the relative pose of two cameras.

        Args:
            calibration: The calibration of the rig.
            first: Index of the camera whose features are matched.
            second: Index of the camera in which they are searched.
            config: Settings.
        """
        self._config, self._calibration, self._index = config, calibration, second
        model, second_model = (calibration.rig.cameras[i].model for i in (first, second))
        self._second, self._scale = second_model, CommonScale(model, second_model)
        focal_px = second_model.central_focal_px[0] * float(self._scale.second.scale[0])
        self._pixel = 1.0 / focal_px  # of the coarser image
        T_second_first = inverse_pose(calibration.Ts_imu_cam[second]) @ calibration.Ts_imu_cam[first]
        self._R, self._t = T_second_first[:3, :3], T_second_first[:3, 3]
        self.is_miscalibrated = False
        """Whether the last matches contradict the relative orientation of the cameras."""

    def match(self, first: Image, second: Image, pixels: Array, xy: Array, inverse_depth: Array) -> StereoMatches:
        """Search features in the second image.

        Args:
            first: Image of the first camera.
            second: Image of the second camera.
            pixels: (N, 2) Positions of the features in the first image [px].
            xy: (N, 2) Undistorted, normalized coordinates of the features in the first camera when the second one is
                exposed, by the calibration in use.
            inverse_depth: (N,) Predicted inverse depths along the first camera's optical axis [1/m]; NaN where unknown.

        Returns:
            The accepted matches, in the order of the features.
        """
        # Prediction by the known or the median inverse depth
        rays = self.rays_in_second(xy, self._filled(pixels, inverse_depth))
        predicted = self._second.project(self._calibration.given_rays(rays, self._index))
        candidates = np.flatnonzero(is_inside(predicted, self._second, self._config.border_px))
        if not len(candidates):
            return StereoMatches(candidates, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
        # Lucas-Kanade from the prediction and back, at a common scale
        c, scale = self._config, self._scale
        first, second = scale.images(klt.match_brightness(first, second), second)
        start, target = scale.first.pixels(pixels[candidates]), scale.second.pixels(predicted[candidates])
        matched, is_tracked = klt.track(first, second, start, target, c.window_px, c.pyramid_levels)
        back, returned = klt.track(second, first, matched, start, c.window_px, 0)
        is_tracked &= returned & (np.linalg.norm(back - start, axis=1) < c.max_backward_error_px)
        matched = scale.second.restored(matched)
        is_tracked &= is_inside(matched, self._second, c.border_px)
        rows, matched = candidates[is_tracked], matched[is_tracked]
        # Rotation of the second camera that is missing in the calibration
        xy_second = self._second.normalize(matched)
        corrected = self._calibration.corrected_xy(xy_second, np.full(len(xy_second), self._index))
        bearings = np.column_stack([corrected, np.ones(len(corrected))])
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        bearings = bearings @ exp_so3(self._rotation_correction(xy[rows], bearings)).T
        # Matches near their epipolar lines at an allowed depth
        epipolar_error, depth = self._geometry(xy[rows], bearings)
        with np.errstate(invalid="ignore"):  # pixels outside the lens model have NaN bearings and are rejected
            pixel = self._pixel
            half_pixel_m = 0.5 * pixel / max(float(np.linalg.norm(self._t)), 1e-6)
            valid = np.abs(epipolar_error) < self._config.max_epipolar_error_px * pixel
            valid &= ((depth > -half_pixel_m) & (depth < 1.0 / self._config.min_depth_m)) | self.is_miscalibrated
        valid &= np.isfinite(xy_second).all(axis=1)
        valid &= valid.sum() >= MIN_SHARE * len(candidates)
        return StereoMatches(rows[valid], matched[valid], xy_second[valid], np.maximum(depth[valid], 0.0))

    def rays_in_second(self, xy: Array, inverse_depth: Array) -> Array:
        """Return rays (N, 3) in the second camera to features (N, 2) of the first at inverse depths (N,) [1/m]."""
        return np.asarray(np.column_stack([xy, np.ones(len(xy))]) @ self._R.T + inverse_depth[:, None] * self._t)

    def _filled(self, pixels: Array, inverse_depth: Array) -> Array:
        """Return inverse depths (N,) in which unknown values are the median of those of the nearest features."""
        known = np.isfinite(inverse_depth)
        if known.all():
            return inverse_depth
        if not known.any():
            return np.zeros(len(inverse_depth))
        (x, y), (x_known, y_known) = pixels[~known].T, pixels[known].T
        squared_px = (x[:, None] - x_known) ** 2 + (y[:, None] - y_known) ** 2
        count = min(self._config.neighbours, len(x_known))
        nearest = np.argpartition(squared_px, count - 1, axis=1)[:, :count]
        filled = inverse_depth.copy()
        filled[~known] = np.median(inverse_depth[known][nearest], axis=1)
        return filled

    def _geometry(self, xy: Array, bearings: Array) -> tuple[Array, Array]:
        """Return signed angles (N,) of bearings (N, 3) to their epipolar planes [rad], and inverse depths (N,) [1/m].

        The inverse depth ρ aligns R f + ρ t with the bearing g: it is the least-squares solution of
        g × (R f + ρ t) = 0.
        """
        infinite = np.column_stack([xy, np.ones(len(xy))]) @ self._R.T
        epipolar_error = np.sum(self._normals(infinite) * bearings, axis=1)
        across, along = cross(bearings, self._t), cross(bearings, infinite)
        return epipolar_error, -np.sum(across * along, axis=1) / np.maximum(np.sum(across * across, axis=1), 1e-12)

    def _normals(self, infinite: Array) -> Array:
        """Return the unit normals (N, 3) of the epipolar planes of rays (N, 3) from the second camera to infinity."""
        normals = cross(self._t, infinite)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))

    def _rotation_correction(self, xy: Array, bearings: Array) -> Array:
        """Return the rotation vector (3,) [rad] that moves most bearings (N, 3) into their epipolar planes.

        It is zero where they are there already, or where no rotation moves them there. To first order, a rotation ω
        moves a bearing b off the plane of normal n by ω · (b × n). The minimum of the sum of absolute distances is
        found by iteratively reweighted least squares (Schlossmacher, JASA 1973). The rotation about the axis
        perpendicular to baseline and optical axis is hardly observable from epipolar distances; the prior keeps it
        close to zero.
        """
        c, pixel, zero = self._config, self._pixel, np.zeros(3)
        finite = np.isfinite(bearings).all(axis=1)
        bearings = bearings[finite]
        normals = self._normals(np.column_stack([xy[finite], np.ones(len(bearings))]) @ self._R.T)
        errors = np.sum(normals * bearings, axis=1)
        limit = c.max_epipolar_error_px * pixel
        if len(errors) >= c.min_matches:
            self.is_miscalibrated = float(np.median(np.abs(errors))) > limit
        if not self.is_miscalibrated:
            return zero
        jacobian, rotation = cross(bearings, normals), zero
        for _ in range(ITERATIONS):
            weights = 1.0 / np.maximum(np.abs(errors + jacobian @ rotation), NOISE_PX * pixel)
            prior = np.eye(3) * NOISE_PX * pixel / c.rotation_sigma_rad**2
            H = (jacobian * weights[:, None]).T @ jacobian + prior
            rotation = -np.linalg.solve(H, jacobian.T @ (weights * errors))
        if len(errors) >= c.min_matches:  # errors that no rotation explains have another cause
            self.is_miscalibrated = float(np.median(np.abs(errors + jacobian @ rotation))) < limit
        return rotation if self.is_miscalibrated else zero


GRID = 12  # points in each direction; the share is accurate to about one percent
DEPTHS_M = (1.0, 3.0, 10.0, 1e6)  # typical depths in rooms and halls, and infinity


def shared_view(camera: RigCamera, other: RigCamera) -> float:
    """Return the share of a camera's image, from 0 to 1, that another camera also observes, averaged over depths."""
    model = camera.model
    columns, rows = (np.linspace(0.0, size - 1.0, GRID) for size in (model.width, model.height))
    bearings = model.unproject(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    bearings = bearings[np.isfinite(bearings).all(axis=1)]
    T_other_camera = inverse_pose(other.T_imu_cam) @ camera.T_imu_cam
    points = np.concatenate([depth * bearings for depth in DEPTHS_M]) @ T_other_camera[:3, :3].T
    pixels = other.model.project(points + T_other_camera[:3, 3])
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false: such points are not inside
        inside = np.all((pixels > -0.5) & (pixels < [other.model.width - 0.5, other.model.height - 0.5]), axis=1)
    return float(inside.mean()) if len(inside) else 0.0
