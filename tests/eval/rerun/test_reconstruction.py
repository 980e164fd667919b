"""Rerun files of reconstructions: points, cameras, small images, and observations on a timeline of images."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import rerun as rr

from dronevio.eval import colours
from dronevio.eval.rerun import entities, write_reconstruction_rerun
from dronevio.eval.rerun.entities import ComponentEntities
from dronevio.eval.rerun.reconstruction import THUMBNAIL_PX
from dronevio.eval.scene import ResidualStyle, frustum_depth
from dronevio.models.errors import EvaluationError, InputError
from dronevio.models.reconstruction import Reconstruction

if TYPE_CHECKING:
    from tests.eval.conftest import EntityColumns, ReadRrd, SyntheticReconstruction, VerifyRrd

COMPONENT = ComponentEntities(0)
MISSING = "photos/004.jpg"


def number_list(column: pa.Array, row: int) -> npt.NDArray[np.float64]:
    """Return the numbers of a row of a column, with a row for each point or vector."""
    return np.array(column[row].as_py(), dtype=np.float64)


def image_entity(name: str) -> str:
    """Return the path of the small image of a name."""
    return f"{COMPONENT.camera(name)}/image"


@pytest.fixture(scope="module")
def rrd(synthetic: "SyntheticReconstruction", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with the reconstruction and its photographs except one."""
    path = tmp_path_factory.mktemp("rerun") / "new" / "reconstruction.rrd"
    images = {name: image for name, image in synthetic.images.items() if name != MISSING}
    write_reconstruction_rerun([synthetic.reconstruction], path, images.get)
    return path


@pytest.fixture(scope="module")
def columns(rrd: Path, read_rrd: "ReadRrd") -> "EntityColumns":
    """Return the content of the file."""
    return read_rrd(rrd)


def test_the_file_is_valid(rrd: Path, verify_rrd: "VerifyRrd") -> None:
    verify_rrd(rrd)


def test_points_have_their_colours(columns: "EntityColumns", synthetic: "SyntheticReconstruction") -> None:
    points, r = columns[COMPONENT.points], synthetic.reconstruction
    np.testing.assert_allclose(number_list(points["positions"], 0), r.points, rtol=1e-6)
    packed = np.array(points["colors"][0].as_py(), dtype=np.uint32)
    rgb = np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1)
    np.testing.assert_array_equal(rgb, r.colours)


def test_cameras_have_poses_and_small_images(columns: "EntityColumns", synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    for i, name in enumerate(r.image_names):
        pose, camera = columns[COMPONENT.camera(name)], columns[image_entity(name)]
        np.testing.assert_allclose(number_list(pose["translation"], 0)[0], r.positions[i], rtol=1e-6)
        columnwise = number_list(pose["mat3x3"], 0)[0].reshape(3, 3)
        np.testing.assert_allclose(columnwise.T, r.Ts_world_cam[i, :3, :3], atol=1e-6)
        assert number_list(camera["image_plane_distance"], 0)[0] == pytest.approx(frustum_depth(r), rel=1e-6)
        scale = 1.0 if name == MISSING else THUMBNAIL_PX / 376
        np.testing.assert_allclose(number_list(camera["resolution"], 0)[0], [376 * scale, 240 * scale], rtol=1e-6)
        K = number_list(camera["image_from_camera"], 0)[0].reshape(3, 3).T
        expected = np.array([[230.0, 0.0, 188.0], [0.0, 229.0, 120.0], [0.0, 0.0, 1.0]])
        np.testing.assert_allclose(K, np.diag([scale, scale, 1.0]) @ expected, rtol=1e-6)
    blob = np.array(columns[image_entity(r.image_names[0])]["blob"][0].as_py()[0], dtype=np.uint8)
    picture = cv2.imdecode(blob, cv2.IMREAD_COLOR_RGB)
    assert picture is not None and picture.shape == (163, THUMBNAIL_PX, 3)
    original = cv2.resize(synthetic.images[r.image_names[0]], (THUMBNAIL_PX, 163), interpolation=cv2.INTER_AREA)
    assert np.mean(np.abs(picture.astype(float) - original)) < 8.0
    assert "blob" not in columns[image_entity(MISSING)]


def test_observations_are_on_the_timeline(columns: "EntityColumns", synthetic: "SyntheticReconstruction") -> None:
    r, style = synthetic.reconstruction, ResidualStyle.of([synthetic.reconstruction])
    keypoints, strips = columns[entities.KEYPOINTS], columns[entities.RESIDUALS]
    rows = keypoints["image"].to_pylist()
    assert [index for index in rows if index is not None] == list(range(12))
    for index in (0, 7):
        seen = r.observation_image == index
        row = rows.index(index)
        expected = r.observation_px[seen] + 0.5  # rerun's pixel centres are at .5
        np.testing.assert_allclose(number_list(keypoints["positions"], row), expected, atol=1e-4)
        ends = number_list(strips["strips"], strips["image"].to_pylist().index(index))[:, 1]
        residuals = r.reprojection_residuals_px()[seen]
        np.testing.assert_allclose(ends, expected + style.factor * residuals, atol=1e-3)
        points = columns[COMPONENT.observed_points]
        observed = number_list(points["positions"], points["image"].to_pylist().index(index))
        np.testing.assert_allclose(observed, r.points[r.observation_point[seen]], rtol=1e-6)


def test_the_current_camera_is_highlighted(columns: "EntityColumns", synthetic: "SyntheticReconstruction") -> None:
    pose, camera = columns[COMPONENT.current_camera], columns[f"{COMPONENT.current_camera}/image"]
    assert pose["image"].to_pylist() == list(range(12))
    np.testing.assert_allclose(number_list(pose["translation"], 5)[0], synthetic.reconstruction.positions[5], rtol=1e-6)
    red, green, blue = colours.rgb(colours.LANDMARKS)
    assert camera["color"][5].as_py()[0] >> 8 == red << 16 | green << 8 | blue


def test_a_missing_image_removes_the_one_before(columns: "EntityColumns") -> None:
    image = columns[entities.CURRENT_IMAGE]
    assert len(image["blob"]) == 11
    assert image["is_recursive"].to_pylist() == [[False]]  # the observations remain
    assert len(columns[entities.SUMMARY]["text"]) == 12
    assert f"| image | {MISSING} |" in columns[entities.SUMMARY]["text"][4].as_py()[0]


def test_components_continue_the_timeline(
    synthetic: "SyntheticReconstruction", read_rrd: "ReadRrd", verify_rrd: "VerifyRrd", tmp_path: Path
) -> None:
    r = synthetic.reconstruction
    other = replace(r, image_names=tuple(f"other {name}" for name in r.image_names))
    write_reconstruction_rerun([r, other], tmp_path / "two.rrd")
    verify_rrd(tmp_path / "two.rrd")
    columns = read_rrd(tmp_path / "two.rrd")
    assert columns[ComponentEntities(1).current_camera]["image"].to_pylist() == list(range(12, 24))
    assert not any("blob" in entity for entity in columns.values())


def test_points_alone_can_be_written(synthetic: "SyntheticReconstruction", tmp_path: Path) -> None:
    r, none = synthetic.reconstruction, np.zeros(0, np.int64)
    points = Reconstruction((), (), none, np.zeros((0, 4, 4)), r.points, r.colours, none, none, np.zeros((0, 2)))
    write_reconstruction_rerun([points], tmp_path / "points.rrd", up=synthetic.up)
    assert (tmp_path / "points.rrd").stat().st_size > 1000


def test_bad_output_is_refused(synthetic: "SyntheticReconstruction", tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="without components"):
        write_reconstruction_rerun([], tmp_path / "a.rrd")
    with pytest.raises(InputError, match="a folder"):
        write_reconstruction_rerun([synthetic.reconstruction], tmp_path)
    assert not list(tmp_path.iterdir())


def test_rerun_names_of_images_are_escaped() -> None:
    assert ComponentEntities(2).camera("a b/c.jpg") == f"component2/cameras/{rr.escape_entity_path_part('a b/c.jpg')}"
