"""Synthetic places: points with random descriptors, and keyframes that see them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.map.keyframe import KeyframeFeatures, MapKeyframe
from dronevio.models.arrays import Array
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import exp_so3, inverse_pose, rotation_z

RIG = euroc_rig()
R_LEVEL = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Orientation of EuRoC's IMU on a level vehicle that looks along the world's x axis."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Points in the world and their descriptors."""

    points: Array  # (N, 3)
    descriptors: npt.NDArray[np.uint8]  # (N, 32)


@dataclass(frozen=True)
class Errors:
    """Errors of the measurements of a keyframe."""

    pixel: float = 0.0
    depth: float = 0.0
    scale: float = 0.0
    tilt_rad: float = 0.0
    bits: int = 0
    wrong: float = 0.0  # share of the corners whose descriptors belong to other corners


EXACT = Errors()


def scene(rng: np.random.Generator, count: int = 160, centre: tuple[float, float, float] = (5.0, 0.0, 0.0)) -> Scene:
    """Return random points in a box of 4 x 6 x 4 m."""
    points = np.array(centre) + rng.uniform(-1.0, 1.0, (count, 3)) * [2.0, 3.0, 2.0]
    return Scene(points, rng.integers(0, 256, (count, 32), dtype=np.uint8))


def pose(position: npt.ArrayLike, yaw_rad: float = 0.0, tilt: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Return the pose of an IMU that looks along x, turned by a yaw and a tilt."""
    T = np.eye(4)
    T[:3, :3] = rotation_z(yaw_rad) @ R_LEVEL @ exp_so3(np.asarray(tilt, np.float64))
    T[:3, 3] = position
    return T


def random_pose(rng: np.random.Generator, reach_m: float = 0.4) -> Array:
    """Return a pose near the origin of the scene."""
    return pose(rng.uniform(-reach_m, reach_m, 3), rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1, 3))


def keyframe(
    number: int,
    T_world_imu: Array,
    places: Scene,
    errors: Errors = EXACT,
    rng: np.random.Generator | None = None,
    T_odom_imu: Array | None = None,
    t_s: float | None = None,
    rig: Rig = RIG,
) -> MapKeyframe:
    """Return a keyframe that sees all points in its field of view, and knows their positions."""
    rng = rng or np.random.default_rng(number)
    parts, landmarks = [], []
    scale = 1.0 + errors.scale * rng.standard_normal()
    for index, camera in enumerate(rig.cameras):
        T_cam_world = inverse_pose(T_world_imu @ camera.T_imu_cam)
        p_cam = places.points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        pixels = camera.model.project(p_cam)
        size = [camera.model.width - 1, camera.model.height - 1]
        with np.errstate(invalid="ignore"):
            ids = np.flatnonzero((p_cam[:, 2] > 0.2) & np.all((pixels >= 0) & (pixels <= size), axis=1))
        xy = p_cam[ids, :2] / p_cam[ids, 2:] + errors.pixel / camera.model.fx * rng.standard_normal((len(ids), 2))
        descriptors = places.descriptors[ids].copy()
        flipped = rng.integers(0, 256, (len(ids), errors.bits))
        np.bitwise_xor.at(
            descriptors, (np.arange(len(ids))[:, None], flipped // 8), np.uint8(1) << (flipped % 8).astype(np.uint8)
        )
        is_wrong = rng.random(len(ids)) < errors.wrong
        descriptors[is_wrong] = descriptors[rng.permutation(np.flatnonzero(is_wrong))]
        factor = scale * (1.0 + errors.depth * rng.standard_normal((len(ids), 1)))
        landmarks.append(factor * p_cam[ids] @ camera.T_imu_cam[:3, :3].T + camera.T_imu_cam[:3, 3])
        parts.append((pixels[ids], xy, np.full(len(ids), index), descriptors, ids))
    T_odom = np.array(T_world_imu if T_odom_imu is None else T_odom_imu)
    T_odom[:3, :3] = exp_so3(errors.tilt_rad * rng.standard_normal(3) * [1.0, 1.0, 0.0]) @ T_odom[:3, :3]
    features = KeyframeFeatures(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    ids, first = np.unique(features.landmark, return_index=True)
    t_ns = round((number if t_s is None else t_s) * 1e9)
    return MapKeyframe(number, t_ns, T_odom, features, ids, np.concatenate(landmarks)[first])
