"""The truth of dense maps: points of surfaces and of free space that the camera of a simulated flight saw."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.recordings.scenario_file import world_of
from dronevio.models.rig import RigCamera
from dronevio.models.state import Trajectory
from dronevio.sim.ray_casting import RayCaster, surface_points

NEAR_PATH_M = 2.0
"""Largest distance from the path of the surface samples [m]."""
_GRID = 28, 20  # rays a frame, each displaced at random within its cell
_SPACING_M = 0.03  # of the points of the surface


@dataclass(frozen=True, eq=False)
class SeenSpace:
    """What a camera saw in the static world, as random points in the world frame [m]."""

    surface: Array
    """(N, 3) Points of surfaces within range and near the path, once for each ray that ended there."""
    surface_ns: Times
    """(N,) Times at which they were seen [ns]."""
    free: Array
    """(M, 3) Points of free space between the camera and the surfaces, within range."""
    all_surface: Array
    """(K, 3) Dense points of all static surfaces around the path, seen or not."""


def seen_space(folder: Path, truth: Trajectory, camera: RigCamera, t_ns: Times, range_m: float) -> SeenSpace:
    """Return what the camera of a simulated flight saw at some of its frames.

    Args:
        folder: Recording of the flight, which names its world.
        truth: True trajectory of the IMU.
        camera: The camera.
        t_ns: (F,) Times of the frames [ns].
        range_m: Largest depth along the optical axis [m].

    Raises:
        InputError: The folder holds no simulated flight.
    """
    world, seed = world_of(folder)
    rng = np.random.default_rng(0)
    caster, path = RayCaster(world, seed), cKDTree(truth.p_world_imu)
    true, rows = interpolate(truth, t_ns)
    surface, seen_ns, free = [], [], []
    for T_world_imu, t in zip(true.Ts_world_imu, t_ns[rows], strict=True):
        T_world_cam = T_world_imu @ camera.T_imu_cam
        bearings = random_bearings(camera, rng)
        ranges = caster.ranges_m(T_world_cam[None], bearings, 3.0 * range_m)[0]
        limit = range_m / bearings[:, 2]
        rays = bearings @ T_world_cam[:3, :3].T
        hit = ranges <= limit
        points = T_world_cam[:3, 3] + ranges[hit, None] * rays[hit]
        near = path.query(points, distance_upper_bound=NEAR_PATH_M)[0] <= NEAR_PATH_M
        surface.append(points[near])
        seen_ns.append(np.full(int(near.sum()), t))
        share = rng.uniform(0.05, 1.0, len(rays)) * np.fmin(ranges, limit)
        free.append((T_world_cam[:3, 3] + share[:, None] * rays)[:: len(_GRID) * 2])
    everywhere = surface_points(world, seed, _SPACING_M).points_m
    low, high = truth.p_world_imu.min(axis=0) - 1.5 * range_m, truth.p_world_imu.max(axis=0) + 1.5 * range_m
    around = np.all((everywhere > low) & (everywhere < high), axis=1)
    return SeenSpace(np.concatenate(surface), np.concatenate(seen_ns), np.concatenate(free), everywhere[around])


def random_bearings(camera: RigCamera, rng: np.random.Generator) -> Array:
    """Return unit vectors (S, 3) of pixels that are spread over the image at random, without those behind it."""
    model, (columns, rows) = camera.model, _GRID
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    pixels = (grid + rng.random(grid.shape)) / _GRID * [model.width, model.height] - 0.5
    bearings = model.unproject(pixels)
    with np.errstate(invalid="ignore"):
        return np.asarray(bearings[bearings[:, 2] > 0.1])


def moved_points(caster: RayCaster, T_world_cam: Array, bearings: Array, t_s: float, range_m: float) -> Array:
    """Return points (N, 3) on moving objects that a camera sees at a time since the start of the flight [m]."""
    static, moving = (caster.ranges_m(T_world_cam[None], bearings, range_m, at)[0] for at in (None, t_s))
    on_mover: npt.NDArray[np.bool_] = np.isfinite(moving) & (moving < static - 0.01)
    return np.asarray(T_world_cam[:3, 3] + moving[on_mover, None] * (bearings[on_mover] @ T_world_cam[:3, :3].T))
