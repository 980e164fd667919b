"""The dense map beside poles, behind moving things, around a loop, after a wrong correction, and over ten minutes."""

import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from dense_map_poles import WIDTHS_M, pole_flight, poles_of
from dense_map_runs import (
    TRUE_SIGMA_M,
    MapRun,
    path_in_odometry,
    slam_estimates,
    true_estimate,
    true_estimates,
)
from dense_map_truth import moved_points, random_bearings
from measuring import Row, opened, text

from dronevio.estimator.mapping import DenseMapConfig, DenseMapper
from dronevio.estimator.mapping.depth_source import depth_source
from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.local_map import LocalMap
from dronevio.estimator.mapping.submap import ActiveSubmap, Anchor
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.clouds import compare_clouds
from dronevio.eval.metrics.occupancy import are_falsely_free
from dronevio.models.arrays import Array, Mask
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.imu import Times
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PlacedSubmap
from dronevio.models.recordings.scenario_file import world_of
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate
from dronevio.sim.flight import plant_of, reference_of
from dronevio.sim.ray_casting import RayCaster, surface_points
from dronevio.sim.scenario import Scenario

AGES_S = (1.0, 2.0, 5.0, 10.0)
"""Ages of the traces of moving things [s]."""
DISTANCES_M = (0.05, 0.1, 0.2)


# --- poles


def pole_rows(rig: Rig, config: DenseMapConfig, places: int) -> list[Row]:
    """Return a row for each pole: where it is occupied first, and where it is falsely free last, at several places."""
    found = np.array([_pole_flight(rig, config, place) for place in range(places)])  # (places, values, poles)
    half, whole, wrong, last = np.moveaxis(found, 1, 0)
    return [
        {
            "pole": f"{100.0 * width:.0f} cm",
            "half occupied at": f"{_median(half[:, k])} m",
            "all occupied at": f"{_median(whole[:, k])} m",
            "falsely free within 2 m": f"{100.0 * wrong[:, k].mean():.2f} %",
            "places": f"{np.count_nonzero(wrong[:, k])} of {places}",
            "falsely free at last at": f"{text(float(np.fmin.reduce(last[:, k])), '.2f')} m",
        }
        for k, width in enumerate(WIDTHS_M)
    ]


def _median(ranges_m: Array) -> str:
    """Return the median of ranges as text, in which NaN, never, is nearer than all."""
    return text(float(np.median(np.nan_to_num(ranges_m))) or None, ".2f")


def _pole_flight(rig: Rig, config: DenseMapConfig, place: int) -> Array:
    """Return values (4, 3) of the poles at a place.

    They are the ranges at which half and 95 % of a pole are occupied first [m], the share that is falsely free within
    2 m, and the smallest range at which some of it is [m].
    """
    run, poles = MapRun(DenseMapper(rig, config)), poles_of(place)
    ranges, occupied, wrong = [], [], []
    for frame, estimate in pole_flight(rig, place):
        grid = run.mapper.local_map if run.add(frame, estimate) else None
        if grid is None or estimate.T_odom_imu is None:
            continue
        position = estimate.T_odom_imu[:3, 3]
        heights = position[2] + np.linspace(-0.3, 0.3, 25)
        columns = [np.stack([*np.broadcast_arrays(*foot[:2], heights)], axis=1) for foot in poles]
        ranges.append(poles[:, 0] - position[0])
        occupied.append([float(np.mean(_are_near(grid, column, OCCUPIED))) for column in columns])
        wrong.append([float(np.mean(are_falsely_free(grid, column))) for column in columns])
    r, o, w = np.array(ranges), np.array(occupied), np.array(wrong)
    return np.array(
        [
            [
                _largest(r[:, k], o[:, k] >= 0.5),
                _largest(r[:, k], o[:, k] >= 0.95),
                w[r[:, k] < 2.0, k].mean(),
                _smallest(r[:, k], w[:, k] > 0.0),
            ]
            for k in range(len(WIDTHS_M))
        ]
    ).T


def _are_near(grid: OccupancyGrid, points: Array, state: int) -> Mask:
    """Return whether a cell within one cell of points (N, 3) has a state, as a mask (N,)."""
    others = OccupancyGrid(grid.low_m, grid.cell_m, np.where(grid.states == state, UNKNOWN, FREE).astype(np.uint8))
    inside = np.all((points > grid.low_m + grid.cell_m) & (points < grid.high_m - grid.cell_m), axis=1)
    return np.asarray(inside & ~are_falsely_free(others, points))


def _largest(values: Array, chosen: Mask) -> float:
    return float(values[chosen].max()) if chosen.any() else np.nan


def _smallest(values: Array, chosen: Mask) -> float:
    return float(values[chosen].min()) if chosen.any() else np.nan


# --- moving things


def mover_rows(folder: Path, config: DenseMapConfig) -> list[Row]:
    """Return a row for each age: the share of the cells of moving things that are still occupied, on true poses."""
    recording, _ = opened(folder, 2)
    world, seed = world_of(folder)
    camera, rng = recording.rig.cameras[0], np.random.default_rng(0)
    caster = RayCaster(world, seed)
    static = surface_points(world, seed, 0.05).points_m
    mapper, cell_m = DenseMapper(recording.rig, config), config.cell_m
    swept: dict[tuple[int, ...], list[float]] = {}  # time of the newest trace in a cell, and of the newest view of it
    still: dict[float, list[tuple[bool, bool]]] = {age: [] for age in AGES_S}
    near = _cells(static, cell_m, 2)
    for frame, estimate in true_estimates(recording):
        T_world_imu, depth = estimate.T_odom_imu, mapper.add_frame(frame, estimate)
        if depth is None or T_world_imu is None or mapper.local_map is None:
            continue
        t_s, T_world_cam = 1e-9 * frame.t_ns, T_world_imu @ camera.T_imu_cam
        points = moved_points(caster, T_world_cam, random_bearings(camera, rng), t_s, config.range_m)
        for cell in set(map(tuple, np.floor(points / cell_m).astype(int).tolist())) - near:
            swept[cell] = [t_s, 0.0]
        grid, cells = mapper.local_map, list(swept)
        if not cells:
            continue
        centres = (np.array(cells) + 0.5) * cell_m
        for cell, seen in zip(cells, _are_seen(caster, depth, centres, t_s, config), strict=True):
            swept[cell][1] += float(seen)
        states = grid.at(centres)
        for cell, state in zip(cells, states.tolist(), strict=True):
            traced_s, views = swept[cell]
            for age in AGES_S:
                if age <= t_s - traced_s < age + 0.11:
                    still[age].append((state == OCCUPIED, views >= 3.0))
    rows: list[Row] = []
    for age, found in still.items():
        occupied, again = np.array(found, bool).reshape(-1, 2).T
        if not again.any():
            continue
        rows.append(
            {
                "after": f"{age:g} s",
                "cells": str(len(occupied)),
                "occupied": f"{100.0 * occupied.mean():.1f} %",
                "seen 3 times since": str(int(again.sum())),
                "of these occupied": f"{100.0 * occupied[again].mean():.1f} %",
            }
        )
    return rows


def _cells(points: Array, cell_m: float, margin: int) -> set[tuple[int, ...]]:
    """Return the cells of points (N, 3) and those around them."""
    cells = np.unique(np.floor(points / cell_m).astype(int), axis=0)
    steps = range(-margin, margin + 1)
    around = np.array([(i, j, k) for i in steps for j in steps for k in steps])
    return set(map(tuple, np.unique((cells[:, None] + around).reshape(-1, 3), axis=0).tolist()))


def _are_seen(caster: RayCaster, depth: DepthImage, centres: Array, t_s: float, config: DenseMapConfig) -> Mask:
    """Return which cells (N,) a depth image shows to the edges, with nothing in front of their centres or in them."""
    camera, T = depth.camera, depth.T_odom_cam
    rays, reach_m = (centres - T[:3, 3]) @ T[:3, :3], 0.5 * np.sqrt(3.0) * config.cell_m
    distance = np.linalg.norm(rays, axis=1)
    seen = (rays[:, 2] > 0.4) & (rays[:, 2] < config.range_m - reach_m)
    pixels = rays[seen] @ camera.K.T / rays[seen, 2:]
    edge_px = reach_m * camera.K[0, 0] / (rays[seen, 2:] - reach_m)
    size = np.array([camera.width, camera.height])
    seen[seen] = np.all((pixels[:, :2] > edge_px) & (pixels[:, :2] < size - 1.0 - edge_px), axis=1)
    if seen.any():
        bearings = rays[seen] / distance[seen, None]
        seen[seen] = caster.ranges_m(T[None], bearings, 40.0, t_s)[0] > distance[seen] + 0.3
    return np.asarray(seen)


# --- a loop


DRIFT_SHARE, DRIFT_RAD_M = 0.01, np.radians(0.05)
"""Drift that is put into the odometry: share of the path, and yaw for each metre [rad/m]."""


def drifting(estimate: Estimate, t_ns: Times, path_m: Array) -> Estimate:
    """Return an estimate whose odometry frame drifts with the path, with the same poses in the map.

    Args:
        estimate: An estimate of visual SLAM.
        t_ns: (N,) Times of the path [ns].
        path_m: (N,) Length of the path until then [m].
    """

    def drift(at_ns: Times) -> Array:
        s = np.interp(at_ns, t_ns, path_m)
        return pose_matrix(rotation_z(DRIFT_RAD_M * s), DRIFT_SHARE * s[:, None] * np.array([0.9, 0.3, 0.3]))

    if estimate.state is None:
        return estimate
    D, found = drift(np.array([estimate.t_ns]))[0], estimate.map_correction
    T_map_odom = None if estimate.T_map_odom is None else np.asarray(estimate.T_map_odom @ inverse_pose(D))
    if found is not None:
        found = replace(found, Ts_map_odom=np.asarray(found.Ts_map_odom @ np.linalg.inv(drift(found.t_ns))))
    state, exposed = (
        None if each is None else replace(each, T_world_imu=np.asarray(D @ each.T_world_imu))
        for each in (estimate.state, estimate.exposed)
    )
    return replace(estimate, state=state, exposed=exposed, T_map_odom=T_map_odom, map_correction=found)


def loop_rows(folder: Path, config: DenseMapConfig, drift: bool = True) -> list[Row]:
    """Return the rows of the map of a flight that bends with its keyframes, and of one that does not.

    Args:
        folder: Recording of a flight that comes back.
        config: Settings of the map.
        drift: Whether drift is put into the odometry, which is too good in simulated flights to show the difference.
    """
    recording, truth = opened(folder, 2)
    run, loops = MapRun(DenseMapper(recording.rig, config)), 0
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.p_world_imu, axis=0), axis=1))])
    for frame, estimate in slam_estimates(recording):
        run.add(frame, drifting(estimate, truth.t_ns, path_m) if drift else estimate)
        loops += len(estimate.closed_loops_ns)
    world, seed = world_of(folder)
    surface = surface_points(world, seed, 0.04).points_m
    true, rows = interpolate(truth, np.array(run.t_ns, dtype=np.int64))
    placed = [submap for submap in run.mapper.submaps if submap.T_map_odom is not None]
    starts = np.array([submap.anchor_ns for submap in placed])
    of_frame = np.clip(np.searchsorted(starts, run.t_ns, side="right") - 1, 0, None)
    result: list[Row] = []
    for name, Ts in (
        ("bends", np.array([submap.T_map_odom for submap in placed])),
        ("does not", np.tile(np.eye(4), (len(placed), 1, 1))),
    ):
        path = np.einsum("nij,nj->ni", Ts[of_frame][:, :3, :3], path_in_odometry(run)) + Ts[of_frame][:, :3, 3]
        found = align(true.p_world_imu, path[rows])
        clouds = [s.grid.points(OCCUPIED) @ T[:3, :3].T + T[:3, 3] for s, T in zip(placed, Ts, strict=True)]
        cloud = found.positions(np.concatenate(clouds))
        scores = compare_clouds(surface, cloud, DISTANCES_M, scored_true=surface[::50])
        twice = _seen_twice(placed, clouds)
        errors = np.linalg.norm(found.positions(path[rows]) - true.p_world_imu, axis=1)
        result.append(
            {
                "map": name,
                "submaps": str(len(placed)),
                "loops": str(loops),
                "path RMS": f"{100.0 * np.sqrt((errors**2).mean()):.1f} cm",
                "accuracy": " ".join(text(100.0 * score.accuracy, ".0f") for score in scores),
                "first and last submap apart": twice,
            }
        )
    return result


def _seen_twice(placed: Sequence[PlacedSubmap], clouds: list[Array]) -> str:
    """Return how far the surfaces of the last submaps are from those of the first ones where these overlap."""
    from scipy.spatial import cKDTree

    third = max(1, len(placed) // 4)
    first, last = np.concatenate(clouds[:third]), np.concatenate(clouds[-third:])
    distance, _ = cKDTree(first).query(last, distance_upper_bound=0.5)
    near = distance[np.isfinite(distance)]
    return f"{100.0 * near.mean():.1f} cm" if len(near) else "–"


# --- a correction that is taken back


def taken_back(folder: Path, config: DenseMapConfig, frames: int = 200) -> str:
    """Return whether a map whose correction was wrong for a second equals one whose correction never was."""
    recording, _ = opened(folder, 2)
    wrong = pose_matrix(rotation_z(0.3), np.array([2.0, -1.0, 0.2]))
    grids = []
    for is_wrong in (False, True):
        run = MapRun(DenseMapper(recording.rig, config))
        meanwhile = None
        for row, (frame, estimate) in enumerate(true_estimates(recording)):
            if row == frames:
                break
            corrected = is_wrong and frames // 2 <= row < frames // 2 + 20
            run.add(frame, replace(estimate, T_map_odom=wrong) if corrected else estimate)
            if corrected:
                meanwhile = run.mapper.fused()
        grids.append((run.mapper.fused(), meanwhile))
    (right, _), (back, meanwhile) = grids
    assert right is not None and back is not None and meanwhile is not None
    same = right.states.shape == back.states.shape and np.array_equal(right.low_m, back.low_m)
    differ = int((right.states != back.states).sum()) if same else -1
    return f"cells that differ after the correction was taken back: {differ}; map meanwhile began at {meanwhile.low_m}"


# --- cost


def cost_rows(folder: Path, config: DenseMapConfig, frames: int = 100) -> list[Row]:
    """Return a row for each stage of an update with its processor time, on true poses."""
    recording, _ = opened(folder, 2)
    source, local = depth_source(recording.rig), LocalMap(config.cell_m)
    submap: ActiveSubmap | None = None
    times: dict[str, list[float]] = defaultdict(list)
    step = max(1, round(recording.rig.cameras[0].rate_hz / config.rate_hz))
    for row, (frame, estimate) in enumerate(true_estimates(recording)):
        if row % step or row < 3 * step:  # the first frames also fill caches
            continue
        start = time.process_time()
        depth = source.depth(frame, estimate)
        if depth is None:
            continue
        position = depth.T_odom_cam[:3, 3]
        submap = submap or ActiveSubmap(Anchor(0, 0, frame.t_ns), position)
        marks = [start, time.process_time()]
        found = evidence(depth, config.cell_m, config.range_m)
        marks.append(time.process_time())
        local.centre_on(position)
        local.add(found)
        marks.append(time.process_time())
        submap.add(found, position)
        marks.append(time.process_time())
        local.distance_field(unknown_is_obstacle=True)
        marks.append(time.process_time())
        for name, elapsed in zip(
            ("depth", "evidence", "local map", "submap", "distance field"), np.diff(marks), strict=True
        ):
            times[name].append(1e3 * float(elapsed))
        if len(times["depth"]) == frames:
            break
    return [
        {"stage": name, "median ms": f"{np.median(found):.1f}", "95 % ms": f"{np.percentile(found, 95):.1f}"}
        for name, found in times.items()
    ]


# --- ten minutes


@dataclass(frozen=True, eq=False)
class CastDepth:
    """True depth by rays through every fourth pixel of an image at half the resolution; a depth source."""

    caster: RayCaster
    """The world."""
    camera: Pinhole
    """Camera of the image."""
    T_imu_cam: Array
    """(4, 4) Pose of the camera in the IMU frame."""
    T_world_odom: Array
    """(4, 4) Pose of the odometry frame in the world."""

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image at the pose of an estimate."""
        if estimate.state is None:
            return None
        rays = self.camera.rays()[2::4, 2::4].reshape(-1, 3).astype(np.float64)
        lengths = np.linalg.norm(rays, axis=1)
        T_odom_cam = estimate.state.T_world_imu @ self.T_imu_cam
        ranges = self.caster.ranges_m((self.T_world_odom @ T_odom_cam)[None], rays / lengths[:, None])[0]
        z = np.where(np.isfinite(ranges), ranges / lengths, 0.0).reshape(self.camera.height // 4, -1)
        depth = np.kron(z, np.ones((4, 4))).astype(np.float32)
        sigma = np.where(depth > 0.0, TRUE_SIGMA_M, 0.0).astype(np.float32)
        return DepthImage(frame.t_ns, self.camera, T_odom_cam, depth, sigma, np.zeros(depth.shape, np.uint8))


STOREY_M = 3.5
"""Height of a floor above the one below [m]."""
MINUTES = 10
_LONG_RATE_HZ = 5.0


def long_poses(scenario: Scenario, seconds: float) -> Array:
    """Return the poses T_world_imu (N, 4, 4) of a planned flight, which is repeated until its time has passed."""
    reference = reference_of(scenario, plant_of(scenario))
    every = round(1e9 / _LONG_RATE_HZ / reference.t_ns[1])
    rows = np.arange(0, len(reference), every)
    rows = np.resize(rows, int(seconds * _LONG_RATE_HZ))
    return pose_matrix(rotation_z(reference.yaw_rad[rows]), reference.position_m[rows])


def long_rows(scenarios: Sequence[Scenario], rig: Rig, config: DenseMapConfig) -> Iterator[Row]:
    """Yield a row a minute: cost and size of a map over several floors, each above the one before.

    The camera is level and looks ahead. Depth is cast at 94 × 60 rays and enlarged to half the resolution.
    """
    model, R = rig.cameras[0].model, np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    f = 0.5 * model.central_focal_px[0]
    camera = Pinhole(376, 240, np.array([[f, 0.0, 187.5], [0.0, f, 119.5], [0.0, 0.0, 1.0]]))
    given = _Given()
    run, number, image = MapRun(DenseMapper(rig, config, given)), 0, np.zeros((480, 752), np.uint8)
    times, start_mb = [], rss_mb()
    for storey, scenario in enumerate(scenarios):
        T_odom_world = pose_matrix(np.eye(3), np.array([0.0, 0.0, storey * STOREY_M]))
        caster = RayCaster(scenario.world, scenario.seed_of_world)
        source = CastDepth(caster, camera, pose_matrix(R, np.zeros(3)), inverse_pose(T_odom_world))
        for T_world_imu in long_poses(scenario, 60.0 * MINUTES / len(scenarios)):
            t_ns = round(1e9 * number / _LONG_RATE_HZ)
            estimate = true_estimate(t_ns, T_odom_world @ T_world_imu)
            given.image = source.depth(CameraFrame(t_ns, (image, image)), estimate)
            before = time.process_time()
            run.add(CameraFrame(t_ns, (image, image)), estimate)
            times.append(time.process_time() - before)
            number += 1
            if number % round(60.0 * _LONG_RATE_HZ) == 0:
                recent = 1e3 * np.array(times[-round(60.0 * _LONG_RATE_HZ) :])
                yield {
                    "minute": f"{number / 60.0 / _LONG_RATE_HZ:.0f}",
                    "floor": str(storey + 1),
                    "submaps": str(len(run.mapper.submaps)),
                    "median ms": f"{np.median(recent):.1f}",
                    "95 % ms": f"{np.percentile(recent, 95):.1f}",
                    "largest ms": f"{recent.max():.0f}",
                    "memory": f"{rss_mb() - start_mb:.0f} MB",
                }
    before, grid = time.process_time(), run.mapper.fused()
    fused_s, grown_mb = time.process_time() - before, rss_mb() - start_mb
    if grid is not None:
        known_m3 = float((grid.states != UNKNOWN).sum()) * grid.cell_m**3
        box_m3, packed_mb = grid.states.size * grid.cell_m**3, run.mapper.packed_bytes / 1e6
        print(
            f"fused: {known_m3:.0f} m³ known of {box_m3:.0f} m³, in {fused_s:.1f} s; packed submaps {packed_mb:.2f} MB,"
            f" {1e3 * packed_mb / known_m3:.2f} MB per 1000 m³ known; process {grown_mb:.0f} MB larger than before",
            file=sys.stderr,
        )


@dataclass(eq=False)
class _Given:
    """A depth source that returns a given image."""

    image: DepthImage | None = None

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the image."""
        return self.image


def rss_mb() -> float:
    """Return the memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6
