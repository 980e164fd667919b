"""The window of the smoother after a correction of the calibration."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest

from dronevio.estimator.backend.landmarks import LandmarkConfig, LandmarkDatabase
from dronevio.estimator.backend.marginal_prior import KeyframeState, MarginalPrior
from dronevio.estimator.backend.recalibration import (
    image_velocity,
    recalibrated_observations,
    with_calibration_error,
)
from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.estimator.optimization.linalg import CholeskyFactor
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

if TYPE_CHECKING:
    from tests.estimator.conftest import KeyframeFeed, SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

OFFSET_S = 0.003
INFLATION = np.diag(np.repeat([0.01, 0.02, 0.1, 0.005, 0.15], 3) ** 2)


def state_of(pose: Array, velocity: Array) -> KeyframeState:
    return KeyframeState(gtsam.Pose3(pose), velocity, gtsam.imuBias.ConstantBias())


def two_states(rng: np.random.Generator) -> dict[int, KeyframeState]:
    return {k: state_of(pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3)), np.zeros(3)) for k in (3, 4)}


def test_a_common_error_adds_to_the_covariance() -> None:
    """The covariance grows by J Jᵀ, and the mean stays; a direction without information stays without."""
    rng = np.random.default_rng(0)
    A, J = rng.normal(size=(30, 30)), rng.normal(size=(30, 4))
    H, b = A @ A.T + np.eye(30), rng.normal(size=30)
    prior = MarginalPrior(H, b, two_states(rng)).with_common_error(J)
    np.testing.assert_allclose(np.linalg.inv(prior.H), np.linalg.inv(H) + J @ J.T, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(prior.H, prior.b), np.linalg.solve(H, b), rtol=1e-6)
    H[7], H[:, 7], b[7] = 0.0, 0.0, 0.0
    assert not MarginalPrior(H, b, two_states(rng)).with_common_error(J).H[7].any()


def test_the_error_of_a_calibration_is_common_to_all_keyframes() -> None:
    """Orientations, velocities and biases become uncertain together; their differences, positions and points do not."""
    states = two_states(np.random.default_rng(1))
    prior = MarginalPrior(1e6 * np.eye(33), np.zeros(33), states, {12: np.ones(3)})
    before, after = (np.linalg.inv(p.H) for p in (prior, with_calibration_error(prior, INFLATION, {}, 0.0)))
    grown = np.sqrt(np.diag(after - before).clip(0.0)).reshape(11, 3)
    expected = np.array([0.01, 0.0, 0.1, 0.15, 0.005, 0.01, 0.0, 0.1, 0.15, 0.005, 0.0])
    np.testing.assert_allclose(grown, np.repeat(expected[:, None], 3, axis=1), atol=1e-6)
    R = [state.pose.rotation().matrix() for state in states.values()]
    difference = np.zeros((6, 33))
    difference[:3, 0:3], difference[:3, 15:18] = R[0], -R[1]
    difference[3:, 6:9], difference[3:, 21:24] = np.eye(3), -np.eye(3)
    np.testing.assert_allclose(difference @ after @ difference.T, difference @ before @ difference.T, atol=1e-9)


def test_a_time_offset_moves_keyframes_along_their_motion() -> None:
    """The pose of a keyframe becomes uncertain by the motion within the change of the offset, and by nothing else."""
    pose, velocity, rate = exp_so3(np.array([0.4, 0.1, -0.9])), np.array([1.0, -2.0, 0.5]), np.array([0.2, 0.0, -0.4])
    states = {0: state_of(pose_matrix(pose, np.ones(3)), velocity)}
    prior = MarginalPrior(1e6 * np.eye(15), np.zeros(15), states)
    found = with_calibration_error(prior, np.zeros((15, 15)), {0: rate}, OFFSET_S)
    motion = OFFSET_S * np.concatenate([rate, pose.T @ velocity, np.zeros(9)])
    np.testing.assert_allclose(np.linalg.inv(found.H) - 1e-6 * np.eye(15), np.outer(motion, motion), atol=1e-11)


def test_image_velocity_is_the_derivative_of_the_projection() -> None:
    """Landmarks of known and unknown depth, in a camera away from the IMU's centre, in rotation and translation."""
    rng = np.random.default_rng(2)
    T_imu_cam = pose_matrix(exp_so3(np.array([0.3, -0.2, 1.2])), np.array([0.1, -0.05, 0.2]))
    R, p = exp_so3(rng.normal(size=3)), rng.normal(size=3)
    velocity, rate = rng.normal(size=3), rng.normal(size=3)
    in_camera = np.column_stack([rng.uniform(-1.0, 1.0, (5, 2)) * 3.0, np.full(5, 3.0)])
    T_world_cam = pose_matrix(R, p) @ T_imu_cam
    points = in_camera @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]

    def projected(t_s: float) -> Array:
        T = pose_matrix(R @ exp_so3(rate * t_s), p + velocity * t_s) @ T_imu_cam
        inverse = inverse_pose(T)
        at = points @ inverse[:3, :3].T + inverse[:3, 3]
        return np.asarray(at[:, :2] / at[:, 2:])

    ids, landmarks = np.arange(5), LandmarkDatabase(400.0, LandmarkConfig())
    landmarks.add_observations(7, Observations(ids, np.zeros((5, 2)), projected(0.0), np.ones(5, np.int64)))
    landmarks.ids, landmarks.points = ids[:3], points[:3]
    state = state_of(pose_matrix(R, p), velocity)
    flow = image_velocity(landmarks.all_observations, landmarks, state, rate, T_imu_cam[None])
    np.testing.assert_allclose(flow, (projected(1e-5) - projected(-1e-5)) / 2e-5, atol=1e-6)
    landmarks.ids, landmarks.points = ids[:0], points[:0]  # without any depth, as of infinitely far landmarks
    far = image_velocity(
        landmarks.all_observations, landmarks, state_of(pose_matrix(R, p), np.zeros(3)), rate, np.eye(4)[None]
    )
    ray = np.column_stack([projected(0.0), np.ones(5)])
    turned = ray @ exp_so3(rate * 1e-5)  # by the inverse rotation
    np.testing.assert_allclose(far, (turned[:, :2] / turned[:, 2:] - ray[:, :2]) / 1e-5, atol=1e-3)


@pytest.fixture(scope="module")
def flight(make_flight: MakeFlight) -> "SyntheticFlight":
    """A flight in motion whose images are exposed later than its stamps say."""
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment")
    return replace(flight, rig=replace(flight.rig, time_offset_s=OFFSET_S))


@pytest.fixture
def feed(flight: "SyntheticFlight", keyframe_feed: type["KeyframeFeed"]) -> "KeyframeFeed":
    """A smoother after that flight, which assumes that the stamps are right."""
    start = flight.state_at(int(flight.frame_times_ns[0]))
    assumed = replace(flight.rig, time_offset_s=0.0)
    return keyframe_feed(flight, start, np.diag(np.repeat([1e-4, 1e-8, 1e-2, 1e-4, 1e-2], 3)), assumed=assumed).finish()


def velocity_error(feed: "KeyframeFeed") -> float:
    truth = feed.flight.state_at(feed.smoother.state.t_ns)
    return float(np.linalg.norm(feed.smoother.state.velocity_m_s - truth.velocity_m_s))


def test_observations_are_those_of_the_corrected_time(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """The observations of all keyframes agree with cameras that expose without the offset, to a tenth of the shift."""
    window, focal_px = feed.smoother._window, flight.rig.cameras[0].model.fx
    before = Calibration(replace(flight.rig, time_offset_s=0.0))
    args = window.landmarks, window.states, feed.smoother._rates_rad_s, before
    moved = recalibrated_observations(*args, replace(before, time_offset_correction_s=OFFSET_S))
    shift = {(i, k): xy for i, k, xy in zip(moved.landmark.tolist(), moved.keyframe.tolist(), moved.xy, strict=True)}
    errors, shifts = [], []
    for k, t_ns in zip(window.states, feed.smoother.keyframe_times_ns, strict=True):
        exact = replace(flight, rig=before.rig).front_end()
        late = flight.front_end()
        for front_end in (exact, late):
            front_end.track(flight.frame(int(np.searchsorted(flight.frame_times_ns, t_ns))), np.eye(3))
        table = window.landmarks.all_observations
        for i, xy in zip(table.landmark[table.keyframe == k], table.xy[table.keyframe == k], strict=True):
            row = int(np.nanargmin(np.linalg.norm(late._model.normalize(late._pixels) - xy, axis=1)))
            true = exact._model.normalize(exact._pixels[row : row + 1])[0]
            errors.append(np.linalg.norm(shift[i, k] - true) * focal_px)
            shifts.append(np.linalg.norm(xy - true) * focal_px)
    assert np.median(shifts) > 0.5
    assert np.median(errors) < 0.1 * np.median(shifts)


def test_keyframes_of_unknown_rotation_lose_their_observations(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """Without its angular velocity, a keyframe's observations cannot be moved; unmoved ones are not lost."""
    window, before = feed.smoother._window, Calibration(flight.rig)
    oldest = min(window.states)
    rates = {k: rate for k, rate in feed.smoother._rates_rad_s.items() if k != oldest}
    later = recalibrated_observations(
        window.landmarks, window.states, rates, before, replace(before, time_offset_correction_s=1e-3)
    )
    table = window.landmarks.all_observations
    np.testing.assert_array_equal(later.landmark, table.landmark[table.keyframe != oldest])
    same = recalibrated_observations(window.landmarks, window.states, {}, before, before)
    np.testing.assert_array_equal(same.xy, table.xy)


def test_coordinates_by_corrected_intrinsics(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """Coordinates by the corrected camera have the pixels of those by the given one; the way back."""
    window, given = feed.smoother._window, Calibration(flight.rig)
    intrinsics = IntrinsicCorrections(np.full(1, 0.01), np.array([[0.02, -0.01]]), np.array([0.01]), given.models)
    corrected = replace(given, intrinsics=intrinsics)
    table = window.landmarks.all_observations
    found = recalibrated_observations(window.landmarks, window.states, {}, given, corrected)
    m, (k1, *others) = given.models[0], given.models[0].distortion
    true = replace(
        m, fx=1.01 * m.fx, fy=1.01 * m.fy, cx=m.cx + 0.02 * m.fx, cy=m.cy - 0.01 * m.fy, distortion=(k1 + 0.01, *others)
    )
    by_true, by_given = (
        model.project(np.column_stack([xy, np.ones(len(xy))])) for model, xy in ((true, found.xy), (m, table.xy))
    )
    np.testing.assert_allclose(by_true, by_given, atol=1e-6)
    assert np.median(np.linalg.norm(found.xy - table.xy, axis=1)) > 0.01
    window.landmarks.replace_observations(found)
    again = recalibrated_observations(window.landmarks, window.states, {}, corrected, given)
    np.testing.assert_allclose(again.xy, table.xy, atol=1e-12)


def test_a_correction_keeps_the_window_and_mends_it(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """The keyframes stay, the velocity comes closer to the truth, and the position becomes more uncertain."""
    smoother, times_ns, error = feed.smoother, feed.smoother.keyframe_times_ns, velocity_error(feed)
    before, count = smoother.state, len(smoother.landmarks)
    calibration = Calibration(replace(flight.rig, time_offset_s=0.0), time_offset_correction_s=OFFSET_S)
    assert smoother.recalibrate(calibration, 0.1 * INFLATION)
    assert smoother.keyframe_times_ns == times_ns and len(smoother.landmarks) == count
    assert velocity_error(feed) < 0.5 * error
    residual, _, observed = smoother._window.residuals()
    assert smoother.image_variance == smoother._window.image_variance(residual, observed)
    assert before.covariance is not None and smoother.state.covariance is not None
    growth = np.diag(smoother.state.covariance - before.covariance)[3:6]
    assert (growth > 0.1 * 0.02**2).all()


def test_extrinsics_are_those_of_the_correction(flight: "SyntheticFlight", keyframe_feed: type["KeyframeFeed"]) -> None:
    """After a rotation of the camera is corrected, the observations agree with the window again."""
    camera = flight.rig.cameras[0]
    turned = replace(camera, T_imu_cam=camera.T_imu_cam @ pose_matrix(exp_so3(np.array([0.0, 0.02, 0.0])), np.zeros(3)))
    flight = replace(flight, rig=replace(flight.rig, time_offset_s=0.0))
    start = flight.state_at(int(flight.frame_times_ns[0]))
    covariance = np.diag(np.repeat([1e-4, 1e-8, 1e-2, 1e-4, 1e-2], 3))
    feed = keyframe_feed(flight, start, covariance, assumed=replace(flight.rig, cameras=(turned,))).finish()
    assert feed.smoother.recalibrate(Calibration(flight.rig), INFLATION)
    T_world_cam = feed.smoother.state.T_world_imu @ camera.T_imu_cam
    window = feed.smoother._window
    np.testing.assert_allclose(window.cameras[window.newest][0][0], T_world_cam[:3, :3], atol=1e-12)
    assert feed.smoother.image_variance is not None and feed.smoother.image_variance < 1.0


def test_gravity_needs_a_new_window(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """Preintegrated measurements contain gravity, so the smoother refuses and is not changed."""
    before = feed.smoother.state
    assert not feed.smoother.recalibrate(Calibration(flight.rig, gravity_correction_m_s2=0.02), INFLATION)
    assert feed.smoother.state is before
    restarted = feed.smoother.restarted(Calibration(flight.rig, gravity_correction_m_s2=0.02), INFLATION)
    assert restarted.keyframe_times_ns == (before.t_ns,)


def test_a_window_without_a_solution_is_not_kept(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """Coordinates that are not finite make the linear system singular."""
    calibration = Calibration(flight.rig, time_offset_correction_s=np.nan)
    with np.errstate(all="ignore"):
        assert not feed.smoother.recalibrate(calibration, INFLATION)


def test_landmarks_without_observations_leave_the_prior(feed: "KeyframeFeed", flight: "SyntheticFlight") -> None:
    """Keyframes without a known angular velocity lose their observations, and the window keeps a solution."""
    window, before = feed.smoother._window, feed.smoother._calibration
    assert window.persistent
    window.recalibrate(before, replace(before, time_offset_correction_s=OFFSET_S), {}, INFLATION)
    assert not window.persistent and not len(window.landmarks.ids)
    system = window.linearize()
    assert np.isfinite(CholeskyFactor(system.H).solve(system.b)).all()
