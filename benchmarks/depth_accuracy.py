"""Accuracy of single depth maps of dense reconstruction, before they are filtered and fused.

A few images of a flight are compared with their true depths below 10 m. The rows are shares of the pixels with a true
depth: those with a depth at all, and those with a depth within 1, 5 and 10 cm. Flights of other seeds serve to choose
settings, which are options of the command::

    .venv/bin/python benchmarks/depth_accuracy.py --work build/dense --scenario hall-medium-v0 --seed 7
    .venv/bin/python benchmarks/depth_accuracy.py --work build/dense --scenario room-v0 --dense.depth.directions 0
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import tyro
from dense_accuracy import DISTANCES_M, FARTHEST_M, reconstructed, true_depth

from dronevio.cli.terminal import print_table
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.depth import estimate_depth
from dronevio.estimator.dense.directions import dominant_normals
from dronevio.estimator.dense.neighbours import observed_points, select_neighbours
from dronevio.estimator.dense.views import Undistortion, ViewLoader


@dataclass(frozen=True)
class DepthAccuracyCommand:
    """Compare depth maps with true depths."""

    work: Path
    """Folder of recordings and reconstructions; existing ones are used again."""
    scenario: str = "room-v0"
    """Scenario that is flown."""
    seed: int = 7
    """Seed of the flight."""
    frames: int = 100
    """Number of frames of the reconstruction."""
    images: tuple[int, ...] = (5, 25, 45, 65, 85)
    """Indices of the images whose depths are compared."""
    dense: DenseConfig = field(default_factory=DenseConfig)
    """Settings of dense reconstruction."""


def measure(command: DepthAccuracyCommand) -> None:
    """Estimate the depth maps and print the shares."""
    flight, recording, frames, images, reconstruction = reconstructed(
        command.work, command.scenario, command.seed, command.frames
    )
    config = command.dense
    load = ViewLoader(images, reconstruction, config.views)
    neighbours = select_neighbours(reconstruction, config.views)
    normals = dominant_normals(reconstruction.points, config.depth.directions)
    rows, start = [], time.process_time()
    for i in command.images:
        sources = [load(int(j)) for j in neighbours[i]]
        found = estimate_depth(load(i), sources, observed_points(reconstruction, i), normals, config.depth)
        undistortion = Undistortion.of(reconstruction.cameras[reconstruction.image_camera[i]], config.views)
        distorted = cv2.resize(
            true_depth(flight, recording, int(frames[i])), undistortion.size, interpolation=cv2.INTER_NEAREST
        )
        u, v = undistortion.map_px[..., 0], undistortion.map_px[..., 1]
        true = np.where(undistortion.mask, cv2.remap(distorted, u, v, cv2.INTER_NEAREST), 0.0)
        near = (true > 0.0) & (true < FARTHEST_M)
        known = (found.inverse_depth > 0.0) & (found.correlation >= config.consistency.min_correlation)
        depth = np.divide(1.0, found.inverse_depth, out=np.full(true.shape, np.inf), where=known)
        errors = np.abs(depth - true)[near]
        rows.append([np.isfinite(errors).mean(), *((errors <= d).mean() for d in DISTANCES_M)])
    names = [*map(str, command.images), "mean"]
    cells = [[n, *(f"{v:.3f}" for v in row)] for n, row in zip(names, [*rows, np.mean(rows, axis=0)], strict=True)]
    print_table("Depth maps", ("image", "known", *(f"{1e2 * d:.0f} cm" for d in DISTANCES_M)), cells)
    print(f"processor time: {(time.process_time() - start) / len(rows):.2f} s per image")


if __name__ == "__main__":
    measure(tyro.cli(DepthAccuracyCommand, description=__doc__))
