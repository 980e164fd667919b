"""Cameras of a reconstruction on a map: GeoJSON (RFC 7946) and KML (OGC 12-007r2, version 2.3).

Altitudes are those of the origin of the world frame, whose reference is stated: GeoJSON expects heights above the
ellipsoid, and KML heights above sea level.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from dronevio.models.geodesy import GeodeticPoint, yaw_pitch_roll_deg
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.recordings.files import write_text

_KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>{name}</name>
<description>Cameras of a reconstruction; altitudes by {reference}</description>
{placemarks}
</Document>
</kml>
"""
_PLACEMARK = """<Placemark>
<name>{name}</name>
<Camera><longitude>{longitude:.9f}</longitude><latitude>{latitude:.9f}</latitude><altitude>{altitude:.4f}</altitude>\
<heading>{heading:.3f}</heading><tilt>{tilt:.3f}</tilt><altitudeMode>absolute</altitudeMode></Camera>
<Point><altitudeMode>absolute</altitudeMode><coordinates>{longitude:.9f},{latitude:.9f},{altitude:.4f}</coordinates></Point>
</Placemark>"""


def write_cameras_geojson(path: Path, reconstructions: Sequence[Reconstruction], origin: GeodeticPoint) -> None:
    """Write the cameras of reconstructions whose world frame is east, north, up, as GeoJSON.

    Args:
        path: The file to write.
        reconstructions: The reconstructions, in metres.
        origin: Where the origin of their world frame is.

    Raises:
        InputError: The file cannot be written.
    """
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates": [round(longitude, 9), round(latitude, 9), round(altitude, 4)],
            },
            "properties": {
                "image": name,
                "component": number,
                "altitude_reference": origin.reference,
                "yaw_deg": round(yaw, 4),
                "pitch_deg": round(pitch, 4),
                "roll_deg": round(roll, 4),
            },
        }
        for number, name, (latitude, longitude, altitude), (yaw, pitch, roll) in _cameras(reconstructions, origin)
    ]
    content = {"type": "FeatureCollection", "features": features}
    write_text(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_cameras_kml(path: Path, reconstructions: Sequence[Reconstruction], origin: GeodeticPoint, name: str) -> None:
    """Write the cameras of reconstructions whose world frame is east, north, up, as KML.

    Args:
        path: The file to write.
        reconstructions: The reconstructions, in metres.
        origin: Where the origin of their world frame is.
        name: Name of the document.

    Raises:
        InputError: The file cannot be written.
    """
    placemarks = [
        _PLACEMARK.format(
            name=escape(image),
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            heading=yaw % 360.0,
            tilt=90.0 + pitch,
        )
        for _, image, (latitude, longitude, altitude), (yaw, pitch, _) in _cameras(reconstructions, origin)
    ]
    text = _KML.format(name=escape(name), reference=origin.reference, placemarks="\n".join(placemarks))
    write_text(path, text)


def _cameras(
    reconstructions: Sequence[Reconstruction], origin: GeodeticPoint
) -> list[tuple[int, str, tuple[float, ...], tuple[float, float, float]]]:
    """Return component, name, geodetic coordinates, and yaw, pitch and roll [deg] of each camera."""
    return [
        (number, name, tuple(place), yaw_pitch_roll_deg(T[:3, :3]))
        for number, found in enumerate(reconstructions, start=1)
        for name, place, T in zip(
            found.image_names, origin.from_enu(found.positions).tolist(), found.Ts_world_cam, strict=True
        )
    ]
