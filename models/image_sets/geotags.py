"""Position and orientation of photographs by their metadata: EXIF GPS, and the XMP of DJI.

A position in the XMP of DJI, which has more digits, replaces that of EXIF. Its altitude is that above the ellipsoid if
a fix is of RTK; in EXIF, the reference of the altitude says it. Without a geoid, heights above sea level stay what they
are: where a set is small, the difference is a constant of up to a hundred metres. Standard deviations are those of RTK
in XMP, or ``GPSHPositioningError``, or follow from ``GPSDOP``, or are assumed.

The orientation is that of the gimbal: yaw from north, clockwise, pitch, which is −90° straight down, and roll, applied
in this order about the axes forward, right and down.

The text of XMP is searched for values of known names and never parsed as XML, so that no entity of it is expanded.

Tags: CIPA DC-008, "Exchangeable image file format for digital still cameras: Exif 3.0", section 4.6.6; DJI,
"Image metadata" of the Mavic 3 Enterprise and the Phantom 4 RTK.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.geodesy import AltitudeReference, GeodeticPoint, rotation_enu_cam

ASSUMED_SIGMA_M = 5.0
"""Standard deviation of the horizontal coordinates of a position of which nothing is stated [m]."""
RANGE_ERROR_M = 2.5
"""Standard deviation of a position for a dilution of precision of one [m]."""
VERTICAL_RATIO = 1.5
"""Standard deviation of the altitude relative to that of the horizontal coordinates, where it is not stated."""
RTK_SIGMAS_M = 0.02, 0.02, 0.04
"""Standard deviations east, north and up of a fix of RTK that does not state them [m]."""
MIN_SIGMA_M = 0.001
"""Smallest standard deviation that is believed [m]."""
ALTITUDE_RANGE_M = -1000.0, 100_000.0
"""Range of plausible altitudes [m]."""
MAX_XMP_BYTES = 1_000_000
"""Number of bytes of XMP that are searched."""

_XMP_NUMBER = rb"drone-dji:%s\s*(?:=\s*[\"']|>)\s*([+-]?[0-9]{1,9}(?:\.[0-9]{0,20})?)\s*[\"'<]"
_XMP_TEXT = rb"drone-dji:%s\s*(?:=\s*[\"']|>)\s*([A-Za-z]{1,40})\s*[\"'<]"
_RTK_FIXED, _RTK_FLOAT = 50, range(32, 50)
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_DOP, _POSITIONING_ERROR = 11, 31
_ALTITUDE_SIGNS: Mapping[int, tuple[float, AltitudeReference]] = {
    0: (1.0, "sea level"),
    1: (-1.0, "sea level"),
    2: (1.0, "ellipsoid"),
    3: (-1.0, "ellipsoid"),
}


@dataclass(frozen=True)
class GeoTag:
    """Position and orientation of one photograph by its metadata."""

    latitude_deg: float
    """Latitude of WGS 84, north positive [deg]."""
    longitude_deg: float
    """Longitude, east positive [deg]."""
    altitude_m: float | None
    """Altitude [m], None if it is unknown."""
    altitude_reference: AltitudeReference
    """Reference of the altitude."""
    sigma_m: tuple[float, float, float]
    """Standard deviations east, north and up [m]."""
    gimbal_deg: tuple[float, float, float] | None = None
    """Yaw, pitch and roll of the camera [deg], None if they are unknown."""


@dataclass(frozen=True, eq=False)
class GeoTags:
    """Positions and orientations of the I images of a set by their metadata."""

    geodetic: Array
    """(I, 3) Latitude, longitude [deg], altitude [m]; NaN where there is none."""
    sigmas_m: Array
    """(I, 3) Standard deviations east, north and up [m]; NaN where there is no position."""
    Rs_enu_cam: Array
    """(I, 3, 3) Orientations of the cameras by their gimbals in east, north, up; NaN where there is none."""
    altitude_reference: AltitudeReference
    """Reference that most altitudes have; those with another one are left out."""
    notes: tuple[str, ...] = ()
    """What was left out, and of how many images."""

    def __getitem__(self, chosen: npt.NDArray[np.int64]) -> "GeoTags":
        """Return those of some images."""
        arrays = self.geodetic[chosen], self.sigmas_m[chosen], self.Rs_enu_cam[chosen]
        return GeoTags(*arrays, self.altitude_reference, self.notes)

    @property
    def has_position(self) -> Mask:
        """(I,) Whether latitude and longitude of each image are known."""
        return np.isfinite(self.geodetic[:, 0])

    @property
    def origin(self) -> GeodeticPoint:
        """The median position, which one wrong position hardly moves, to a millionth of a degree and a metre."""
        latitude, longitude, altitude = (
            float(np.median(column[np.isfinite(column)])) if np.isfinite(column).any() else 0.0
            for column in self.geodetic.T
        )
        return GeodeticPoint(round(latitude, 6), round(longitude, 6), float(round(altitude)), self.altitude_reference)


def read_geotag(gps: Mapping[int, object], xmp: bytes) -> GeoTag | str | None:
    """Return the position of a photograph, None if it has none, or a text that says why it cannot be used.

    Args:
        gps: Values of the GPS tags of EXIF by number.
        xmp: The XMP packet, empty without one.
    """
    dji = _dji_position(xmp)
    latitude = dji[0] if dji else _degrees(gps.get(_LATITUDE), gps.get(_LATITUDE_REF), "NS", 90.0)
    longitude = dji[1] if dji else _degrees(gps.get(_LONGITUDE), gps.get(_LONGITUDE_REF), "EW", 180.0)
    if latitude is None or longitude is None:
        return "a position that cannot be read" if gps.get(_LATITUDE) or gps.get(_LONGITUDE) else None
    if latitude == 0.0 and longitude == 0.0:
        return "a position at latitude and longitude zero"  # what receivers without a fix write
    altitude, reference = _altitude(gps)
    if dji is not None and dji[2] is not None:
        altitude, reference = dji[2], "ellipsoid" if _is_rtk(xmp) else reference
    return GeoTag(latitude, longitude, altitude, reference, _sigmas_m(gps, xmp), _gimbal_deg(xmp))


def geotags_of(tags: Sequence[GeoTag | str | None]) -> GeoTags | None:
    """Return the positions of a set of images, None if no image has one or a text that says why it has none."""
    if not any(tag is not None for tag in tags):
        return None
    geodetic, sigmas = np.full((len(tags), 3), np.nan), np.full((len(tags), 3), np.nan)
    rotations = np.full((len(tags), 3, 3), np.nan)
    notes = Counter(tag for tag in tags if isinstance(tag, str))
    references = Counter(t.altitude_reference for t in tags if isinstance(t, GeoTag) and t.altitude_m is not None)
    reference = references.most_common(1)[0][0] if references else "unknown"
    for i, tag in enumerate(tags):
        if not isinstance(tag, GeoTag):
            continue
        geodetic[i, :2], sigmas[i] = (tag.latitude_deg, tag.longitude_deg), tag.sigma_m
        if tag.altitude_m is not None and tag.altitude_reference == reference:
            geodetic[i, 2] = tag.altitude_m
        elif tag.altitude_m is not None:
            notes[f"an altitude by another reference ({tag.altitude_reference}) than most ({reference})"] += 1
        if tag.gimbal_deg is not None:
            rotations[i] = rotation_enu_cam(*tag.gimbal_deg)
    listed = tuple(f"{count} of {len(tags)} images: {text}" for text, count in sorted(notes.items()))
    return GeoTags(geodetic, sigmas, rotations, reference, listed)


def joined_geotags(first: GeoTags | None, count: int, second: GeoTags | None, others: int) -> GeoTags | None:
    """Return the positions of two sets of images together; altitudes of the second by another reference are left out.

    Args:
        first: Positions of the first set, None without any.
        count: Number of its images.
        second: Positions of the second set.
        others: Number of its images.
    """
    if first is None and second is None:
        return None
    parts = [part or _no_geotags(size) for part, size in ((first, count), (second, others))]
    reference = (first or parts[1]).altitude_reference
    geodetic = np.concatenate([part.geodetic for part in parts])
    if parts[1].altitude_reference != reference:
        geodetic[count:, 2] = np.nan
    return GeoTags(
        geodetic,
        np.concatenate([part.sigmas_m for part in parts]),
        np.concatenate([part.Rs_enu_cam for part in parts]),
        reference,
        parts[0].notes + parts[1].notes,
    )


def _no_geotags(count: int) -> GeoTags:
    """Return those of images without positions."""
    unknown = np.full((count, 3), np.nan)
    return GeoTags(unknown, unknown.copy(), np.full((count, 3, 3), np.nan), "unknown")


def _dji_position(xmp: bytes) -> tuple[float, float, float | None] | None:
    """Return latitude, longitude and altitude in the XMP of DJI, None without a plausible one."""
    latitude = _xmp_number(xmp, b"GpsLatitude")
    longitude = _xmp_number(xmp, b"GpsLong(?:t?)itude")  # older firmware writes GpsLongtitude
    if latitude is None or longitude is None or abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return None
    if latitude == 0.0 and longitude == 0.0:
        return None
    return latitude, longitude, _plausible_altitude(_xmp_number(xmp, b"AbsoluteAltitude"))


def _is_rtk(xmp: bytes) -> bool:
    """Return whether the position in XMP is one of RTK, whose altitude is that above the ellipsoid."""
    kind = re.search(_XMP_TEXT % b"AltitudeType", xmp[:MAX_XMP_BYTES])
    if kind is not None:
        return kind[1] == b"RtkAlt"
    flag = _xmp_number(xmp, b"RtkFlag")
    return flag is not None and (int(flag) == _RTK_FIXED or int(flag) in _RTK_FLOAT)


def _sigmas_m(gps: Mapping[int, object], xmp: bytes) -> tuple[float, float, float]:
    """Return the standard deviations east, north and up [m]."""
    flag = int(_xmp_number(xmp, b"RtkFlag") or 0)
    if flag == _RTK_FIXED or flag in _RTK_FLOAT:
        stated = [_xmp_number(xmp, name) for name in (b"RtkStdLon", b"RtkStdLat", b"RtkStdHgt")]
        if all(value is not None and value > 0.0 for value in stated):
            east, north, up = (max(value or 0.0, MIN_SIGMA_M) for value in stated)
            return east, north, up
        if flag == _RTK_FIXED:
            return RTK_SIGMAS_M
    horizontal = _number(gps.get(_POSITIONING_ERROR)) or 0.0
    if horizontal <= 0.0:
        horizontal = RANGE_ERROR_M * max(_number(gps.get(_DOP)) or 0.0, 0.0) or ASSUMED_SIGMA_M
    horizontal = max(horizontal, MIN_SIGMA_M)
    return horizontal, horizontal, VERTICAL_RATIO * horizontal


def _gimbal_deg(xmp: bytes) -> tuple[float, float, float] | None:
    """Return yaw, pitch and roll of the gimbal, None unless all are plausible."""
    yaw, pitch, roll = (
        _xmp_number(xmp, name) for name in (b"GimbalYawDegree", b"GimbalPitchDegree", b"GimbalRollDegree")
    )
    if yaw is None or pitch is None or roll is None or max(abs(yaw), abs(pitch), abs(roll)) > 360.0:
        return None
    return yaw, pitch, roll


def _altitude(gps: Mapping[int, object]) -> tuple[float | None, AltitudeReference]:
    """Return the altitude in EXIF and its reference."""
    value, reference = _number(gps.get(_ALTITUDE)), gps.get(_ALTITUDE_REF, 0)
    code = reference[0] if isinstance(reference, bytes) and reference else reference
    if value is None or not isinstance(code, int) or code not in _ALTITUDE_SIGNS:
        return None, "unknown"
    sign, kind = _ALTITUDE_SIGNS[code]
    return _plausible_altitude(sign * value), kind


def _plausible_altitude(value: float | None) -> float | None:
    """Return an altitude, None if no drone is that low or high."""
    return value if value is not None and ALTITUDE_RANGE_M[0] <= value <= ALTITUDE_RANGE_M[1] else None


def _degrees(value: object, reference: object, signs: str, limit: float) -> float | None:
    """Return an angle in EXIF [deg]: degrees, minutes and seconds, with a letter for the sign."""
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or not 1 <= len(value) <= 3:
        return None
    parts = [_number(part) for part in value]
    if isinstance(reference, bytes):
        reference = reference.decode("ascii", "replace")
    letter = reference.strip(" \0").upper()[:1] if isinstance(reference, str) else ""
    if any(part is None or part < 0.0 for part in parts) or letter not in signs or not letter:
        return None
    angle = sum((part or 0.0) / 60.0**k for k, part in enumerate(parts))
    return (angle if letter == signs[0] else -angle) if angle <= limit else None


def _number(value: object) -> float | None:
    """Return a finite number, None for anything else; a rational number may have the denominator zero."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _xmp_number(xmp: bytes, name: bytes) -> float | None:
    """Return the number of a name in XMP, an attribute or an element; None if it has none."""
    found = re.search(_XMP_NUMBER % name, xmp[:MAX_XMP_BYTES])
    return None if found is None else float(found[1])
