"""World frame in east, north, up and metres from the positions of photographs (GPS) and ground control points.

A robust similarity transformation brings the reconstruction to the measured positions (`positions`), and all
observations are then adjusted together with them. An error that all positions have in common moves the result as a
whole: the images do not show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, RelativePose, adjust
from dronevio.estimator.sfm.config import GpsConfig, SfmConfig, TriangulationConfig
from dronevio.estimator.sfm.model import PositionPriors, Scene, SfmState
from dronevio.estimator.sfm.placement.gauge import transformed
from dronevio.estimator.sfm.placement.positions import (
    CAUCHY_SIGMAS,
    MeasuredPositions,
    PositionAlignment,
    align_with_positions,
)
from dronevio.estimator.sfm.structure import triangulate
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.arrays import Array, Mask
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.georeference import GeoReference, PositionSource
from dronevio.models.image_sets import ImageSet
from dronevio.models.image_sets.control_points import ControlPoints
from dronevio.models.rotation import log_so3

Indices = npt.NDArray[np.int64]
CLICK_SIGMA_PX = 1.0
"""Standard deviation of the pixel of a control point, which a person points at [px]."""
UNKNOWN_SIGMA_M = 1e5
"""Standard deviation of an altitude that is unknown [m]."""
ADJUSTMENTS = 5
"""Largest number of adjustments: with each, the positions may be trusted more."""
PROGRESS = 0.7
"""Ratio of the residuals after and before an adjustment above which no further one is made."""
SETTLED = 1.5
"""Ratio of the residuals to their standard deviations below which the positions are trusted as stated."""
TOLERANCE = 1e-5
"""Relative decrease of the error at which the adjustments stop."""
LINE_RATIO = 0.1
"""Ratio of the extents of positions across and along their main direction below which they are called a line."""


def georeference(
    scene: Scene,
    state: SfmState,
    images: ImageSet,
    config: SfmConfig,
    cauchy_px: float,
    origin: GeodeticPoint,
    rig: Sequence[RelativePose] = (),
) -> tuple[SfmState, GeoReference | str, bool]:
    """Return a reconstruction in east, north, up, how it was placed or why it was not, and whether it is in metres.

    Positions on a line do not determine the rotation about it. The result is then in metres, without a vertical.

    Args:
        scene: The measurements.
        state: The reconstruction, of arbitrary scale unless a rig determines it.
        images: The images with their positions or control points.
        config: Settings.
        cauchy_px: Scale of the Cauchy loss of the adjustment [px].
        origin: Origin of the world frame.
        rig: Known relative poses of images; with them, the scale stays.
    """
    extended, state = _with_control_points(scene, state, images.control_points, config.mapper.triangulation)
    targets = _Targets.of(images, state, origin)
    alignment = align_with_positions(targets.measured(state), bool(rig))
    reason, has_scale = _insufficient(alignment, targets, config.gps)
    if isinstance(alignment, str) or reason:
        if has_scale and not isinstance(alignment, str):
            state = transformed(state, alignment.scale, np.eye(3), np.zeros(3))
        return _without_control_points(state, scene), reason, has_scale or bool(rig)
    # Adjustments with positions that are trusted as far as they agree, from the whole to its parts
    noise_px = state.noise_px(extended)
    for _ in range(ADJUSTMENTS):
        before = alignment.noise_factor
        state = transformed(state, alignment.scale, alignment.R, alignment.t)
        adjustment = BundleAdjustmentConfig(relative_tolerance=TOLERANCE, cauchy_px=cauchy_px)
        priors = targets.priors(before, noise_px)
        state = adjust(extended, state, state.used(extended), adjustment, rig, positions=priors)
        again = align_with_positions(targets.measured(state), bool(rig))
        assert isinstance(again, PositionAlignment)
        alignment = again
        if before < SETTLED or alignment.noise_factor > PROGRESS * before:
            break
    state = transformed(state, alignment.scale, alignment.R, alignment.t)
    return _without_control_points(state, scene), targets.result(extended, state, images.names, alignment, origin), True


def geo_origin(images: ImageSet) -> GeodeticPoint:
    """Return the origin of the world frame of a set: the median of its positions, or else of its control points."""
    if images.geotags is not None and images.geotags.has_position.any():
        return images.geotags.origin
    assert images.control_points is not None
    latitude, longitude, altitude = np.median(images.control_points.geodetic, axis=0).tolist()
    return GeodeticPoint(round(latitude, 6), round(longitude, 6), float(round(altitude)), "unknown")


@dataclass(frozen=True, eq=False)
class _Targets:
    """Measured positions of N registered images and of the control points that are the last G tracks."""

    image: Indices  # (N,)
    cameras_m: Array  # (N, 3)
    camera_sigmas_m: Array  # (N, 3)
    has_altitude: Mask  # (N,)
    R_enu_cam: Array  # (I, 3, 3) NaN where there is none
    points_m: Array  # (G, 3)
    point_sigmas_m: Array  # (G, 3)
    point_names: tuple[str, ...]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, images: ImageSet, state: SfmState, origin: GeodeticPoint) -> "_Targets":
        """Return the targets of the registered images of a set."""
        tags, control = images.geotags, images.control_points
        count = len(images)
        geodetic = np.full((count, 3), np.nan) if tags is None else tags.geodetic.copy()
        sigmas = np.full((count, 3), np.nan) if tags is None else tags.sigmas_m.copy()
        has_altitude = np.isfinite(geodetic[:, 2])
        geodetic[~has_altitude, 2], sigmas[~has_altitude, 2] = origin.altitude_m, UNKNOWN_SIGMA_M
        image = np.flatnonzero(state.is_registered & np.isfinite(geodetic[:, 0]))
        chosen = np.empty(0, np.int64) if control is None else _seen_points(control, state)
        return cls(
            image,
            origin.to_enu(geodetic[image]),
            sigmas[image],
            has_altitude[image],
            np.full((count, 3, 3), np.nan) if tags is None else tags.Rs_enu_cam,
            np.empty((0, 3)) if control is None else origin.to_enu(control.geodetic[chosen]),
            np.empty((0, 3)) if control is None else np.tile(control.sigmas_m[chosen][:, None], 3),
            () if control is None else tuple(control.names[g] for g in chosen),
            _notes(images),
        )

    @property
    def source(self) -> PositionSource:
        """Which positions there are."""
        if not len(self.points_m):
            return "gps"
        return "gps and control points" if len(self.image) else "control points"

    def measured(self, state: SfmState) -> MeasuredPositions:
        """Return the positions of the images and of the triangulated control points of a state."""
        points = state.points[len(state.points) - len(self.points_m) :]
        is_seen = np.isfinite(points[:, 0])
        oriented = np.flatnonzero(state.is_registered & np.isfinite(self.R_enu_cam[:, 0, 0]))
        return MeasuredPositions(
            np.concatenate([state.Ts_world_cam[self.image, :3, 3], points[is_seen]]),
            np.concatenate([self.cameras_m, self.points_m[is_seen]]),
            np.concatenate([self.camera_sigmas_m, self.point_sigmas_m[is_seen]]),
            self.R_enu_cam[oriented] @ np.swapaxes(state.Ts_world_cam[oriented, :3, :3], 1, 2),
        )

    def priors(self, factor: float, noise_px: float) -> PositionPriors:
        """Return the priors of an adjustment in which pixels have a standard deviation of one.

        Args:
            factor: Factor on the standard deviations.
            noise_px: Standard deviation of the pixels as it is.
        """
        weight = factor / noise_px
        cameras, sigmas = np.full((len(self.R_enu_cam), 3), np.nan), np.full((len(self.R_enu_cam), 3), np.nan)
        cameras[self.image], sigmas[self.image] = self.cameras_m, weight * self.camera_sigmas_m
        return PositionPriors(cameras, sigmas, self.points_m, weight * self.point_sigmas_m, CAUCHY_SIGMAS * noise_px)

    def result(
        self, scene: Scene, state: SfmState, names: Sequence[str], alignment: PositionAlignment, origin: GeodeticPoint
    ) -> GeoReference:
        """Return how the state is placed."""
        count, first = len(self.image), len(state.points) - len(self.points_m)
        residuals = alignment.residuals_m[:count].copy()
        residuals[~self.has_altitude, 2] = np.nan
        points = state.points[first:]
        is_seen = np.isfinite(points[:, 0])
        at_points = replace(state, points=np.concatenate([state.points[:first], self.points_m]))
        index = np.flatnonzero((scene.tracks.track >= first) & state.is_registered[scene.tracks.image])
        errors = np.minimum(at_points.errors_px(scene, index), 1e9)
        rows = scene.tracks.track[index] - first
        pixels = np.bincount(rows, minlength=len(points))
        rms = np.sqrt(np.bincount(rows, errors**2, len(points)) / np.maximum(pixels, 1))
        turned = self.measured(state).Rs
        tilts, yaws = (np.empty(0), np.empty(0))
        if len(turned):
            vectors = np.degrees(log_so3(turned))
            tilts, yaws = np.linalg.norm(vectors[:, :2], axis=1), -vectors[:, 2]
        return GeoReference(
            source=self.source,
            origin=origin,
            scale_sigma=alignment.scale_sigma,
            north_sigma_rad=alignment.yaw_sigma_rad,
            tilt_sigma_rad=alignment.tilt_sigma_rad,
            noise_factor=alignment.noise_factor,
            image_names=tuple(names[i] for i in self.image),
            residuals_m=residuals,
            is_outlier=alignment.is_outlier[:count],
            gimbal_deviation_deg=(float(np.median(tilts)), float(np.median(yaws))) if len(turned) else None,
            point_names=tuple(name for name, seen in zip(self.point_names, is_seen, strict=True) if seen),
            point_residuals_m=(self.points_m - points)[is_seen],
            point_errors_px=rms[is_seen],
            point_is_outlier=alignment.is_outlier[count:],
            notes=self.notes,
        )


def _notes(images: ImageSet) -> tuple[str, ...]:
    """Return what was left out of the positions and of the control points."""
    notes = () if images.geotags is None else images.geotags.notes
    control = images.control_points
    if control is not None and control.unknown_images:
        unknown = control.unknown_images
        notes += (f"control points in {len(unknown)} images that are not in the set, such as {unknown[0]}",)
    return notes


def _seen_points(control: ControlPoints, state: SfmState) -> Indices:
    """Return the control points (G,) with pixels in two registered images."""
    seen = np.unique(np.column_stack([control.point, control.image])[state.is_registered[control.image]], axis=0)
    counts = np.bincount(seen[:, 0], minlength=len(control.names)) if len(seen) else np.zeros(len(control.names))
    return np.flatnonzero(counts >= 2)


def _with_control_points(
    scene: Scene, state: SfmState, control: ControlPoints | None, config: TriangulationConfig
) -> tuple[Scene, SfmState]:
    """Return a scene and a state that have control points as further tracks, triangulated if their pixels agree."""
    chosen = np.empty(0, np.int64) if control is None else _seen_points(control, state)
    if control is None or not len(chosen):
        return scene, state
    rows = np.flatnonzero(np.isin(control.point, chosen))
    rows = rows[np.argsort(control.point[rows], kind="stable")]
    track = np.searchsorted(chosen, control.point[rows])
    unused = np.full(len(rows), -1, np.int64)  # they belong to no feature
    sigmas = np.full(len(rows), CLICK_SIGMA_PX / state.noise_px(scene))
    tracks = Tracks(control.image[rows], unused, track)
    alone = replace(scene, tracks=tracks, pixels=control.pixels[rows], sigmas=sigmas)
    start = replace(state, points=np.full((len(chosen), 3), np.nan), is_inlier=np.zeros(len(rows), np.bool_))
    triangulated = triangulate(alone, start, config)
    first = scene.tracks.count
    extended = replace(
        scene,
        tracks=Tracks(
            np.concatenate([scene.tracks.image, tracks.image]),
            np.concatenate([scene.tracks.feature, tracks.feature]),
            np.concatenate([scene.tracks.track, first + track]),
        ),
        pixels=np.concatenate([scene.pixels, alone.pixels]),
        sigmas=np.concatenate([scene.sigmas, sigmas]),
    )
    points = np.concatenate([state.points, triangulated.points])
    return extended, replace(state, points=points, is_inlier=np.concatenate([state.is_inlier, triangulated.is_inlier]))


def _without_control_points(state: SfmState, scene: Scene) -> SfmState:
    """Return a state with the tracks of a scene alone."""
    return replace(state, points=state.points[: scene.tracks.count], is_inlier=state.is_inlier[: len(scene.pixels)])


def _insufficient(alignment: PositionAlignment | str, targets: _Targets, config: GpsConfig) -> tuple[str, bool]:
    """Return why positions do not determine the world frame, empty if they do, and whether they determine the scale."""
    if isinstance(alignment, str):
        return alignment, False
    scale, limit = 100.0 * alignment.scale_sigma, 100.0 * config.max_scale_sigma
    if scale > limit:
        return (
            "the positions are too close together for their errors: the scale has a standard deviation of"
            f" {scale:.0f} %; at most {limit:g} % is allowed"
        ), False
    rotation = float(np.degrees(max(alignment.tilt_sigma_rad, alignment.yaw_sigma_rad)))
    if rotation > config.max_rotation_sigma_deg:
        positions = np.concatenate([targets.cameras_m, targets.points_m])
        extents = np.linalg.svd(positions - np.median(positions, axis=0), compute_uv=False)
        is_line = extents[1] < LINE_RATIO * extents[0]
        why = "the positions are nearly on a line" if is_line else "the positions are too close together"
        limit = config.max_rotation_sigma_deg
        return (
            f"{why}: north or the vertical has a standard deviation of {rotation:.0f}°; at most {limit:g}° is allowed",
            True,
        )
    return "", True
