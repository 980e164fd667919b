"""Settings of multi-view stereo; this module imports none of the libraries that it uses."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ViewConfig:
    """Undistorted images, and the neighbours of each image."""

    max_side_px: int = 1000
    """Largest length of the longer side of the undistorted images; larger photographs are reduced [px]."""
    max_angle_deg: float = 60.0
    """Largest angle from the optical axis that undistorted images contain; fisheye images are cut there [deg]."""
    neighbours: int = 6
    """Number of neighbouring images that an image is compared with."""
    angle_deg: float = 6.0
    """Preferred angle between the rays of two neighbouring images to a point [deg]."""


@dataclass(frozen=True)
class DepthConfig:
    """Depth maps by a plane sweep and semi-global matching."""

    window_px: int = 7
    """Side of the square window of the correlation, an odd number [px]."""
    best_views: int = 2
    """Number of neighbouring images with the best correlation whose mean is the cost; the others may be occluded."""
    max_planes: int = 128
    """Largest number of planes of a sweep."""
    plane_step: float = 1.5
    """Distance between the planes of a sweep, at the lowest resolution [px]."""
    directions: int = 3
    """Number of surface orientations of the scene along which planes are swept, besides the optical axis."""
    range_margin: float = 0.3
    """Margin of the depth range around the points of the reconstruction, as a share of the nearest and farthest."""
    levels: int = 3
    """Number of resolutions, each half the next one; planes are swept at the lowest."""
    refinement_steps: int = 4
    """Number of depths on either side of the result of a lower resolution that the refinement examines."""
    refinement_step: float = 0.5
    """Distance between the depths of the refinement [px]."""
    small_penalty: float = 0.06
    """Penalty of semi-global matching for a change by one depth step between neighbouring pixels; costs are 0 to 1."""
    large_penalty: float = 0.4
    """Penalty of semi-global matching for a larger change between neighbouring pixels, where there is no edge."""


@dataclass(frozen=True)
class ConsistencyConfig:
    """Photometric and geometric consistency of depths."""

    min_correlation: float = 0.3
    """Smallest mean correlation (ZNCC) of a depth."""
    min_views: int = 2
    """Smallest number of other depth maps that confirm a depth."""
    max_reprojection_px: float = 1.0
    """Largest distance from a pixel after the projection to another depth map and back [px]."""
    max_depth_ratio: float = 0.01
    """Largest relative difference between a depth and that of the other depth map."""


@dataclass(frozen=True)
class MeshConfig:
    """Surface from a truncated signed distance function."""

    voxel: float = 0.0
    """Side of a voxel in the unit of the reconstruction; 0 for `voxel_px`."""
    voxel_px: float = 2.0
    """Side of a voxel in pixels of the undistorted images, at the median depth [px]."""
    truncation_voxels: float = 4.0
    """Distance from the surface at which the function is truncated, in voxels."""
    max_voxels: int = 20_000_000
    """Largest number of voxels; larger voxels are used if the scene needs more."""
    min_triangles: int = 100
    """Smallest number of triangles of a connected part of the mesh."""


@dataclass(frozen=True)
class DenseConfig:
    """Multi-view stereo."""

    views: ViewConfig = field(default_factory=ViewConfig)
    """Undistorted images, and the neighbours of each image."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Depth maps of the images."""
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    """Consistency of depths."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Mesh of the surface."""
    spacing_px: float = 1.0
    """Distance between neighbouring points of the cloud, in pixels of the undistorted images at the median depth."""
    threads: int = 2
    """Number of threads that compute depth maps."""
