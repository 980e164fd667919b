"""The dense map's update and distance field beside libraries, in processor time and memory.

Each candidate runs in a process of its own, with the same depth images of a room by arithmetic, 376 × 240 pixels, or
the same local map of 80 × 80 × 40 cells. Memory is what importing and using it adds to the process. Candidates that
are not installed are left out: ``pip install edt numba open3d pyoctomap``. What they do differs: dronevio's evidence
takes the nearest depth of the footprint of each cell, numba marches along the ray of each pixel, octomap casts the ray
of each point through its tree, open3d integrates a truncated distance without free space.

    python benchmarks/map_libraries.py
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Row, print_as_made

from dronevio.models.arrays import Array, Floats
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.occupancy import FREE, OccupancyGrid
from dronevio.models.rotation import pose_matrix, rotation_z

CELL_M, RANGE_M = 0.1, 4.0
CAMERA = Pinhole(376, 240, np.array([[229.0, 0.0, 187.5], [0.0, 229.0, 119.5], [0.0, 0.0, 1.0]]))
LOW_M, HIGH_M = np.array([-3.1, -2.7, -1.3]), np.array([3.3, 2.9, 1.5])
IMAGES, REPETITIONS = 12, 5
R_IMU_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def depth_images() -> list[DepthImage]:
    """Return depth images of a room, with the noise of a stereo pair and a fifth of the pixels unknown in patches."""
    rng, found = np.random.default_rng(0), []
    for index in range(IMAGES):
        T = pose_matrix(rotation_z(0.5 * index) @ R_IMU_CAM, 0.05 * rng.normal(size=3))
        rays = CAMERA.rays() @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = np.where(rays > 0.0, (HIGH_M - T[:3, 3]) / rays, (LOW_M - T[:3, 3]) / rays).min(axis=-1)
        sigma = 0.01 * depth * depth
        patches = np.kron(rng.random((60, 94)) < 0.2, np.ones((4, 4), bool))
        noisy = np.where(patches, 0.0, depth + sigma * rng.normal(size=depth.shape)).astype(np.float32)
        known_sigma = np.where(patches, 0.0, sigma).astype(np.float32)
        found.append(DepthImage(index, CAMERA, T, noisy, known_sigma, np.zeros(depth.shape, np.uint8)))
    return found


def local_grid() -> OccupancyGrid:
    """Return the local map of the depth images, in which a third of the cells is free."""
    from dronevio.estimator.mapping.evidence import evidence
    from dronevio.estimator.mapping.local_map import LocalMap

    local = LocalMap(CELL_M)
    for image in depth_images() * 2:
        local.add(evidence(image, CELL_M, RANGE_M))
    return local.grid()


def own_update() -> list[Callable[[], Any]]:
    """Evidence of the depth images, added to the local map."""
    from dronevio.estimator.mapping.evidence import evidence
    from dronevio.estimator.mapping.local_map import LocalMap

    local = LocalMap(CELL_M)

    def update(image: DepthImage) -> None:
        local.add(evidence(image, CELL_M, RANGE_M))

    return [partial(update, image) for image in depth_images()]


def numba_update() -> list[Callable[[], Any]]:
    """Log-odds along the ray of each pixel, by steps of a cell."""
    numba = import_module("numba")

    values, half = np.zeros((80, 80, 40), np.float32), np.array([40, 40, 20])

    @numba.njit  # type: ignore[untyped-decorator]
    def march(log_odds: Floats, points: Array, p: Array) -> None:
        """Add the rays from a position to the points, both in cells of the box."""
        for n in range(len(points)):
            ray = points[n] - p
            steps = 1 + int(np.sqrt((ray * ray).sum()))
            for step in range(steps):
                i, j, k = int(p[0] + ray[0] * step / steps), int(p[1] + ray[1] * step / steps), 0
                k = int(p[2] + ray[2] * step / steps)
                if 0 <= i < log_odds.shape[0] and 0 <= j < log_odds.shape[1] and 0 <= k < log_odds.shape[2]:
                    last = step == steps - 1
                    log_odds[i, j, k] = min(max(log_odds[i, j, k] + (0.1 if last else -0.01), -2.0), 3.5)

    def update(image: DepthImage) -> None:
        near = DepthImage(0, CAMERA, image.T_odom_cam, np.minimum(image.depth_m, RANGE_M), image.sigma_m, image.grey)
        march(values, near.points_odom() / CELL_M + half, image.T_odom_cam[:3, 3] / CELL_M + half)

    return [partial(update, image) for image in depth_images()]


def octomap_update() -> list[Callable[[], Any]]:
    """Points inserted into an octree."""
    pyoctomap = import_module("pyoctomap")

    tree = pyoctomap.OcTree(CELL_M)

    def update(image: DepthImage) -> None:
        tree.insertPointCloud(image.points_odom(), image.T_odom_cam[:3, 3], RANGE_M)

    return [partial(update, image) for image in depth_images()]


def open3d_update() -> list[Callable[[], Any]]:
    """Depth integrated into blocks of voxels with a truncated distance."""
    o3d = import_module("open3d")

    core, device = o3d.core, o3d.core.Device("CPU:0")
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), CELL_M, 8, 4000, device
    )
    K = core.Tensor(CAMERA.K)

    def update(image: DepthImage) -> None:
        depth, extrinsic = o3d.t.geometry.Image(image.depth_m), core.Tensor(np.linalg.inv(image.T_odom_cam))
        blocks = grid.compute_unique_block_coordinates(depth, K, extrinsic, 1.0, RANGE_M)
        grid.integrate(blocks, depth, K, extrinsic, 1.0, RANGE_M)

    return [partial(update, image) for image in depth_images()]


def own_distance() -> list[Callable[[], Any]]:
    """`dronevio.estimator.mapping.distance`."""
    from dronevio.estimator.mapping.distance import distance_field

    grid = local_grid()
    return [lambda: distance_field(grid, unknown_is_obstacle=True).distance_m]


def scipy_distance() -> list[Callable[[], Any]]:
    """`scipy.ndimage.distance_transform_edt`."""
    from scipy.ndimage import distance_transform_edt

    clear = local_grid().states == FREE
    return [lambda: distance_transform_edt(clear, sampling=CELL_M)]


def edt_distance() -> list[Callable[[], Any]]:
    """`edt.edt`."""
    edt = import_module("edt")

    clear = local_grid().states == FREE
    return [lambda: edt.edt(clear, anisotropy=(CELL_M,) * 3, black_border=False, parallel=1)]


CANDIDATES: dict[tuple[str, str], tuple[str, Callable[[], list[Callable[[], Any]]]]] = {
    ("update", "dronevio"): ("numpy", own_update),
    ("update", "numba"): ("numba", numba_update),
    ("update", "open3d"): ("open3d", open3d_update),
    ("update", "octomap"): ("pyoctomap", octomap_update),
    ("distance field", "dronevio"): ("numpy", own_distance),
    ("distance field", "scipy"): ("scipy", scipy_distance),
    ("distance field", "edt"): ("edt", edt_distance),
}
"""What is measured, by task and name: the module that it needs, and a function that returns its calls."""


def measured(task: str, name: str) -> Row:
    """Return the row of a candidate, measured in this process."""
    depth_images()  # what all of them have
    local_grid()
    before_mb = memory_mb()
    calls = CANDIDATES[task, name][1]()
    results = [call() for call in calls]
    times = []
    for call in calls * (REPETITIONS if len(calls) > 1 else REPETITIONS * IMAGES):
        start = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - start))
    used_mb = memory_mb() - before_mb
    is_field = task == "distance field"
    return {
        "task": task,
        "by": name,
        "median CPU-ms": f"{np.median(times):.1f}",
        "95 % CPU-ms": f"{np.percentile(times, 95):.1f}",
        "memory": f"{used_mb:.0f} MB",
        "differs by at most": f"{np.abs(results[0] - own_distance()[0]()).max():.1g} m" if is_field else "–",
    }


def memory_mb() -> float:
    """Return the memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Print the table."""
    if len(sys.argv) == 3:
        print(json.dumps(measured(sys.argv[1], sys.argv[2])))
        return
    print_as_made(
        json.loads(subprocess.run([sys.executable, __file__, *key], check=True, capture_output=True).stdout)
        for key, (module, _) in CANDIDATES.items()
        if importlib.util.find_spec(module) is not None
    )


if __name__ == "__main__":
    main()
