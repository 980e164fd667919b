"""Corrections before and soon after the take-off: the rotation between cameras, and the state after a correction."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
import pytest

from dronevio.estimator.calibration import significance
from dronevio.estimator.calibration.adjustment import AdjustmentResult, CalibrationProblem
from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.corrected_state import propagated_state
from dronevio.estimator.calibration.corrections import GYRO_SCALE, Corrections
from dronevio.estimator.calibration.estimate import ParameterEstimate
from dronevio.estimator.calibration.online import CalibrationPrior, OnlineCalibration
from dronevio.estimator.calibration.parameters import ParameterTable
from dronevio.estimator.calibration.significance import SignificanceTest
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.calibration.window_collector import CalibrationWindow
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.optimization.gauss_newton import Step, gauss_newton_step
from dronevio.estimator.optimization.linalg import CholeskyFactor
from dronevio.estimator.types import NO_MATCHES, Calibration, Matches, Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, pose_matrix
from dronevio.models.state import NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

REST_S = 1.0
SIGMAS = np.repeat([0.01, 1e-4, 0.005, 1e-3, 0.05], 3)
"""Standard deviations of the states at rest: orientation, position, velocity, biases."""


def at_rest() -> NavState:
    return NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.diag(SIGMAS**2))


def turned(rig: Rig, rotations_rad: Array) -> Rig:
    """Return a rig whose cameras are rotated in their own frames by rotation vectors (C, 3) [rad]."""
    cameras = (
        replace(camera, T_imu_cam=camera.T_imu_cam @ pose_matrix(exp_so3(rotation), np.zeros(3)))
        for camera, rotation in zip(rig.cameras, rotations_rad, strict=True)
    )
    return replace(rig, cameras=tuple(cameras))


def stereo_view(rig: Rig, noise_px: float = 0.2) -> Observations:
    """Return the observations of 120 landmarks, 2 to 8 m away, by the two cameras of a rig at rest."""
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(2.0, 8.0, 120)[:, None]
    in_first = depth_m * np.column_stack([rng.uniform(-0.6, 0.6, 120), rng.uniform(-0.4, 0.4, 120), np.ones(120)])
    T = inverse_pose(rig.cameras[1].T_imu_cam) @ rig.cameras[0].T_imu_cam
    in_second = in_first @ T[:3, :3].T + T[:3, 3]
    noise = noise_px / rig.cameras[0].model.fx * rng.normal(size=(2, 120, 2))
    first, second = (p[:, :2] / p[:, 2:] + n for p, n in zip((in_first, in_second), noise, strict=True))
    ids = np.arange(120)
    matches = Matches(ids, np.ones(120, np.int64), second)
    return Observations(ids, np.zeros((120, 2)), first, np.ones(120, np.int64), matches=matches)


def compared(tilts_rad: Array, stationary: bool = True) -> tuple[OnlineCalibration, bool]:
    """Return a calibration after one keyframe of cameras that are tilted by (2, 3) [rad], and whether it changed."""
    rig = rig_named("euroc-stereo")
    calibration = OnlineCalibration(rig)
    pim = Preintegration(PreintegrationParams.of(rig.imu, PreintegrationConfig()), gtsam.imuBias.ConstantBias())
    observations = stereo_view(turned(rig, tilts_rad))
    return calibration, calibration.add(at_rest(), np.zeros(3), pim.measurements, observations, stationary)


@pytest.mark.parametrize("angle_deg", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("stationary", [True, False])
def test_rotation_between_cameras_is_found_at_once(angle_deg: float, stationary: bool) -> None:
    tilts = np.radians(angle_deg) * np.array([[0.6, 0.0, 0.8], [-0.8, 0.6, 0.0]])
    calibration, changed = compared(tilts, stationary)
    assert changed
    rig, true = calibration.calibration.rig, turned(rig_named("euroc-stereo"), tilts)
    found, expected = (inverse_pose(r.cameras[0].T_imu_cam) @ r.cameras[1].T_imu_cam for r in (rig, true))
    assert np.degrees(np.linalg.norm(log_so3(found[:3, :3].T @ expected[:3, :3]))) < 0.1
    state = calibration.corrected_state
    assert (state is not None) == stationary
    if state is not None:  # a state at rest does not depend on the calibration
        np.testing.assert_array_equal(state.T_world_imu, np.eye(4))


@pytest.mark.parametrize("angle_deg", [0.0, 0.03, 15.0])
def test_small_and_implausible_rotations_are_not_applied(angle_deg: float) -> None:
    calibration, changed = compared(np.radians(angle_deg) * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert not changed
    assert str(calibration.applied) == "none"


def test_a_rotation_common_to_both_cameras_is_not_seen_at_rest() -> None:
    rig = rig_named("euroc-stereo")
    first, second = (camera.T_imu_cam[:3, :3] for camera in rig.cameras)
    tilt = np.radians([1.0, 0.0, 0.0])
    calibration, changed = compared(np.stack([tilt, second.T @ first @ tilt]))
    assert not changed
    assert not calibration.applied.rotation_rad.any()


def other_baseline(
    position_sigma_m: float = 0.0, max_decrement: float = 0.01
) -> tuple[CalibrationProblem, ParameterTable]:
    """Return the adjustment of a keyframe whose second camera is 0.6 mm behind its given position.

    Args:
        position_sigma_m: Standard deviation of the positions of the cameras [m].
        max_decrement: Decrement per unknown below which a step is the last one.
    """
    rig, config = rig_named("euroc-stereo"), CalibrationConfig(position_sigma_m=position_sigma_m)
    off = {name: replace(getattr(config, name), online=False) for name in ("focal", "principal", "radial")}
    config = replace(config, **off)  # wrong intrinsics look like a rotation, too
    T = rig.cameras[1].T_imu_cam @ pose_matrix(np.eye(3), np.array([0.0, 0.0, 0.0006]))
    seen = stereo_view(replace(rig, cameras=(rig.cameras[0], replace(rig.cameras[1], T_imu_cam=T))), noise_px=0.02)
    parts = (seen, seen.matches)
    ids, camera, xy = (np.concatenate([getattr(p, name) for p in parts]) for name in ("ids", "camera", "xy"))
    keyframe = WindowKeyframe(at_rest(), np.zeros(3), 0.0, GRAVITY_M_S2, None, ids, camera, xy)
    precise = replace(config.adjustment, min_views=2, min_parallax_deg=0.1, pixel_sigma=0.025, iterations=10)
    precise = replace(precise, max_decrement=max_decrement)
    parameters = ParameterTable.of(config, 2)
    given = CalibrationPrior(Calibration(rig), GRAVITY_M_S2, parameters, config)
    window = CalibrationWindow((keyframe,), begins_stationary=False, is_complete=False)
    return given.problem(window, ParameterEstimate.prior(parameters), precise), parameters


@pytest.mark.parametrize(("relative", "is_done"), [(0.99, False), (1.01, True)])
def test_an_adjustment_ends_by_the_decrement_per_unknown(
    monkeypatch: pytest.MonkeyPatch, relative: float, is_done: bool
) -> None:
    taken: list[Step[Any, CholeskyFactor]] = []

    def recorded(*inputs: Any) -> Step[Any, CholeskyFactor]:
        taken.append(gauss_newton_step(*inputs))
        return taken[-1]

    monkeypatch.setattr("dronevio.estimator.calibration.adjustment.gauss_newton_step", recorded)
    other_baseline()[0].step()
    problem, _ = other_baseline(max_decrement=relative * taken[0].decrement / len(taken[0].delta))
    problem.step()
    assert problem.is_done == is_done == (problem.result is not None)


@pytest.mark.parametrize(("position_sigma_m", "is_significant"), [(0.0, True), (0.0005, False)])
def test_another_baseline_is_no_rotation_of_both_cameras(position_sigma_m: float, is_significant: bool) -> None:
    """One camera is 0.6 mm behind its given position, so that the baseline has another direction."""
    problem, parameters = other_baseline(position_sigma_m)
    while not problem.is_done:
        problem.step()
    assert problem.result is not None and problem.landmark_count == 120
    rotations = next(group.rows for group in parameters.groups if group.is_rotation)
    covariance = np.linalg.inv(problem.result.information)[np.ix_(rotations, rotations)]
    variances, axes = np.linalg.eigh(covariance)
    sigmas = np.abs(axes.T @ problem.result.mean[rotations]) / np.sqrt(variances)
    assert sigmas.max() > 4.0 if is_significant else sigmas.max() < 2.0


def test_positions_of_the_cameras_are_not_corrected() -> None:
    """They are unknowns only, also where an estimate is far from the given position."""
    parameters = ParameterTable.of(CalibrationConfig(position_sigma_m=0.1), 2)
    corrected = np.concatenate([group.rows for group in parameters.groups])
    positions = np.setdiff1d(np.flatnonzero(parameters.is_unknown), corrected)
    mean = np.zeros(len(parameters.sigmas))
    mean[positions] = 0.05
    assert len(positions) == 7  # and the scale of the gyroscope
    certain, test = 1e-8 * np.eye(len(mean)), SignificanceTest(0.0, 0.0)
    assert ParameterEstimate.prior(parameters).corrected(mean, certain, parameters, test, is_complete=True) is None
    equal = CalibrationConfig(focal=CalibrationConfig().principal)  # settings of one part that another has, too
    np.testing.assert_array_equal(ParameterTable.of(equal, 2).is_unknown, parameters.is_unknown)
    online = CalibrationConfig(translation=replace(CalibrationConfig().translation, online=True))
    of_positions = Corrections.from_vector(ParameterTable.of(online, 2).sigmas).translation_m
    np.testing.assert_array_equal(of_positions, online.translation.sigma)
    one_camera = ParameterTable.of(CalibrationConfig(), 1)
    corrected = np.concatenate([group.rows for group in one_camera.groups])
    np.testing.assert_array_equal(np.flatnonzero(one_camera.is_unknown), np.union1d(corrected, GYRO_SCALE))


def test_one_camera_has_no_other_to_compare_with(make_flight: MakeFlight) -> None:
    flight = make_flight(0)
    pim = Preintegration(PreintegrationParams.of(flight.rig.imu, PreintegrationConfig()), gtsam.imuBias.ConstantBias())
    calibration = OnlineCalibration(flight.rig)
    observations = replace(stereo_view(rig_named("euroc-stereo")), matches=NO_MATCHES)
    assert not calibration.add(at_rest(), np.zeros(3), pim.measurements, observations, True)


def corrected_flight(
    flight: "SyntheticFlight", true: Rig, drift_m: float, config: CalibrationConfig | None = None
) -> tuple[float, OnlineCalibration, NavState | None]:
    """Return when after the start of the motion a flight is first corrected, by what, and the true state then.

    Without a correction, return the length of the motion, the calibration and None.

    The states of the keyframes are true at rest. In motion, their positions are wrong by ``drift_m`` along x, and their
    velocities by half of that per second.
    """
    front_end, buffer = replace(flight, rig=true).front_end(), ImuBuffer()
    buffer.add(flight.imu)
    params = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
    calibration = OnlineCalibration(flight.rig, config)
    wrong = drift_m * np.array([1.0, 0.0, 0.0])
    for index in range(0, len(flight.frame_times_ns) - 1, 4):
        t_ns = int(flight.frame_times_ns[index])
        truth = flight.truth_at(np.array([t_ns]))
        assert truth.velocity_m_s is not None
        assert truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
        pim = Preintegration(params, gtsam.imuBias.ConstantBias())
        pim.integrate(buffer.take_until(t_ns))
        front_end.track(flight.frame(index), np.eye(3))
        seen = front_end.replenish()
        xy = flight.rig.cameras[0].model.normalize(seen.pixels)
        t_s = (t_ns - flight.frame_times_ns[0]) * 1e-9
        stationary = t_s <= flight.motion.rest_s
        T, v = truth.Ts_world_imu[0].copy(), truth.velocity_m_s[0]
        biases = truth.gyro_bias_rad_s[0], truth.accel_bias_m_s2[0]
        correct = NavState(t_ns, T.copy(), v, *biases)
        T[:3, 3] += (not stationary) * wrong
        state = NavState(t_ns, T, v + 0.5 * (not stationary) * wrong, *biases, np.diag(SIGMAS**2))
        rate = flight.motion.at(np.array([t_s])).omega[0]
        if calibration.add(state, rate, pim.measurements, replace(seen, xy=xy), stationary):
            return t_s - REST_S, calibration, correct
    return t_s - REST_S, calibration, None


@pytest.mark.parametrize(("tilt_deg", "offset_s"), [(2.0, 0.0), (0.0, 0.008)])
def test_a_correction_comes_early_and_mends_the_state(
    make_flight: MakeFlight, tilt_deg: float, offset_s: float
) -> None:
    flight = make_flight(0, rest_s=REST_S, duration_s=8.0)
    true = turned(flight.rig, np.radians(tilt_deg) * np.array([[0.6, 0.0, 0.8]]))
    after_s, calibration, correct = corrected_flight(flight, replace(true, time_offset_s=offset_s), drift_m=0.2)
    assert after_s < 4.0 and correct is not None
    state = calibration.corrected_state
    assert state is not None and state.covariance is not None
    assert state.t_ns == correct.t_ns
    assert np.linalg.norm(state.T_world_imu[:3, 3] - correct.T_world_imu[:3, 3]) < 0.04
    assert np.linalg.norm(state.velocity_m_s - correct.velocity_m_s) < 0.04
    sigmas = np.sqrt(np.diag(state.covariance))
    assert np.all(np.abs(state.T_world_imu[:3, 3] - correct.T_world_imu[:3, 3]) < 4.0 * sigmas[3:6])


def test_the_corrected_state_is_that_for_the_applied_corrections(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rotation, whose estimate is not significant, is not applied, and the state is the one without it."""
    given, newest_given = list[Corrections](), AdjustmentResult.newest_given

    def recorded(found: AdjustmentResult, corrections: Array) -> NavState:
        assert found.mean[3:6].any()
        given.append(Corrections.from_vector(corrections))
        return newest_given(found, corrections)

    monkeypatch.setattr(AdjustmentResult, "newest_given", recorded)
    flight = make_flight(0, rest_s=REST_S, duration_s=8.0)
    _, calibration, _ = corrected_flight(flight, replace(flight.rig, time_offset_s=0.008), drift_m=0.2)
    assert len(given) == 1
    assert given[0].time_offset_s == calibration.applied.time_offset_s != 0.0
    assert not given[0].rotation_rad.any()


@pytest.mark.parametrize(("tilt_deg", "offset_s"), [(0.45, 0.0), (0.0, 0.0022)])
def test_a_small_correction_determines_no_state(make_flight: MakeFlight, tilt_deg: float, offset_s: float) -> None:
    """The window of the odometry is better then than the newest state of the adjustment."""
    flight = make_flight(0, rest_s=REST_S, duration_s=8.0)
    true = turned(flight.rig, np.radians(tilt_deg) * np.array([[0.6, 0.0, 0.8]]))
    _, calibration, corrected = corrected_flight(flight, replace(true, time_offset_s=offset_s), drift_m=0.0)
    assert corrected is not None and str(calibration.applied) != "none"
    assert calibration.corrected_state is None


@pytest.mark.parametrize(("sigmas", "is_early"), [(significance.STATIONARY_SIGMAS, True), (1e3, False)])
def test_windows_that_begin_at_rest_need_more_significance(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch, sigmas: float, is_early: bool
) -> None:
    """The next window, in motion, needs the significance of the settings only."""
    monkeypatch.setattr(significance, "STATIONARY_SIGMAS", sigmas)
    flight = make_flight(0, rest_s=REST_S, duration_s=14.0)
    true = turned(flight.rig, np.radians(2.0) * np.array([[0.6, 0.0, 0.8]]))
    after_s, _, corrected = corrected_flight(flight, true, drift_m=0.0)
    assert corrected is not None
    window_s = CalibrationConfig().window_s
    assert after_s < window_s if is_early else window_s < after_s < 2.5 * window_s


@pytest.mark.parametrize("window_s", [2.8, 3.0, 3.2])
def test_a_corrected_state_is_that_of_the_newest_keyframe(make_flight: MakeFlight, window_s: float) -> None:
    """Also where a window is complete at the keyframe at which the adjustment of its beginning ends."""
    flight = make_flight(0, rest_s=REST_S, duration_s=6.0)
    true = turned(flight.rig, np.radians(2.0) * np.array([[0.6, 0.0, 0.8]]))
    config = CalibrationConfig(window_s=window_s, first_window_s=0.8)
    _, calibration, correct = corrected_flight(flight, true, 0.0, config)
    state = calibration.corrected_state
    assert state is not None and correct is not None
    assert state.t_ns == correct.t_ns
    assert np.linalg.norm(state.T_world_imu[:3, 3] - correct.T_world_imu[:3, 3]) < 0.04


def test_a_window_that_begins_at_rest_leaves_gravity(make_flight: MakeFlight) -> None:
    """At rest, wrong gravity and a wrong bias of the accelerometer are the same; here the calibration is right."""
    flight = make_flight(0, rest_s=REST_S, duration_s=8.0)
    _, calibration, corrected = corrected_flight(flight, flight.rig, drift_m=0.0)
    assert corrected is None and str(calibration.applied) == "none"
    assert calibration.sigmas.time_offset_s < 1e-3  # the window is complete
    assert calibration.estimate.gravity_m_s2 == 0.0
    assert calibration.sigmas.gravity_m_s2 == pytest.approx(0.03)


@pytest.mark.parametrize("begins_stationary", [True, False])
def test_images_have_more_weight_in_a_window_from_rest(make_flight: MakeFlight, begins_stationary: bool) -> None:
    """The setting for windows that begin at rest determines the uncertainty after such a window, and after no other."""

    def sigma_s(stationary_pixel_sigma: float) -> float:
        adjustment = AdjustmentConfig(stationary_pixel_sigma=stationary_pixel_sigma)
        config = CalibrationConfig(window_s=2.0, adjustment=adjustment)
        flight = make_flight(0, rest_s=REST_S if begins_stationary else -5.0, duration_s=REST_S + 3.6)
        _, calibration, corrected = corrected_flight(flight, flight.rig, 0.0, config)
        assert corrected is None and calibration.sigmas.time_offset_s < 0.01  # a window is complete
        return calibration.sigmas.time_offset_s

    assert (sigma_s(0.2) < 0.9 * sigma_s(0.8)) == begins_stationary
    assert begins_stationary or sigma_s(0.2) == sigma_s(0.8)


def test_propagation_follows_the_motion(make_flight: MakeFlight) -> None:
    """Over three keyframes without noise; the covariance grows, and contains that of the position before."""
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment")
    buffer, params = ImuBuffer(), PreintegrationParams.of(flight.rig.imu, PreintegrationConfig(), GRAVITY_M_S2)
    buffer.add(flight.imu)
    times_ns = flight.frame_times_ns[[4, 8, 12, 16]]
    truth = flight.truth_at(times_ns)
    assert truth.velocity_m_s is not None
    buffer.take_until(int(times_ns[0]))
    later = []
    for i in range(1, 4):
        pim = Preintegration(params, gtsam.imuBias.ConstantBias())
        pim.integrate(buffer.take_until(int(times_ns[i])))
        state = NavState(int(times_ns[i]), np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
        nothing = np.zeros(0, np.int64)
        later.append(
            WindowKeyframe(state, np.zeros(3), 0.0, GRAVITY_M_S2, pim.measurements, nothing, nothing, np.zeros((0, 2)))
        )
    P = np.diag(SIGMAS**2)
    start = NavState(int(times_ns[0]), truth.Ts_world_imu[0], truth.velocity_m_s[0], np.zeros(3), np.zeros(3), P)
    end = propagated_state(start, later, 0.04 * np.eye(3), flight.rig.imu)
    assert end.t_ns == times_ns[3] and end.covariance is not None
    np.testing.assert_allclose(end.T_world_imu, truth.Ts_world_imu[3], atol=2e-3)
    np.testing.assert_allclose(end.velocity_m_s, truth.velocity_m_s[3], atol=5e-3)
    assert np.all(np.diag(end.covariance)[3:6] > 0.04)
    np.testing.assert_allclose(P, np.diag(SIGMAS**2))
