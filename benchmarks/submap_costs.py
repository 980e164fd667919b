"""Cost of the submaps of a long flight: memory, files, and the time in which a correction bends the map.

Depth images of a synthetic hall over ten minutes become submaps, without an odometry. All of them are then placed anew,
as after a loop. Usage: ``python benchmarks/submap_costs.py [--minutes M]``.
"""

import argparse
import time

import numpy as np

from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.placing import bounds, fused
from dronevio.estimator.mapping.submap import ActiveSubmap, Anchor
from dronevio.estimator.mapping.submap_store import SubmapStore
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z

CAMERA = Pinhole(94, 60, np.array([[58.0, 0.0, 46.5], [0.0, 58.0, 29.5], [0.0, 0.0, 1.0]]))
R_IMU_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FLOOR_M, FLOORS = np.array([24.0, 16.0, 3.0]), 2
SPEED_M_S, RATE_HZ = 1.0, 2.0


def pose(t_s: float, duration_s: float) -> Array:
    """Return the pose of the camera: laps around one floor after the other."""
    floor, angle = int(FLOORS * t_s / duration_s), SPEED_M_S * t_s / 6.0
    p = np.array([8.5 * np.cos(angle), 4.5 * np.sin(angle), 1.5 + FLOOR_M[2] * floor])
    return pose_matrix(rotation_z(angle + 0.5 * np.pi + np.sin(0.7 * t_s)) @ R_IMU_CAM, p)


def depth_image(t_ns: int, T: Array, rng: np.random.Generator) -> DepthImage:
    """Return the depths of a floor of 24 x 16 x 3 m, with the noise of a stereo pair."""
    rays, p = CAMERA.rays() @ T[:3, :3].T, T[:3, 3]
    floor = FLOOR_M[2] * np.floor(p[2] / FLOOR_M[2])
    low, high = np.array([-12.0, -8.0, floor]), np.array([12.0, 8.0, floor + FLOOR_M[2]])
    with np.errstate(divide="ignore"):
        depth = np.where(rays > 0.0, (high - p) / rays, (low - p) / rays).min(axis=-1).astype(np.float32)
    sigma = (0.02 * depth * depth).astype(np.float32)
    noisy = depth + sigma * rng.normal(size=depth.shape).astype(np.float32)
    return DepthImage(t_ns, CAMERA, T, np.maximum(noisy, 0.1), sigma, np.zeros(depth.shape, np.uint8))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    duration_s = 60.0 * parser.parse_args().minutes
    config, rng = DenseMapConfig(), np.random.default_rng(0)
    store, submap = SubmapStore(config.memory_mb), ActiveSubmap(Anchor(0, 0, 0), pose(0.0, duration_s)[:3, 3])
    pack_s = []
    for t_s in np.arange(0.0, duration_s, 1.0 / RATE_HZ).tolist():
        T = pose(t_s, duration_s)
        submap.add(evidence(depth_image(round(t_s * 1e9), T, rng), config.cell_m, config.range_m), T[:3, 3])
        if submap.path_m > config.submap_m:
            start = time.process_time()
            store.add(submap.closed())
            pack_s.append(time.process_time() - start)
            submap = ActiveSubmap(Anchor(len(store), 0, round(t_s * 1e9)), T[:3, 3])
    packed = list(store)
    cells = float(np.mean([np.prod(each.shape) for each in packed]))
    known_m3 = sum(np.count_nonzero(each.steps) for each in packed) * config.cell_m**3
    data_mb = sum(len(each.data) for each in packed) * 1e-6
    print(f"submaps                     {len(packed)} of {cells:.3g} cells")
    print(f"memory of closed submaps    {store.memory_bytes * 1e-6:.2f} MB (limit {config.memory_mb} MB)")
    print(f"with files                  {data_mb:.2f} MB, {1e3 * data_mb / known_m3:.3f} MB per 1000 m3 of known cells")
    print(f"closing a submap            {1e3 * np.median(pack_s):.1f} ms")
    # All poses change by a smooth error, as after a loop
    Ts = [
        pose_matrix(exp_so3(np.array([0.005, -0.003, 0.05 * np.sin(0.1 * i)])), 0.3 * np.cos(0.1 * i) * np.ones(3))
        for i in range(len(packed))
    ]
    boxes = np.array([bounds(each.low, each.shape, T, config.cell_m) for each, T in zip(packed, Ts, strict=True)])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    middle, half = np.array([8.0, 0.0, 1.5]), np.array([4.0, 4.0, 2.0])
    window = np.floor(np.stack([middle - half, middle + half]) / config.cell_m).astype(np.int64)
    for name, (a, b) in (("the whole map", (low, high)), ("8 x 8 x 4 m of it", window)):
        seen = np.all((boxes[:, 0] < b) & (boxes[:, 1] > a), axis=1)
        chosen = [(each, T) for each, T, is_seen in zip(packed, Ts, seen, strict=True) if is_seen]
        start = time.process_time()
        grid = fused(chosen, a, b, config.cell_m)
        cost_ms = 1e3 * (time.process_time() - start)
        print(f"fusing {name:20} {cost_ms:.0f} ms CPU, {len(chosen)} submaps, {grid.states.size} cells")


if __name__ == "__main__":
    main()
