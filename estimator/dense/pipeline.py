"""Multi-view stereo over a reconstruction: depth maps, their consistency, a point cloud and a mesh.

Source: Seitz et al., "A comparison and evaluation of multi-view stereo reconstruction algorithms", CVPR 2006, for the
problem; Furukawa and Hernández, *Multi-View Stereo: A Tutorial*, 2015, for the methods.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.estimator.dense.depth import estimate_depth
from dronevio.estimator.dense.fusion import fuse
from dronevio.estimator.dense.mesh import build_mesh
from dronevio.estimator.dense.neighbours import depth_range, select_neighbours
from dronevio.estimator.dense.views import ViewLoader
from dronevio.models.image_sets import ImageSet
from dronevio.models.progress import Progress, silent
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.surfaces import Mesh, PointCloud

Floats = npt.NDArray[np.float32]
Stages = Callable[[str], Progress]


@dataclass(frozen=True, eq=False)
class DenseResult:
    """Surfaces of a scene."""

    cloud: PointCloud
    """Points of all surfaces that enough images see."""
    mesh: Mesh
    """Triangles of the same surfaces."""
    depths: tuple[PosedDepth, ...]
    """(I,) Consistent depths of the undistorted images of the reconstruction."""
    times_s: dict[str, float]
    """Elapsed time of each stage [s]."""


def _no_progress(stage: str) -> Progress:
    return silent


def densify(
    images: ImageSet,
    reconstruction: Reconstruction,
    config: DenseConfig | None = None,
    stages: Stages = _no_progress,
) -> DenseResult:
    """Return the surfaces of a scene from images with known cameras.

    Args:
        images: The images.
        reconstruction: Cameras, poses and points of the images, as `dronevio.estimator.sfm.reconstruct` returns.
        config: Settings.
        stages: Returns the progress callback of a stage by its name.

    Raises:
        InputError: A registered image is not among the images, or cannot be read.
    """
    config = config or DenseConfig()
    start = time.perf_counter()
    load = ViewLoader(images, reconstruction, config.views)
    neighbours = select_neighbours(reconstruction, config.views)
    progress = stages("depth maps")
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)

    def estimate(i: int) -> PosedDepth:
        camera, T = load.camera(i), reconstruction.Ts_world_cam[i]
        near, far = depth_range(reconstruction, i, config.depth.range_margin)
        sources = neighbours[i][: config.views.neighbours]
        if not len(sources) or not near < far:
            return PosedDepth(camera, T, np.zeros((camera.height, camera.width), np.float32))
        found = estimate_depth(load(i), [load(int(j)) for j in sources], near, far, config.depth)
        known = found.correlation >= config.consistency.min_correlation
        return PosedDepth(camera, T, np.where(known, found.inverse_depth, 0.0).astype(np.float32))

    try:
        with ThreadPoolExecutor(config.threads) as pool:
            depths = []
            for depth in pool.map(estimate, range(len(load))):
                depths.append(depth)
                progress(len(depths), len(load))
    finally:
        cv2.setNumThreads(threads)
    middle = time.perf_counter()
    cloud, consistent = fuse(depths, neighbours, lambda i: load(i).colours, config.consistency, stages("fusion"))
    filtered = tuple(PosedDepth(d.camera, d.T_world_cam, w) for d, w in zip(depths, consistent, strict=True))
    last = time.perf_counter()
    mesh = build_mesh(filtered, cloud, config.mesh, stages("mesh"))
    times_s = {"depth maps": middle - start, "fusion": last - middle, "mesh": time.perf_counter() - last}
    return DenseResult(cloud, mesh, filtered, times_s)
