"""Compensation of exposure times, on observations with known exposure times."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dronevio.estimator.frontend.rolling_shutter import ExposureCompensation, LocalRotation
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import Calibration, Matches, Observations
from dronevio.models.arrays import Array
from dronevio.models.rig import EUROC_T_IMU_CAM1, Rig, RigCamera, euroc_rig
from dronevio.models.rig_presets import PINHOLE
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, pose_matrix

T_IMU_CAM = euroc_rig().cameras[0].T_imu_cam
FRAME_S = 0.05
ROLLING = RigCamera(PINHOLE, T_IMU_CAM, readout_s=0.03)
GLOBAL = RigCamera(PINHOLE, T_IMU_CAM)


@dataclass(frozen=True, eq=False)
class Path:
    """A motion of the IMU whose rotation and position are polynomials of time."""

    omega: Array
    """(3,) Angular velocity at t = 0 [rad/s]."""
    alpha: Array
    """(3,) Angular acceleration [rad/s²]."""
    velocity: Array
    """(3,) Velocity at t = 0 in the world frame [m/s]."""
    acceleration: Array
    """(3,) Acceleration in the world frame [m/s²]."""
    imu_s: float = 0.005
    """Interval between IMU samples [s]."""

    def T_world_imu(self, t_s: Array) -> Array:
        t = np.asarray(t_s)[..., None]
        R = exp_so3(self.omega * t) @ exp_so3(0.5 * self.alpha * t**2)
        return np.asarray(pose_matrix(R, self.velocity * t + 0.5 * self.acceleration * t**2))

    def increments(self, start_s: float, end_s: float) -> Increments:
        t = np.linspace(start_s, end_s, max(round((end_s - start_s) / self.imu_s), 1) + 1)
        R = self.T_world_imu(t)[:, :3, :3]
        rates = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / np.diff(t)[:, None]
        return Increments(np.diff(t), rates, np.zeros_like(rates))


def begin(times: ExposureCompensation, path: Path, t_s: float) -> None:
    times.begin_frame(path.increments(t_s - FRAME_S, t_s), path.increments(t_s, t_s + 0.03), np.zeros(3))


def landmarks(n: int = 150, depth_m: tuple[float, float] = (2.0, 6.0)) -> Array:
    """Return landmarks (n, 3) that are visible from the origin of the world."""
    rng = np.random.default_rng(5)
    pixels = rng.uniform([40.0, 40.0], [PINHOLE.width - 40.0, PINHOLE.height - 40.0], (n, 2))
    rays = np.column_stack([PINHOLE.normalize(pixels), np.ones(n)]) * rng.uniform(*depth_m, (n, 1))
    return np.asarray(rays @ T_IMU_CAM[:3, :3].T + T_IMU_CAM[:3, 3])


def projected(path: Path, camera: RigCamera, points: Array, t_s: Array) -> Array:
    """Return the projections (N, 2) of points (N, 3), each at its own time (N,) [px]."""
    T_cam_world = inverse_pose(path.T_world_imu(t_s) @ camera.T_imu_cam)
    p_cam = np.einsum("nij,nj->ni", T_cam_world[:, :3, :3], points) + T_cam_world[:, :3, 3]
    return camera.model.project(p_cam)


def exposed(path: Path, camera: RigCamera, points: Array, t_s: float, offset_s: float = 0.0) -> Array:
    """Return the observations (N, 2) of points by a rolling shutter whose middle row is exposed at t + offset [px]."""
    delay_s = np.full(len(points), offset_s)
    for _ in range(20):
        pixels = projected(path, camera, points, t_s + delay_s)
        delay_s = (pixels[:, 1] / (camera.model.height - 1) - 0.5) * camera.readout_s + offset_s
    return pixels


def observations(pixels: Array, **more: object) -> Observations:
    n = len(pixels)
    return Observations(np.arange(n), pixels, PINHOLE.normalize(pixels), np.full(n, 2), **more)  # type: ignore[arg-type]


def errors_px(
    path: Path,
    camera: RigCamera = ROLLING,
    offset_s: float = 0.0,
    dt_s: float = FRAME_S,
    new: slice = slice(0, 0),
    ahead_s: float = 0.03,
) -> tuple[Array, Array]:
    """Return the errors of observations in the second of two frames against those of a global shutter.

    Returns:
        Errors (M,) after the compensation and (N,) before it [px].
    """
    points, times = landmarks(), ExposureCompensation()
    calibration = Calibration(Rig((camera,)), time_offset_correction_s=offset_s)
    for t_s in (-dt_s, 0.0):
        seen = observations(exposed(path, camera, points, t_s, offset_s))
        if t_s < 0.0:
            known = np.ones(len(points), dtype=np.bool_)
            known[new] = False
            seen = Observations(seen.ids[known], seen.pixels[known], seen.xy[known], seen.ages[known])
        before = path.increments(t_s - dt_s, t_s)
        times.begin_frame(before, path.increments(t_s, t_s + ahead_s), O)
        compensated = times.at_frame_time(seen, calibration)
    expected = projected(path, camera, points, np.zeros(len(points)))
    after = np.linalg.norm(
        PINHOLE.project(np.column_stack([compensated.xy, np.ones(len(compensated))])) - expected[compensated.ids],
        axis=1,
    )
    return after, np.linalg.norm(seen.pixels - expected, axis=1)


O = np.zeros(3)  # noqa: E741
RATE = np.array([0.9, -1.6, 1.2])
ANGULAR_ACCELERATION = np.array([8.0, -12.0, 10.0])
R_IMU_CAM = T_IMU_CAM[:3, :3]
AGGRESSIVE = Path(
    RATE, ANGULAR_ACCELERATION, R_IMU_CAM @ np.array([1.0, 0.6, 1.2]), R_IMU_CAM @ np.array([2.0, -2.0, 1.0])
)


@pytest.mark.parametrize("offset_s", [0.0, 0.005, -0.008])
def test_pure_rotation_is_compensated_exactly(offset_s: float) -> None:
    after, before = errors_px(Path(RATE, ANGULAR_ACCELERATION, O, O), offset_s=offset_s)
    lever_arm_px = 0.15  # the camera is 7 cm from the IMU, which rotates in place
    assert np.median(before) > 3.0
    assert after.max() < lever_arm_px


def test_constant_lateral_motion_is_compensated_exactly() -> None:
    after, before = errors_px(Path(O, O, R_IMU_CAM @ np.array([1.5, -0.8, 0.0]), O), offset_s=0.004)
    assert np.median(before) > 1.0
    assert after.max() < 1e-6


@pytest.mark.parametrize("camera", [ROLLING, GLOBAL], ids=["rolling", "global"])
def test_the_remaining_error_is_of_second_order(camera: RigCamera) -> None:
    """Half of the delays and intervals leave a quarter of the error."""
    path = replace(AGGRESSIVE, imu_s=0.0005)
    half = replace(camera, readout_s=0.5 * camera.readout_s)
    long, _ = errors_px(path, camera, 0.004)
    short, _ = errors_px(path, half, 0.002, dt_s=0.5 * FRAME_S)
    ratio = np.median(long) / np.median(short)
    assert 3.3 < ratio < 4.7


def test_the_error_of_aggressive_flight_is_below_half_a_pixel() -> None:
    after, before = errors_px(AGGRESSIVE)
    assert np.median(before) > 5.0
    assert np.median(after) < 0.1 and after.max() < 0.5


def test_a_synchronized_global_shutter_is_unchanged() -> None:
    times = ExposureCompensation()
    seen = observations(exposed(Path(RATE, O, O, O), GLOBAL, landmarks(), 0.0))
    begin(times, Path(RATE, O, O, O), 0.0)
    assert times.at_frame_time(seen, Calibration(Rig((GLOBAL,)))) is seen


def test_gyro_bias_is_subtracted() -> None:
    path, bias = Path(RATE, ANGULAR_ACCELERATION, O, O), np.array([0.05, -0.1, 0.08])
    before, ahead = (path.increments(*span) for span in ((-FRAME_S, 0.0), (0.0, 0.03)))
    biased = [Increments(i.dt_s, i.gyro_rad_s + bias, i.accel_m_s2) for i in (before, ahead)]
    t_s = np.linspace(-0.05, 0.03, 17)
    expected = log_so3(path.T_world_imu(t_s)[:, :3, :3])
    rotation = LocalRotation.of(biased[0], biased[1], bias)
    np.testing.assert_allclose(rotation.at(t_s), np.asarray(expected), atol=2e-5)


def test_the_rate_is_held_beyond_the_measured_motion() -> None:
    rotation = LocalRotation.of(
        Path(RATE, O, O, O).increments(-FRAME_S, 0.0), Increments(np.zeros(0), *np.zeros((2, 0, 3))), O
    )
    np.testing.assert_allclose(rotation.at(np.array([0.02, -0.07])), np.outer([0.02, -0.07], RATE), atol=1e-9)


def test_without_increments_there_is_no_rotation() -> None:
    nothing = Increments(np.zeros(0), *np.zeros((2, 0, 3)))
    np.testing.assert_array_equal(LocalRotation.of(nothing, nothing, O).at(np.array([-0.01, 0.01])), np.zeros((2, 3)))


def test_new_features_are_omitted_until_they_have_a_velocity() -> None:
    after, before = errors_px(AGGRESSIVE, new=slice(0, 30))
    assert len(after) == len(before) - 30
    assert after.max() < 0.5


def test_velocities_include_uncompensated_observations() -> None:
    """The time offset is corrected between two frames; features observed before it are used at once."""
    path, points, times = AGGRESSIVE, landmarks(), ExposureCompensation()
    given = Calibration(Rig((GLOBAL,)))
    corrected = replace(given, time_offset_correction_s=0.004)
    begin(times, path, -FRAME_S)
    times.at_frame_time(observations(exposed(path, GLOBAL, points, -FRAME_S)), given)
    begin(times, path, 0.0)
    compensated = times.at_frame_time(observations(exposed(path, GLOBAL, points, 0.0, 0.004)), corrected)
    assert len(compensated) == len(points)


@pytest.mark.parametrize("other", [True, False], ids=["in another camera", "in no camera"])
def test_a_flow_is_that_since_the_last_image_of_the_camera(other: bool) -> None:
    """An image is missing before the frame; meanwhile, another camera may see features of its own."""
    path = Path(RATE, ANGULAR_ACCELERATION, R_IMU_CAM @ np.array([1.5, -0.8, 0.0]), O)
    points, times, offset_s = landmarks(), ExposureCompensation(), 0.004
    calibration = Calibration(Rig((GLOBAL, GLOBAL)), time_offset_correction_s=offset_s)
    for t_s, is_seen in ((-2.0 * FRAME_S, True), (-FRAME_S, False), (0.0, True)):
        seen = observations(exposed(path, GLOBAL, points, t_s, offset_s))
        if not is_seen:
            seen = replace(seen, ids=seen.ids - 200, camera=np.ones(len(points), np.int64))
            seen = seen if other else seen.without(seen.ids)
        begin(times, path, t_s)
        compensated = times.at_frame_time(seen, calibration)
    expected = projected(path, GLOBAL, points, np.zeros(len(points)))
    found = PINHOLE.project(np.column_stack([compensated.xy, np.ones(len(points))]))
    assert np.median(np.linalg.norm(seen.pixels - expected, axis=1)) > 3.0
    assert np.linalg.norm(found - expected, axis=1).max() < 0.3


def test_after_a_long_gap_there_is_no_flow() -> None:
    path, points, times = Path(O, O, O, O), landmarks(), ExposureCompensation()
    calibration = Calibration(Rig((GLOBAL,)), time_offset_correction_s=0.004)
    for k in range(13):
        seen = observations(exposed(path, GLOBAL, points, FRAME_S * k, 0.004))
        begin(times, path, FRAME_S * k)
        compensated = times.at_frame_time(seen if k in (0, 12) else seen.without(seen.ids), calibration)
    assert not len(compensated)


def test_angular_velocity_at_the_frame() -> None:
    times = ExposureCompensation()
    begin(times, Path(RATE, ANGULAR_ACCELERATION, O, O), 0.0)
    np.testing.assert_allclose(times.angular_velocity_rad_s, RATE, atol=1e-3)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [((1.0, 2.0), (5.0,), 3.4), ((1.0, 2.0), (), 1.9), ((), (5.0, 6.0), 5.1), ((), (), 0.0)],
)
def test_angular_velocity_is_the_mean_of_five_milliseconds_on_each_side(
    before: tuple[float, ...], after: tuple[float, ...], expected: float
) -> None:
    """Intervals of 4 ms: the nearest counts in full and the next one for 1 ms; the nearest rate is held elsewhere."""
    times, bias = ExposureCompensation(), np.array([0.5, 0.0, -0.5])
    increments = [
        Increments(np.full(len(side), 0.004), np.outer(side, [1.0, 0.0, 2.0]) + bias, np.zeros((len(side), 3)))
        for side in (before, after)
    ]
    times.begin_frame(increments[0], increments[1], bias)
    np.testing.assert_allclose(times.angular_velocity_rad_s, [expected, 0.0, 2.0 * expected], atol=1e-12)


def test_compensation_can_be_repeated_within_a_frame() -> None:
    path, points, times = Path(RATE, ANGULAR_ACCELERATION, O, O), landmarks(), ExposureCompensation()
    calibration = Calibration(Rig((ROLLING,)))
    for t_s in (-FRAME_S, 0.0):
        seen = observations(exposed(path, ROLLING, points, t_s))
        begin(times, path, t_s)
        first, second = (times.at_frame_time(seen, calibration) for _ in range(2))
    np.testing.assert_array_equal(first.xy, second.xy)
    assert np.array_equal(first.ids, second.ids) and len(first) == len(points)


def test_matches_of_other_cameras_are_compensated() -> None:
    """Each match is compensated by the exposure time of its row in its image."""
    second = RigCamera(PINHOLE, EUROC_T_IMU_CAM1, readout_s=0.03)
    path = Path(RATE, ANGULAR_ACCELERATION, R_IMU_CAM @ np.array([0.8, 0.4, 0.2]), O)
    points, times = landmarks(), ExposureCompensation()
    calibration = Calibration(Rig((ROLLING, second)))
    for t_s in (-FRAME_S, 0.0):
        pixels = exposed(path, second, points, t_s)
        matches = Matches(np.arange(len(points)), np.ones(len(points), np.int64), PINHOLE.normalize(pixels))
        begin(times, path, t_s)
        seen = observations(exposed(path, ROLLING, points, t_s), matches=matches, miscalibrated=matches)
        compensated = times.at_frame_time(seen, calibration)
    expected = projected(path, second, points, np.zeros(len(points)))
    found = PINHOLE.project(np.column_stack([compensated.matches.xy, np.ones(len(points))]))
    assert np.median(np.linalg.norm(pixels - expected, axis=1)) > 4.0
    assert np.linalg.norm(found - expected, axis=1).max() < 0.4
    np.testing.assert_array_equal(compensated.miscalibrated.xy, compensated.matches.xy)


@pytest.mark.parametrize("yaw_deg", [25.0, -25.0])
def test_motion_along_the_axis_of_another_camera_is_compensated(yaw_deg: float) -> None:
    """The first camera moves sideways, and the second one, which is turned about the same centre, also along its axis.

    The ray r to a landmark moves at a constant rate in the first camera, so that (R r)_xy / (R r)_z is exact.
    """
    turned = T_IMU_CAM @ pose_matrix(exp_so3(np.radians([0.0, yaw_deg, 0.0])), O)
    second = RigCamera(PINHOLE, turned, readout_s=0.03)
    path, points, times = Path(O, O, R_IMU_CAM @ np.array([2.0, 0.0, 0.0]), O), landmarks(), ExposureCompensation()
    calibration = Calibration(Rig((GLOBAL, second)))
    for t_s in (-FRAME_S, 0.0):
        begin(times, path, t_s)
        pixels = exposed(path, second, points, t_s)
        matches = Matches(np.arange(len(points)), np.ones(len(points), np.int64), PINHOLE.normalize(pixels))
        seen = observations(projected(path, GLOBAL, points, np.full(len(points), t_s)), matches=matches)
        compensated = times.at_frame_time(seen, calibration)
    expected = projected(path, second, points, np.zeros(len(points)))
    found = PINHOLE.project(np.column_stack([compensated.matches.xy, np.ones(len(points))]))
    assert np.median(np.linalg.norm(pixels - expected, axis=1)) > 1.0
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(("offset_s", "delay_s"), [(0.004, 0.0), (0.0, -0.007), (0.004, -0.012)])
def test_cameras_exposed_one_after_another_are_compensated(offset_s: float, delay_s: float) -> None:
    """The second camera has a time offset of its own, and its images other time stamps than their frames."""
    second = RigCamera(PINHOLE, EUROC_T_IMU_CAM1, time_offset_s=offset_s)
    path = Path(RATE, ANGULAR_ACCELERATION, R_IMU_CAM @ np.array([0.8, 0.4, 0.2]), O)
    points, times, later_s = landmarks(), ExposureCompensation(), offset_s + delay_s
    calibration = Calibration(Rig((GLOBAL, second)))
    for t_s in (-FRAME_S, 0.0):
        before, after = path.increments(t_s - FRAME_S, t_s), path.increments(t_s, t_s + 0.03)
        times.begin_frame(before, after, O, np.array([0.0, delay_s]))
        pixels = projected(path, second, points, np.full(len(points), t_s + later_s))
        matches = Matches(np.arange(len(points)), np.ones(len(points), np.int64), PINHOLE.normalize(pixels))
        seen = observations(projected(path, GLOBAL, points, np.full(len(points), t_s)), matches=matches)
        compensated = times.at_frame_time(seen, calibration)
        if t_s < 0.0:  # without a flow, the features of the first camera are exact, and their matches unknown
            assert len(compensated) == len(points) and not len(compensated.matches)
    np.testing.assert_array_equal(compensated.xy, seen.xy)
    expected = projected(path, second, points, np.zeros(len(points)))
    found = PINHOLE.project(np.column_stack([compensated.matches.xy, np.ones(len(points))]))
    assert np.median(np.linalg.norm(pixels - expected, axis=1)) > 2.0
    assert np.linalg.norm(found - expected, axis=1).max() < 0.4
    then = times.at_exposure_of(1, seen, calibration)
    first = projected(path, GLOBAL, points, np.full(len(points), later_s))
    moved = PINHOLE.project(np.column_stack([then, np.ones(len(points))]))
    assert np.linalg.norm(moved - first, axis=1).max() < 0.4
    assert times.at_exposure_of(0, seen, calibration) is seen.xy


def test_new_features_are_moved_by_the_rotation_alone() -> None:
    path, points, times = Path(RATE, ANGULAR_ACCELERATION, O, O), landmarks(), ExposureCompensation()
    calibration = Calibration(Rig((GLOBAL, replace(GLOBAL, time_offset_s=0.01))))
    begin(times, path, 0.0)
    then = times.at_exposure_of(1, observations(projected(path, GLOBAL, points, np.zeros(150))), calibration)
    expected = projected(path, GLOBAL, points, np.full(len(points), 0.01))
    moved = PINHOLE.project(np.column_stack([then, np.ones(len(points))]))
    assert np.linalg.norm(moved - expected, axis=1).max() < 0.3


def test_lookahead_covers_readout_and_time_offset() -> None:
    given = Calibration(Rig((ROLLING, GLOBAL)))
    assert ExposureCompensation.lookahead_s(given) == pytest.approx(0.015)
    corrected = replace(given, time_offset_correction_s=0.004)
    assert ExposureCompensation.lookahead_s(corrected) == pytest.approx(0.019)
    late = Calibration(Rig((GLOBAL, replace(GLOBAL, time_offset_s=0.005))))
    assert ExposureCompensation.lookahead_s(late) == pytest.approx(0.005)
    assert ExposureCompensation.lookahead_s(late, np.array([0.0, 0.007])) == pytest.approx(0.012)
    assert ExposureCompensation.lookahead_s(late, np.array([0.0, -0.03])) == 0.0


def test_corrected_extrinsics_are_used_at_once() -> None:
    """The rotation within the readout acts in the camera frame, so corrected extrinsics apply at the next frame."""
    wrong = replace(ROLLING, T_imu_cam=T_IMU_CAM @ pose_matrix(exp_so3(np.radians([0.0, 0.0, 90.0])), np.zeros(3)))
    path, points, times = Path(RATE, ANGULAR_ACCELERATION, O, O), landmarks(), ExposureCompensation()
    for camera, t_s in ((wrong, -FRAME_S), (ROLLING, 0.0), (ROLLING, FRAME_S)):
        begin(times, path, t_s)
        compensated = times.at_frame_time(
            observations(exposed(path, ROLLING, points, t_s)), Calibration(Rig((camera,)))
        )
    expected = projected(path, ROLLING, points, np.full(len(points), FRAME_S))
    found = PINHOLE.project(np.column_stack([compensated.xy, np.ones(len(compensated))]))
    assert np.linalg.norm(found - expected[compensated.ids], axis=1).max() < 0.3
