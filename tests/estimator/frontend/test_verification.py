"""Images that are compared with what is expected of them, on images of a textured wall."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.frontend.protocol import PredictingFrontEnd
from dronevio.estimator.frontend.rig import MIN_VERIFIED, RigTracker
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.types import Calibration, ExpectedFeatures, Observations
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import NO_IMAGE, CameraFrame

RenderWall = Callable[[CameraModel, Array], Image]

LENS = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
T_IMU_MAIN = pose_matrix(exp_so3(np.array([0.3, -0.2, 0.1])), np.array([0.05, 0.02, -0.03]))
WALL_M = 3.0  # depth of the wall in the first camera frame
STILL = np.eye(3)


def rig_of(*rotations_deg: Sequence[float]) -> Rig:
    """Return a rig of equal cameras at one place, whose first camera has the first rotation."""
    poses = (T_IMU_MAIN @ pose_matrix(exp_so3(np.radians(deg)), np.zeros(3)) for deg in rotations_deg)
    return Rig(tuple(RigCamera(LENS, T) for T in poses))


class WallFlight:
    """A rig before the wall, with features that are detected at the origin."""

    def __init__(self, render: RenderWall, rig: Rig) -> None:
        self._render, self._rig, self._k = render, rig, -1
        self.tracker: PredictingFrontEnd = RigTracker(rig, TrackerConfig())
        self.tracker.track(self.frame(), STILL)
        self.first = self.tracker.replenish()
        T_world_cam = [inverse_pose(T_IMU_MAIN) @ rig.cameras[i].T_imu_cam for i in self.first.camera]
        rays = np.column_stack([self.first.xy, np.ones(len(self.first))])
        rays = np.stack([T[:3, :3] @ ray for T, ray in zip(T_world_cam, rays, strict=True)])
        self.points = rays * (WALL_M / rays[:, 2:])

    def frame(self, T_world_main: Array | None = None) -> CameraFrame:
        """Return the next frame from a pose of the main camera."""
        self._k += 1
        T_world_imu = (np.eye(4) if T_world_main is None else T_world_main) @ inverse_pose(T_IMU_MAIN)
        images = tuple(self._render(c.model, T_world_imu @ c.T_imu_cam) for c in self._rig.cameras)
        return CameraFrame(10**18 + self._k * 50_000_000, images)

    def expected(self, T_world_main: Array) -> ExpectedFeatures:
        """Return where a pose of the main camera expects the features."""
        T_imu_world = T_IMU_MAIN @ inverse_pose(T_world_main)
        p_imu = self.points @ T_imu_world[:3, :3].T + T_imu_world[:3, 3]
        return ExpectedFeatures(self.first.ids, Calibration(self._rig).rays(p_imu))

    def errors_px(self, seen: Observations, T_world_main: Array) -> Array:
        """Return the distances (N,) of features of the main camera from their true positions [px]."""
        rays = self.expected(T_world_main).rays[0, np.searchsorted(self.first.ids, seen.ids)]
        return np.asarray(np.linalg.norm(seen.pixels - LENS.project(rays), axis=1))


@pytest.fixture
def flight(render_wall: RenderWall) -> WallFlight:
    return WallFlight(render_wall, rig_of([0.0, 0.0, 0.0]))


def pose(rotation_deg: Sequence[float] = (0, 0, 0), p_m: Sequence[float] = (0, 0, 0)) -> Array:
    return pose_matrix(exp_so3(np.radians(rotation_deg)), np.array(p_m, dtype=np.float64))


MOVED = pose([1.0, -2.0, 8.0], [0.1, 0.05, 0.1])


@pytest.mark.parametrize("error_m", [0.0, 0.004])
def test_an_image_is_verified_where_the_prediction_is_right(flight: WallFlight, error_m: float) -> None:
    """4 mm before a wall at 3 m are 0.3 pixels."""
    predicted = MOVED @ pose(p_m=[error_m, 0.0, 0.0])
    seen = flight.tracker.verified(flight.frame(MOVED), flight.expected(predicted), MOVED[:3, :3].T)
    assert seen is not None and len(seen) > 0.8 * len(flight.first) > MIN_VERIFIED
    assert set(seen.ids) <= set(flight.first.ids)
    assert flight.errors_px(seen, predicted).max() < 1e-6
    back = LENS.project(np.column_stack([seen.xy, np.ones(len(seen))]))
    np.testing.assert_allclose(back, seen.pixels, atol=1e-6)
    assert np.median(seen.zncc) > 0.95


@pytest.mark.parametrize(
    "predicted", [MOVED @ pose(p_m=[0.04, 0.0, 0.0]), MOVED @ pose([0.0, 1.0, 0.0])], ids=["position", "rotation"]
)
def test_an_image_is_not_verified_where_the_prediction_is_wrong(flight: WallFlight, predicted: Array) -> None:
    """By three and by four pixels."""
    assert flight.tracker.verified(flight.frame(MOVED), flight.expected(predicted), MOVED[:3, :3].T) is None


def test_an_image_that_has_lost_features_is_not_verified(flight: WallFlight) -> None:
    """After a turn by 20°, 40 % of the features are outside: new ones are needed."""
    turned = pose([0.0, 20.0, 0.0])
    assert flight.tracker.verified(flight.frame(turned), flight.expected(turned), turned[:3, :3].T) is None


@pytest.mark.parametrize("image", [NO_IMAGE, np.zeros((240, 376), np.uint8)], ids=["missing", "dark"])
def test_a_frame_without_features_is_not_verified(flight: WallFlight, image: Image) -> None:
    frame = replace(flight.frame(), images=(image,))
    assert flight.tracker.verified(frame, flight.expected(np.eye(4)), STILL) is None


def test_few_features_verify_nothing(flight: WallFlight) -> None:
    frame, expected = flight.frame(), flight.expected(np.eye(4))
    flight.tracker.discard(flight.first.ids[MIN_VERIFIED:])
    assert flight.tracker.verified(frame, expected, STILL) is not None
    flight.tracker.discard(flight.first.ids[:1])
    assert flight.tracker.verified(frame, expected, STILL) is None


def test_verification_changes_nothing(render_wall: RenderWall) -> None:
    """A frame that is tracked afterwards is tracked as if it had not been compared."""
    one, other = (WallFlight(render_wall, rig_of([0.0, 0.0, 0.0])) for _ in range(2))
    wrong = MOVED @ pose(p_m=[0.2, 0.0, 0.0])
    assert one.tracker.verified(one.frame(MOVED), one.expected(wrong), MOVED[:3, :3].T) is None
    one_seen, other_seen = (each.tracker.track(each.frame(MOVED), MOVED[:3, :3].T) for each in (one, other))
    np.testing.assert_array_equal(one_seen.ids, other_seen.ids)
    np.testing.assert_array_equal(one_seen.pixels, other_seen.pixels)


def test_features_are_searched_where_they_are_expected(flight: WallFlight) -> None:
    """A displacement by 1 m is one of 76 pixels, beyond the reach of Lucas-Kanade from the rotation alone."""
    far = pose(p_m=[1.0, 0.0, 0.0])
    flight.tracker.track(replace(flight.frame(), images=(NO_IMAGE,)), STILL)
    seen = flight.tracker.track(flight.frame(far), STILL, expected=flight.expected(far @ pose(p_m=[0.02, 0.0, 0.0])))
    inside = np.isfinite(flight.expected(far).rays[0]).all(axis=1)
    pixels = LENS.project(flight.expected(far).rays[0])
    inside &= np.all((pixels > 14.0) & (pixels < [361.0, 225.0]), axis=1)
    assert len(seen) > 0.9 * inside.sum() > 10
    assert np.median(flight.errors_px(seen, far)) < 0.2


def test_every_camera_that_tracks_is_compared(render_wall: RenderWall) -> None:
    """Of two cameras that look past each other, one is dark."""
    flight = WallFlight(render_wall, rig_of([0.0, -35.0, 0.0], [0.0, 35.0, 0.0]))
    assert set(flight.first.camera) == {0, 1}
    frame, expected = flight.frame(), flight.expected(np.eye(4))
    seen = flight.tracker.verified(frame, expected, STILL)
    assert seen is not None and set(seen.camera) == {0, 1} and np.all(np.diff(seen.ids) > 0)
    half = replace(frame, images=(frame.images[0], np.zeros_like(frame.images[1])))
    assert flight.tracker.verified(half, expected, STILL) is None


def test_features_behind_the_camera_are_not_expected() -> None:
    rays = Calibration(rig_of([0.0, 0.0, 0.0])).rays((T_IMU_MAIN[:3, 3] - 2.0 * T_IMU_MAIN[:3, 2])[None])
    assert rays.shape == (1, 1, 3) and np.isnan(rays).all()
