"""The front end of a rig, on pictures of a wall for which every landmark's place is known in every camera."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.frontend.stereo import shared_view
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.types import Observations
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import CameraFrame

LEFT = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
RIGHT = CameraModel(376, 240, 227.0, 227.5, 190.0, 118.0, (-0.27, 0.06, -1e-4, 1e-5))
FISHEYE = CameraModel(320, 240, 138.0, 137.5, 158.0, 121.0, (-0.01, 0.01, -0.01, 0.0), lens="equidistant")
ASKEW = exp_so3(np.radians([1.5, -1.0, 0.5]))
WALL_M = 3.0  # ahead of the first camera
CONFIG = TrackerConfig()


def rig_of(*cameras: tuple[CameraModel, np.ndarray, Sequence[float]]) -> Rig:
    """Return a rig whose IMU is somewhere else, from models, orientations and positions [m]."""
    T_imu = pose_matrix(exp_so3(np.array([0.3, -0.2, 0.1])), np.array([0.05, 0.02, -0.03]))
    return Rig(tuple(RigCamera(model, T_imu @ pose_matrix(R, np.array(p))) for model, R, p in cameras))


STEREO = rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, ASKEW, [0.11, 0.005, -0.01]))


class Wall:
    """Sees the wall with all cameras of a rig; the first one starts at the origin."""

    def __init__(self, see: Callable[..., np.ndarray], rig: Rig) -> None:
        self._see, self._rig, self._k = see, rig, -1
        self.T_main_imu = inverse_pose(rig.cameras[0].T_imu_cam)

    def frame(self, T_world_main: np.ndarray | None = None) -> CameraFrame:
        self._k += 1
        T_world_imu = (np.eye(4) if T_world_main is None else T_world_main) @ self.T_main_imu
        images = [self._see(camera.model, T_world_imu @ camera.T_imu_cam) for camera in self._rig.cameras]
        return CameraFrame(10**18 + self._k * 50_000_000, tuple(images))

    def missed_px(self, seen: Observations, T_world_main: np.ndarray | None = None) -> np.ndarray:
        """Return how far matches are from where the landmarks are that the first camera sees [px]."""
        T = np.eye(4) if T_world_main is None else T_world_main
        first = np.column_stack([seen.xy, np.ones(len(seen))])[np.searchsorted(seen.ids, seen.matches.ids)]
        rays = first @ T[:3, :3].T
        points = T[:3, 3] + rays * ((WALL_M - T[2, 3]) / rays[:, 2:])
        errors = np.empty(len(points))
        for j in np.unique(seen.matches.camera):
            rows, camera = seen.matches.camera == j, self._rig.cameras[j]
            T_cam_world = inverse_pose(T @ self.T_main_imu @ camera.T_imu_cam)
            expected = camera.model.project(points[rows] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
            found = camera.model.project(np.column_stack([seen.matches.xy[rows], np.ones(rows.sum())]))
            errors[rows] = np.linalg.norm(found - expected, axis=1)
        return errors


def first_look(see: Callable[..., np.ndarray], rig: Rig) -> tuple[Wall, RigTracker, Observations]:
    wall, tracker = Wall(see, rig), RigTracker(rig, CONFIG)
    tracker.track(wall.frame(), np.eye(3))
    return wall, tracker, tracker.replenish()


@pytest.mark.parametrize(
    "rig",
    [
        STEREO,
        rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, exp_so3(np.radians([2.0, 8.0, -4.0])), [0.02, 0.15, 0.03])),
        rig_of((FISHEYE, np.eye(3), [0, 0, 0]), (FISHEYE, ASKEW, [0.1, 0, 0])),
        rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, ASKEW, [0.11, 0, 0]), (LEFT, ASKEW, [0.0, 0.1, 0])),
    ],
    ids=["stereo", "one above the other", "fisheyes", "three cameras"],
)
def test_matches_are_where_the_landmarks_are(see_wall: Callable[..., np.ndarray], rig: Rig) -> None:
    wall, tracker, seen = first_look(see_wall, rig)
    for turn_deg, step_m in (([1.0, -2.0, 0.5], [0.05, 0.0, 0.1]), ([2.0, -3.0, 1.0], [0.1, -0.05, 0.3])):
        error_px = wall.missed_px(seen)
        for j in range(1, len(rig.cameras)):
            matched = seen.matches.camera == j
            assert matched.sum() > 0.7 * len(seen)
            assert np.median(error_px[matched]) < 0.15 and np.mean(error_px[matched] < 0.5) > 0.95
        T = pose_matrix(exp_so3(np.radians(turn_deg)), np.array(step_m))
        tracked = tracker.track(wall.frame(T), T[:3, :3].T)
        assert len(tracked.matches) == 0
        seen = tracker.replenish()
        assert np.median(wall.missed_px(seen, T)) < 0.15
        break


def test_matches_are_of_features_that_are_seen(see_wall: Callable[..., np.ndarray]) -> None:
    _, _, seen = first_look(see_wall, STEREO)
    assert np.isin(seen.matches.ids, seen.ids).all() and np.all(np.diff(seen.matches.ids) > 0)
    np.testing.assert_array_equal(seen.camera, 0)
    np.testing.assert_array_equal(seen.matches.camera, 1)


def test_one_camera_is_what_its_tracker_says(see_wall: Callable[..., np.ndarray]) -> None:
    rig = rig_of((LEFT, np.eye(3), [0, 0, 0]))
    wall, alone = Wall(see_wall, rig), FeatureTracker(LEFT, CONFIG)
    whole: FrontEnd = RigTracker(rig, CONFIG)
    assert len(whole.replenish()) == 0  # before any frame
    for k in range(4):
        R = exp_so3(np.radians([0.0, 1.0 * k, 0.0]))
        frame, turn = wall.frame(pose_matrix(R, np.zeros(3))), exp_so3(np.radians([0.0, -1.0, 0.0]))
        whole.track(frame, turn)
        alone.track(frame, turn)
        seen, expected = whole.replenish(), alone.replenish()
        for name in ("ids", "pixels", "xy", "ages", "camera", "zncc", "scale"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(expected, name))
        assert len(seen.matches) == 0
        whole.discard(seen.ids[:3])
        alone.discard(seen.ids[:3])


def test_a_patch_that_is_elsewhere_is_not_matched(see_wall: Callable[..., np.ndarray]) -> None:
    """What is moved across the epipolar lines in the second picture alone is no landmark of both."""
    wall, tracker = Wall(see_wall, STEREO), RigTracker(STEREO, CONFIG)
    frame = wall.frame()
    box, second = (slice(60, 180), slice(100, 240)), frame.images[1].copy()
    second[box] = np.roll(second, 6, axis=0)[box]
    tracker.track(replace(frame, images=(frame.images[0], second)), np.eye(3))
    seen = tracker.replenish()
    pixels = RIGHT.project(np.column_stack([seen.matches.xy, np.ones(len(seen.matches))]))
    inside = np.all((pixels > [112, 72]) & (pixels < [228, 168]), axis=1)
    assert inside.sum() <= 1 and (~inside).sum() > 10


def turned(rig: Rig, turn_deg: Sequence[float]) -> Rig:
    """Return a rig whose second camera is turned from where it was."""
    first, second = rig.cameras
    T = second.T_imu_cam @ pose_matrix(exp_so3(np.radians(turn_deg)), np.zeros(3))
    return replace(rig, cameras=(first, replace(second, T_imu_cam=T)))


@pytest.mark.parametrize("turn_deg", [[1.0, 0.0, 0.0], [0.6, -0.4, -0.7], [-0.5, 0.8, 0.3], [0.2, -0.3, 1.5]])
def test_a_miscalibrated_camera_gives_no_depth(see_wall: Callable[..., np.ndarray], turn_deg: Sequence[float]) -> None:
    true_rig = turned(STEREO, turn_deg)
    wall, tracker = Wall(see_wall, true_rig), RigTracker(STEREO, CONFIG)
    frame = wall.frame()
    tracker.track(frame, np.eye(3))
    for _ in range(2):
        seen = tracker.replenish()
        assert len(seen.matches) == 0 and len(seen.miscalibrated) > 0.6 * len(seen)
        error_px = wall.missed_px(replace(seen, matches=seen.miscalibrated))
        assert np.median(error_px) < 0.2 and np.mean(error_px < 1.0) > 0.95  # they are true, though
    left = seen.without(seen.ids[::2])
    assert len(left.miscalibrated) and not np.isin(left.miscalibrated.ids, seen.ids[::2]).any()
    seen = tracker.replenish(true_rig)
    assert len(seen.miscalibrated) == 0 and len(seen.matches) > 0.7 * len(seen)
    assert np.median(wall.missed_px(seen)) < 0.15


def test_a_twentieth_of_a_degree_is_no_reason_to_doubt(see_wall: Callable[..., np.ndarray]) -> None:
    wall, tracker = Wall(see_wall, turned(STEREO, [0.05, -0.05, 0.05])), RigTracker(STEREO, CONFIG)
    tracker.track(wall.frame(), np.eye(3))
    seen = tracker.replenish()
    assert len(seen.miscalibrated) == 0 and len(seen.matches) > 0.7 * len(seen)


def test_recalibration_turns_the_cameras_that_follow(see_wall: Callable[..., np.ndarray]) -> None:
    """The rotation handed on to a second tracker is by the new mounting: a wrong one loses its features."""
    back = rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, exp_so3(np.radians([0.0, 50.0, 0.0])), [0, 0, 0]))
    believed = replace(back, cameras=(back.cameras[0], replace(back.cameras[1], T_imu_cam=back.cameras[0].T_imu_cam @
        pose_matrix(exp_so3(np.radians([0.0, 50.0, 90.0])), np.zeros(3)))))  # fmt: skip
    told = [RigTracker(believed, CONFIG), RigTracker(back, CONFIG)]
    wall, R = Wall(see_wall, back), exp_so3(np.radians([0.0, 0.0, 8.0]))
    for frame, turn in ((wall.frame(), np.eye(3)), (wall.frame(pose_matrix(R, np.zeros(3))), R.T)):
        for tracker in told:
            tracker.track(frame, turn, rig=back)
        seen = [tracker.replenish() for tracker in told]
        np.testing.assert_array_equal(seen[0].pixels, seen[1].pixels)
    assert np.any(seen[0].camera == 1)


def test_second_camera_in_the_dark_is_no_reason_to_fail(see_wall: Callable[..., np.ndarray]) -> None:
    wall, tracker = Wall(see_wall, STEREO), RigTracker(STEREO, CONFIG)
    frame = wall.frame()
    tracker.track(replace(frame, images=(frame.images[0], np.zeros_like(frame.images[1]))), np.eye(3))
    dark = tracker.replenish()
    assert len(dark) > 20 and len(dark.matches) == 0
    tracker.track(wall.frame(), np.eye(3))
    assert len(tracker.replenish().matches) > 0.7 * len(dark)


def test_cameras_that_look_elsewhere_have_features_of_their_own(see_wall: Callable[..., np.ndarray]) -> None:
    """The second camera looks back, at a wall that is seen in a mirror; its turns are told from the first one's."""
    about = exp_so3(np.array([0.0, np.pi, 0.0]))
    rig = rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, about, [0.0, 0.0, -0.1]))
    tracker = RigTracker(
        rig, replace(CONFIG, min_tracked_ratio=0.0, min_inlier_ratio=0.0)
    )  # no other help than the prediction
    R_before, turn_deg = np.eye(3), np.array([0.0, 6.0, 3.0])  # too much for a tracker that is told nothing
    seen = []
    for k in range(3):
        R = exp_so3(np.radians(k * turn_deg))
        images = (
            see_wall(LEFT, pose_matrix(R, np.zeros(3))),
            see_wall(RIGHT, pose_matrix(about.T @ R @ about, np.zeros(3))),
        )
        tracked = tracker.track(CameraFrame(k, images), R.T @ R_before)
        seen.append((tracked, tracker.replenish()))
        R_before = R
    newest = -1
    for tracked, after in seen:
        assert np.all(np.diff(after.ids) > 0) and set(after.camera.tolist()) == {0, 1}
        new = after.ids[~np.isin(after.ids, tracked.ids)]
        assert np.all(new > newest)
        newest = int(new.max(initial=newest))
        assert len(after.matches) == 0
    for camera in (0, 1):
        before, tracked = seen[1][1], seen[2][0]
        assert np.sum(tracked.camera == camera) > 0.5 * np.sum(before.camera == camera) > 10
    back = RIGHT.project(np.column_stack([after.xy, np.ones(len(after))]))
    np.testing.assert_allclose(back[after.camera == 1], after.pixels[after.camera == 1], atol=1e-9)


def test_shared_view_of_the_named_rigs() -> None:
    for name in RIGS:
        cameras = rig_named(name).cameras
        assert shared_view(cameras[0], cameras[0]) == pytest.approx(1.0, abs=0.03), name
        if len(cameras) > 1:
            assert shared_view(cameras[1], cameras[0]) > 0.8, name


def test_shared_view_falls_as_a_camera_turns_away() -> None:
    turned = [
        shared_view(
            *rig_of((LEFT, exp_so3(np.radians([0.0, a, 0.0])), [0.1, 0, 0]), (LEFT, np.eye(3), [0, 0, 0])).cameras
        )
        for a in range(0, 181, 15)
    ]
    assert np.all(np.diff(turned) <= 0.01) and turned[0] > 0.8 and turned[-1] == 0.0


@pytest.mark.parametrize(
    "second",
    [None, np.zeros((LEFT.width, LEFT.height), np.uint8), np.zeros((LEFT.height, LEFT.width))],
    ids=["None", "turned", "floats"],
)
def test_refuses_what_is_no_image_of_the_second_camera(second: object) -> None:
    first = np.zeros((LEFT.height, LEFT.width), np.uint8)
    with pytest.raises(ConfigError, match=r"image 1 is .* expected uint8 of shape"):
        RigTracker(STEREO, CONFIG).track(CameraFrame(0, (first, second)), np.eye(3))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="image 1 is NoneType"):
        RigTracker(STEREO, CONFIG).track(CameraFrame(0, (first,)), np.eye(3))
