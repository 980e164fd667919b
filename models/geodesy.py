"""Positions and attitudes on Earth: WGS 84, Earth-centred coordinates, and local frames of east, north and up.

Geodetic coordinates are latitude and longitude [deg], and the height above the ellipsoid [m]. Earth-centred
coordinates (ECEF) have z along the axis of rotation and x through latitude and longitude zero [m]. A local frame (ENU)
has its origin at a point, x east, y north and z up along the normal of the ellipsoid [m].

Source: NGA.STND.0036, "Department of Defense World Geodetic System 1984", 2014. ECEF coordinates are converted back by
Bowring, "The accuracy of geodetic latitude and height equations", Survey Review 28 (1985), whose error is below a
nanometre up to 10 km above the ellipsoid. Transverse Mercator: Karney, "Transverse Mercator with an accuracy of a few
nanometers", Journal of Geodesy 85 (2011), eq. 35-36, to the order n³ of the flattening (below a millimetre in a zone).
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dronevio.models.arrays import Array

SEMI_MAJOR_M = 6378137.0
"""Semi-major axis of the ellipsoid [m]."""
FLATTENING = 1.0 / 298.257223563
"""Flattening of the ellipsoid."""
AltitudeReference = Literal["ellipsoid", "sea level", "unknown"]
"""Reference of altitudes: the ellipsoid of WGS 84, or mean sea level (a geoid)."""
UTM_SCALE, UTM_FALSE_EASTING_M, UTM_FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0
"""Scale on the central meridian of a UTM zone, and its false easting and, in the south, northing [m]."""
BOWRING_ITERATIONS = 3
"""Number of iterations of Bowring's equation; one is enough near the ellipsoid."""

_E2 = FLATTENING * (2.0 - FLATTENING)
_SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_R_FORWARD_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # forward, right, down
_R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class GeodeticPoint:
    """A point on Earth, by the ellipsoid of WGS 84; the origin of a local frame."""

    latitude_deg: float
    """Geodetic latitude, north positive [deg]."""
    longitude_deg: float
    """Longitude, east positive [deg]."""
    altitude_m: float
    """Height above the reference [m]."""
    reference: AltitudeReference = "ellipsoid"
    """Reference of the altitude. Above sea level, heights are converted as if they were those above the ellipsoid, from
    which they differ by nearly the same everywhere in a small area."""

    @property
    def geodetic(self) -> Array:
        """(3,) Latitude, longitude [deg], height [m]."""
        return np.array([self.latitude_deg, self.longitude_deg, self.altitude_m])

    def to_enu(self, geodetic: Array) -> Array:
        """Return the positions (..., 3) in the local frame of geodetic coordinates (..., 3) [m]."""
        relative = ecef_from_geodetic(geodetic) - ecef_from_geodetic(self.geodetic)
        return np.asarray(relative @ rotation_ecef_enu(self.latitude_deg, self.longitude_deg))

    def from_enu(self, enu_m: Array) -> Array:
        """Return the geodetic coordinates (..., 3) of positions (..., 3) in the local frame."""
        R_ecef_enu = rotation_ecef_enu(self.latitude_deg, self.longitude_deg)
        return geodetic_from_ecef(ecef_from_geodetic(self.geodetic) + np.asarray(enu_m) @ R_ecef_enu.T)


def ecef_from_geodetic(geodetic: Array) -> Array:
    """Return the ECEF coordinates (..., 3) [m] of latitudes, longitudes [deg] and heights [m] (..., 3)."""
    geodetic = np.asarray(geodetic, np.float64)
    latitude, longitude = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
    height = geodetic[..., 2]
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)  # radius of curvature in the prime vertical
    across = (normal + height) * np.cos(latitude)
    z = (normal * (1.0 - _E2) + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), z], axis=-1)


def geodetic_from_ecef(ecef_m: Array) -> Array:
    """Return latitudes, longitudes [deg] and heights [m] (..., 3) of ECEF coordinates (..., 3) [m]."""
    x, y, z = np.moveaxis(np.asarray(ecef_m, np.float64), -1, 0)
    across = np.hypot(x, y)
    second_e2 = _E2 / (1.0 - _E2)
    sine, cosine = z * SEMI_MAJOR_M, across * _SEMI_MINOR_M  # of the parametric latitude, not normalized
    for _ in range(BOWRING_ITERATIONS):
        length = np.hypot(sine, cosine)
        s, c = sine / length, cosine / length
        up = z + second_e2 * _SEMI_MINOR_M * s**3
        out = across - _E2 * SEMI_MAJOR_M * c**3
        sine, cosine = _SEMI_MINOR_M * up, SEMI_MAJOR_M * out
    latitude = np.arctan2(up, out)
    sin, cos = np.sin(latitude), np.cos(latitude)
    height = across * cos + z * sin - SEMI_MAJOR_M * np.sqrt(1.0 - _E2 * sin**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=-1)


def rotation_ecef_enu(latitude_deg: float, longitude_deg: float) -> Array:
    """Return the rotation (3, 3) from the local frame of a point to ECEF; its columns are east, north and up."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, -s * cl, c * cl], [cl, -s * sl, c * sl], [0.0, c, s]])


def geodetic_from_utm(easting_northing_m: Array, zone: int, is_north: bool) -> Array:
    """Return latitudes and longitudes (..., 2) [deg] of coordinates in a zone of UTM.

    Args:
        easting_northing_m: (..., 2) Easting and northing [m].
        zone: Number of the zone, from 1 to 60; its central meridian is 6 · zone − 183 degrees east.
        is_north: Whether the zone is that of the northern hemisphere.
    """
    coordinates = np.asarray(easting_northing_m, np.float64)
    n = FLATTENING / (2.0 - FLATTENING)
    radius = SEMI_MAJOR_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    # Krüger's series in the third flattening: to conformal coordinates, and from the conformal to geodetic latitude
    beta = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    delta = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    xi = (coordinates[..., 1] - (0.0 if is_north else UTM_FALSE_NORTHING_M)) / (UTM_SCALE * radius)
    eta = (coordinates[..., 0] - UTM_FALSE_EASTING_M) / (UTM_SCALE * radius)
    xi1 = xi - sum(b * np.sin(2 * k * xi) * np.cosh(2 * k * eta) for k, b in enumerate(beta, start=1))
    eta1 = eta - sum(b * np.cos(2 * k * xi) * np.sinh(2 * k * eta) for k, b in enumerate(beta, start=1))
    conformal = np.arcsin(np.sin(xi1) / np.cosh(eta1))
    latitude = conformal + sum(d * np.sin(2 * k * conformal) for k, d in enumerate(delta, start=1))
    longitude = np.arctan2(np.sinh(eta1), np.cos(xi1))
    return np.stack([np.degrees(latitude), np.degrees(longitude) + 6.0 * zone - 183.0], axis=-1)


def rotation_enu_cam(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Return the orientation (3, 3) of a camera (x right, y down, z forward) in east, north, up.

    Args:
        yaw_deg: Azimuth of the direction forward from north, clockwise [deg].
        pitch_deg: Elevation of the optical axis, −90 straight down [deg].
        roll_deg: Roll about the optical axis, to the right [deg].
    """
    (cy, sy), (cp, sp), (cr, sr) = (
        (math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (yaw_deg, pitch_deg, roll_deg)
    )
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(_R_ENU_NED @ yaw @ pitch @ roll @ _R_FORWARD_CAM)


def yaw_pitch_roll_deg(R_enu_cam: Array) -> tuple[float, float, float]:
    """Return yaw, pitch and roll of a camera [deg], the inverse of `rotation_enu_cam`; the roll is 0 straight down."""
    R = _R_ENU_NED.T @ R_enu_cam @ _R_FORWARD_CAM.T
    pitch = math.degrees(math.asin(min(max(-R[2, 0], -1.0), 1.0)))
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:
        return math.degrees(math.atan2(-R[0, 1], R[1, 1])), pitch, 0.0
    yaw, roll = math.atan2(R[1, 0], R[0, 0]), math.atan2(R[2, 1], R[2, 2])
    return math.degrees(yaw), pitch, math.degrees(roll)
