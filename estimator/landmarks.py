"""What the smoother's window knows of landmarks: which keyframes saw each, and how far it is to be trusted."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend import Observations
from dronevio.estimator.triangulation import Triangulation, triangulate

Array = npt.NDArray[np.float64]
Cameras = Mapping[int, tuple[Array, Array]]
"""Orientations (C, 3, 3) and positions (C, 3) of the rig's cameras in the world, at each keyframe."""


@dataclass(frozen=True)
class LandmarkConfig:
    """When a landmark constrains the window, and how strongly."""

    pixel_sigma: float = 0.8
    """Standard deviation of an image measurement [px]: tracking error and what calibration leaves."""
    min_views: int = 3
    """Sightings that a landmark needs before it constrains anything, by one camera or several ..."""
    min_keyframes: int = 2
    """... from so many keyframes: several cameras at one instant tell where it is, but nothing of the motion."""
    min_parallax_deg: float = 0.3
    """Angle under which a landmark must have been seen [°]; below, its depth is not observable and iSAM2 fails."""
    min_baseline_m: float = 0.02
    """Distance from which a landmark must have been seen [m]; below, what looks like parallax of something near is
    rather the tracker's drift."""
    max_reprojection_px: float = 6.0
    """A landmark seen further than this from where it should be is given up [px] ..."""
    max_over_median: float = 5.0
    """... unless others are off too: then, further than so many times their median."""
    chunk_s: float = 4.0
    """A landmark that is seen for longer starts again as a new one [s]. Were it not shorter than the smoother's lag,
    those that were first seen together would be absorbed into the prior together, and leave nothing to hold on to."""


@dataclass(eq=False)
class Track:
    """The sightings of one landmark that share a factor."""

    id: int
    keyframes: list[int] = field(default_factory=list)  # of each sighting, in time order
    cameras: list[int] = field(default_factory=list)  # of each sighting
    xy: list[Array] = field(default_factory=list)
    sigma: float = 0.0  # of its sightings, normalised
    point: Array | None = None  # (3,) position in the world, once triangulated
    parallax_rad: float = 0.0  # largest angle between its sightings
    slot: int | None = None  # where its factor stands in the solver; None while there is none

    def see(self, k: int, camera: int, xy: Array) -> None:
        """Add a sighting."""
        self.keyframes.append(k)
        self.cameras.append(camera)
        self.xy.append(xy)


@dataclass(frozen=True, eq=False)
class KnownLandmarks:
    """The landmarks that constrain a window, for those who want to know how well they do."""

    ids: npt.NDArray[np.int64]
    """(N,) Identities of their features, in increasing order."""
    points: Array
    """(N, 3) Positions in the world [m]."""
    parallax_rad: Array
    """(N,) Largest angle under which each has been seen [rad]."""


class LandmarkWindow:
    """Keeps the tracks of a window of keyframes."""

    def __init__(self, focal_px: float, config: LandmarkConfig) -> None:
        self._config = config
        self._focal_px = focal_px
        self._tracks: dict[int, Track] = {}
        self._times_s: dict[int, float] = {}

    def observe(self, k: int, t_s: float, observations: Observations) -> None:
        """Add the sightings of keyframe k."""
        self._times_s[k] = t_s
        for track_id, camera, xy in zip(
            observations.ids.tolist(), observations.camera.tolist(), observations.xy, strict=True
        ):
            track = self._tracks.get(track_id)
            if track is None or t_s - self._times_s[track.keyframes[0]] > self._config.chunk_s:
                track = self._tracks[track_id] = Track(track_id)
            track.see(k, camera, xy)
        matches = observations.matches
        for track_id, camera, xy in zip(matches.ids.tolist(), matches.camera.tolist(), matches.xy, strict=True):
            self._tracks[track_id].see(k, camera, xy)

    def judge(self, cameras: Cameras, seen_from: int | None = None) -> tuple[list[Track], list[Track]]:
        """Triangulate, and say which tracks may constrain the window, and which are wrong.

        The weight of a track falls with its reprojection error, as that of a residual does under Cauchy's robust loss:
        factors are made anew with every keyframe, which makes this iteratively reweighted least squares.

        Args:
            cameras: Where the rig's cameras are at each keyframe.
            seen_from: Only the tracks that this keyframe sees; None for all.
        """
        c = self._config
        seen = [
            track
            for track in self._tracks.values()
            if len(track.keyframes) >= c.min_views
            and track.keyframes[-1] - track.keyframes[0] >= c.min_keyframes - 1
            and seen_from in (None, track.keyframes[-1])
        ]
        if not seen:
            return [], []
        found = _triangulate(seen, cameras)
        deep = (found.parallax_rad > np.radians(c.min_parallax_deg)) & (found.baseline_m > c.min_baseline_m)
        typical = float(np.median(found.rms[deep])) if deep.any() else 0.0
        limit = max(c.max_reprojection_px / self._focal_px, c.max_over_median * typical)
        wrong = deep & (~found.in_front | (np.maximum(found.rms, found.newest) > limit))
        sigma = c.pixel_sigma / self._focal_px
        sigmas = sigma * np.sqrt(1.0 + (found.rms / max(sigma, 2.0 * typical)) ** 2)
        angles = found.parallax_rad.tolist()
        for track, point, track_sigma, angle in zip(seen, found.points, sigmas.tolist(), angles, strict=True):
            track.point, track.sigma, track.parallax_rad = point, track_sigma, angle
        useful = [track for track, yes in zip(seen, (deep & ~wrong).tolist(), strict=True) if yes]
        return useful, [track for track, yes in zip(seen, wrong.tolist(), strict=True) if yes]

    def typical_error(self, cameras: Cameras) -> float:
        """Return the median reprojection error of the tracks that constrain the window; infinite if none does."""
        used = [track for track in self._tracks.values() if track.slot is not None]
        return float(np.median(_triangulate(used, cameras).rms)) if used else float("inf")

    def drop(self, tracks: Iterable[Track]) -> None:
        """Let go of tracks."""
        for track in tracks:
            del self._tracks[track.id]

    def forget_before(self, oldest: int, newest: int) -> None:
        """Let go of the keyframes before ``oldest``.

        A factor whose oldest keyframe was marginalised has been absorbed whole into the prior. Its track begins anew,
        so that no sighting counts twice.
        """
        self._times_s = {k: t_s for k, t_s in self._times_s.items() if k >= oldest}
        for track in list(self._tracks.values()):
            if track.keyframes[0] >= oldest:
                continue
            kept = [i for i, k in enumerate(track.keyframes) if k >= oldest] if track.slot is None else []
            track.keyframes = [track.keyframes[i] for i in kept]
            track.cameras = [track.cameras[i] for i in kept]
            track.xy = [track.xy[i] for i in kept]
            track.slot = None
            if not kept or track.keyframes[-1] < newest:
                del self._tracks[track.id]

    def move_slots(self, new_slots: Mapping[int, int]) -> None:
        """Follow factors to other places in the solver."""
        for track in self._tracks.values():
            if track.slot is not None:
                track.slot = new_slots[track.slot]

    def known(self) -> KnownLandmarks:
        """Return the landmarks that constrain the window."""
        used = [t for t in self._tracks.values() if t.slot is not None and t.point is not None]
        tracks = sorted(used, key=lambda track: track.id)
        return KnownLandmarks(
            np.array([track.id for track in tracks], dtype=np.int64),
            np.array([track.point for track in tracks]).reshape(-1, 3),
            np.array([track.parallax_rad for track in tracks], dtype=np.float64),
        )

    def points(self) -> Array:
        """Return the positions (N, 3) of the landmarks that constrain the window [m]."""
        points = [track.point for track in self._tracks.values() if track.slot is not None and track.point is not None]
        return np.array(points).reshape(-1, 3)


def _triangulate(tracks: Sequence[Track], cameras: Cameras) -> Triangulation:
    counts = np.array([len(track.keyframes) for track in tracks])
    sightings = [(k, c) for track in tracks for k, c in zip(track.keyframes, track.cameras, strict=True)]
    Rs = np.array([cameras[k][0][c] for k, c in sightings])
    ps = np.array([cameras[k][1][c] for k, c in sightings])
    xy = np.array(list(chain.from_iterable(track.xy for track in tracks)))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return triangulate(starts, Rs, ps, xy)
