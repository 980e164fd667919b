"""Settings of multi-view stereo; this module imports none of the libraries that it uses."""

from dataclasses import dataclass, field
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class ViewConfig(Settings):
    """Undistorted images, and the neighbours of each image."""

    max_side_px: Annotated[int, Range(16, 10_000)] = 1000
    """Largest length of the longer side of the undistorted images; larger photographs are reduced [px]."""
    max_angle_deg: Annotated[float, Range(above=0.0, below=90.0)] = 60.0
    """Largest angle from the optical axis that undistorted images contain; fisheye images are cut there [deg]."""
    neighbours: Annotated[int, Range(1, 100)] = 6
    """Number of neighbouring images that an image is compared with."""
    angle_deg: Annotated[float, Range(above=0.0, high=90.0)] = 6.0
    """Preferred angle between the rays of two neighbouring images to a point [deg]."""


@dataclass(frozen=True)
class DepthConfig(Settings):
    """Depth maps by a plane sweep and semi-global matching."""

    window_px: Annotated[int, Range(3, 31, odd=True)] = 7
    """Side of the square window of the correlation, an odd number [px]."""
    best_views: Annotated[int, Range(1, 100)] = 2
    """Number of neighbouring images with the best correlation whose mean is the cost; the others may be occluded."""
    max_planes: Annotated[int, Range(4, 1024)] = 128
    """Largest number of planes of a sweep."""
    plane_step: Annotated[float, Range(0.1, 100.0)] = 1.5
    """Distance between the planes of a sweep, at the lowest resolution [px]."""
    directions: Annotated[int, Range(0, 20)] = 3
    """Number of surface orientations of the scene along which planes are swept, besides the optical axis."""
    range_margin: Annotated[float, Range(0.0, below=1.0)] = 0.3
    """Margin of the depth range around the points of the reconstruction, as a share of the nearest and farthest."""
    levels: Annotated[int, Range(1, 8)] = 3
    """Number of resolutions, each half the next one; planes are swept at the lowest."""
    small_penalty: Annotated[float, Range(0.0, 100.0)] = 0.06
    """Penalty of semi-global matching for a change by one depth step between neighbouring pixels; costs are 0 to 1."""
    large_penalty: Annotated[float, Range(0.0, 100.0)] = 0.4
    """Penalty of semi-global matching for a larger change between neighbouring pixels, where there is no edge."""


@dataclass(frozen=True)
class ConsistencyConfig(Settings):
    """Photometric and geometric consistency of depths."""

    min_correlation: Annotated[float, Range(-1.0, 1.0)] = 0.3
    """Smallest mean correlation (ZNCC) of a depth."""
    min_views: Annotated[int, Range(0, 100)] = 2
    """Smallest number of other depth maps that confirm a depth."""
    max_reprojection_px: Annotated[float, Range(above=0.0)] = 1.0
    """Largest distance from a pixel after the projection to another depth map and back [px]."""


@dataclass(frozen=True)
class MeshConfig(Settings):
    """Surface from a truncated signed distance function."""

    voxel: Annotated[float, Range(low=0.0)] = 0.0
    """Side of a voxel in the unit of the reconstruction; 0 for two pixels of the undistorted images."""
    max_voxels: Annotated[int, Range(1000, 1_000_000_000)] = 20_000_000
    """Largest number of voxels; larger voxels are used if the scene needs more."""
    min_triangles: Annotated[int, Range(0, 100_000_000)] = 100
    """Smallest number of triangles of a connected part of the mesh."""
    texture_px: Annotated[int, Range(64, 32_768)] = 8192
    """Largest width and height of the texture of a mesh; the images are reduced until it suffices [px]."""


@dataclass(frozen=True)
class DenseConfig(Settings):
    """Multi-view stereo."""

    views: ViewConfig = field(default_factory=ViewConfig)
    """Undistorted images, and the neighbours of each image."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Depth maps of the images."""
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    """Consistency of depths."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Mesh of the surface."""
    spacing_px: Annotated[float, Range(0.01, 1e3)] = 1.0
    """Distance between neighbouring points of the cloud, in pixels of the undistorted images at the median depth."""
    threads: Annotated[int, Range(1, 256)] = 2
    """Number of threads that compute depth maps."""
