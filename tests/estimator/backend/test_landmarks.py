"""The landmark database: which landmarks are triangulated, and which are rejected as outliers."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.backend.landmarks import CameraPoses, LandmarkConfig, LandmarkDatabase
from dronevio.estimator.backend.observations import CORRELATED_KEYFRAMES
from dronevio.estimator.types import NO_FEATURES, Matches, Observations
from dronevio.models.arrays import Array, Integers
from dronevio.models.rotation import exp_so3

FOCAL_PX = 458.0
LANDMARKS, KEYFRAMES = 30, 12


class Flight:
    """Keyframes of one camera on a curve, and landmarks in front of them."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.R = exp_so3(0.1 * rng.normal(size=(KEYFRAMES, 3)))
        self.p = np.linspace(0.0, 1.0, KEYFRAMES)[:, None] * [1.0, 0.4, 0.3] + 0.02 * rng.normal(size=(KEYFRAMES, 3))
        self.points = rng.uniform([-2.0, -1.5, 3.5], [3.0, 1.5, 6.5], (LANDMARKS, 3))
        in_camera = np.einsum("kij,lki->klj", self.R, self.points[:, None] - self.p)
        self.xy = in_camera[..., :2] / in_camera[..., 2:]  # (K, L, 2)

    def cameras(self) -> dict[int, tuple[Array, Array]]:
        """Return the pose of the camera at each keyframe."""
        return {k: (self.R[k, None], self.p[k, None]) for k in range(KEYFRAMES)}

    def observations(self, k: int, shifted_px: Array | None = None) -> Observations:
        """Return what keyframe k observes, of which the first three landmarks may be shifted [px]."""
        xy = self.xy[k].copy()
        if shifted_px is not None:
            xy[:3] += shifted_px / FOCAL_PX
        return Observations(np.arange(LANDMARKS), FOCAL_PX * xy, xy, np.full(LANDMARKS, k + 1))

    def database(self, keyframes: int, config: LandmarkConfig | None = None) -> LandmarkDatabase:
        """Return a database of the first keyframes."""
        landmarks = LandmarkDatabase(FOCAL_PX, config or LandmarkConfig())
        for k in range(keyframes):
            landmarks.add_observations(k, self.observations(k))
        return landmarks


@pytest.fixture
def flight() -> Flight:
    return Flight()


def rejected(landmarks: LandmarkDatabase, cameras: CameraPoses) -> Integers:
    """Return the outliers by the residuals of one camera at some poses."""
    table = landmarks.observations
    points = landmarks.points[landmarks.rows(table.landmark)]
    R, p = (np.stack([cameras[k][i][0] for k in table.keyframe.tolist()]) for i in (0, 1))
    in_camera = np.einsum("nij,ni->nj", R, points - p)
    return landmarks.reject_outliers(table.xy - in_camera[:, :2] / in_camera[:, 2:], in_camera[:, 2], table)


def test_variance_grows_with_the_keyframes_of_a_window(flight: Flight) -> None:
    """The n-th keyframe has 1 + ((n − 1) / c)² times the variance of the first; a removed one does not count."""
    landmarks = flight.database(3)
    landmarks.remove_keyframe(1)
    landmarks.add_observations(3, flight.observations(3))  # after keyframes 0 and 2
    landmarks.triangulate(flight.cameras(), 3)
    table = landmarks.observations
    assert len(table) > 0
    earlier = np.select([table.keyframe == 0, table.keyframe == 2, table.keyframe == 3], [0, 2, 2], -1)
    np.testing.assert_allclose(table.variance_growth, 1.0 + (earlier / CORRELATED_KEYFRAMES) ** 2)


def test_landmarks_with_views_and_parallax_are_triangulated(flight: Flight) -> None:
    landmarks = flight.database(8)
    assert len(landmarks.triangulate(flight.cameras(), newest=7)) == 0
    assert landmarks.ids.tolist() == list(range(LANDMARKS))
    np.testing.assert_allclose(landmarks.points, flight.points, atol=1e-3)
    assert len(landmarks.observations) == 8 * LANDMARKS


@pytest.mark.parametrize(
    ("keyframes", "config"),
    [
        (2, LandmarkConfig()),
        (8, LandmarkConfig(min_parallax_deg=60.0)),
        (8, LandmarkConfig(min_baseline_m=2.0)),
        (8, LandmarkConfig(max_distance_m=1.0)),
        (8, LandmarkConfig(min_keyframes=9)),
    ],
    ids=["views", "parallax", "baseline", "distance", "keyframes"],
)
def test_other_landmarks_are_neither_used_nor_removed(flight: Flight, keyframes: int, config: LandmarkConfig) -> None:
    landmarks = flight.database(keyframes, config)
    assert len(landmarks.triangulate(flight.cameras(), keyframes - 1)) == 0
    assert len(landmarks.ids) == 0 and len(landmarks.observations) == 0
    assert landmarks.observed_in(0).tolist() == list(range(LANDMARKS))


@pytest.mark.parametrize(("min_keyframes", "expected"), [(1, (30, 30)), (2, (0, 30)), (3, (0, 0))])
def test_keyframes_count_and_not_only_cameras(flight: Flight, min_keyframes: int, expected: tuple[int, int]) -> None:
    """Three cameras of one keyframe triangulate a landmark, but constrain no motion."""
    landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig(min_keyframes=min_keyframes))
    rig = {0: (flight.R[[0, 4, 8]], flight.p[[0, 4, 8]]), 1: (flight.R[[1, 5, 9]], flight.p[[1, 5, 9]])}
    for k, (first, others) in enumerate(((0, (4, 8)), (1, (5, 9)))):
        xy = np.concatenate([flight.xy[i] for i in others])
        matches = Matches(np.tile(np.arange(LANDMARKS), 2), np.repeat([1, 2], LANDMARKS), xy)
        landmarks.add_observations(k, replace(flight.observations(first), matches=matches))
        assert len(landmarks.triangulate(rig, newest=k)) == 0
        assert len(landmarks.ids) == expected[k]
    np.testing.assert_allclose(landmarks.points, flight.points[landmarks.ids], atol=1e-3)


def test_only_landmarks_of_the_newest_keyframe_are_new(flight: Flight) -> None:
    landmarks = flight.database(8)
    landmarks.add_observations(8, NO_FEATURES)
    landmarks.triangulate(flight.cameras(), newest=8)
    assert len(landmarks.ids) == 0
    landmarks.triangulate(flight.cameras(), newest=8, retriangulate=True)
    assert len(landmarks.ids) == LANDMARKS


def test_new_outliers_are_removed(flight: Flight) -> None:
    landmarks = flight.database(7)
    landmarks.add_observations(7, flight.observations(7, np.array([40.0, -30.0])))
    assert landmarks.triangulate(flight.cameras(), newest=7).tolist() == [0, 1, 2]
    assert landmarks.ids.tolist() == list(range(3, LANDMARKS))
    assert not np.isin(landmarks.observed_in(7), [0, 1, 2]).any()


@pytest.mark.parametrize(("shifted", "expected"), [(KEYFRAMES - 1, [0, 1, 2]), (KEYFRAMES - 4, [])])
def test_the_newest_observation_alone_rejects_a_landmark(flight: Flight, shifted: int, expected: list[int]) -> None:
    """One of twelve observations errs by 12 px: their root mean square is 3.5 px, but the track is lost if it is the
    newest one.
    """
    landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig(max_reprojection_px=6.0))
    for k in range(KEYFRAMES):
        landmarks.add_observations(k, flight.observations(k, np.array([0.0, 12.0]) if k == shifted else None))
    assert landmarks.triangulate(flight.cameras(), newest=KEYFRAMES - 1).tolist() == expected
    assert landmarks.ids.tolist() == [i for i in range(LANDMARKS) if i not in expected]


def test_triangulated_outliers_are_removed(flight: Flight) -> None:
    landmarks = flight.database(7)
    landmarks.triangulate(flight.cameras(), newest=6)
    landmarks.add_observations(7, flight.observations(7, np.array([40.0, -30.0])))
    assert rejected(landmarks, flight.cameras()).tolist() == [0, 1, 2]
    assert landmarks.ids.tolist() == list(range(3, LANDMARKS)) and len(landmarks.points) == LANDMARKS - 3


@pytest.mark.parametrize("wrong", [slice(0, 8), slice(7, 8)], ids=["all", "newest"])
def test_wrong_poses_make_no_outliers(flight: Flight, wrong: slice) -> None:
    """Poses are rotated by some degrees, each about another axis."""
    landmarks = flight.database(8)
    landmarks.triangulate(flight.cameras(), newest=7)
    rotations = exp_so3(np.radians(3.0) * np.random.default_rng(3).normal(size=(8, 3)))
    cameras = flight.cameras()
    for k in range(8)[wrong]:
        cameras[k] = cameras[k][0] @ rotations[k], cameras[k][1]
    assert len(rejected(landmarks, cameras)) == 0 and len(landmarks.ids) == LANDMARKS


def test_removed_and_unobserved_landmarks_are_gone(flight: Flight) -> None:
    landmarks = flight.database(8)
    landmarks.triangulate(flight.cameras(), newest=7)
    landmarks.remove(np.arange(5))
    assert landmarks.ids.tolist() == list(range(5, LANDMARKS)) and len(landmarks.observations) == 8 * 25
    landmarks.remove_keyframe(3)
    assert 3 not in landmarks.observations.keyframe and len(landmarks.observations) == 7 * 25
    for k in (0, 1, 2, 4, 5, 6, 7):
        landmarks.remove_keyframe(k)
    assert len(landmarks.ids) == len(landmarks.points) == len(landmarks.observations) == 0


def test_parallax_of_the_triangulated_landmarks(flight: Flight) -> None:
    landmarks = flight.database(8)
    landmarks.triangulate(flight.cameras(), newest=7)
    found = landmarks.triangulated(flight.cameras())
    rays = flight.points[:, None] - flight.p[:8]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    expected = np.arccos(np.einsum("lki,li->lk", rays, rays[:, 0]).clip(-1.0, 1.0)).max(axis=1)
    np.testing.assert_array_equal(found.ids, np.arange(LANDMARKS))
    np.testing.assert_allclose(found.parallax_rad, expected, atol=1e-3)


@pytest.mark.parametrize(("scale", "triangulated"), [(1.0, 0), (20.0, 1)])
def test_a_baseline_of_millimetres_gives_no_depth(scale: float, triangulated: int) -> None:
    """A drifting track observed from one place resembles a close landmark; at twenty times the size it is real."""
    point = scale * np.array([0.0, 0.0, 0.15])
    cameras = {k: (np.eye(3)[None], scale * np.array([[0.002 * k, 0.0, 0.0]])) for k in range(4)}
    landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig())
    for k, (_, p) in cameras.items():
        ray = point - p[0]
        xy = ray[None, :2] / ray[2]
        landmarks.add_observations(k, Observations(np.array([7]), FOCAL_PX * xy, xy, np.array([k + 1])))
    assert len(landmarks.triangulate(cameras, newest=3)) == 0
    assert len(landmarks.ids) == triangulated
