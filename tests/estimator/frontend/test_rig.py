"""Front end of a rig on images of a textured wall, for which the projections of all landmarks are known."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.frontend import stereo
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker, measures_depth
from dronevio.estimator.frontend.stereo import shared_view
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import NO_IMAGE, CameraFrame

RenderWall = Callable[[CameraModel, Array], npt.NDArray[np.uint8]]

LEFT = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
RIGHT = CameraModel(376, 240, 227.0, 227.5, 190.0, 118.0, (-0.27, 0.06, -1e-4, 1e-5))
FISHEYE = CameraModel(320, 240, 138.0, 137.5, 158.0, 121.0, (-0.01, 0.01, -0.01, 0.0), lens="equidistant")
MISALIGNED = exp_so3(np.radians([1.5, -1.0, 0.5]))
WALL_M = 3.0  # depth of the wall in the first camera frame
CONFIG = TrackerConfig()


def rig_of(*cameras: tuple[CameraModel, Array, Sequence[float]]) -> Rig:
    """Return a rig with an IMU apart from its cameras, from models, orientations and positions [m]."""
    T_imu = pose_matrix(exp_so3(np.array([0.3, -0.2, 0.1])), np.array([0.05, 0.02, -0.03]))
    return Rig(tuple(RigCamera(model, T_imu @ pose_matrix(R, np.array(p))) for model, R, p in cameras))


STEREO = rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, MISALIGNED, [0.11, 0.005, -0.01]))


class WallSequence:
    """Renders consecutive frames of all cameras of a rig; the first camera starts at the origin."""

    def __init__(self, render: RenderWall, rig: Rig) -> None:
        self._render, self._rig, self._k = render, rig, -1
        self.T_main_imu = inverse_pose(rig.cameras[0].T_imu_cam)

    def frame(self, T_world_main: Array | None = None) -> CameraFrame:
        self._k += 1
        T_world_imu = (np.eye(4) if T_world_main is None else T_world_main) @ self.T_main_imu
        images = [self._render(camera.model, T_world_imu @ camera.T_imu_cam) for camera in self._rig.cameras]
        return CameraFrame(10**18 + self._k * 50_000_000, tuple(images))

    def match_errors_px(self, seen: Observations, T_world_main: Array | None = None) -> Array:
        """Return the errors (M,) of matches against the projections of the landmarks of the first camera [px]."""
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


def replenished_once(render: RenderWall, rig: Rig) -> tuple[WallSequence, RigTracker, Observations]:
    wall, tracker = WallSequence(render, rig), RigTracker(rig, CONFIG)
    tracker.track(wall.frame(), np.eye(3))
    return wall, tracker, tracker.replenish()


@pytest.mark.parametrize(
    "rig",
    [
        STEREO,
        rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, exp_so3(np.radians([2.0, 8.0, -4.0])), [0.02, 0.15, 0.03])),
        rig_of((FISHEYE, np.eye(3), [0, 0, 0]), (FISHEYE, MISALIGNED, [0.1, 0, 0])),
        rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, MISALIGNED, [0.11, 0, 0]), (LEFT, MISALIGNED, [0.0, 0.1, 0])),
    ],
    ids=["stereo", "vertical baseline", "fisheyes", "three cameras"],
)
def test_matches_are_at_the_projections_of_landmarks(render_wall: RenderWall, rig: Rig) -> None:
    wall, tracker, seen = replenished_once(render_wall, rig)
    for rotation_deg, p_m in (([1.0, -2.0, 0.5], [0.05, 0.0, 0.1]), ([2.0, -3.0, 1.0], [0.1, -0.05, 0.3])):
        error_px = wall.match_errors_px(seen)
        for j in range(1, len(rig.cameras)):
            matched = seen.matches.camera == j
            assert matched.sum() > 0.7 * len(seen)
            assert np.median(error_px[matched]) < 0.15 and np.mean(error_px[matched] < 0.5) > 0.95
        T = pose_matrix(exp_so3(np.radians(rotation_deg)), np.array(p_m))
        tracked = tracker.track(wall.frame(T), T[:3, :3].T)
        assert len(tracked.matches) == 0
        seen = tracker.replenish()
        assert np.median(wall.match_errors_px(seen, T)) < 0.15
        break


def cropped(model: CameraModel, x: int, y: int) -> CameraModel:
    """Return a camera without some columns at the left and right, and rows at the top and bottom."""
    return replace(model, width=model.width - 2 * x, height=model.height - 2 * y, cx=model.cx - x, cy=model.cy - y)


LARGE_LEFT, LARGE_RIGHT = LEFT.resized(752, 480), RIGHT.resized(752, 480)


@pytest.mark.parametrize(
    ("first", "second", "error_px", "share"),
    [
        (LARGE_LEFT, RIGHT, 0.15, 0.85),
        (LEFT, LARGE_RIGHT, 0.3, 0.85),  # of the finer camera
        (LARGE_LEFT, RIGHT.resized(600, 380), 0.15, 0.85),
        (LARGE_LEFT, cropped(LARGE_RIGHT, 60, 40), 0.15, 0.85),
        (cropped(LARGE_LEFT, 80, 20), LARGE_RIGHT, 0.15, 0.85),
        (LEFT, FISHEYE, 0.15, 0.5),  # far from the axis, patches of a fisheye are compressed
    ],
    ids=["second half", "first half", "second smaller", "second cropped", "first cropped", "pinhole and fisheye"],
)
def test_cameras_with_images_of_different_sizes_are_matched(
    render_wall: RenderWall, first: CameraModel, second: CameraModel, error_px: float, share: float
) -> None:
    rig = rig_of((first, np.eye(3), [0, 0, 0]), (second, MISALIGNED, [0.11, 0.005, -0.01]))
    wall, _, seen = replenished_once(render_wall, rig)
    T_second_first = inverse_pose(rig.cameras[1].T_imu_cam) @ rig.cameras[0].T_imu_cam
    points = WALL_M * np.column_stack([seen.xy, np.ones(len(seen))])
    pixels = second.project(points @ T_second_first[:3, :3].T + T_second_first[:3, 3])
    visible = np.all((pixels > 10) & (pixels < [second.width - 11, second.height - 11]), axis=1)
    assert visible.sum() > 20
    assert len(seen.matches) > share * visible.sum()
    errors = wall.match_errors_px(seen)
    assert np.median(errors) < error_px and np.mean(errors < 1.0) > 0.95


def test_cameras_exposed_one_after_another_are_matched(render_wall: RenderWall) -> None:
    """The rig turns and moves before the second camera is exposed; the features are moved to that time."""
    T = pose_matrix(exp_so3(np.radians([1.5, 0.2, 0.8])), np.array([0.004, 0.02, 0.003]))
    T_main_imu = inverse_pose(STEREO.cameras[0].T_imu_cam)
    first = render_wall(LEFT, np.eye(4))
    second = render_wall(RIGHT, T @ T_main_imu @ STEREO.cameras[1].T_imu_cam)

    def at_exposure_of(camera: int, seen: Observations) -> Array:
        assert camera == 1
        points = WALL_M * np.column_stack([seen.xy, np.ones(len(seen))])
        p = (points - T[:3, 3]) @ T[:3, :3]
        return np.asarray(p[:, :2] / p[:, 2:])

    tracker = RigTracker(STEREO, CONFIG)
    tracker.track(CameraFrame(0, (first, second)), np.eye(3))
    unaware = tracker.replenish()
    seen = tracker.replenish(None, at_exposure_of)
    assert len(unaware.matches) == 0  # the calibration seems to be wrong
    assert len(seen.matches) > 0.7 * len(seen)
    rays = np.column_stack([seen.xy, np.ones(len(seen))])[np.searchsorted(seen.ids, seen.matches.ids)]
    T_second = inverse_pose(T @ T_main_imu @ STEREO.cameras[1].T_imu_cam)
    expected = RIGHT.project(WALL_M * rays @ T_second[:3, :3].T + T_second[:3, 3])
    found = RIGHT.project(np.column_stack([seen.matches.xy, np.ones(len(seen.matches))]))
    assert np.median(np.linalg.norm(found - expected, axis=1)) < 0.15


def test_matches_belong_to_observed_features(render_wall: RenderWall) -> None:
    _, _, seen = replenished_once(render_wall, STEREO)
    assert np.isin(seen.matches.ids, seen.ids).all() and np.all(np.diff(seen.matches.ids) > 0)
    np.testing.assert_array_equal(seen.camera, 0)
    np.testing.assert_array_equal(seen.matches.camera, 1)


def test_one_camera_gives_the_result_of_its_tracker(render_wall: RenderWall) -> None:
    rig = rig_of((LEFT, np.eye(3), [0, 0, 0]))
    wall, single = WallSequence(render_wall, rig), FeatureTracker(LEFT, CONFIG)
    whole: FrontEnd = RigTracker(rig, CONFIG)
    assert len(whole.replenish()) == 0  # before any frame
    for k in range(4):
        R = exp_so3(np.radians([0.0, 1.0 * k, 0.0]))
        frame, R_cur_prev = wall.frame(pose_matrix(R, np.zeros(3))), exp_so3(np.radians([0.0, -1.0, 0.0]))
        whole.track(frame, R_cur_prev)
        single.track(frame, R_cur_prev)
        seen, expected = whole.replenish(), single.replenish()
        for name in ("ids", "pixels", "xy", "ages", "camera", "zncc", "scale"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(expected, name))
        assert len(seen.matches) == 0
        whole.discard(seen.ids[:3])
        single.discard(seen.ids[:3])


def test_displaced_patches_are_not_matched(render_wall: RenderWall) -> None:
    """A part of the second image is displaced across the epipolar lines."""
    wall, tracker = WallSequence(render_wall, STEREO), RigTracker(STEREO, CONFIG)
    frame = wall.frame()
    box, second = (slice(60, 180), slice(100, 240)), frame.images[1].copy()
    second[box] = np.roll(second, 6, axis=0)[box]
    tracker.track(replace(frame, images=(frame.images[0], second)), np.eye(3))
    seen = tracker.replenish()
    pixels = RIGHT.project(np.column_stack([seen.matches.xy, np.ones(len(seen.matches))]))
    inside = np.all((pixels > [112, 72]) & (pixels < [228, 168]), axis=1)
    assert inside.sum() <= 1 and (~inside).sum() > 10


def misaligned(rig: Rig, rotation_deg: Sequence[float]) -> Rig:
    """Return a rig whose second camera is rotated."""
    first, second = rig.cameras
    T = second.T_imu_cam @ pose_matrix(exp_so3(np.radians(rotation_deg)), np.zeros(3))
    return replace(rig, cameras=(first, replace(second, T_imu_cam=T)))


@pytest.mark.parametrize("rotation_deg", [[1.0, 0.0, 0.0], [0.6, -0.4, -0.7], [-0.5, 0.8, 0.3], [0.2, -0.3, 1.5]])
def test_miscalibrated_cameras_give_no_depth(render_wall: RenderWall, rotation_deg: Sequence[float]) -> None:
    true_rig = misaligned(STEREO, rotation_deg)
    wall, tracker = WallSequence(render_wall, true_rig), RigTracker(STEREO, CONFIG)
    frame = wall.frame()
    tracker.track(frame, np.eye(3))
    for _ in range(2):
        seen = tracker.replenish()
        assert len(seen.matches) == 0 and len(seen.miscalibrated) > 0.6 * len(seen)
        error_px = wall.match_errors_px(replace(seen, matches=seen.miscalibrated))
        assert np.median(error_px) < 0.2 and np.mean(error_px < 1.0) > 0.95  # the matches are correct
    left = seen.without(seen.ids[::2])
    assert len(left.miscalibrated) and not np.isin(left.miscalibrated.ids, seen.ids[::2]).any()
    seen = tracker.replenish(Calibration(true_rig))
    assert len(seen.miscalibrated) == 0 and len(seen.matches) > 0.7 * len(seen)
    assert np.median(wall.match_errors_px(seen)) < 0.15


def test_small_misalignment_is_tolerated(render_wall: RenderWall) -> None:
    wall, tracker = WallSequence(render_wall, misaligned(STEREO, [0.05, -0.05, 0.05])), RigTracker(STEREO, CONFIG)
    tracker.track(wall.frame(), np.eye(3))
    seen = tracker.replenish()
    assert len(seen.miscalibrated) == 0 and len(seen.matches) > 0.7 * len(seen)


def test_corrected_extrinsics_apply_to_all_trackers(render_wall: RenderWall) -> None:
    """The predicted rotation of a second tracker depends on its extrinsics; with wrong ones its features are lost."""
    true_rig, wrong_rig = (
        rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, exp_so3(np.radians([0.0, 50.0, roll_deg])), [0, 0, 0]))
        for roll_deg in (0.0, 90.0)
    )
    trackers = [RigTracker(wrong_rig, CONFIG), RigTracker(true_rig, CONFIG)]
    wall, R = WallSequence(render_wall, true_rig), exp_so3(np.radians([0.0, 0.0, 8.0]))
    for frame, R_cur_prev in ((wall.frame(), np.eye(3)), (wall.frame(pose_matrix(R, np.zeros(3))), R.T)):
        for tracker in trackers:
            tracker.track(frame, R_cur_prev, calibration=Calibration(true_rig))
        seen = [tracker.replenish() for tracker in trackers]
        np.testing.assert_array_equal(seen[0].pixels, seen[1].pixels)
    assert np.any(seen[0].camera == 1)


def test_corrected_intrinsics_apply_to_matches(render_wall: RenderWall) -> None:
    """Focal lengths and principal points of both cameras are wrong, each by another amount."""
    focal, principal = np.array([0.01, -0.02]), np.array([[0.012, -0.009], [-0.01, 0.015]])
    true = [replace(camera.model, distortion=(0.0, 0.0, 0.0, 0.0)) for camera in STEREO.cameras]
    given = []
    for m, f, (x, y) in zip(true, focal, principal, strict=True):
        fx, fy = m.fx / (1.0 + f), m.fy / (1.0 + f)
        given.append(replace(m, fx=fx, fy=fy, cx=m.cx - fx * x, cy=m.cy - fy * y))
    true_rig, given_rig = (
        replace(STEREO, cameras=tuple(replace(c, model=m) for c, m in zip(STEREO.cameras, models, strict=True)))
        for models in (true, given)
    )
    corrections = IntrinsicCorrections(focal, principal, np.zeros(2), Calibration(given_rig).models)
    wall, tracker = WallSequence(render_wall, true_rig), RigTracker(given_rig, CONFIG)
    tracker.track(wall.frame(), np.eye(3))
    assert len(tracker.replenish().matches) == 0
    calibration = Calibration(given_rig, intrinsics=corrections)
    seen = calibration.normalized(tracker.replenish(calibration))
    assert len(seen.miscalibrated) == 0 and len(seen.matches) > 0.7 * len(seen)
    assert np.median(wall.match_errors_px(seen)) < 0.15


def test_few_matches_may_agree_by_chance(render_wall: RenderWall, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second image shows another place, but for a small part."""
    found = []
    for share in (0.0, stereo.MIN_SHARE):
        monkeypatch.setattr(stereo, "MIN_SHARE", share)
        wall, tracker = WallSequence(render_wall, STEREO), RigTracker(STEREO, CONFIG)
        frame, elsewhere = wall.frame(), wall.frame(pose_matrix(np.eye(3), np.array([2.0, 1.0, 0.0])))
        second = elsewhere.images[1].copy()
        second[80:160, 130:230] = frame.images[1][80:160, 130:230]
        tracker.track(replace(frame, images=(frame.images[0], second)), np.eye(3))
        seen = tracker.replenish()
        found.append(len(seen.matches) + len(seen.miscalibrated))
    assert 0 < found[0] < 0.1 * len(seen) and found[1] == 0


def test_a_dark_second_image_yields_no_matches(render_wall: RenderWall) -> None:
    wall, tracker = WallSequence(render_wall, STEREO), RigTracker(STEREO, CONFIG)
    frame = wall.frame()
    tracker.track(replace(frame, images=(frame.images[0], np.zeros_like(frame.images[1]))), np.eye(3))
    dark = tracker.replenish()
    assert len(dark) > 20 and len(dark.matches) == 0
    tracker.track(wall.frame(), np.eye(3))
    assert len(tracker.replenish().matches) > 0.7 * len(dark)


def test_cameras_without_overlap_track_separately(render_wall: RenderWall) -> None:
    """The second camera faces backwards, and its rotation is predicted from that of the first camera."""
    R_back = exp_so3(np.array([0.0, np.pi, 0.0]))
    rig = rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, R_back, [0.0, 0.0, -0.1]))
    tracker = RigTracker(rig, replace(CONFIG, min_tracked_ratio=0.0, min_inlier_ratio=0.0))  # the prediction alone
    R_previous, step_deg = np.eye(3), np.array([0.0, 6.0, 3.0])  # too large for tracking without prediction
    seen = []
    for k in range(3):
        R = exp_so3(np.radians(k * step_deg))
        images = (
            render_wall(LEFT, pose_matrix(R, np.zeros(3))),
            render_wall(RIGHT, pose_matrix(R_back.T @ R @ R_back, np.zeros(3))),
        )
        tracked = tracker.track(CameraFrame(k, images), R.T @ R_previous)
        seen.append((tracked, tracker.replenish()))
        R_previous = R
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


def test_cameras_may_lack_an_image(render_wall: RenderWall) -> None:
    """Without the second image nothing is matched; without the first, which tracks, nothing is observed."""
    wall, tracker, before = replenished_once(render_wall, STEREO)
    first, second = wall.frame().images
    one = tracker.track(CameraFrame(10**18 + 60_000_000, (first, NO_IMAGE)), np.eye(3))
    assert len(one) > 0.9 * len(before)
    assert len(tracker.replenish().matches) == 0
    assert len(tracker.track(CameraFrame(10**18 + 70_000_000, (NO_IMAGE, second)), np.eye(3))) == 0
    assert len(tracker.replenish()) == 0
    tracker.track(wall.frame(), np.eye(3))
    after = tracker.replenish()
    assert len(after.matches) > 0.8 * len(before.matches)
    assert np.isin(before.ids, after.ids).mean() > 0.9


def test_cameras_measure_depth_where_they_share_the_view() -> None:
    apart = rig_of((LEFT, np.eye(3), [0, 0, 0]), (RIGHT, exp_so3(np.radians([0.0, 120.0, 0.0])), [0.1, 0, 0]))
    alone = replace(STEREO, cameras=STEREO.cameras[:1])
    assert [measures_depth(rig) for rig in (STEREO, apart, alone)] == [True, False, False]


def test_shared_view_of_the_named_rigs() -> None:
    for name in RIGS:
        cameras = rig_named(name).cameras
        assert shared_view(cameras[0], cameras[0]) == pytest.approx(1.0, abs=0.03), name
        if len(cameras) > 1:
            assert shared_view(cameras[1], cameras[0]) > 0.8, name


def test_shared_view_decreases_with_the_angle() -> None:
    shares = [
        shared_view(
            *rig_of((LEFT, exp_so3(np.radians([0.0, a, 0.0])), [0.1, 0, 0]), (LEFT, np.eye(3), [0, 0, 0])).cameras
        )
        for a in range(0, 181, 15)
    ]
    assert np.all(np.diff(shares) <= 0.01) and shares[0] > 0.8 and shares[-1] == 0.0


@pytest.mark.parametrize(
    "second",
    [None, np.zeros((LEFT.width, LEFT.height), np.uint8), np.zeros((LEFT.height, LEFT.width))],
    ids=["None", "transposed", "floats"],
)
def test_invalid_second_images_are_refused(second: object) -> None:
    first = np.zeros((LEFT.height, LEFT.width), np.uint8)
    with pytest.raises(ConfigError, match=r"image 1 is .* expected uint8 of shape"):
        RigTracker(STEREO, CONFIG).track(CameraFrame(0, (first, second)), np.eye(3))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="with 1 images; expected 2, one for each camera"):
        RigTracker(STEREO, CONFIG).track(CameraFrame(0, (first,)), np.eye(3))
