"""Points of a reconstruction: triangulation of tracks, removal of outliers, and completion of tracks."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.config import TriangulationConfig
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.estimator.sfm.triangulation import triangulate_tracks, widest_angles
from dronevio.models.arrays import Mask

Indices = npt.NDArray[np.int64]

REPAIR_ERROR_PX = 1.0
"""Reprojection error above which a point is triangulated again after an adjustment without it [px]."""


def triangulate(
    scene: Scene,
    state: SfmState,
    config: TriangulationConfig,
    again: Mask | None = None,
    tracks: Indices | None = None,
) -> SfmState:
    """Triangulate tracks without a point.

    Args:
        scene: The measurements.
        state: The reconstruction.
        config: Thresholds.
        again: (T,) Tracks that are triangulated although they have a point; None for none.
        tracks: The tracks that are considered, in increasing order; None for all.
    """
    wanted = ~state.has_point if again is None else ~state.has_point | again
    index = _observations(scene, tracks)
    index = index[state.is_registered[scene.tracks.image[index]] & wanted[scene.tracks.track[index]]]
    bearings = state.bearings(scene, index)
    is_defined = np.isfinite(bearings[:, 0])
    index, bearings = index[is_defined], bearings[is_defined]
    observations = np.bincount(scene.tracks.track[index], minlength=scene.tracks.count)
    enough = observations[scene.tracks.track[index]] >= 2
    index, bearings = index[enough], bearings[enough]
    ids, track = np.unique(scene.tracks.track[index], return_inverse=True)
    T = state.Ts_world_cam[scene.tracks.image[index]]
    triangulation = triangulate_tracks(
        track.astype(np.int64),
        T[:, :3, 3],
        np.einsum("mij,mj->mi", T[:, :3, :3], bearings),
        state.focal_px(scene, index),
        config,
        np.random.default_rng(0),
    )
    points, is_inlier = state.points.copy(), state.is_inlier.copy()
    points[ids], is_inlier[index] = triangulation.points, triangulation.is_inlier
    return replace(state, points=points, is_inlier=is_inlier)


def repair(scene: Scene, state: SfmState, config: TriangulationConfig) -> SfmState:
    """Triangulate again the points that no longer agree with their observations, after an adjustment without them."""
    index = np.flatnonzero(state.used(scene))
    worst = np.zeros(scene.tracks.count)
    np.maximum.at(worst, scene.tracks.track[index], state.errors_px(scene, index))
    return triangulate(scene, state, config, worst > REPAIR_ERROR_PX)


def remove_outliers(
    scene: Scene, state: SfmState, config: TriangulationConfig, tracks: Indices | None = None
) -> SfmState:
    """Remove outliers, and points with fewer than two observations or too small an angle.

    Args:
        scene: The measurements.
        state: The reconstruction.
        config: Thresholds.
        tracks: The tracks that are considered, in increasing order; None for all.
    """
    observed = _observations(scene, tracks)
    index = observed[state.used(scene, observed)]
    index = index[state.errors_px(scene, index) <= config.max_error_px]
    ids, track = np.unique(scene.tracks.track[index], return_inverse=True)
    keep = np.ones(scene.tracks.count, np.bool_)
    keep[slice(None) if tracks is None else tracks] = False
    if len(index):
        counts = np.bincount(track)
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        origins = state.Ts_world_cam[scene.tracks.image[index], :3, 3]
        angles = widest_angles(track, starts, state.points[ids], origins, np.ones(len(index), np.bool_))
        keep[ids] = (counts >= 2) & (angles >= np.radians(config.min_angle_deg))
    is_inlier = state.is_inlier.copy()
    is_inlier[observed] = False
    is_inlier[index] = keep[scene.tracks.track[index]]
    return replace(state, points=np.where(keep[:, None], state.points, np.nan), is_inlier=is_inlier)


def _observations(scene: Scene, tracks: Indices | None) -> Indices:
    """Return the observations of some tracks, of all if None."""
    return np.arange(len(scene.pixels)) if tracks is None else scene.tracks.of_tracks(tracks)


def complete(scene: Scene, state: SfmState, config: TriangulationConfig) -> SfmState:
    """Triangulate tracks without a point, and add observations that agree with the point of their track."""
    state = triangulate(scene, state, config)
    index = np.flatnonzero(
        ~state.is_inlier & state.is_registered[scene.tracks.image] & state.has_point[scene.tracks.track]
    )
    is_inlier = state.is_inlier.copy()
    is_inlier[index] = state.errors_px(scene, index) <= config.max_error_px
    return replace(state, is_inlier=is_inlier)
