"""The landmarks of the smoother's window: their observations, positions, triangulation and outlier rejection."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import NO_OBSERVATIONS, ObservationTable, observation_table
from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.backend.weighting import group_medians
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array, Integers
from dronevio.models.ranges import Range, Settings

CameraPoses = Mapping[int, tuple[Array, Array]]
"""Orientations (C, 3, 3) and positions (C, 3) of the rig's cameras in the world frame, for each keyframe."""
MAX_OVER_MEDIAN = 5.0
"""Reprojection error beyond which a landmark is an outlier, as a multiple of the median over the landmarks of the same
keyframe, where that is larger than `LandmarkConfig.max_reprojection_px`."""


@dataclass(frozen=True)
class LandmarkConfig(Settings):
    """When a landmark constrains the window."""

    min_views: Annotated[int, Range(2, 100)] = 3
    """Smallest number of observations of a landmark, by one or several cameras."""
    min_keyframes: Annotated[int, Range(1, 100)] = 2
    """Smallest number of keyframes that observe a landmark. Several cameras in one keyframe determine its position, but
    constrain no motion."""
    min_parallax_deg: Annotated[float, Range(0.01, 90.0)] = 0.3
    """Smallest parallax of a landmark [°]. Below it the depth is not observable."""
    min_baseline_m: Annotated[float, Range(low=0.0)] = 0.02
    """Smallest distance between the camera positions that observe a landmark [m]. Below it the parallax of a close
    landmark is rather drift of the tracker."""
    max_distance_m: Annotated[float, Range(0.1, 1e4)] = 60.0
    """Largest depth of a landmark [m]."""
    max_reprojection_px: Annotated[float, Range(above=0.0)] = 6.0
    """Reprojection error beyond which a landmark is an outlier [px], unless `MAX_OVER_MEDIAN` allows more."""


@dataclass(frozen=True, eq=False)
class TriangulatedLandmarks:
    """The landmarks that constrain a window, with their parallax."""

    ids: Integers
    """(N,) Identities of the landmarks, in increasing order."""
    points: Array
    """(N, 3) Positions in the world frame [m]."""
    parallax_rad: Array
    """(N,) Largest angle between the first ray to a landmark and another [rad]."""


class LandmarkDatabase:
    """The observations of a window of keyframes, and the landmarks that are triangulated from them."""

    def __init__(self, focal_px: float, config: LandmarkConfig) -> None:
        """Create an empty database.

        Args:
            focal_px: Focal length, which converts pixels to normalized coordinates [px].
            config: Settings.
        """
        self._config, self._focal_px = config, focal_px
        self._all = NO_OBSERVATIONS  # of triangulated landmarks and of others
        self.ids: Integers = np.zeros(0, np.int64)
        """(L,) Identities of the triangulated landmarks, in increasing order."""
        self._selected = self._all, self.ids, NO_OBSERVATIONS  # a table, landmarks, and the rows of these landmarks
        self.points: Array = np.zeros((0, 3))
        """(L, 3) Positions of the triangulated landmarks in the world frame [m]."""

    def set_points(self, points: Array) -> None:
        """Set the positions (L, 3) of all triangulated landmarks in the world frame [m]."""
        self.points = points

    def add_observations(self, k: int, observations: Observations) -> None:
        """Add the observations of keyframe k."""
        table = observation_table(k, observations)
        self._all += replace(table, earlier=self._all.keyframe_counts(table.landmark))

    @property
    def observations(self) -> ObservationTable:
        """The observations of the triangulated landmarks."""
        if self._selected[0] is not self._all or self._selected[1] is not self.ids:
            self._selected = self._all, self.ids, self._all[np.isin(self._all.landmark, self.ids)]
        return self._selected[2]

    @property
    def all_observations(self) -> ObservationTable:
        """The observations of all landmarks, triangulated or not."""
        return self._all

    def replace_observations(self, observations: ObservationTable) -> None:
        """Replace all observations by others of the same landmarks; those without observations are removed."""
        self._all = observations
        self._remove_unobserved()

    def rows(self, landmarks: npt.ArrayLike) -> Integers:
        """Return the rows of `points` that hold some of the triangulated landmarks."""
        return np.asarray(np.searchsorted(self.ids, np.asarray(landmarks, dtype=np.int64)))

    def positions(self, landmarks: Collection[int]) -> dict[int, Array]:
        """Return the positions (3,) of some of the triangulated landmarks in the world frame [m]."""
        return {i: self.points[row] for i, row in zip(landmarks, self.rows(list(landmarks)), strict=True)}

    def observed_in(self, k: int) -> Integers:
        """Return the identities (N,) of all landmarks that keyframe k observes, triangulated or not, sorted."""
        return np.asarray(np.unique(self._all.landmark[self._all.keyframe == k]))

    def triangulate(self, cameras: CameraPoses, newest: int, *, retriangulate: bool = False) -> Integers:
        """Triangulate the landmarks that have enough observations and parallax.

        Args:
            cameras: Poses of the rig's cameras at each keyframe.
            newest: The keyframe that observes the landmarks to triangulate.
            retriangulate: Whether to triangulate all landmarks again, also those of other keyframes.

        Returns:
            The identities of the outliers, which are removed.
        """
        c, table = self._config, self._all
        if not retriangulate:
            candidates = np.setdiff1d(self.observed_in(newest), self.ids, assume_unique=True)
            table = table[np.isin(table.landmark, candidates)]
        table = table.by_landmark()
        ids, starts, counts = np.unique(table.landmark, return_index=True, return_counts=True)
        is_enough = (counts >= c.min_views) & (_keyframe_counts(table, starts) >= c.min_keyframes)
        table = table[np.repeat(is_enough, counts)]
        ids, counts = ids[is_enough], counts[is_enough]
        if retriangulate:
            self.ids, self.points = np.zeros(0, np.int64), np.zeros((0, 3))
        if len(ids) == 0:
            return ids
        R, p = _camera_poses(table, cameras)
        found = triangulate(np.cumsum(counts) - counts, R, p, table.xy)
        is_observable = (found.parallax_rad > np.radians(c.min_parallax_deg)) & (found.baseline_m > c.min_baseline_m)
        is_observable &= found.in_front & (found.depth_m < c.max_distance_m)
        median = float(np.median(found.rms[is_observable])) if is_observable.any() else 0.0
        is_outlier = is_observable & (np.maximum(found.rms, found.newest) > self._max_error(median))
        self._insert(ids[is_observable & ~is_outlier], found.points[is_observable & ~is_outlier])
        outliers: Integers = ids[is_outlier]
        self.remove(outliers)
        return outliers

    def reject_outliers(self, residual: Array, depth_m: Array, observations: ObservationTable) -> Integers:
        """Remove the landmarks whose reprojection errors are too large, and return their identities.

        The limit scales with the median error of the keyframe: where all errors are large, the pose of the keyframe is
        inaccurate, and not the landmarks.

        Args:
            residual: (N, 2) Residuals of observations of triangulated landmarks, in normalized coordinates.
            depth_m: (N,) Depths of the landmarks [m].
            observations: The observations, N of them.
        """
        if len(observations) == 0:
            return np.zeros(0, np.int64)
        error = np.hypot(*residual.T)
        median = group_medians(observations.keyframe, error)
        outliers = np.unique(observations.landmark[(error > self._max_error(median)) | (depth_m <= 0.0)])
        self.remove(outliers)
        return outliers

    def remove(self, landmarks: Integers) -> None:
        """Remove some landmarks and all their observations."""
        if len(landmarks):
            self._all = self._all[~np.isin(self._all.landmark, landmarks)]
            self._remove_unobserved()

    def remove_keyframe(self, k: int) -> None:
        """Remove the observations of a keyframe, and the landmarks that no other keyframe observes."""
        self._all = self._all[self._all.keyframe != k]
        self._remove_unobserved()

    def triangulated(self, cameras: CameraPoses) -> TriangulatedLandmarks:
        """Return the landmarks that constrain the window.

        Args:
            cameras: Poses of the rig's cameras at each keyframe.
        """
        table = self.observations.by_landmark()
        if len(table) == 0:
            return TriangulatedLandmarks(self.ids, self.points, np.zeros(0))
        row = self.rows(table.landmark)
        keyframes = sorted(cameras)
        p_world_cam = np.stack([cameras[k][1] for k in keyframes])
        x, y, z = (p_world_cam[np.searchsorted(keyframes, table.keyframe), table.camera] - self.points[row]).T
        rays = np.stack([x, y, z]) / np.sqrt(x * x + y * y + z * z)
        starts = np.flatnonzero(np.diff(row, prepend=-1))
        counts = np.diff(np.append(starts, len(table)))
        cosine = np.minimum.reduceat(np.einsum("in,in->n", rays, np.repeat(rays[:, starts], counts, axis=1)), starts)
        return TriangulatedLandmarks(self.ids, self.points, np.arccos(np.clip(cosine, -1.0, 1.0)))

    def _max_error(self, median: Array | float) -> Array:
        """Return the normalized reprojection error of an outlier, where the median of all is given."""
        max_error = self._config.max_reprojection_px / self._focal_px
        return np.maximum(max_error, MAX_OVER_MEDIAN * np.asarray(median))

    def _insert(self, ids: Integers, points: Array) -> None:
        """Add triangulated landmarks."""
        ids, points = np.concatenate([self.ids, ids]), np.concatenate([self.points, points])
        order = np.argsort(ids)
        self.ids, self.points = ids[order], points[order]

    def _remove_unobserved(self) -> None:
        """Remove the positions of landmarks that no keyframe observes any more."""
        is_observed = np.isin(self.ids, self._all.landmark)
        self.ids, self.points = self.ids[is_observed], self.points[is_observed]


def _camera_poses(table: ObservationTable, cameras: CameraPoses) -> tuple[Array, Array]:
    """Return the orientation (N, 3, 3) and position (N, 3) of the camera of each observation."""
    keyframes = np.array(sorted(cameras))
    R = np.stack([cameras[k][0] for k in keyframes.tolist()])
    p = np.stack([cameras[k][1] for k in keyframes.tolist()])
    k = np.searchsorted(keyframes, table.keyframe)
    return R[k, table.camera], p[k, table.camera]


def _keyframe_counts(table: ObservationTable, starts: Integers) -> Integers:
    """Return the number (L,) of keyframes that observe each landmark, in a table sorted by landmark and keyframe."""
    is_new = np.diff(table.keyframe, prepend=-1) != 0
    is_new[starts] = True
    return np.asarray(np.add.reduceat(is_new.astype(np.int64), starts))
