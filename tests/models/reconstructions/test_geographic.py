"""Cameras on a map: GeoJSON and KML."""

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.geodesy import GeodeticPoint, rotation_enu_cam
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.geographic import write_cameras_geojson, write_cameras_kml

ORIGIN = GeodeticPoint(47.4, -8.5, 400.0, "sea level")
KML = "{http://www.opengis.net/kml/2.2}"


@pytest.fixture
def cameras() -> Reconstruction:
    """Two cameras, one 100 m above the origin that looks down with north on top, one level to the east."""
    Ts = np.tile(np.eye(4), (2, 1, 1))
    Ts[0, :3, :3], Ts[0, :3, 3] = rotation_enu_cam(0.0, -90.0, 0.0), (0.0, 0.0, 100.0)
    Ts[1, :3, :3], Ts[1, :3, 3] = rotation_enu_cam(90.0, 0.0, 0.0), (50.0, 0.0, 0.0)
    empty = np.empty(0, np.int64)
    return Reconstruction(
        (CameraModel(40, 30, 30.0, 30.0, 19.5, 14.5),),
        ("a & <b>.jpg", "ü.jpg"),
        np.zeros(2, np.int64),
        Ts,
        np.empty((0, 3)),
        np.empty((0, 3), np.uint8),
        empty,
        empty,
        np.empty((0, 2)),
    )


def test_geojson(cameras: Reconstruction, tmp_path: Path) -> None:
    second = replace(cameras, image_names=("c", "d"))
    write_cameras_geojson(tmp_path / "cameras.geojson", [cameras, second], ORIGIN)
    document = json.loads((tmp_path / "cameras.geojson").read_text(encoding="utf-8"))
    assert document["type"] == "FeatureCollection" and len(document["features"]) == 4
    down, level = document["features"][:2]
    assert down["geometry"] == {"type": "Point", "coordinates": [-8.5, 47.4, 500.0]}
    assert down["properties"]["image"] == "a & <b>.jpg" and down["properties"]["altitude_reference"] == "sea level"
    assert down["properties"]["pitch_deg"] == pytest.approx(-90.0) and down["properties"]["yaw_deg"] == 0.0
    assert level["properties"]["yaw_deg"] == pytest.approx(90.0) and level["properties"]["pitch_deg"] == 0.0
    longitude, latitude, altitude = level["geometry"]["coordinates"]
    np.testing.assert_allclose(ORIGIN.to_enu(np.array([latitude, longitude, altitude])), [50.0, 0.0, 0.0], atol=1e-3)
    assert [feature["properties"]["component"] for feature in document["features"]] == [1, 1, 2, 2]


def test_kml(cameras: Reconstruction, tmp_path: Path) -> None:
    write_cameras_kml(tmp_path / "cameras.kml", [cameras], ORIGIN, "house & garden")
    document = ElementTree.parse(tmp_path / "cameras.kml").getroot().find(f"{KML}Document")
    assert document is not None and document.findtext(f"{KML}name") == "house & garden"
    first, second = document.findall(f"{KML}Placemark")
    assert first.findtext(f"{KML}name") == "a & <b>.jpg"
    assert [float(v) for v in (first.findtext(f"{KML}Point/{KML}coordinates") or "").split(",")] == [-8.5, 47.4, 500.0]
    angles = [
        [float(p.findtext(f"{KML}Camera/{KML}{n}") or "nan") for n in ("heading", "tilt")] for p in (first, second)
    ]
    np.testing.assert_allclose(angles, [[0.0, 0.0], [90.0, 90.0]], atol=1e-3)
