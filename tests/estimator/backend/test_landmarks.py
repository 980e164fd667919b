"""Triangulation of many landmarks at once, and the window that says which may be trusted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from dronevio.estimator.backend.landmarks import LandmarkConfig, LandmarkDatabase
from dronevio.estimator.backend.triangulation import Triangulation, triangulate
from dronevio.estimator.types import Matches, Observations
from dronevio.models.rotation import exp_so3

FOCAL_PX = 458.0
PIXEL = 1.0 / FOCAL_PX


class Scene:
    """Cameras on a curve, landmarks ahead of them."""

    def __init__(self, seed: int = 0, cameras: int = 12, landmarks: int = 30, depth_m: float = 5.0) -> None:
        rng = np.random.default_rng(seed)
        self.R = exp_so3(0.1 * rng.normal(size=(cameras, 3)))
        self.p = np.linspace(0.0, 1.0, cameras)[:, None] * [1.0, 0.4, 0.3] + 0.02 * rng.normal(size=(cameras, 3))
        self.points = rng.uniform([-2.0, -1.5, 0.7 * depth_m], [3.0, 1.5, 1.3 * depth_m], (landmarks, 3))
        in_camera = np.einsum("kij,lki->klj", self.R, self.points[:, None] - self.p)
        self.xy = in_camera[..., :2] / in_camera[..., 2:]  # (K, L, 2)

    def poses(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Where a rig of one camera is."""
        return {k: (self.R[k, None], self.p[k, None]) for k in range(len(self.p))}

    def seen(self, k: int, noise: np.ndarray | float = 0.0) -> Observations:
        n = len(self.points)
        xy = self.xy[k] + noise
        return Observations(np.arange(n), FOCAL_PX * xy, xy, np.full(n, k + 1))


def flat(scene: Scene, views: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the arguments for `triangulate`: landmark l is seen by its first views[l] cameras."""
    keyframes = np.concatenate([np.arange(n) for n in views])
    landmarks = np.repeat(np.arange(len(views)), views)
    starts = np.concatenate([[0], np.cumsum(views)[:-1]])
    return starts, scene.R[keyframes], scene.p[keyframes], xy[keyframes, landmarks]


@pytest.mark.parametrize("seed", range(3))
def test_exact_sightings_give_exact_points(seed: int) -> None:
    scene = Scene(seed)
    views = np.random.default_rng(seed).integers(3, 13, 30)
    found = triangulate(*flat(scene, views, scene.xy))
    np.testing.assert_allclose(found.points, scene.points, atol=1e-3)
    assert found.in_front.all()
    assert found.rms.max() < 1e-4 * PIXEL * 10 and found.newest.max() < 1e-4 * PIXEL * 10


def test_noisy_observations_give_least_reprojection_error() -> None:
    scene = Scene(1)
    noise = PIXEL * np.random.default_rng(0).normal(size=scene.xy.shape)
    views = np.full(30, 12)
    found = triangulate(*flat(scene, views, scene.xy + noise))

    def residuals(point: np.ndarray, landmark: int) -> np.ndarray:
        q = np.einsum("kij,ki->kj", scene.R, point - scene.p)
        return (q[:, :2] / q[:, 2:] - (scene.xy + noise)[:, landmark]).ravel()

    for landmark in range(30):
        best = least_squares(residuals, scene.points[landmark], args=(landmark,), xtol=1e-12, ftol=1e-12, gtol=1e-14)
        rms = np.sqrt(np.sum(best.fun**2) / 12)
        assert found.rms[landmark] == pytest.approx(rms, rel=1e-3)
        last = np.linalg.norm(residuals(found.points[landmark], landmark)[-2:])
        assert found.newest[landmark] == pytest.approx(last, rel=1e-9)


def test_landmarks_do_not_mind_their_neighbours() -> None:
    scene = Scene(2)
    views = np.random.default_rng(1).integers(2, 13, 30)
    together = triangulate(*flat(scene, views, scene.xy))
    for landmark in range(30):
        rows = np.arange(views[landmark])
        alone: Triangulation = triangulate(
            np.array([0]), scene.R[rows], scene.p[rows], np.ascontiguousarray(scene.xy[rows, landmark])
        )
        for name in ("points", "in_front", "rms", "newest", "parallax_rad"):
            np.testing.assert_allclose(getattr(alone, name)[0], getattr(together, name)[landmark], atol=1e-9)


def test_parallax_is_the_largest_angle_to_the_first_ray() -> None:
    R, p = np.tile(np.eye(3), (3, 1, 1)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    point = np.array([0.0, 0.0, 2.0])
    q = point - p
    found = triangulate(np.array([0]), R, p, q[:, :2] / q[:, 2:])
    assert found.parallax_rad[0] == pytest.approx(np.arctan2(1.0, 2.0))


def test_points_behind_a_camera_are_told() -> None:
    """Rays that meet behind: the two cameras look apart."""
    R, p = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = triangulate(np.array([0]), R, p, np.array([[-0.2, 0.0], [0.2, 0.0]]))
    assert not found.in_front[0]


def test_one_view_and_no_parallax_are_no_reason_to_fail() -> None:
    scene = Scene(3)
    R, p = scene.R[:1], scene.p[:1]
    single = triangulate(np.array([0]), R, p, scene.xy[0, :1])
    assert np.isfinite(single.points).all() and single.parallax_rad[0] < 1e-7
    same_place = np.repeat(p, 4, axis=0), np.repeat(R, 4, axis=0)
    found = triangulate(np.array([0]), same_place[1], same_place[0], np.repeat(scene.xy[0, :1], 4, axis=0))
    assert np.isfinite(found.points).all() and found.parallax_rad[0] < 1e-7


def window(scene: Scene, frames: int, config: LandmarkConfig | None = None) -> LandmarkDatabase:
    landmarks = LandmarkDatabase(FOCAL_PX, config or LandmarkConfig())
    for k in range(frames):
        landmarks.add_observations(k, scene.seen(k))
    return landmarks


def judged(landmarks: LandmarkDatabase, poses: dict[int, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the landmarks that the window gives up, by the errors that they have with one camera at some poses."""
    seen = landmarks.observations
    points = landmarks.points[landmarks.rows(seen.landmark)]
    R, p = (np.stack([poses[k][i][0] for k in seen.keyframe.tolist()]) for i in (0, 1))
    in_camera = np.einsum("nij,ni->nj", R, points - p)
    return landmarks.reject_outliers(seen.xy - in_camera[:, :2] / in_camera[:, 2:], in_camera[:, 2], seen)


def test_landmarks_seen_often_and_from_aside_are_found() -> None:
    scene = Scene()
    landmarks = window(scene, 8)
    assert len(landmarks.triangulate(scene.poses(), newest=7)) == 0
    assert landmarks.ids.tolist() == list(range(30))
    np.testing.assert_allclose(landmarks.points, scene.points, atol=1e-3)
    assert len(landmarks.observations) == 8 * 30


def test_landmarks_need_views_and_parallax() -> None:
    scene = Scene()
    for landmarks, newest in ((window(scene, 2), 1), (window(scene, 8, LandmarkConfig(min_parallax_deg=60.0)), 7)):
        assert len(landmarks.triangulate(scene.poses(), newest)) == 0
        assert len(landmarks.ids) == 0 and len(landmarks.observations) == 0


def test_several_cameras_at_one_instant_show_no_motion() -> None:
    """Three cameras of one keyframe place a landmark; it constrains the window from its second keyframe on."""
    scene = Scene()
    landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig())
    ids = np.arange(30)
    rig = {0: (scene.R[[0, 4, 8]], scene.p[[0, 4, 8]]), 1: (scene.R[[1, 5, 9]], scene.p[[1, 5, 9]])}
    for k, (first, others) in enumerate(((0, (4, 8)), (1, (5, 9)))):
        xy = np.concatenate([scene.xy[i] for i in others])
        matches = Matches(np.tile(ids, 2), np.repeat([1, 2], 30), xy)
        landmarks.add_observations(k, replace(scene.seen(first), matches=matches))
        assert len(landmarks.triangulate(rig, newest=k)) == 0
        assert len(landmarks.ids) == (0, 30)[k]
    np.testing.assert_allclose(landmarks.points, scene.points, atol=1e-3)


def test_landmarks_that_are_not_seen_now_are_left_alone() -> None:
    scene = Scene()
    landmarks = window(scene, 8)
    nothing = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
    landmarks.add_observations(8, nothing)
    landmarks.triangulate(scene.poses(), newest=8)
    assert len(landmarks.ids) == 0


def test_wrong_ones_are_found_when_new() -> None:
    scene = Scene()
    landmarks = window(scene, 7)
    jump = np.zeros((30, 2))
    jump[:3] = [40.0 * PIXEL, -30.0 * PIXEL]
    landmarks.add_observations(7, scene.seen(7, jump))
    assert landmarks.triangulate(scene.poses(), newest=7).tolist() == [0, 1, 2]
    assert landmarks.ids.tolist() == list(range(3, 30))
    assert not np.isin(landmarks.observed_in(7), [0, 1, 2]).any()


def test_wrong_ones_are_found_when_known() -> None:
    scene = Scene()
    landmarks = window(scene, 7)
    landmarks.triangulate(scene.poses(), newest=6)
    jump = np.zeros((30, 2))
    jump[:3] = [40.0 * PIXEL, -30.0 * PIXEL]
    landmarks.add_observations(7, scene.seen(7, jump))
    assert judged(landmarks, scene.poses()).tolist() == [0, 1, 2]
    assert landmarks.ids.tolist() == list(range(3, 30)) and len(landmarks.points) == 27


def test_where_all_poses_are_off_no_landmark_is_wrong() -> None:
    """When all poses are off by 3° each its own way, it is the poses that are wrong."""
    scene = Scene()
    landmarks = window(scene, 8)
    landmarks.triangulate(scene.poses(), newest=7)
    turns = exp_so3(np.radians(3.0) * np.random.default_rng(3).normal(size=(8, 3)))
    poses = {k: (R @ turns[k], p) for k, (R, p) in list(scene.poses().items())[:8]}
    assert len(judged(landmarks, poses)) == 0 and len(landmarks.ids) == 30


def test_where_one_pose_is_off_no_landmark_is_wrong() -> None:
    """When the newest pose is off by 3°, it is the pose that is wrong."""
    scene = Scene()
    landmarks = window(scene, 8)
    landmarks.triangulate(scene.poses(), newest=7)
    poses = scene.poses()
    poses[7] = (poses[7][0] @ exp_so3(np.radians([3.0, 0.0, 0.0])), poses[7][1])
    assert len(judged(landmarks, poses)) == 0 and len(landmarks.ids) == 30


def test_dropped_and_unseen_ones_are_gone() -> None:
    scene = Scene()
    landmarks = window(scene, 8)
    landmarks.triangulate(scene.poses(), newest=7)
    landmarks.remove(np.arange(5))
    assert landmarks.ids.tolist() == list(range(5, 30)) and len(landmarks.observations) == 8 * 25
    landmarks.remove_keyframe(3)
    assert 3 not in landmarks.observations.keyframe and len(landmarks.observations) == 7 * 25
    for k in (0, 1, 2, 4, 5, 6, 7):
        landmarks.remove_keyframe(k)
    assert len(landmarks.ids) == len(landmarks.points) == len(landmarks.observations) == 0


def test_parallax_from_a_baseline_of_millimetres_is_not_believed() -> None:
    """A track that drifts by some pixels, seen from one place, looks like something right before the lens."""
    near, there = (
        np.array([0.0, 0.0, 0.15]),
        {k: (np.eye(3)[None], np.array([[0.002 * k, 0.0, 0.0]])) for k in range(4)},
    )
    for scale, useful in ((1.0, 0), (20.0, 1)):  # the same picture, twenty times as large
        landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig())
        cameras = {k: (R, scale * p) for k, (R, p) in there.items()}
        for k, (_, p) in cameras.items():
            ray = scale * near - p[0]
            xy = ray[None, :2] / ray[2]
            landmarks.add_observations(k, Observations(np.array([7]), FOCAL_PX * xy, xy, np.array([k + 1])))
        assert len(landmarks.triangulate(cameras, newest=3)) == 0
        assert len(landmarks.ids) == useful
