"""Geometric verification: whether two keyframes show the same place, and from where.

Landmarks of the old keyframe are matched with corners of the new one, and landmarks of the new one with corners of the
old one. One rigid motion has to explain both: the map of today has to fit the images of then, and the map of then the
images of today. A wrong place may pass in one direction by chance or by repetitive texture, but rarely in both.

The pose is accepted if in each direction enough matches agree with it, if they are spread over the images, if each
direction alone gives the same pose, if it keeps the direction of gravity, if its covariance is small, and if no other
pose explains nearly as many matches. The last test is the one against repetitive texture, where a motion by one period
fits as well.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from dronevio.estimator.backend.observations import NO_OBSERVATIONS, ObservationTable
from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.places.gravity_pose import (
    LevelMatches,
    LevelPoses,
    level_pose_matrix,
    sample_poses,
    squared_errors,
)
from dronevio.estimator.slam.places.matching import Correspondences, DescriptorMatchingConfig, match_landmarks
from dronevio.estimator.slam.places.relative_pose import PoseFit, RelativePoseConfig, Views, refine, whitened_errors
from dronevio.models.arrays import Array, Mask
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import log_so3

FEW_ITERATIONS = 3
"""Number of Gauss-Newton steps where the result only selects matches, or begins close to the solution."""
MAX_ROUNDS = 4
"""Largest number of rounds in which matches are selected and the pose is refined."""
MIN_SPREAD = 0.08
"""Smallest standard deviation of the positions of the agreeing corners in each direction, along the axis in which
they are spread least, in normalized coordinates."""
MAX_POSITION_RATIO = 0.02
"""Tolerance of the position, relative to the median depth of the landmarks."""


@dataclass(frozen=True)
class VerificationConfig(Settings):
    """When two keyframes are accepted as views of one place."""

    matching: DescriptorMatchingConfig = field(default_factory=DescriptorMatchingConfig)
    """Settings of the matching of descriptors."""
    pose: RelativePoseConfig = field(default_factory=RelativePoseConfig)
    """Assumed errors of the measurements."""
    samples: Annotated[int, Range(1, 10_000)] = 150
    """Number of pairs of matches that are drawn in each direction."""
    max_error_px: Annotated[float, Range(0.1, 100.0)] = 4.0
    """Largest reprojection error of a match that agrees with a hypothesis [px]."""
    max_error_sigmas: Annotated[float, Range(0.1, 100.0)] = 3.0
    """Largest error of a match that agrees with the refined pose, in standard deviations."""
    min_inliers: Annotated[int, Range(3, 1000)] = 8
    """Smallest number of matches in each direction that agree with the pose."""
    min_total_inliers: Annotated[int, Range(6, 2000)] = 22
    """Smallest number of matches in both directions together that agree with the pose."""
    min_inlier_ratio: Annotated[float, Range(0.0, 1.0)] = 0.25
    """Smallest share of all matches that agree with the pose."""
    max_competitor_ratio: Annotated[float, Range(0.0, 1.0)] = 0.5
    """Largest number of matches that agree with another pose, relative to those of the accepted one."""
    max_tilt_sigmas: Annotated[float, Range(0.1, 100.0)] = 3.0
    """Largest deviation from the directions of gravity, in standard deviations."""
    max_position_m: Annotated[float, Range(1e-4, 10.0)] = 0.05
    """Tolerance of the position [m], to which a share of the depth is added: a third of it is the largest standard
    deviation, and the whole the largest difference between the poses of the two directions."""
    max_rotation_deg: Annotated[float, Range(0.01, 90.0)] = 1.0
    """Tolerance of the rotation [°], used as that of the position."""
    max_distance_m: Annotated[float, Range(0.01, 1000.0)] = 3.0
    """Largest distance between the two keyframes [m]; beyond it, descriptors of the same corners hardly match."""


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """Two keyframes of one place, and their relative pose."""

    query: int
    """Number of the new keyframe."""
    match: int
    """Number of the old keyframe."""
    T_match_query: Array
    """(4, 4) Pose of the new keyframe's IMU in the IMU frame of the old one."""
    covariance: Array
    """(6, 6) Covariance of δθ (right perturbation, IMU frame of the new keyframe) and δp (IMU frame of the old one)."""
    old_landmarks: int
    """Number of landmarks of the old keyframe that agree with the new images."""
    new_landmarks: int
    """Number of landmarks of the new keyframe that agree with the old images."""
    observations: ObservationTable = NO_OBSERVATIONS
    """Their observations, with standard deviations in pixels."""


@dataclass(frozen=True)
class Rejection:
    """Why two keyframes are not accepted as views of one place."""

    reason: str
    """Name of the test that failed."""


def verify(query: MapKeyframe, match: MapKeyframe, rig: Rig, config: VerificationConfig) -> PlaceMatch | Rejection:
    """Return the relative pose of two keyframes if they show the same place.

    The result is a function of the two keyframes alone: random samples are drawn from a seed made of their numbers.

    Args:
        query: The new keyframe.
        match: The old keyframe.
        rig: The calibration of the cameras.
        config: Settings.
    """
    c = config
    # Landmarks of each keyframe, matched in the other one
    old, new = match_landmarks(match, query, c.matching), match_landmarks(query, match, c.matching)
    if not _are_enough(len(old), len(new), c):
        return Rejection("matches")
    # RANSAC with two points and gravity
    Ts_imu_cam = np.stack([camera.T_imu_cam for camera in rig.cameras])
    focal_px = np.array([camera.model.central_focal_px[0] for camera in rig.cameras])
    views = Views(Ts_imu_cam, focal_px, match.T_odom_imu[:3, :3], query.T_odom_imu[:3, :3])
    depth_m = float(np.median(np.linalg.norm(np.concatenate([old.points, new.points]), axis=1)))
    rng = np.random.default_rng([query.number, match.number])
    consensus = _consensus(old, new, views, depth_m, rng, c)
    if isinstance(consensus, Rejection):
        return consensus
    # Pose by all inliers
    refined = _refined(consensus, old, new, views, c)
    if refined is None:
        return Rejection("inliers")
    pose, is_old, is_new = refined
    # Tests of the result: support, gravity, distance, certainty, and each keyframe's landmarks by themselves
    inliers = int(is_old.sum()), int(is_new.sum())
    if not _are_enough(*inliers, c) or sum(inliers) < c.min_inlier_ratio * (len(old) + len(new)):
        return Rejection("inliers")
    if min(_spread(old.xy[is_old]), _spread(new.xy[is_new])) < MIN_SPREAD:
        return Rejection("spread")
    if pose.tilt_sigmas > c.max_tilt_sigmas:
        return Rejection("gravity")
    if np.linalg.norm(pose.T_match_query[:3, 3]) > c.max_distance_m:
        return Rejection("distance")
    tolerance_m = c.max_position_m + MAX_POSITION_RATIO * depth_m
    tolerance_rad = np.radians(c.max_rotation_deg)
    if not pose.is_certain(tolerance_m / 3.0, tolerance_rad / 3.0):
        return Rejection("covariance")
    if not _directions_agree(pose, old[is_old], new[is_new], views, tolerance_m, tolerance_rad, c):
        return Rejection("directions")
    sigma_px = c.pose.pixel_sigma
    observations = old[is_old].observed_by(query.number, sigma_px) + new[is_new].observed_by(match.number, sigma_px)
    return PlaceMatch(query.number, match.number, pose.T_match_query, pose.covariance, *inliers, observations)


def _are_enough(old: int, new: int, config: VerificationConfig) -> bool:
    """Return whether numbers of matches in both directions are sufficient."""
    return min(old, new) >= config.min_inliers and old + new >= config.min_total_inliers


def _consensus(
    old: Correspondences,
    new: Correspondences,
    views: Views,
    depth_m: float,
    rng: np.random.Generator,
    config: VerificationConfig,
) -> Array | Rejection:
    """Return the pose (4, 4) with the largest consensus, unless another pose has nearly as large a one."""
    forward = _level(old, views, views.R_match, views.R_query)
    backward = _level(new, views, views.R_query, views.R_match)
    from_old = sample_poses(forward, config.samples, rng)
    from_new = sample_poses(backward, config.samples, rng).inverse
    poses = LevelPoses(np.concatenate([from_old.yaw_rad, from_new.yaw_rad]), np.concatenate([from_old.t, from_new.t]))
    if not len(poses):
        return Rejection("hypotheses")
    threshold2 = (config.max_error_px / float(views.focal_px.min())) ** 2
    error2 = np.concatenate([squared_errors(poses, forward), squared_errors(poses.inverse, backward)], axis=1)
    loss = np.minimum(error2 / threshold2, 1.0)
    best = int(np.argmin(loss.sum(axis=1)))
    is_inlier = error2 < threshold2
    if not _are_enough(int(is_inlier[best, : len(old)].sum()), int(is_inlier[best, len(old) :].sum()), config):
        return Rejection("consensus")
    yaw = np.abs(np.angle(np.exp(1j * (poses.yaw_rad - poses.yaw_rad[best]))))
    apart = (np.linalg.norm(poses.t - poses.t[best], axis=1) > 0.1 + 0.1 * depth_m) | (yaw > np.radians(10.0))
    # Matches of the best pose that also agree with a distant one are far away and say nothing about the translation.
    competitors = np.sum(is_inlier & ~is_inlier[best], axis=1)[apart]
    if len(competitors) and competitors.max() > config.max_competitor_ratio * is_inlier[best].sum():
        return Rejection("competitor")
    return level_pose_matrix(float(poses.yaw_rad[best]), poses.t[best], views.R_match, views.R_query)


def _refined(
    T: Array, old: Correspondences, new: Correspondences, views: Views, config: VerificationConfig
) -> tuple[PoseFit, Mask, Mask] | None:
    """Return the refined pose, and which matches of each direction agree with it; None without a solution."""
    pose = refine(T, old, new, views, replace(config.pose, iterations=FEW_ITERATIONS))
    is_old, is_new = np.zeros(len(old), np.bool_), np.zeros(len(new), np.bool_)
    for _ in range(MAX_ROUNDS):
        if pose is None:
            return None
        before = is_old, is_new
        is_old, is_new = _agreeing(pose.T_match_query, old, new, views, config)
        if is_old.sum() + is_new.sum() < 6:
            return None
        if np.array_equal(is_old, before[0]) and np.array_equal(is_new, before[1]):
            break
        pose = refine(pose.T_match_query, old[is_old], new[is_new], views, config.pose)
    return None if pose is None else (pose, is_old, is_new)


def _agreeing(
    T: Array, old: Correspondences, new: Correspondences, views: Views, config: VerificationConfig
) -> tuple[Mask, Mask]:
    """Return which matches of each direction agree with a pose (4, 4)."""
    of_old, of_new = whitened_errors(T, old, new, views, config.pose)
    return of_old < config.max_error_sigmas, of_new < config.max_error_sigmas


def _level(matches: Correspondences, views: Views, R_points: Array, R_observer: Array) -> LevelMatches:
    """Return correspondences in the level frames of the keyframe of the landmarks and of the one of the corners."""
    T = views.Ts_imu_cam[matches.camera]
    rays = np.column_stack([matches.xy, np.ones(len(matches))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    bearings = np.einsum("nij,nj->ni", T[:, :3, :3], rays)
    return LevelMatches(matches.points @ R_points.T, bearings @ R_observer.T, T[:, :3, 3] @ R_observer.T)


def _spread(xy: Array) -> float:
    """Return the standard deviation of points (N, 2) along the axis in which they are spread least."""
    return float(np.sqrt(max(np.linalg.eigvalsh(np.cov(xy.T))[0], 0.0)))


def _directions_agree(
    pose: PoseFit,
    old: Correspondences,
    new: Correspondences,
    views: Views,
    tolerance_m: float,
    tolerance_rad: float,
    config: VerificationConfig,
) -> bool:
    """Return whether each direction alone gives the same pose, within the tolerance."""
    none, few = np.zeros(0, np.int64), replace(config.pose, iterations=FEW_ITERATIONS)
    alone = (
        refine(pose.T_match_query, old, new[none], views, few),
        refine(pose.T_match_query, old[none], new, views, few),
    )
    if alone[0] is None or alone[1] is None:
        return False
    first, second = alone[0].T_match_query, alone[1].T_match_query
    angle_rad = float(np.linalg.norm(log_so3(first[:3, :3].T @ second[:3, :3])))
    return angle_rad <= tolerance_rad and float(np.linalg.norm(first[:3, 3] - second[:3, 3])) <= tolerance_m
