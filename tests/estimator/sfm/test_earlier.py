"""Images that are added to an earlier reconstruction."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dronevio.estimator.sfm import pipeline
from dronevio.estimator.sfm.earlier import earlier_cameras, earlier_images, earlier_pairs
from dronevio.estimator.sfm.matching import match_features
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.estimator.sfm.placement.gauge import similarity
from dronevio.estimator.sfm.placement.world import WorldFrame
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.image_sets import ImageSet, joined, subset, with_earlier
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rotation import exp_so3, pose_matrix

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, SyntheticScene

EARLIER = 6
"""Number of images of the earlier reconstruction."""
SCALE = 3.0
"""Scale of its world frame."""


@pytest.fixture(scope="module")
def earlier(scene: "SyntheticScene", make_images: "MakeImages", tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A reconstruction of the first images, in a world frame of its own."""
    images, workspace = make_images(scene, tmp_path_factory.mktemp("earlier"))
    [found] = reconstruct(subset(images, range(EARLIER)), None, workspace).reconstructions
    return found.transformed(SCALE, exp_so3(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0]))


def test_added_images_keep_the_world_frame(
    scene: "SyntheticScene", make_images: "MakeImages", earlier: Reconstruction, tmp_path: "Path"
) -> None:
    images, workspace = make_images(scene, tmp_path)
    result = reconstruct(images, None, workspace, earlier=earlier, earlier_world=WorldFrame("earlier"))
    [found] = result.reconstructions
    assert found.image_names == images.names
    assert result.is_metric
    np.testing.assert_allclose(found.positions[:EARLIER], earlier.positions, atol=0.003 * SCALE)
    scale, R, t = similarity(scene.Ts_world_cam[:EARLIER], earlier.Ts_world_cam)
    expected = scale * scene.Ts_world_cam[EARLIER:, :3, 3] @ R.T + t
    np.testing.assert_allclose(found.positions[EARLIER:], expected, atol=0.01 * SCALE)
    assert len(found.points) >= len(earlier.points)


def test_earlier_images_are_not_matched_again(
    scene: "SyntheticScene",
    make_images: "MakeImages",
    earlier: Reconstruction,
    tmp_path: "Path",
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images, workspace = make_images(scene, tmp_path)
    matched = []

    def spy(first: Any, second: Any, config: Any) -> Any:
        matched.append((len(first), len(second)))
        return match_features(first, second, config)

    monkeypatch.setattr(pipeline, "match_features", spy)
    result = reconstruct(images, None, workspace, earlier=earlier)
    assert len(matched) == 8 * 7 // 2 - EARLIER * (EARLIER - 1) // 2
    assert result.match_counts[0, 1] > 100  # the points that the two observed before


def test_other_features_are_matched_anew(
    scene: "SyntheticScene", make_images: "MakeImages", earlier: Reconstruction, tmp_path: "Path"
) -> None:
    images, workspace = make_images(scene, tmp_path)
    other = replace(earlier, observation_px=earlier.observation_px + 3.0)
    assert earlier_pairs(earlier_images(images, other), other, list(scene.features)) is None
    [found] = reconstruct(images, None, workspace, earlier=other).reconstructions
    assert found.image_names == images.names
    np.testing.assert_allclose(found.positions[:EARLIER], earlier.positions, atol=0.003 * SCALE)


def test_tracks_are_found_again(scene: "SyntheticScene", earlier: Reconstruction) -> None:
    pairs = earlier_pairs(np.arange(EARLIER), earlier, list(scene.features))
    assert pairs is not None
    for pair in pairs:
        points = [scene.point_of[i][pair.matches[:, k]] for k, i in enumerate((pair.first, pair.second))]
        assert np.mean(points[0] == points[1]) > 0.99


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 320}, "640 × 480 px as in the earlier"),
        ({"fx": 510.0}, "the calibration has radtan fx 510.00"),
        ({"distortion": (-0.1, 0.02, 0.0, 0.0, 0.01)}, "the calibration has radtan"),
        ({"distortion": (0.9,), "lens": "fov"}, "the calibration has fov"),
    ],
    ids=["size", "calibration", "k3", "lens"],
)
def test_another_camera_is_refused(
    change: dict[str, Any],
    message: str,
    scene: "SyntheticScene",
    make_images: "MakeImages",
    earlier: Reconstruction,
    tmp_path: "Path",
) -> None:
    images, _ = make_images(scene, tmp_path)
    with pytest.raises(ConfigError, match=message):
        earlier_cameras(replace(images, cameras=(replace(scene.camera, **change),)), earlier)
    guess = replace(images, is_calibrated=np.array([False]))
    assert earlier_cameras(guess, earlier) == earlier.cameras


def numbered(names: tuple[str, ...], camera: CameraModel) -> ImageSet:
    """Return blank images with some names, whose pixels are the digits of the names."""
    blank = [np.full((camera.height, camera.width), int(name[-1]), np.uint8) for name in names]
    return ImageSet(
        names,
        np.zeros(len(names), np.int64),
        (camera,),
        np.array([False]),
        False,
        None,
        None,
        None,
        lambda index: blank[index],
        lambda index: None,
    )


def test_images_of_two_folders_are_joined() -> None:
    camera, other = CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5), CameraModel(4, 3, 5.0, 5.0, 1.5, 1.0)
    both = with_earlier(numbered(("b3", "b4"), camera), ("a2", "a1"), numbered(("a1", "a2", "a3"), camera), False)
    assert both.names == ("a1", "a2", "b3", "b4")
    assert [int(both.read(i)[0, 0]) for i in range(4)] == [1, 2, 3, 4]
    assert both.cameras == (camera,)
    assert joined(numbered(("1",), camera), numbered(("2",), other)).image_camera.tolist() == [0, 1]


def test_images_of_one_folder_keep_their_order() -> None:
    folder = numbered(("1", "2", "3", "4"), CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5))
    both = with_earlier(subset(folder, [0, 3]), ("2",), folder, True)
    assert both.names == ("1", "2", "4")
    assert int(both.read(2)[0, 0]) == 4


def test_sets_without_new_or_earlier_images_are_refused() -> None:
    camera = CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5)
    folder = numbered(("1", "2"), camera)
    with pytest.raises(ConfigError, match="1 of 2 images of the earlier reconstruction, such as 5, are not"):
        with_earlier(folder, ("1", "5"), folder, True)
    with pytest.raises(ConfigError, match="all 2 images are in the earlier"):
        with_earlier(folder, ("1", "2"), folder, True)
    with pytest.raises(ConfigError, match="1 images, such as 2, have the names of others"):
        with_earlier(folder, ("2",), numbered(("2", "3"), camera), False)


def test_similarity_by_hand() -> None:
    # Two poses, one unit apart along x, are brought two units apart along y.
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    R, t = exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 0.0, 0.0])
    others = np.stack([pose_matrix(R, t), pose_matrix(R, t + [0.0, 2.0, 0.0])])
    scale, rotation, translation = similarity(poses, others)
    assert scale == pytest.approx(2.0)
    np.testing.assert_allclose(rotation, R, atol=1e-12)
    np.testing.assert_allclose(translation, t, atol=1e-12)
