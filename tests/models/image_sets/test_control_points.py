"""Files of ground control points."""

from pathlib import Path

import numpy as np
import pytest

from dronevio.models.errors import InputError
from dronevio.models.image_sets import image_folder, subset
from dronevio.models.image_sets.control_points import ASSUMED_SIGMA_M, find_control_points, read_control_points

NAMES = ("north/01.jpg", "north/02.jpg", "03.jpg")
HEADER = "name,longitude_deg,latitude_deg,altitude_m,image,x_px,y_px,sigma_m\n"


def test_a_csv(tmp_path: Path) -> None:
    text = HEADER + "A, 13.4, 52.5, 35.5, north/01.jpg, 100.5, 20\nB,13.41,52.51,36,03.jpg,1,2,0.05\n"
    (tmp_path / "gcp.csv").write_text(text + "A,13.4,52.5,35.5,02.jpg,7,8,\nA,13.4,52.5,35.5,missing.jpg,7,8,\n")
    points = find_control_points(tmp_path, NAMES)
    assert points is not None and points.names == ("A", "B")
    np.testing.assert_allclose(points.geodetic, [[52.5, 13.4, 35.5], [52.51, 13.41, 36.0]])
    assert points.sigmas_m.tolist() == [ASSUMED_SIGMA_M, 0.05]
    assert points.point.tolist() == [0, 1, 0] and points.image.tolist() == [0, 2, 1]
    assert points.pixels.tolist() == [[100.5, 20.0], [1.0, 2.0], [7.0, 8.0]]
    assert points.unknown_images == ("missing.jpg",)


def test_a_list_of_opendronemap(tmp_path: Path) -> None:
    rows = "391390.7313 5817855.2408 35 10 20 01.jpg A extra\n391390.7313 5817855.2408 35 11 21 03.jpg A\n"
    for crs in ("EPSG:32633", "WGS84 UTM 33N", "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"):
        (tmp_path / "gcp_list.txt").write_text(f"{crs}\n\n# a comment\n{rows}")
        points = find_control_points(tmp_path, NAMES)
        assert points is not None and points.names == ("A",) and points.image.tolist() == [0, 2]
        np.testing.assert_allclose(points.geodetic, [[52.5, 13.4, 35.0]], atol=1e-8)
    (tmp_path / "gcp_list.txt").write_text("WGS84\n13.4 52.5 35 10 20 01.jpg\n13.4 52.5 35 9 8 03.jpg\n")
    points = find_control_points(tmp_path, NAMES)
    assert points is not None and points.names == ("13.4 52.5 35",)  # a point without a name
    np.testing.assert_allclose(points.geodetic, [[52.5, 13.4, 35.0]])
    assert find_control_points(tmp_path / "elsewhere", NAMES) is None


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("gcp.csv", "name,longitude_deg\nA,1\n", "gcp.csv:1: no column latitude_deg"),
        ("gcp.csv", HEADER, "no control points"),
        ("gcp.csv", HEADER + "A,13.4,x,35,01.jpg,1,2,\n", "gcp.csv:2: latitude_deg 'x'; expected a number"),
        ("gcp.csv", HEADER + "A,13.4,nan,35,01.jpg,1,2,\n", "latitude_deg 'nan'"),
        ("gcp.csv", HEADER + "A,52.5,134,35,01.jpg,1,2,\n", "latitude 134°"),
        ("gcp.csv", HEADER + "A,13.4,52.5,35,01.jpg,1,2,0\n", "sigma_m 0; expected a number above zero"),
        ("gcp.csv", HEADER + ",13.4,52.5,35,01.jpg,1,2,\n", "without a name"),
        ("gcp.csv", HEADER + "A,13.4,52.5,35,9.jpg,1,2,\n", "pixels in 9.jpg, which is not among the images"),
        ("gcp.csv", HEADER + "A,13,52,35,01.jpg,1,2,\nA,13,52,36,02.jpg,1,2,\n", "gcp.csv:3: another position of A"),
        ("gcp_list.txt", "EPSG:2056\n1 2 3 4 5 01.jpg\n", "gcp_list.txt:1: the coordinates 'EPSG:2056'"),
        ("gcp_list.txt", "EPSG:32699\n1 2 3 4 5 01.jpg\n", "the zone 99 of UTM"),
        ("gcp_list.txt", "WGS84\n13 52 3 4 01.jpg\n", "gcp_list.txt:2: 5 values"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, name: str, text: str, found: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as error:
        find_control_points(tmp_path, NAMES)
    assert found in str(error.value)


def test_names_that_two_images_have(tmp_path: Path) -> None:
    (tmp_path / "gcp.csv").write_text(HEADER + "A,13,52,35,a/1.jpg,1,2,\nA,13,52,35,1.jpg,1,2,\n")
    points = read_control_points(tmp_path / "gcp.csv", ("a/1.jpg", "b/1.jpg"))
    assert points.image.tolist() == [0] and points.unknown_images == ("1.jpg",)


def test_points_of_a_folder_and_of_a_subset(tmp_path: Path) -> None:
    from PIL import Image

    for number in (1, 2, 3):
        Image.fromarray(np.zeros((20, 30), np.uint8)).save(tmp_path / f"{number}.png")
    rows = "".join(f"A,13,52,35,{number}.png,{number},2,\n" for number in (1, 2, 3))
    (tmp_path / "gcp.csv").write_text(HEADER + rows)
    part = subset(image_folder(tmp_path), [2, 0]).control_points
    assert part is not None
    assert part.image.tolist() == [1, 0] and part.pixels[:, 0].tolist() == [1.0, 3.0]
