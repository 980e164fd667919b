"""What the smoother's window knows of landmarks: who saw each, where it is, and whether it is to be believed."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import NO_OBSERVATIONS, Integers, ObservationTable, observation_table
from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.types import Observations

Array = npt.NDArray[np.float64]
Cameras = Mapping[int, tuple[Array, Array]]
"""Orientations (C, 3, 3) and positions (C, 3) of the rig's cameras in the world, at each keyframe."""


@dataclass(frozen=True)
class LandmarkConfig:
    """When a landmark constrains the window."""

    min_views: int = 3
    """ObservationTable that a landmark needs before it constrains anything, by one camera or several ..."""
    min_keyframes: int = 2
    """... from so many keyframes: several cameras at one instant tell where it is, but nothing of the motion."""
    min_parallax_deg: float = 0.3
    """Angle under which a landmark must have been seen [°]; below, its depth is not observable."""
    min_baseline_m: float = 0.02
    """Distance from which a landmark must have been seen [m]; below, what looks like parallax of something near is
    rather the tracker's drift."""
    max_distance_m: float = 60.0
    """Landmarks beyond are ignored [m]."""
    max_reprojection_px: float = 6.0
    """A landmark seen further than this from where it should be is given up [px] ..."""
    max_over_median: float = 5.0
    """... unless others are off too: then, further than so many times their median."""


@dataclass(frozen=True, eq=False)
class TriangulatedLandmarks:
    """The landmarks that constrain a window, for those who want to know how well they do."""

    ids: Integers
    """(N,) Identities of their features, in increasing order."""
    points: Array
    """(N, 3) Positions in the world [m]."""
    parallax_rad: Array
    """(N,) Largest angle under which each has been seen [rad]."""


class LandmarkDatabase:
    """Keeps the observations of a window of keyframes, and the landmarks that they tell."""

    def __init__(self, focal_px: float, config: LandmarkConfig) -> None:
        """Begin with nothing seen.

        Args:
            focal_px: Focal length, which turns pixels into normalized coordinates.
            config: Settings.
        """
        self._config, self._focal_px = config, focal_px
        self._all = NO_OBSERVATIONS
        self.ids: Integers = np.zeros(0, np.int64)
        """(L,) Identities of the landmarks whose places are known, in increasing order."""
        self.points: Array = np.zeros((0, 3))
        """(L, 3) Their places in the world [m]; whoever optimizes them sets them."""

    def add_observations(self, k: int, observations: Observations) -> None:
        """Add what keyframe k shows."""
        self._all += observation_table(k, observations)

    @property
    def observations(self) -> ObservationTable:
        """The observations of landmarks whose places are known."""
        return self._all[np.isin(self._all.landmark, self.ids)]

    def rows(self, landmarks: npt.ArrayLike) -> Integers:
        """Return the rows of `points` that hold some of the known landmarks."""
        return np.asarray(np.searchsorted(self.ids, np.asarray(landmarks, dtype=np.int64)))

    def positions(self, landmarks: Collection[int]) -> dict[int, Array]:
        """Return the places (3,) of some of the known landmarks [m]."""
        return {i: self.points[row] for i, row in zip(landmarks, self.rows(list(landmarks)), strict=True)}

    def observed_in(self, k: int) -> Integers:
        """Return the identities, sorted, of all that keyframe k shows, known or not."""
        return np.asarray(np.unique(self._all.landmark[self._all.keyframe == k]))

    def triangulate(self, cameras: Cameras, newest: int, *, retriangulate: bool = False) -> Integers:
        """Find the places of landmarks that have been seen often enough by now, and from aside.

        Args:
            cameras: Where the rig's cameras are at each keyframe.
            newest: Only landmarks that this keyframe sees ...
            retriangulate: ... or all, those that are known as well.

        Returns:
            The identities of those that turned out to be wrong; they are let go of.
        """
        c, rows = self._config, self._all.by_landmark()
        if not retriangulate:
            wanted = np.setdiff1d(self.observed_in(newest), self.ids, assume_unique=True)
            rows = rows[np.isin(rows.landmark, wanted)]
        ids, starts, counts = np.unique(rows.landmark, return_index=True, return_counts=True)
        span = rows.keyframe[starts + counts - 1] != rows.keyframe[starts] if c.min_keyframes > 1 else True
        enough = (counts >= c.min_views) & span
        rows = rows[np.repeat(enough, counts)]
        ids, counts = ids[enough], counts[enough]
        if retriangulate:
            self.ids, self.points = np.zeros(0, np.int64), np.zeros((0, 3))
        if len(ids) == 0:
            return ids
        R, p = _views(rows, cameras)
        found = triangulate(np.cumsum(counts) - counts, R, p, rows.xy)
        deep = (found.parallax_rad > np.radians(c.min_parallax_deg)) & (found.baseline_m > c.min_baseline_m)
        deep &= found.in_front & (found.depth_m < c.max_distance_m)
        typical = float(np.median(found.rms[deep])) if deep.any() else 0.0
        wrong = deep & (np.maximum(found.rms, found.newest) > self._limit(typical))
        self._keep(ids[deep & ~wrong], found.points[deep & ~wrong])
        rejected: Integers = ids[wrong]
        self.remove(rejected)
        return rejected

    def reject_outliers(self, error: Array, depth_m: Array, observations: ObservationTable) -> Integers:
        """Let go of the landmarks that are not where they should be, and return their identities.

        Where all that a keyframe shows is off, it is the keyframe that is wrong, and no landmark.

        Args:
            error: (N, 2) Residuals of observations of known landmarks, normalized.
            depth_m: (N,) The landmarks' depths.
            observations: The observations.
        """
        if len(observations) == 0:
            return np.zeros(0, np.int64)
        distance, typical = np.linalg.norm(error, axis=1), np.zeros(len(error))
        for k in np.unique(observations.keyframe).tolist():
            there = observations.keyframe == k
            typical[there] = np.median(distance[there])
        wrong = np.unique(observations.landmark[(distance > self._limit(typical)) | (depth_m <= 0.0)])
        self.remove(wrong)
        return wrong

    def remove(self, landmarks: Integers) -> None:
        """Let go of some landmarks and all their observations."""
        if len(landmarks):
            self._all = self._all[~np.isin(self._all.landmark, landmarks)]
            self._forget_unseen()

    def remove_keyframe(self, k: int) -> None:
        """Let go of what a keyframe shows."""
        self._all = self._all[self._all.keyframe != k]
        self._forget_unseen()

    def triangulated(self, cameras: Cameras) -> TriangulatedLandmarks:
        """Return the landmarks that constrain the window."""
        rows = self.observations.by_landmark()
        if len(rows) == 0:
            return TriangulatedLandmarks(self.ids, self.points, np.zeros(0))
        place = self.rows(rows.landmark)
        rays = _views(rows, cameras)[1] - self.points[place]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        starts = np.flatnonzero(np.diff(place, prepend=-1))
        counts = np.diff(np.append(starts, len(rows)))
        cosine = np.minimum.reduceat(np.sum(rays * np.repeat(rays[starts], counts, axis=0), axis=1), starts)
        return TriangulatedLandmarks(self.ids, self.points, np.arccos(np.clip(cosine, -1.0, 1.0)))

    def _limit(self, typical: Array | float) -> Array:
        """Return the residual beyond which a landmark is wrong, where ``typical`` is usual."""
        c = self._config
        return np.maximum(c.max_reprojection_px / self._focal_px, c.max_over_median * np.asarray(typical))

    def _keep(self, ids: Integers, points: Array) -> None:
        """Add landmarks whose places are known now."""
        ids, points = np.concatenate([self.ids, ids]), np.concatenate([self.points, points])
        order = np.argsort(ids)
        self.ids, self.points = ids[order], points[order]

    def _forget_unseen(self) -> None:
        """Forget the places of landmarks that no keyframe sees any more."""
        seen = np.isin(self.ids, self._all.landmark)
        self.ids, self.points = self.ids[seen], self.points[seen]


def _views(rows: ObservationTable, cameras: Cameras) -> tuple[Array, Array]:
    """Return orientation (N, 3, 3) and position (N, 3) of the camera of each sighting."""
    keyframes = np.array(sorted(cameras))
    R = np.stack([cameras[k][0] for k in keyframes.tolist()])
    p = np.stack([cameras[k][1] for k in keyframes.tolist()])
    k = np.searchsorted(keyframes, rows.keyframe)
    return R[k, rows.camera], p[k, rows.camera]
