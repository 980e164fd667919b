"""Points and mesh of the depth images of a flight, at the final poses of their cameras."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from dronevio.estimator.dense.config import MeshConfig
from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.estimator.dense.fusion import fuse
from dronevio.estimator.dense.meshing.mesh import build_mesh
from dronevio.estimator.dense.meshing.tsdf import integrate
from dronevio.estimator.mapping.keyframe_depths import KeptDepth
from dronevio.models.arrays import Array, Floats
from dronevio.models.progress import Progress, silent
from dronevio.models.surfaces import Mesh, PointCloud

MIN_SUPPORT = 2.0
"""Number of depth images, each at a large depth, that have to see a voxel with a surface."""
_LARGE_PERCENTILE = 90.0  # of all depths
_MIN_TRIANGLES = 100  # of a connected part of the mesh
_MAX_VOXELS = 20_000_000


def surfaces(
    depths: Sequence[KeptDepth], Ts_map_odom: Array, voxel_m: float, progress: Progress = silent
) -> tuple[PointCloud, Mesh]:
    """Return the surfaces of depth images as points and as a mesh, in the map frame.

    The mesh is the zero level of their truncated signed distance function; see `dronevio.estimator.dense.meshing.tsdf`.
    Voxels that few images have seen have no surface, and neither have small separate parts. The points are means in
    voxels, of which those beside the mesh are left out.

    Args:
        depths: N depth images.
        Ts_map_odom: (N, 4, 4) Poses of the odometry frame in the map frame at their times.
        voxel_m: Side of the voxels [m].
        progress: Called with the number of integrated depth images.
    """
    posed = [
        PosedDepth(depth.camera, T @ depth.T_odom_cam, depth.inverse_depth.astype(np.float32))
        for depth, T in zip(depths, Ts_map_odom, strict=True)
    ]
    greys = (np.repeat(depth.grey[..., None], 3, axis=2) for depth in depths)
    cloud = fuse(zip(posed, greys, strict=True), voxel_m)
    volume = integrate(posed, MeshConfig(voxel=voxel_m, max_voxels=_MAX_VOXELS), progress)
    volume.weights[volume.weights < MIN_SUPPORT * _least_weight(posed)] = 0.0
    mesh = build_mesh(volume, cloud, _MIN_TRIANGLES)
    return _beside(cloud, mesh, 2.0 * volume.voxel), mesh


def _least_weight(posed: Sequence[PosedDepth]) -> float:
    """Return the weight of a depth image at a large depth, 0 without depths; nearer surfaces have larger weights."""
    known: list[Floats] = [each.inverse_depth[each.inverse_depth > 0.0][::16] for each in posed]
    values = np.concatenate([np.zeros(0, np.float32), *known])
    return float(np.percentile(values, 100.0 - _LARGE_PERCENTILE) ** 2) if len(values) else 0.0


def _beside(cloud: PointCloud, mesh: Mesh, distance: float) -> PointCloud:
    """Return the points of a cloud within a distance of a vertex of a mesh."""
    if not len(cloud) or not len(mesh.vertices):
        return cloud.selected(np.zeros(len(cloud), bool))
    found, _ = cKDTree(mesh.vertices).query(cloud.points, distance_upper_bound=distance)
    return cloud.selected(np.isfinite(found))
