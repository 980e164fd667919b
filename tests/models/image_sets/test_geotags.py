"""Positions and orientations of photographs by EXIF and the XMP of DJI."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from dronevio.models.geodesy import rotation_enu_cam
from dronevio.models.image_sets import image_folder, joined, subset
from dronevio.models.image_sets.geotags import ASSUMED_SIGMA_M, RANGE_ERROR_M, GeoTag, geotags_of, read_geotag

GPS: dict[int, object] = {1: "N", 2: (47.0, 23.0, 51.72), 3: "W", 4: (8.0, 32.0, 44.16), 5: b"\x00", 6: 430.5}
RTK = {
    "AltitudeType": "RtkAlt",
    "GpsLatitude": "+47.3977000000",
    "GpsLongitude": "-8.5456000000",
    "AbsoluteAltitude": "+478.1234",
    "GimbalYawDegree": "+91.50",
    "GimbalPitchDegree": "-89.90",
    "GimbalRollDegree": "+0.00",
    "RtkFlag": "50",
    "RtkStdLon": "0.01100",
    "RtkStdLat": "0.01200",
    "RtkStdHgt": "0.02500",
}


def xmp(values: dict[str, str], as_elements: bool = False) -> bytes:
    """Return a packet with attributes or elements, as older and newer firmware writes them."""
    if as_elements:
        inside = "".join(f"<drone-dji:{name}>{value}</drone-dji:{name}>" for name, value in values.items())
        return f"<rdf:Description>{inside}</rdf:Description>".encode()
    return ("<rdf:Description" + "".join(f'\n drone-dji:{n}="{v}"' for n, v in values.items()) + "/>").encode()


def tag_of(gps: dict[int, object], packet: bytes = b"") -> GeoTag:
    """Return the position of a photograph that has one."""
    tag = read_geotag(gps, packet)
    assert isinstance(tag, GeoTag), tag
    return tag


def photo(file: Path, gps: dict[int, object] | None = None, packet: bytes = b"") -> None:
    """Write a photograph with metadata."""
    exif = Image.Exif()
    if gps is not None:
        ifd = exif.get_ifd(0x8825)
        for number, value in gps.items():
            ifd[number] = tuple(map(IFDRational, value)) if isinstance(value, tuple) else value
    options: dict[str, Any] = {"exif": exif} | ({"xmp": packet} if packet else {})
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(file, **options)


def test_a_position_in_exif() -> None:
    tag = tag_of(GPS)
    assert tag.latitude_deg == pytest.approx(47.3977) and tag.longitude_deg == pytest.approx(-8.5456)
    assert (tag.altitude_m, tag.altitude_reference, tag.gimbal_deg) == (430.5, "sea level", None)
    assert tag.sigma_m == (ASSUMED_SIGMA_M, ASSUMED_SIGMA_M, 1.5 * ASSUMED_SIGMA_M)


@pytest.mark.parametrize(
    ("reference", "altitude", "kind"),
    [(b"\x00", 430.5, "sea level"), (1, -430.5, "sea level"), (2, 430.5, "ellipsoid"), (b"\x03", -430.5, "ellipsoid")],
)
def test_references_of_altitudes(reference: object, altitude: float, kind: str) -> None:
    tag = tag_of({**GPS, 5: reference})
    assert (tag.altitude_m, tag.altitude_reference) == (altitude, kind)
    assert tag_of({**GPS, 5: 7}).altitude_m is None  # no reference of that number
    assert tag_of({**GPS, 6: 1e9}).altitude_m is None


def test_accuracy_in_exif() -> None:
    assert tag_of({**GPS, 31: 4.0}).sigma_m == (4.0, 4.0, 6.0)
    assert tag_of({**GPS, 31: 4.0, 11: 9.0}).sigma_m[0] == 4.0
    assert tag_of({**GPS, 11: 2.0}).sigma_m[0] == pytest.approx(2.0 * RANGE_ERROR_M)
    assert tag_of({**GPS, 31: IFDRational(0, 0)}).sigma_m[0] == ASSUMED_SIGMA_M


@pytest.mark.parametrize("as_elements", [False, True])
def test_rtk_of_dji(as_elements: bool) -> None:
    tag = tag_of(GPS, xmp(RTK, as_elements))
    assert (tag.latitude_deg, tag.longitude_deg, tag.altitude_m) == (47.3977, -8.5456, 478.1234)
    assert tag.altitude_reference == "ellipsoid" and tag.sigma_m == (0.011, 0.012, 0.025)
    assert tag.gimbal_deg == (91.5, -89.9, 0.0)


def test_dji_without_rtk() -> None:
    plain = {name: value for name, value in RTK.items() if name.startswith(("Gimbal", "Absolute"))}
    tag = tag_of(GPS, xmp(plain))
    assert tag.altitude_m == 430.5 and tag.sigma_m[0] == ASSUMED_SIGMA_M and tag.gimbal_deg is not None
    older = {**plain, "GpsLatitude": "+47.3977", "GpsLongtitude": "-8.5456"}  # as older firmware spells it
    assert tag_of({}, xmp(older)).longitude_deg == -8.5456
    assert tag_of({}, xmp({**older, "RtkFlag": "0"})).altitude_reference == "unknown"
    assert tag_of({}, xmp({**RTK, "RtkStdLon": "0"})).sigma_m == (0.02, 0.02, 0.04)


@pytest.mark.parametrize(
    ("gps", "reason"),
    [
        ({**GPS, 2: (95.0, 0.0, 0.0)}, "a position that cannot be read"),
        ({**GPS, 1: "X"}, "a position that cannot be read"),
        ({**GPS, 2: (47.0, IFDRational(1, 0), 0.0)}, "a position that cannot be read"),
        ({**GPS, 2: "47 N"}, "a position that cannot be read"),
        ({**GPS, 2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, "a position at latitude and longitude zero"),
        ({0: b"\x02\x03\x00\x00"}, None),
        ({}, None),
    ],
)
def test_positions_that_cannot_be_used(gps: dict[int, object], reason: str | None) -> None:
    assert read_geotag(gps, b"") == reason
    assert read_geotag(gps, b'drone-dji:GpsLatitude="abc" drone-dji:GpsLongitude="1"') == reason


def test_entities_of_xmp_are_not_expanded() -> None:
    bomb = b'<!DOCTYPE x [<!ENTITY a "1234567890">]><x drone-dji:GpsLatitude="&a;" drone-dji:GpsLongitude="&a;"/>'
    assert read_geotag({}, bomb) is None


values = st.one_of(
    st.none(), st.integers(), st.floats(), st.text(), st.binary(), st.lists(st.one_of(st.floats(), st.text()))
)


@given(st.dictionaries(st.integers(0, 32), values), st.binary(max_size=200), values, values)
def test_any_metadata_is_read(gps: dict[int, object], packet: bytes, latitude: object, number: object) -> None:
    text = f'drone-dji:GpsLatitude="{latitude}" drone-dji:GpsLongitude="{number}" drone-dji:RtkFlag="{number}"'
    tag = read_geotag({**GPS, **gps, 2: latitude}, packet + text.encode("utf-8", "replace"))
    if isinstance(tag, GeoTag):
        assert abs(tag.latitude_deg) <= 90.0 and abs(tag.longitude_deg) <= 180.0 and min(tag.sigma_m) > 0.0


def test_a_folder_of_photographs(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", GPS, xmp(RTK))
    photo(tmp_path / "2.jpg", {**GPS, 5: b"\x02"})
    photo(tmp_path / "3.jpg", GPS)
    photo(tmp_path / "4.jpg", {**GPS, 2: (95.0, 0.0, 0.0)})
    photo(tmp_path / "5.jpg")
    images = image_folder(tmp_path)
    assert len(images.cameras) == 1  # a position does not tell cameras apart
    tags = images.geotags
    assert tags is not None and tags.has_position.tolist() == [True, True, True, False, False]
    assert tags.altitude_reference == "ellipsoid"
    np.testing.assert_allclose(tags.geodetic[:3, 2], [478.1234, 430.5, np.nan])
    np.testing.assert_allclose(tags.Rs_enu_cam[0], rotation_enu_cam(91.5, -89.9, 0.0))
    assert np.isnan(tags.Rs_enu_cam[1:]).all()
    assert tags.notes == (
        "1 of 5 images: a position that cannot be read",
        "1 of 5 images: an altitude by another reference (sea level) than most (ellipsoid)",
    )
    origin = tags.origin
    assert (origin.latitude_deg, origin.longitude_deg, origin.altitude_m) == (47.3977, -8.5456, 454.0)
    # Subsets and unions
    part = subset(images, [2, 0]).geotags
    assert part is not None
    np.testing.assert_array_equal(part.geodetic, tags.geodetic[[2, 0]])
    (tmp_path / "more").mkdir()
    photo(tmp_path / "more" / "6.jpg", GPS)
    both = joined(images, image_folder(tmp_path / "more")).geotags
    assert both is not None and both.has_position.sum() == 4 and np.isnan(both.geodetic[5, 2])


def test_photographs_without_positions(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg")
    assert image_folder(tmp_path).geotags is None
    assert geotags_of([None, None]) is None
    noted = geotags_of([None, "a position that cannot be read"])
    assert noted is not None and not noted.has_position.any() and len(noted.notes) == 1
