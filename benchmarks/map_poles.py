"""At which range thin poles become occupied in the local map, and the processor time of an update, by arithmetic.

A camera like the half-size images of EuRoC's approaches an upright pole in front of a wall at 1 m/s, with ten depth
images a second. Disparities have a standard deviation of half a pixel: half of its square is an error of the whole
image, the rest is independent between pixels. A pole is occupied from the first image on after which one of the cells
at its surface is; it is freed if its cell and the eight around it in the plane are free.

    python benchmarks/map_poles.py
"""

import time

import cv2
import numpy as np
from measuring import print_rows

from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.local_map import LocalMap
from dronevio.models.arrays import Array, Floats
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.occupancy import FREE, OCCUPIED

CAMERA = Pinhole(376, 240, np.array([[229.0, 0.0, 187.5], [0.0, 229.0, 119.5], [0.0, 0.0, 1.0]]))
FOCAL_BASELINE = 229.0 * 0.11
SIGMA_PX = 0.5
POLE_X_M, WALL_X_M = 6.0, 9.0
APPROACHES = 4


def depth_of_pole(x_m: float, diameter_m: float, side_m: float) -> Floats:
    """Return the depth (H, W) of an upright round pole in front of a wall, from a distance along x."""
    slope = CAMERA.rays()[..., 0].astype(np.float64)
    distance = POLE_X_M - x_m
    a, b = 1.0 + slope * slope, slope * side_m + distance
    root = b * b - a * (side_m**2 + distance**2 - (0.5 * diameter_m) ** 2)
    pole = (b - np.sqrt(np.maximum(root, 0.0))) / a
    return np.where(root >= 0.0, pole, WALL_X_M - x_m).astype(np.float32)


def measured(depth_m: Floats, position: Array, rng: np.random.Generator) -> DepthImage:
    """Return a depth image with the errors of a stereo pair."""
    errors = SIGMA_PX * np.sqrt(0.5) * (rng.normal() + rng.normal(size=depth_m.shape))
    depth = (FOCAL_BASELINE / np.maximum(FOCAL_BASELINE / depth_m + errors, 0.5)).astype(np.float32)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], position
    sigma = (depth * depth * np.float32(SIGMA_PX / FOCAL_BASELINE)).astype(np.float32)
    return DepthImage(0, CAMERA, T, depth, sigma, np.zeros(depth.shape, np.uint8))


def approach(diameter_m: float, cell_m: float, range_m: float, seed: int) -> tuple[float, bool, list[float]]:
    """Return the range at which a pole is occupied, whether it was ever freed, and the times of the updates [ms]."""
    rng = np.random.default_rng(seed)
    side_m, y = rng.uniform(-0.6, 0.6), rng.uniform(0.0, 0.1)
    local, occupied_m, freed, times = LocalMap(cell_m), 0.0, False, []
    plane = cell_m * np.array([[i, j, 0] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    for x in np.arange(0.0, 5.5, 0.1):
        position = np.array([x, y, 0.03])
        image = measured(depth_of_pole(x, diameter_m, side_m), position, rng)
        begin = time.process_time()
        local.centre_on(position)
        local.add(evidence(image, cell_m, range_m))
        times.append(1e3 * (time.process_time() - begin))
        grid, surface = local.grid(), np.array([POLE_X_M - 0.5 * diameter_m, y - side_m, 0.05])
        if not occupied_m and np.any(grid.at(surface + plane[1::3]) == OCCUPIED):
            occupied_m = POLE_X_M - x
        freed = freed or bool(np.all(grid.at(surface + plane) == FREE))
    return occupied_m, freed, times


def main() -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    rows = []
    for cell_m, range_m in ((0.05, 4.0), (0.1, 4.0), (0.2, 4.0), (0.1, 10.0), (0.2, 10.0)):
        times = []
        for diameter_m in (0.02, 0.04, 0.08):
            runs = [approach(diameter_m, cell_m, range_m, seed) for seed in range(APPROACHES)]
            times += [value for run in runs for value in run[2]]
            ranges = [run[0] for run in runs]
            rows.append(
                {
                    "cell [cm]": f"{100 * cell_m:.0f}",
                    "range [m]": f"{range_m:.0f}",
                    "pole [cm]": f"{100 * diameter_m:.0f}",
                    "occupied at [m], least": f"{min(ranges):.1f}",
                    "median": f"{np.median(ranges):.1f}",
                    "freed": f"{sum(run[1] for run in runs)} of {APPROACHES}",
                    "update [CPU-ms]": f"{np.median(times):.2f}",
                }
            )
    print_rows("Poles", rows)


if __name__ == "__main__":
    main()
