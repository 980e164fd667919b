"""Finds in a second camera what a first one sees at the same instant.

The relative pose of the two is known, so a feature of the first lies on a line in the second, and its inverse depth
says where (Hartley and Zisserman, "Multiple View Geometry", 2004, ch. 9). Lucas-Kanade starts at the best guess of that
depth, moves freely, and what it finds must lie on the line, before both cameras, and lead back to where it came from.

Where most matches are off their epipolar lines, and a small rotation of the second camera brings them there, the
extrinsic calibration is wrong. Matches are then flagged as miscalibrated: only those that agree with one rotation are
returned, for online calibration to use.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend import klt
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

ROUNDS = 10
"""Of weighted least squares: what changes after them is far below a pixel."""
NOISE_PX = 0.3
"""Distance from its epipolar line that a good match may have by noise alone [px]."""


@dataclass(frozen=True)
class StereoConfig:
    """Settings of the search for matches."""

    window_px: int = 15
    """Side of the patch that is compared [px]."""
    pyramid_levels: int = 3
    """Pyramid levels above the image: a guess may be off by about window/2 · 2^levels pixels."""
    epipolar_px: float = 1.0
    """Largest distance from the epipolar line [px]: tracking error and what calibration leaves."""
    return_px: float = 0.5
    """Largest distance by which the way back may miss the feature [px]."""
    min_depth_m: float = 0.15
    """Nothing that is looked for is nearer [m]."""
    border_px: int = 8
    """Matches nearer to the image's border are not believed [px]."""
    neighbours: int = 3
    """A feature that was never matched is looked for at the median depth of so many that were."""
    turn_sigma_rad: float = 0.02
    """How far a camera may be turned from where it is said to be: standard deviation [rad]. A degree is a bad mount."""
    min_to_judge: int = 20
    """With fewer matches, how the camera is turned cannot be judged, and the last judgement holds."""


@dataclass(frozen=True, eq=False)
class StereoMatches:
    """What was found."""

    rows: npt.NDArray[np.int64]
    """(M,) Which of the features were found."""
    pixels: Array
    """(M, 2) Where in the second image [px]."""
    xy: Array
    """(M, 2) Undistorted and normalized, in the second camera."""
    inverse_depth: Array
    """(M,) One over the distance along the first camera's axis [1/m]; 0 for what is too far to tell."""


class StereoMatcher:
    """Matches from one camera of a rig to another."""

    def __init__(self, first: RigCamera, second: RigCamera, config: StereoConfig) -> None:
        self._config = config
        self._first, self._second = first.model, second.model
        T_second_first = inverse_pose(second.T_imu_cam) @ first.T_imu_cam
        self._R, self._t = T_second_first[:3, :3], T_second_first[:3, 3]
        self.is_miscalibrated = False
        """Whether the last matches contradict where the second camera is said to be."""

    def match(self, first: Image, second: Image, pixels: Array, xy: Array, inverse_depth: Array) -> StereoMatches:
        """Find features in the second image.

        Args:
            first: The first camera's image.
            second: The second camera's image, of the same instant.
            pixels: (N, 2) The features in the first image [px].
            xy: (N, 2) The same, undistorted and normalized.
            inverse_depth: (N,) A guess of one over their distance along the first camera's axis [1/m]; NaN for none.
        """
        guessed = self._second.project(self.seen_from_second(xy, self._guesses(pixels, inverse_depth)))
        looked_for = np.flatnonzero(self._inside(guessed))
        if not len(looked_for):
            return StereoMatches(looked_for, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
        start = pixels[looked_for]
        c, first = self._config, klt.match_brightness(first, second)
        found, there = klt.track(first, second, start, guessed[looked_for], c.window_px, c.pyramid_levels)
        back, returned = klt.track(second, first, found, start, c.window_px, 0)
        there &= returned & (np.linalg.norm(back - start, axis=1) < c.return_px) & self._inside(found)
        rows, found = looked_for[there], found[there]
        bearings = self._second.unproject(found)
        bearings = bearings @ exp_so3(self._turned(xy[rows], bearings)).T
        off_line, depth = self._geometry(xy[rows], bearings)
        with np.errstate(invalid="ignore"):  # NaN, where the lens images nothing, is not believed
            pixel = 1.0 / self._second.fx
            half_pixel_m = 0.5 * pixel / max(float(np.linalg.norm(self._t)), 1e-6)
            right = np.abs(off_line) < self._config.epipolar_px * pixel
            right &= ((depth > -half_pixel_m) & (depth < 1.0 / self._config.min_depth_m)) | self.is_miscalibrated
        xy_second = self._second.normalize(found)
        right &= np.isfinite(xy_second).all(axis=1)
        return StereoMatches(rows[right], found[right], xy_second[right], np.maximum(depth[right], 0.0))

    def seen_from_second(self, xy: Array, inverse_depth: Array) -> Array:
        """Return rays (N, 3) in the second camera of features (N, 2) at some inverse depths (N,) [1/m]."""
        return np.column_stack([xy, np.ones(len(xy))]) @ self._R.T + inverse_depth[:, None] * self._t

    def _guesses(self, pixels: Array, inverse_depth: Array) -> Array:
        """Return the inverse depths (N,), those that are unknown taken from the nearest features that have one."""
        known = np.isfinite(inverse_depth)
        if known.all():
            return inverse_depth
        if not known.any():
            return np.zeros(len(inverse_depth))
        away = np.linalg.norm(pixels[~known, None] - pixels[None, known], axis=2)
        nearest = np.argsort(away, axis=1, kind="stable")[:, : self._config.neighbours]
        guesses = inverse_depth.copy()
        guesses[~known] = np.median(inverse_depth[known][nearest], axis=1)
        return guesses

    def _inside(self, pixels: Array) -> npt.NDArray[np.bool_]:
        border, size = self._config.border_px, np.array([self._second.width, self._second.height])
        with np.errstate(invalid="ignore"):
            return np.asarray(np.all((pixels >= border) & (pixels <= size - 1 - border), axis=1))

    def _geometry(self, xy: Array, bearings: Array) -> tuple[Array, Array]:
        """Return how far bearings (N, 3) are from their epipolar planes (N,) [rad], and inverse depths (N,) [1/m].

        The first has a sign: it says on which side of the plane. The inverse depth ρ turns R f + ρ t towards the
        bearing g: the least squares solution of g × (R f + ρ t) = 0.
        """
        infinite = np.column_stack([xy, np.ones(len(xy))]) @ self._R.T
        off_line = np.sum(self._normals(infinite) * bearings, axis=1)
        across, along = np.cross(bearings, self._t), np.cross(bearings, infinite)
        return off_line, -np.sum(across * along, axis=1) / np.maximum(np.sum(across * across, axis=1), 1e-12)

    def _normals(self, infinite: Array) -> Array:
        """Return the unit normals (N, 3) of the epipolar planes of rays (N, 3) from the second camera to infinity."""
        normals = np.cross(self._t, infinite)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))

    def _turned(self, xy: Array, bearings: Array) -> Array:
        """Return the turn (3,) [rad] that puts most bearings (N, 3) into their epipolar planes; none if they are there.

        To first order a turn ω moves a bearing b off the plane of normal n by ω · (b × n). What fits best, in the sum
        of distances, is found by weighted least squares (Schlossmacher, JASA 1973). About the axis across baseline and
        view, planes hardly tell a turn; it stays near zero.
        """
        c, pixel, none = self._config, 1.0 / self._second.fx, np.zeros(3)
        seen = np.isfinite(bearings).all(axis=1)
        bearings = bearings[seen]
        normals = self._normals(np.column_stack([xy[seen], np.ones(len(bearings))]) @ self._R.T)
        off = np.sum(normals * bearings, axis=1)
        limit = c.epipolar_px * pixel
        if len(off) >= c.min_to_judge:
            self.is_miscalibrated = float(np.median(np.abs(off))) > limit
        if not self.is_miscalibrated:
            return none
        slopes, turn = np.cross(bearings, normals), none
        for _ in range(ROUNDS):
            weights = 1.0 / np.maximum(np.abs(off + slopes @ turn), NOISE_PX * pixel)
            H = (slopes * weights[:, None]).T @ slopes + np.eye(3) * NOISE_PX * pixel / c.turn_sigma_rad**2
            turn = -np.linalg.solve(H, slopes.T @ (weights * off))
        if len(off) >= c.min_to_judge:  # what no turn explains is not the camera's fault
            self.is_miscalibrated = float(np.median(np.abs(off + slopes @ turn))) < limit
        return turn if self.is_miscalibrated else none


GRID = 12  # pixels each way: a share is told to a percent
DEPTHS_M = (1.0, 3.0, 10.0, 1e6)  # what rooms, halls and the sky have


def shared_view(camera: RigCamera, other: RigCamera) -> float:
    """Return what share of a camera's image another one sees too, over all depths: 0 to 1."""
    model = camera.model
    across, down = (np.linspace(0.0, size - 1.0, GRID) for size in (model.width, model.height))
    bearings = model.unproject(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    bearings = bearings[np.isfinite(bearings).all(axis=1)]
    T_other_camera = inverse_pose(other.T_imu_cam) @ camera.T_imu_cam
    points = np.concatenate([depth * bearings for depth in DEPTHS_M]) @ T_other_camera[:3, :3].T
    pixels = other.model.project(points + T_other_camera[:3, 3])
    with np.errstate(invalid="ignore"):  # NaN is nowhere inside
        inside = np.all((pixels > -0.5) & (pixels < [other.model.width - 0.5, other.model.height - 0.5]), axis=1)
    return float(inside.mean()) if len(inside) else 0.0
