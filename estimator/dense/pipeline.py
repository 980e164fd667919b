"""Multi-view stereo over a reconstruction: depth maps, their consistency, a point cloud and a mesh.

Source: Seitz et al., "A comparison and evaluation of multi-view stereo reconstruction algorithms", CVPR 2006, for the
problem; Furukawa and Hernández, *Multi-View Stereo: A Tutorial*, 2015, for the methods.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import numpy.typing as npt

from dronevio.estimator.array_store import ArrayStore, digest
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.consistency import PosedDepth, consistent_depth
from dronevio.estimator.dense.depth import estimate_depth
from dronevio.estimator.dense.directions import dominant_normals
from dronevio.estimator.dense.finished import FinishedDepth, reusable_depths, settings_hash
from dronevio.estimator.dense.fusion import fuse
from dronevio.estimator.dense.meshing.mesh import build_mesh
from dronevio.estimator.dense.meshing.texture import textured
from dronevio.estimator.dense.meshing.tsdf import integrate, pixel_size
from dronevio.estimator.dense.neighbours import observed_points, select_neighbours
from dronevio.estimator.dense.views import ViewLoader
from dronevio.estimator.threads import map_with_progress, single_threaded
from dronevio.models.image_sets import ImageSet
from dronevio.models.progress import Progress, Stages, silent, silent_stages
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.surfaces import Mesh, PointCloud

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class DenseResult:
    """Surfaces of a scene."""

    cloud: PointCloud
    """Points of all surfaces that enough images see."""
    mesh: Mesh
    """Triangles of the same surfaces."""
    spacing: float
    """Distance between neighbouring points of the cloud, in the unit of the reconstruction."""
    voxel: float
    """Side of the voxels of the mesh, in the unit of the reconstruction."""
    depths: tuple[PosedDepth, ...]
    """(I,) Consistent depths of the undistorted images of the reconstruction."""
    times_s: dict[str, float]
    """Elapsed time of each stage [s]."""
    reused: int = 0
    """Number of depth maps of an earlier result that were reused."""


@single_threaded()
def densify(
    images: ImageSet,
    reconstruction: Reconstruction,
    config: DenseConfig | None = None,
    stages: Stages = silent_stages,
    store: ArrayStore | None = None,
    finished: Mapping[str, FinishedDepth] | None = None,
    *,
    with_texture: bool = False,
) -> DenseResult:
    """Return the surfaces of a scene from images with known cameras.

    To compute them step by step, or to see the depth map of one image::

        load = ViewLoader(images, reconstruction, ViewConfig())
        neighbours = select_neighbours(reconstruction, ViewConfig())
        normals = dominant_normals(reconstruction.points, 3)
        sources = [load(j) for j in neighbours[0]]
        depth = estimate_depth(load(0), sources, observed_points(reconstruction, 0), normals, DepthConfig())

    Args:
        images: The images.
        reconstruction: Cameras, poses and points of the images, as `dronevio.estimator.sfm.reconstruct` returns.
        config: Settings.
        stages: Returns the progress callback of a stage by its name.
        store: Where depth maps are kept; an earlier one is used if its images, cameras and settings are the same.
        finished: Depth maps of an earlier result by the names of their images, which are used again where they hold.
        with_texture: Whether the mesh gets a texture from the images, at their full resolution.

    Raises:
        InputError: A registered image is not among the images, or cannot be read.
    """
    config = config or DenseConfig()
    load = ViewLoader(images, reconstruction, config.views)
    neighbours = select_neighbours(reconstruction, config.views)
    times = [time.perf_counter()]
    reused = reusable_depths(load, reconstruction.image_names, finished or {}, config)
    depths = estimate_depths(load, reconstruction, neighbours, config, stages("depth maps"), store, reused)
    times.append(time.perf_counter())
    consistent = filter_depths(depths, neighbours, config, stages("consistency"))
    spacing = config.spacing_px * pixel_size(consistent)
    cloud = fuse(((depth, load(i).colours) for i, depth in enumerate(consistent)), spacing)
    times.append(time.perf_counter())
    volume = integrate(consistent, config.mesh, stages("mesh"))
    mesh = build_mesh(volume, cloud, config.mesh.min_triangles)
    times.append(time.perf_counter())
    if with_texture:
        mesh = textured(mesh, load, consistent, volume.voxel, config.mesh.texture_px, stages("texture"))
        times.append(time.perf_counter())
    elapsed = np.diff(times).tolist()
    times_s = dict(zip(("depth maps", "fusion", "mesh", "texture"), elapsed, strict=False))
    return DenseResult(cloud, mesh, spacing, volume.voxel, tuple(consistent), times_s, len(reused))


def estimate_depths(
    load: ViewLoader,
    reconstruction: Reconstruction,
    neighbours: Sequence[Indices],
    config: DenseConfig,
    progress: Progress = silent,
    store: ArrayStore | None = None,
    reused: Mapping[int, FinishedDepth] | None = None,
) -> list[PosedDepth]:
    """Return the depth map of each image, without the depths at which the images correlate too little.

    Args:
        load: Returns undistorted images.
        reconstruction: Cameras and points.
        neighbours: (I,) Neighbours of each image.
        config: Settings.
        progress: Called with the number of finished depth maps.
        store: Where depth maps are kept; an earlier one is used if its images, cameras and settings are the same.
        reused: Depth maps of an earlier result by the indices of their images.
    """
    store, reused = store or ArrayStore(), reused or {}
    normals = dominant_normals(reconstruction.points, config.depth.directions)

    def estimate(i: int) -> PosedDepth:
        camera, T = load.camera(i), reconstruction.Ts_world_cam[i]
        points = observed_points(reconstruction, i)
        if not len(neighbours[i]) or not len(points):
            return PosedDepth(camera, T, np.zeros((camera.height, camera.width), np.float32))
        file = f"depth-{i:06d}.npz"
        if i in reused:
            store.save(file, "", **reused[i].arrays())
            return PosedDepth(camera, T, reused[i].inverse_depth)
        reference, sources = load(i), [load(int(j)) for j in neighbours[i]]
        threshold = config.consistency.min_correlation
        inputs = chain.from_iterable(view.inputs() for view in (reference, *sources))
        key = digest(config.depth, threshold, points, normals, camera.width, *inputs)
        stored = store.load(file, key)
        if stored is not None:
            return PosedDepth(camera, T, stored["inverse_depth"])
        depth_map = estimate_depth(reference, sources, points, normals, config.depth)
        inverse_depth = np.where(depth_map.correlation >= threshold, depth_map.inverse_depth, np.float32(0.0))
        names = [reconstruction.image_names[j] for j in (i, *neighbours[i])]
        made = FinishedDepth.of(settings_hash(config), names, (reference, *sources), inverse_depth)
        store.save(file, key, **made.arrays())
        return PosedDepth(camera, T, inverse_depth)

    with ThreadPoolExecutor(config.threads) as pool:
        return map_with_progress(pool, estimate, range(len(load)), progress)


def filter_depths(
    depths: Sequence[PosedDepth], neighbours: Sequence[Indices], config: DenseConfig, progress: Progress = silent
) -> list[PosedDepth]:
    """Return the depth maps with the depths that others confirm, averaged over those that agree.

    Args:
        depths: (I,) Depth maps.
        neighbours: (I,) Depth maps with which each is compared.
        config: Settings.
        progress: Called with the number of finished depth maps.
    """

    def check(i: int) -> PosedDepth:
        inverse_depth, _ = consistent_depth(depths[i], [depths[j] for j in neighbours[i]], config.consistency)
        return replace(depths[i], inverse_depth=inverse_depth)

    with ThreadPoolExecutor(config.threads) as pool:
        return map_with_progress(pool, check, range(len(depths)), progress)
