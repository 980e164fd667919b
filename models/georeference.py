"""How measured positions determine the world frame of a reconstruction."""

from dataclasses import dataclass
from typing import Literal

from dronevio.models.arrays import Array, Mask
from dronevio.models.geodesy import GeodeticPoint

PositionSource = Literal["gps", "control points", "gps and control points"]
"""Which positions determine a world frame: those of photographs, those of ground control points, or both."""


@dataclass(frozen=True, eq=False)
class GeoReference:
    """How measured positions determine the world frame of a reconstruction: east, north, up from an origin.

    An error that all positions have in common is part of none of the standard deviations.
    """

    source: PositionSource
    """Which positions determine it."""
    origin: GeodeticPoint
    """The origin of the world frame."""
    scale_sigma: float
    """Standard deviation of the scale, relative to it; 0 if a rig determines the scale."""
    north_sigma_rad: float
    """Standard deviation of north [rad]."""
    tilt_sigma_rad: float
    """Standard deviation of the vertical about the less certain axis [rad]."""
    noise_factor: float
    """Ratio of the residuals to the stated standard deviations, by which these were multiplied; at least 1."""
    image_names: tuple[str, ...]
    """(N,) Images with a position."""
    residuals_m: Array
    """(N, 3) Their measured positions minus the estimated ones, east, north and up [m]; NaN without an altitude."""
    is_outlier: Mask
    """(N,) Whether a residual is larger than the noise explains; such a position has little weight."""
    gimbal_deviation_deg: tuple[float, float] | None
    """Median angles between the orientations by the gimbals and the estimated ones [deg]: the tilt, and the yaw, which
    is positive if that of the gimbals is larger. None without gimbals."""
    point_names: tuple[str, ...]
    """(G,) Control points that were found in two registered images."""
    point_residuals_m: Array
    """(G, 3) Their measured positions minus the estimated ones, east, north and up [m]."""
    point_errors_px: Array
    """(G,) RMS distance of their pixels from the projections of their measured positions [px]."""
    point_is_outlier: Mask
    """(G,) Whether a residual is larger than the noise explains."""
    notes: tuple[str, ...]
    """What was left out."""
