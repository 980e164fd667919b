"""Revisits, right loops and recall, by hand-worked geometry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.metrics.revisits import (
    LoopTolerance,
    RevisitRule,
    Views,
    covisible_shares,
    find_revisits,
    grid_pixels,
    revisit_recall,
    right_loops,
    true_relative_poses,
)
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3, pose_matrix

CAMERA = CameraModel(160, 120, 80.0, 80.0, 79.5, 59.5)  # sees ±45° to either side
WALL_M = 4.0
Array = np.ndarray


def facing_wall(positions: list[list[float]], t_s: list[float], path_m: list[float], turned_rad: Array) -> Views:
    """Return views along z of a wall in the plane z = 4 m, each turned about y."""
    R = exp_so3(np.outer(turned_rad, [0.0, 1.0, 0.0]))
    rays = CAMERA.unproject(grid_pixels(CAMERA)) @ np.swapaxes(R, 1, 2)[:, None]
    distance = (WALL_M - np.array(positions)[:, 2])[:, None, None] / np.maximum(rays[..., 2], 1e-9)
    t_ns = np.round(1e9 * np.array(t_s)).astype(np.int64)
    return Views(t_ns, np.array(path_m), pose_matrix(R, np.array(positions)), CAMERA, distance)


def pair(dx_m: float = 0.0, age_s: float = 10.0, path_m: float = 5.0, turned_deg: float = 0.0) -> Views:
    """Return two views of the wall, of which the second is moved and turned."""
    return facing_wall([[0.0, 0.0, 0.0], [dx_m, 0.0, 0.0]], [0.0, age_s], [0.0, path_m], np.radians([0.0, turned_deg]))


def test_grid_is_in_the_middle_of_its_cells() -> None:
    pixels = grid_pixels(CAMERA, 16, 12)
    assert pixels.shape == (12, 16, 2)
    np.testing.assert_allclose(pixels[0, 0], [4.5, 4.5])
    np.testing.assert_allclose(pixels[11, 15], [154.5, 114.5])


@pytest.mark.parametrize("views", [pair(), pair(dx_m=0.999), pair(turned_deg=29.9), pair(turned_deg=-29.9)])
def test_revisits_within_the_limits(views: Views) -> None:
    found = find_revisits(views)
    assert found.now.tolist() == [1] and found.then.tolist() == [0]
    assert found.revisiting.tolist() == [False, True] and found.percent == 50.0


@pytest.mark.parametrize(
    "views",
    [pair(dx_m=1.001), pair(age_s=9.999), pair(path_m=4.999), pair(turned_deg=30.1), pair(turned_deg=-30.1)],
)
def test_frames_beyond_a_limit_are_no_revisits(views: Views) -> None:
    found = find_revisits(views)
    assert len(found.now) == 0 and found.percent == 0.0


def test_overlap_of_two_views_of_a_wall_by_hand() -> None:
    # The camera sees 8 m of the wall in 16 columns, so that a step of 0.5 m moves a column out of the image.
    for steps in (0, 1, 4, 8, 16):
        views = pair(dx_m=0.5 * steps)
        assert covisible_shares(views, np.array([1]), np.array([0])) == pytest.approx([1.0 - steps / 16])


def test_the_covisible_share_decides() -> None:
    views = pair(dx_m=1.0)  # 14 of 16 columns
    assert find_revisits(views, RevisitRule(covisible=14 / 16)).now.tolist() == [1]
    assert find_revisits(views, RevisitRule(covisible=14.1 / 16)).now.tolist() == []


def test_hidden_points_are_not_covisible() -> None:
    views = pair()
    ranges = views.ranges_m.copy()
    ranges[0, :, :8] *= 0.25  # a screen at 1 m in the left half of the earlier image
    screened = replace(views, ranges_m=ranges)
    # Points of columns 0 to 6 are hidden; column 7 is beside the wall in column 8, and the farthest sample decides.
    assert covisible_shares(screened, np.array([1]), np.array([0])) == pytest.approx([9 / 16])
    # Points of the screen lie in front of the wall and are within the other image.
    assert covisible_shares(screened, np.array([0]), np.array([1])) == pytest.approx([1.0])


@pytest.mark.parametrize(("factor", "share"), [(1.09, 1.0), (1.11, 0.0)])
def test_points_a_tenth_behind_a_surface_are_hidden(factor: float, share: float) -> None:
    views = facing_wall([[0.0, 0.0, 0.0]] * 2, [0.0, 10.0], [0.0, 5.0], np.zeros(2))
    views.ranges_m[:] = np.array([1.0, factor])[:, None, None]  # spheres around the camera
    assert covisible_shares(views, np.array([1]), np.array([0])).tolist() == [share]


def test_pixels_without_a_surface_do_not_count() -> None:
    views = facing_wall([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]], [0.0, 10.0], [0.0, 5.0], np.zeros(2))
    views.ranges_m[1, :, :8] = np.inf
    assert covisible_shares(views, np.array([1]), np.array([0])).tolist() == [1.0]


def test_a_camera_rolled_about_its_axis_revisits() -> None:
    views = pair()
    rolled = views.Ts_world_cam.copy()
    rolled[1, :3, :3] = exp_so3(np.array([0.0, 0.0, np.radians(60.0)]))
    ranges = np.repeat(views.ranges_m[:1], 2, axis=0)
    assert find_revisits(replace(views, Ts_world_cam=rolled, ranges_m=ranges)).now.tolist() == [1]


def test_surfaces_behind_the_camera_are_not_covisible() -> None:
    views = pair(turned_deg=179.9, dx_m=0.0)
    views.ranges_m[1] = WALL_M
    assert covisible_shares(views, np.array([1]), np.array([0])).tolist() == [0.0]


def test_a_frame_without_surfaces_revisits_nothing() -> None:
    views = pair()
    ranges = views.ranges_m.copy()
    ranges[1] = np.inf
    blind = replace(views, ranges_m=ranges)
    assert np.isnan(covisible_shares(blind, np.array([1]), np.array([0]))).all()
    assert find_revisits(blind).percent == 0.0
    assert np.isnan(blind.median_depth_m[1])


def test_median_depth_is_along_the_optical_axis() -> None:
    views = pair()
    np.testing.assert_allclose(views.median_depth_m, WALL_M)  # the distances are up to 5.7 m
    ranges = views.ranges_m.copy()
    ranges[0, :, :7], ranges[0, :, 7:9] = np.inf, np.inf  # seven columns of the wall remain
    ranges[0, :4, 9:] *= 0.5
    np.testing.assert_allclose(replace(views, ranges_m=ranges).median_depth_m[0], WALL_M)
    ranges[0, :6, 9:] = views.ranges_m[0, :6, 9:] * 0.5  # half of the rows at 2 m
    np.testing.assert_allclose(replace(views, ranges_m=ranges).median_depth_m[0], 3.0)


def test_three_laps_revisit_in_the_second_and_third() -> None:
    x = [0.0, 3.0, 6.0] * 3
    views = facing_wall(
        [[v, 0.0, 0.0] for v in x], [6.0 * k for k in range(9)], [4.0 * k for k in range(9)], np.zeros(9)
    )
    found = find_revisits(views)
    assert found.revisiting.tolist() == [False] * 3 + [True] * 6
    assert list(zip(found.now.tolist(), found.then.tolist(), strict=True)) == [
        (3, 0),
        (4, 1),
        (5, 2),
        (6, 0),
        (6, 3),
        (7, 1),
        (7, 4),
        (8, 2),
        (8, 5),
    ]
    assert found.percent == pytest.approx(200 / 3)


def loop(error_m: float, error_deg: float) -> tuple[Array, Array]:
    """Return a claimed and a true relative pose with a position and a rotation error."""
    true = pose_matrix(exp_so3(np.array([[0.1, -0.4, 2.0]])), np.array([[0.5, -0.2, 0.7]]))
    claimed = true.copy()
    claimed[0, :3, 3] += error_m * np.array([2.0, -1.0, 2.0]) / 3.0
    claimed[0, :3, :3] = true[0, :3, :3] @ exp_so3(np.radians(error_deg) * np.array([0.0, 0.6, 0.8]))
    return claimed, true


@pytest.mark.parametrize(
    ("error_m", "error_deg", "right"),
    [(0.0, 0.0, True), (0.129, 0.0, True), (0.131, 0.0, False), (0.0, 0.99, True), (0.0, 1.01, False)],
)
def test_right_loops_by_hand(error_m: float, error_deg: float, right: bool) -> None:
    # 5 cm and 2 % of 4 m are 13 cm.
    assert right_loops(*loop(error_m, error_deg), np.array([4.0])).tolist() == [right]


def test_tolerances_of_loops_are_settings() -> None:
    claimed, true = loop(0.2, 2.0)
    assert right_loops(claimed, true, np.array([4.0]), LoopTolerance(0.3, 0.0, 0.05)).tolist() == [True]


def test_matrices_that_are_no_poses_are_wrong_loops() -> None:
    claimed, true = (np.repeat(T, 6, axis=0) for T in loop(0.0, 0.0))
    claimed[0, 0, 3] = np.nan
    claimed[1, :3, :3] = 0.0
    claimed[2, :3, :3] *= 1.1
    claimed[3, :3, :3] *= -1.0
    claimed[4, :3, 2] *= -1.0  # a reflection
    assert right_loops(claimed, true, np.full(6, 4.0)).tolist() == [False] * 5 + [True]
    assert right_loops(claimed, true, np.full(6, np.nan)).tolist() == [False] * 6


def test_a_loop_to_a_place_that_looks_the_same_is_wrong() -> None:
    # Columns repeat every 3 m: the claim "the same pose" is 3 m off.
    views = facing_wall([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [0.0, 20.0], [0.0, 9.0], np.zeros(2))
    now, then = np.array([1]), np.array([0])
    true = true_relative_poses(views, now, then)
    np.testing.assert_allclose(true[0, :3, 3], [3.0, 0.0, 0.0])
    assert right_loops(np.eye(4)[None], true, views.median_depth_m[now]).tolist() == [False]
    assert right_loops(true, true, views.median_depth_m[now]).tolist() == [True]


def test_recall_by_hand() -> None:
    t_ns = np.arange(6) * 1_000_000_000
    revisiting = np.array([False, False, True, True, True, False])  # at 2, 3 and 4 s
    matched = np.array([3_500_000_000, 0])
    assert revisit_recall(t_ns, revisiting, matched) == pytest.approx(1 / 3)  # the frame at 3 s
    assert revisit_recall(t_ns, revisiting, matched, within_s=1.5) == pytest.approx(2 / 3)
    assert revisit_recall(t_ns, revisiting, matched, within_s=0.4) == 0.0
    assert revisit_recall(t_ns, revisiting, np.array([3_000_000_000])) == pytest.approx(2 / 3)  # those at 2 and 3 s
    assert revisit_recall(t_ns, revisiting, np.zeros(0, np.int64)) == 0.0
    assert np.isnan(revisit_recall(t_ns, np.zeros(6, np.bool_), matched))


def test_views_of_different_lengths_are_refused() -> None:
    views = pair()
    with pytest.raises(ConfigError, match=r"\(2,\), \(1,\)"):
        replace(views, path_m=np.zeros(1))
    with pytest.raises(ConfigError, match="do not increase"):
        replace(views, t_ns=np.zeros(2, np.int64))


def random_views(seed: int, count: int) -> Views:
    """Return views of random surfaces from random poses within half a metre."""
    rng = np.random.default_rng(seed)
    poses = pose_matrix(exp_so3(rng.normal(0.0, 0.2, (count, 3))), rng.uniform(-0.5, 0.5, (count, 3)))
    t_ns = np.cumsum(rng.integers(1, 5, count)) * 1_000_000_000
    return Views(t_ns, np.cumsum(rng.uniform(0.0, 3.0, count)), poses, CAMERA, rng.uniform(1.0, 6.0, (count, 12, 16)))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_frames_see_their_own_surfaces(seed: int, count: int) -> None:
    views, rows = random_views(seed, count), np.arange(count)
    np.testing.assert_array_equal(covisible_shares(views, rows, rows), 1.0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 12))
def test_revisits_do_not_depend_on_the_world_frame(seed: int, count: int) -> None:
    views, rng = random_views(seed, count), np.random.default_rng(seed + 1)
    T = pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    moved = replace(
        views, t_ns=views.t_ns + 7, path_m=views.path_m + 3.0, Ts_world_cam=(T @ views.Ts_world_cam).reshape(-1, 4, 4)
    )
    one, other = find_revisits(views), find_revisits(moved)
    assert one.now.tolist() == other.now.tolist() and one.then.tolist() == other.then.tolist()
    assert (one.then < one.now).all()
    age_s = (views.t_ns[one.now] - views.t_ns[one.then]) * 1e-9
    assert (age_s >= 10.0).all() and (views.path_m[one.now] - views.path_m[one.then] >= 5.0).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 1.0), st.floats(0.0, 1.0))
def test_stricter_rules_find_a_part_of_the_revisits(seed: int, factor: float, covisible: float) -> None:
    views, loose = random_views(seed, 12), RevisitRule(covisible=0.1)
    strict = RevisitRule(factor, factor * loose.angle_rad, 10.0 / factor, 5.0 / factor, max(covisible, 0.1))
    pairs = [
        set(zip(r.now.tolist(), r.then.tolist(), strict=True))
        for r in map(find_revisits, (views,) * 2, (strict, loose))
    ]
    assert pairs[0] <= pairs[1]
