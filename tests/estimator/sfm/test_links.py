"""Wrong links between images of places that look alike."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import dronevio.estimator.sfm.pipeline as pipeline
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.links import wrong_links
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.estimator.sfm.two_view import Geometry, ImageView, TwoView, view_of
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import exp_so3, pose_matrix

if TYPE_CHECKING:
    from dronevio.models.reconstruction import Reconstruction
    from tests.estimator.sfm.conftest import MakeImages, MakeScene, SyntheticScene

CAMERA = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0, (-0.1, 0.02, 0.0, 0.0))
ALIKE, SEEN_BY_TWO, APART_M = 60, 300, 6.0


def joined(*parts: Features) -> Features:
    """Return all features of one image."""
    names = ("pixels", "sizes_px", "descriptors", "colours")
    return Features(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@pytest.fixture(scope="module")
def twins(make_scene: "MakeScene") -> "SyntheticScene":
    """Two places, six images each: some of their points look alike, and others join the last image and the first."""
    here, there = make_scene(images=6, seed=0), make_scene(images=6, seed=1)
    rng = np.random.default_rng(2)
    offset = np.array([APART_M, 0.0, 0.0])
    Ts_there = there.Ts_world_cam.copy()
    Ts_there[:, :3, 3] += offset
    between = rng.uniform([-2.0, -4.0, 15.0], [8.0, 4.0, 25.0], (SEEN_BY_TWO, 3))
    described = rng.integers(0, 90, (SEEN_BY_TWO, 128))
    unit = np.round(512.0 * described / np.linalg.norm(described, axis=1, keepdims=True)).astype(np.uint8)
    grey = np.full((SEEN_BY_TWO, 3), 128, np.uint8)

    def of_between(T: Array) -> Features:
        pixels = here.camera.project((between - T[:3, 3]) @ T[:3, :3]) + rng.normal(scale=0.3, size=(SEEN_BY_TWO, 2))
        return Features(pixels, np.full(SEEN_BY_TWO, 5.0), unit, grey)

    def alike(k: int) -> Features:
        chosen = here.point_of[k] < ALIKE
        f = here.features[k]
        return Features(f.pixels[chosen], f.sizes_px[chosen], f.descriptors[chosen], f.colours[chosen])

    first = [*here.features[:5], joined(here.features[5], of_between(here.Ts_world_cam[5]))]
    second = [joined(there.features[k], alike(k)) for k in range(6)]
    second[0] = joined(second[0], of_between(Ts_there[0]))
    unknown = tuple(np.arange(len(f)) for f in (*first, *second))
    return replace(
        here,
        Ts_world_cam=np.concatenate([here.Ts_world_cam, Ts_there]),
        features=(*first, *second),
        point_of=unknown,
    )


def error_m(twins: "SyntheticScene", found: "Reconstruction") -> float:
    """Return the largest error of a position, after a similarity transformation [m]."""
    rows = [int(Path(name).stem) for name in found.image_names]
    true = twins.Ts_world_cam[rows, :3, 3]
    fit = umeyama(true, found.positions, with_scale=True)
    residuals = true - (fit.scale * found.positions @ fit.R_truth_estimate.T + fit.t_m)
    return float(np.linalg.norm(residuals, axis=1).max())


def test_places_that_look_alike_are_not_joined(
    twins: "SyntheticScene", make_images: "MakeImages", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, workspace = make_images(twins, tmp_path)
    found = reconstruct(images, workspace=workspace).reconstructions
    assert [len(each.image_names) for each in found] == [6, 6]
    assert max(error_m(twins, each) for each in found) < 0.02
    monkeypatch.setattr(pipeline, "wrong_links", lambda *_: np.empty(0, np.intp))
    (joined_up,) = reconstruct(images, workspace=workspace).reconstructions
    assert len(joined_up.image_names) == 12 and error_m(twins, joined_up) > 1.0


def linked(counts: dict[tuple[int, int], int]) -> tuple[list[TwoView], list[ImageView], Array]:
    """Return pairs with numbers of matches, of images on a line, with their views and poses."""
    rng = np.random.default_rng(0)
    images = 1 + max(max(pair) for pair in counts)
    points = rng.uniform([-3.0, -2.0, 5.0], [3.0, 2.0, 9.0], (500, 3))
    Ts = np.stack([pose_matrix(np.eye(3), np.array([0.3 * k, 0.0, 0.0])) for k in range(images)])
    views = [view_of(CAMERA.project(points - T[:3, 3]), CAMERA, True) for T in Ts]
    pairs = [
        TwoView(i, j, np.tile(np.arange(n)[:, None], 2), Geometry.GENERAL, np.eye(4), 0.1)
        for (i, j), n in counts.items()
    ]
    return pairs, views, Ts


def moved(Ts: Array, images: list[int]) -> Array:
    """Return poses of which some are turned and elsewhere."""
    wrong = Ts.copy()
    for k in images:
        wrong[k] = pose_matrix(exp_so3(np.array([0.0, 0.4, 0.0])), np.array([1.0, 2.0, 0.0])) @ wrong[k]
    return wrong


def alias(pairs: list[TwoView], of: list[int], Ts: Array, views: list[ImageView], wrong: Array) -> list[ImageView]:
    """Return the views in which the pairs of some indices agree with wrong poses instead of the right ones."""
    rng = np.random.default_rng(1)
    changed = [view.pixels.copy() for view in views]
    out = []
    for k in of:
        first, second = pairs[k].first, pairs[k].second
        points = rng.uniform([-1.0, -1.0, 6.0], [1.0, 1.0, 9.0], (len(pairs[k].matches), 3))
        rows = []
        for image in (first, second):
            T = wrong[image]
            rows.append(np.arange(len(changed[image]), len(changed[image]) + len(points)))
            changed[image] = np.vstack([changed[image], CAMERA.project((points - T[:3, 3]) @ T[:3, :3])])
        out.append(replace(pairs[k], matches=np.stack(rows, axis=1)))
    for k, pair in zip(of, out, strict=True):
        pairs[k] = pair
    return [view_of(pixels, CAMERA, True) for pixels in changed]


COUNTS = {(0, 1): 300, (1, 2): 250, (2, 3): 200, (3, 4): 300, (4, 5): 250, (0, 4): 60, (1, 5): 40}


def test_links_that_agree_are_kept() -> None:
    pairs, views, Ts = linked(COUNTS)
    assert wrong_links(pairs, views, Ts).size == 0
    assert wrong_links([], views, Ts).size == 0
    unregistered = np.full_like(Ts, np.nan)
    assert wrong_links(pairs, views, unregistered).size == 0


@pytest.mark.parametrize(("joining", "expected"), [(60, [5, 6]), (120, [])])
def test_weak_links_that_a_strong_one_contradicts_are_wrong(joining: int, expected: list[int]) -> None:
    """Links (0, 4) and (1, 5) have placed images 3 to 5, which the 200 matches of the link (2, 3) contradict."""
    pairs, views, Ts = linked({**COUNTS, (0, 4): joining})
    wrong = moved(Ts, [3, 4, 5])
    views = alias(pairs, [5, 6], Ts, views, wrong)
    assert wrong_links(pairs, views, wrong).tolist() == expected


def test_links_of_rotations_agree() -> None:
    pairs, _, Ts = linked({(0, 1): 200, (1, 2): 200})
    rng = np.random.default_rng(3)
    points = rng.uniform([-3.0, -2.0, 5.0], [3.0, 2.0, 9.0], (500, 3))
    for k in range(3):
        Ts[k] = pose_matrix(exp_so3(np.array([0.0, 0.1 * k, 0.0])), np.array([1e-6 * k, 0.0, 0.0]))
    pixels = [CAMERA.project(points @ T[:3, :3]) + rng.normal(scale=0.5, size=(500, 2)) for T in Ts]
    assert wrong_links(pairs, [view_of(each, CAMERA, True) for each in pixels], Ts).size == 0
