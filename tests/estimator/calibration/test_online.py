"""Online calibration on synthetic flights: hidden errors are found where the motion makes them observable."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest

from dronevio.estimator.calibration.adjustment import AdjustmentResult, CalibrationProblem
from dronevio.estimator.calibration.config import CalibratedPart, CalibrationConfig
from dronevio.estimator.calibration.corrections import COMMON_PARAMETERS, PARAMETERS_PER_CAMERA
from dronevio.estimator.calibration.estimate import ParameterEstimate
from dronevio.estimator.calibration.objective import CalibrationObjective
from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.calibration.parameters import ParameterTable
from dronevio.estimator.calibration.significance import SignificanceTest
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

ROTATION_RAD = np.radians([0.6, -0.5, 0.7])
TRANSLATION_M = np.array([0.01, -0.008, 0.006])
ON, OFF = CalibratedPart(True, 0.5, 0.0, 0.0), CalibratedPart(False, 0.02, 0.0, 0.0)
ALL_OFF = CalibrationConfig(OFF, OFF, OFF, OFF, OFF, OFF, OFF, gyro_scale_sigma=0.0)
HOVER = {"positions_m": np.zeros((3, 2)), "angles_rad": np.zeros((3, 2))}
NO_ROTATION = {"angles_rad": np.zeros((3, 2))}


@dataclass(frozen=True, eq=False)
class Errors:
    """Differences of the true rig from the assumed calibration, and errors of the states."""

    time_offset_s: float = 0.0
    """True time offset; the assumed one is zero [s]."""
    rotation_rad: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) True rotation of the camera in its own frame [rad]."""
    translation_m: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) True displacement of the camera in the IMU frame [m]."""
    model: Callable[[CameraModel], CameraModel] = lambda model: model
    """The true camera model from the assumed one."""
    gyro_scale: float = 1.0
    """Scale of the rates that the gyroscope measures."""
    state_sigma: float = 0.0
    """Standard deviation of the orientation of the states [rad], and a fifth of that of the velocity [m/s]."""

    def true_rig(self, rig: Rig) -> Rig:
        """Return the true rig, given the assumed one of one camera."""
        camera = rig.cameras[0]
        T = camera.T_imu_cam @ pose_matrix(exp_so3(self.rotation_rad), np.zeros(3))
        T[:3, 3] += self.translation_m
        cameras = (replace(camera, T_imu_cam=T, model=self.model(camera.model)),)
        return replace(rig, cameras=cameras, time_offset_s=self.time_offset_s)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe as the calibration receives it."""

    state: NavState
    rate_rad_s: Array
    preintegrated: gtsam.PreintegratedCombinedMeasurements
    observations: Observations


def keyframes(
    flight: "SyntheticFlight", errors: Errors, gravity_m_s2: Callable[[], float] = lambda: GRAVITY_M_S2
) -> Iterator[Keyframe]:
    """Yield the keyframes of a flight with its true rig, normalized by the assumed calibration and gravity."""
    front_end, buffer = replace(flight, rig=errors.true_rig(flight.rig)).front_end(), ImuBuffer()
    buffer.add(replace(flight.imu, gyro_rad_s=errors.gyro_scale * flight.imu.gyro_rad_s))
    params, rng = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig()), np.random.default_rng(0)
    for index in range(0, len(flight.frame_times_ns) - 1, 4):
        t_ns = int(flight.frame_times_ns[index])
        truth = flight.truth_at(np.array([t_ns]))
        assert truth.velocity_m_s is not None
        assert truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
        pim = Preintegration(replace(params, gravity_m_s2=gravity_m_s2()), gtsam.imuBias.ConstantBias())
        pim.integrate(buffer.take_until(t_ns))
        front_end.track(flight.frame(index), np.eye(3))
        seen = front_end.replenish()
        T = truth.Ts_world_imu[0] @ pose_matrix(exp_so3(errors.state_sigma * rng.normal(size=3)), np.zeros(3))
        velocity = truth.velocity_m_s[0] + 5.0 * errors.state_sigma * rng.normal(size=3)
        state = NavState(t_ns, T, velocity, truth.gyro_bias_rad_s[0], truth.accel_bias_m_s2[0])
        rate = flight.motion.at(np.array([(t_ns - flight.frame_times_ns[0]) * 1e-9])).omega[0]
        xy = flight.rig.cameras[0].model.normalize(seen.pixels)
        yield Keyframe(state, rate, pim.measurements, replace(seen, xy=xy))


def calibrated(flight: "SyntheticFlight", config: CalibrationConfig, errors: Errors) -> OnlineCalibration:
    """Return the calibration after a flight."""
    calibration = OnlineCalibration(flight.rig, config)
    for k in keyframes(flight, errors, lambda: GRAVITY_M_S2 + calibration.applied.gravity_m_s2):
        calibration.add(k.state, k.rate_rad_s, k.preintegrated, k.observations)
    return calibration


@pytest.fixture(scope="module")
def noiseless(make_flight: MakeFlight) -> "SyntheticFlight":
    return make_flight(0, rest_s=-5.0, duration_s=7.0, noisy=False, sampling="increment")


@pytest.mark.parametrize("offset_s", [0.005, -0.003])
def test_time_offset_is_found(noiseless: "SyntheticFlight", offset_s: float) -> None:
    found = calibrated(noiseless, replace(ALL_OFF, time_offset=ON), Errors(time_offset_s=offset_s))
    assert found.estimate.time_offset_s == pytest.approx(offset_s, abs=5e-5)
    assert 1e-5 < found.sigmas.time_offset_s < 2e-3


def test_rotation_of_the_camera_is_found(noiseless: "SyntheticFlight") -> None:
    errors = Errors(rotation_rad=ROTATION_RAD)
    found = calibrated(noiseless, replace(ALL_OFF, rotation=ON), errors)
    np.testing.assert_allclose(found.estimate.rotation_rad[0], ROTATION_RAD, atol=np.radians(0.01))
    expected = errors.true_rig(noiseless.rig).cameras[0].T_imu_cam
    np.testing.assert_allclose(found.calibration.rig.cameras[0].T_imu_cam, expected, atol=3e-4)


def test_a_calibration_stays_implausible(make_flight: MakeFlight) -> None:
    """A rotation of 6.5° is beyond five standard deviations; without it in the second half, the mean is within them."""
    flight = make_flight(0, rest_s=-5.0, duration_s=13.0, noisy=False, sampling="increment")
    calibration, largest = OnlineCalibration(flight.rig, CalibrationConfig()), 0.0
    turned, right = keyframes(flight, Errors(rotation_rad=np.radians([0.0, 0.0, 6.5]))), keyframes(flight, Errors())
    for wrong, k in zip(turned, right, strict=True):
        is_first = (k.state.t_ns - flight.frame_times_ns[0]) * 1e-9 < 6.0
        calibration.add(k.state, k.rate_rad_s, k.preintegrated, (wrong if is_first else k).observations)
        largest = max(largest, float(np.abs(calibration.applied.rotation_rad).max()))
    limit_rad = CalibrationConfig().max_correction_sigmas * CalibrationConfig().rotation.sigma
    assert np.abs(calibration.applied.rotation_rad).max() < limit_rad < largest
    assert not calibration.is_plausible


def test_time_offset_and_rotation_are_found_together(noiseless: "SyntheticFlight") -> None:
    errors = Errors(time_offset_s=0.004, rotation_rad=ROTATION_RAD, state_sigma=0.003)
    found = calibrated(noiseless, replace(ALL_OFF, time_offset=ON, rotation=ON), errors)
    assert found.estimate.time_offset_s == pytest.approx(0.004, abs=1e-4)
    np.testing.assert_allclose(found.estimate.rotation_rad[0], ROTATION_RAD, atol=np.radians(0.02))


def test_intrinsics_are_found(noiseless: "SyntheticFlight") -> None:
    assumed = replace(noiseless.rig.cameras[0].model, distortion=(0.0,) * 4)
    flight = replace(noiseless, rig=Errors(model=lambda model: assumed).true_rig(noiseless.rig))
    true = replace(assumed, fx=1.01 * assumed.fx, fy=1.01 * assumed.fy, cx=assumed.cx + 4.0)
    errors = Errors(model=lambda model: replace(true, distortion=(0.02, 0.0, 0.0, 0.0)))
    found = calibrated(flight, replace(ALL_OFF, focal=ON, principal=ON, radial=ON), errors)
    np.testing.assert_allclose(found.estimate.focal[0], 0.01, atol=1e-3)
    np.testing.assert_allclose(found.estimate.principal[0], [4.0 / assumed.fx, 0.0], atol=1e-3)
    np.testing.assert_allclose(found.estimate.radial[0], 0.02, atol=2e-3)
    *_, last = keyframes(flight, errors)
    corrected = found.calibration.normalized(last.observations)
    expected = errors.model(assumed).normalize(last.observations.pixels)
    np.testing.assert_allclose(corrected.xy, expected, atol=2e-3)


def test_a_wrong_scale_of_the_gyroscope_is_not_taken_for_a_focal_length(noiseless: "SyntheticFlight") -> None:
    """It is where it is known; with a prior of its own, a part of it is ascribed to it, and the rest is not certain."""
    errors, known = Errors(gyro_scale=1.01), replace(CalibrationConfig(), gyro_scale_sigma=0.0)
    fooled, free = (calibrated(noiseless, config, errors) for config in (known, CalibrationConfig()))
    assert abs(fooled.applied.focal[0, 0]) > 0.005
    assert not free.applied.focal.any()
    assert free.estimate.gyro_scale < 0.0
    assert free.sigmas.focal[0, 0] > fooled.sigmas.focal[0, 0]


def test_the_scale_of_a_gyroscope_is_found(noiseless: "SyntheticFlight") -> None:
    """Where the camera is known."""
    found = calibrated(noiseless, replace(ALL_OFF, time_offset=ON, gyro_scale_sigma=0.05), Errors(gyro_scale=1.02))
    assert found.estimate.gyro_scale == pytest.approx(1.0 / 1.02 - 1.0, abs=2e-3)
    assert found.applied.gyro_scale == 0.0


def test_translation_of_the_camera_is_found(noiseless: "SyntheticFlight") -> None:
    found = calibrated(noiseless, replace(ALL_OFF, translation=ON), Errors(translation_m=TRANSLATION_M))
    np.testing.assert_allclose(found.estimate.translation_m[0], TRANSLATION_M, atol=1e-3)


@pytest.mark.parametrize(("gravity_m_s2", "duration_s"), [(9.78, 7.0), (9.832, 19.0)])
def test_gravity_is_found(make_flight: MakeFlight, gravity_m_s2: float, duration_s: float) -> None:
    """By one window, and kept by two further ones, whose measurements contain the correction."""
    flight = make_flight(
        0, rest_s=-5.0, duration_s=duration_s, noisy=False, sampling="increment", gravity_m_s2=gravity_m_s2
    )
    found = calibrated(flight, replace(ALL_OFF, gravity=replace(ON, significance=0.0)), Errors(state_sigma=0.003))
    assert found.estimate.gravity_m_s2 == pytest.approx(gravity_m_s2 - GRAVITY_M_S2, abs=2e-3)
    assert found.calibration.gravity_correction_m_s2 == found.applied.gravity_m_s2 == found.estimate.gravity_m_s2
    assert np.sqrt(found.covariance_inflation[[0, 3, 6, 12], [0, 3, 6, 12]]) == pytest.approx([1e-3, 2e-3, 0.01, 0.03])


@pytest.mark.parametrize("gravity_m_s2", [9.78, 9.832])
def test_later_windows_know_the_gravity_in_use(make_flight: MakeFlight, gravity_m_s2: float) -> None:
    """A second window whose measurements contain the correction confirms it, and does not find a part of it anew."""
    flight = make_flight(0, rest_s=-5.0, duration_s=13.0, noisy=False, sampling="increment", gravity_m_s2=gravity_m_s2)
    found = calibrated(flight, replace(ALL_OFF, gravity=replace(ON, significance=0.0)), Errors(state_sigma=0.003))
    assert found.estimate.gravity_m_s2 == pytest.approx(gravity_m_s2 - GRAVITY_M_S2, abs=4e-4)
    assert found.sigmas.gravity_m_s2 < 0.04  # by two windows


def test_the_adjustment_ends_with_a_short_step(noiseless: "SyntheticFlight", monkeypatch: pytest.MonkeyPatch) -> None:
    """Without errors, the first step is shorter than a standard deviation; a wrong time offset needs two."""
    ends, step = list[bool](), CalibrationProblem.step

    def counted(problem: CalibrationProblem) -> None:
        step(problem)
        ends.append(problem.is_done)

    monkeypatch.setattr(CalibrationProblem, "step", counted)
    calibrated(noiseless, CalibrationConfig(), Errors())
    assert ends == [True]
    ends.clear()
    calibrated(noiseless, CalibrationConfig(), Errors(time_offset_s=0.005))
    assert ends == [False, True]


def window_of(flight: "SyntheticFlight") -> list[WindowKeyframe]:
    """Return the keyframes of a flight without errors, with observations of the first camera."""
    return [
        WindowKeyframe(
            k.state,
            k.rate_rad_s,
            0.0,
            GRAVITY_M_S2,
            k.preintegrated,
            k.observations.ids,
            np.zeros(len(k.observations), np.int64),
            k.observations.xy,
        )
        for k in keyframes(flight, Errors())
    ]


def test_agreement_is_that_of_the_camera_where_it_is_smallest(make_flight: MakeFlight) -> None:
    """The first of two cameras observes all landmarks where they are, the second one a third of them."""
    flight = make_flight(0, rest_s=-5.0, duration_s=3.0)
    rig = replace(flight.rig, cameras=flight.rig.cameras * 2)
    estimated, information = np.zeros(23, np.bool_), 1e14 * np.eye(23)
    agreements = []
    for wrong_px in (0.0, 40.0):
        window = []
        for k in window_of(flight):
            displaced = np.where(k.ids % 3 == 0, 0.0, wrong_px / 458.0)[:, None] * [0.0, 1.0]
            two = np.concatenate([k.camera, k.camera + 1]), np.concatenate([k.xy, k.xy + displaced])
            window.append(replace(k, ids=np.tile(k.ids, 2), camera=two[0], xy=two[1]))
        config = AdjustmentConfig(max_reprojection_px=100.0)
        objective = CalibrationObjective.of(
            window, Calibration(rig), config, np.zeros(23), information, estimated, GRAVITY_M_S2
        )
        agreements.append(objective.linearize(objective.initial).agreement)
    assert agreements[0] > 0.8
    assert agreements[1] == pytest.approx(0.33, abs=0.08)


def test_the_state_given_corrections_is_that_of_their_problem(make_flight: MakeFlight) -> None:
    """Its conditional expectation given a rotation of 0.1° is the result of an adjustment with that rotation known."""
    flight = make_flight(0, rest_s=-5.0, duration_s=3.0)
    window = window_of(flight)
    config = AdjustmentConfig(iterations=20, max_decrement=1e-10)
    calibration = Calibration(flight.rig)
    estimated, prior = np.isin(np.arange(13), [0, 3, 4, 5]), np.diag(np.repeat([1e4, 2.5e3], [3, 10]))

    def adjusted(mean: Array, information: Array) -> AdjustmentResult:
        objective = CalibrationObjective.of(
            window, calibration, config, mean, information, estimated, GRAVITY_M_S2, initial=np.zeros(13)
        )
        problem = CalibrationProblem(objective, config, window[-1].state.t_ns)
        while not problem.is_done:
            problem.step()
        assert problem.result is not None
        return problem.result

    free = adjusted(np.zeros(13), prior)
    other = free.mean.copy()
    other[3:6] += np.radians([0.0, 0.1, 0.0])
    known = adjusted(other, prior + 1e14 * np.diag(estimated.astype(float)))
    np.testing.assert_allclose(known.mean, other, atol=1e-7)
    given, before, after = free.newest_given(other), free.newest, known.newest
    for value in ("velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2"):
        moved = np.linalg.norm(getattr(after, value) - getattr(before, value))
        assert np.linalg.norm(getattr(given, value) - getattr(after, value)) < 0.1 * moved
    moved_m = np.linalg.norm(after.T_world_imu[:3, 3] - before.T_world_imu[:3, 3])
    assert np.linalg.norm(given.T_world_imu[:3, 3] - after.T_world_imu[:3, 3]) < 0.1 * moved_m > 1e-5
    R_before, R_given, R_after = (state.T_world_imu[:3, :3] for state in (before, given, after))
    turned = np.linalg.norm(log_so3(R_before.T @ R_after))
    assert np.linalg.norm(log_so3(R_given.T @ R_after)) < 0.1 * turned


def test_a_hover_changes_neither_estimate_nor_covariance(make_flight: MakeFlight) -> None:
    """Without motion, neither time offset nor rotation is observable."""
    flight = make_flight(0, rest_s=-5.0, duration_s=7.0, motion=HOVER)
    found = calibrated(flight, CalibrationConfig(), Errors(time_offset_s=0.005, rotation_rad=ROTATION_RAD))
    assert found.applied.time_offset_s == 0.0 and not found.applied.rotation_rad.any()
    assert abs(found.estimate.time_offset_s) < 1e-3
    assert found.sigmas.time_offset_s == pytest.approx(CalibrationConfig().time_offset.sigma, rel=0.05)
    assert found.sigmas.rotation_rad.min() > 0.9 * CalibrationConfig().rotation.sigma
    assert found.sigmas.gravity_m_s2 > 0.9 * CalibrationConfig().gravity.sigma


def test_translation_is_unobservable_without_rotation(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=7.0, noisy=False, sampling="increment", motion=NO_ROTATION)
    found = calibrated(flight, replace(ALL_OFF, translation=ON), Errors(translation_m=TRANSLATION_M))
    assert found.sigmas.translation_m.min() > 0.9 * ON.sigma
    assert np.abs(found.estimate.translation_m).max() < 0.1 * ON.sigma


@pytest.mark.parametrize("seed", range(3))
def test_a_correct_calibration_is_not_changed(make_flight: MakeFlight, seed: int) -> None:
    found = calibrated(make_flight(seed, rest_s=-5.0, duration_s=12.0), CalibrationConfig(), Errors())
    assert str(found.applied) == "none"
    estimate, sigmas = found.estimate, found.sigmas
    assert abs(estimate.time_offset_s) < 3.0 * sigmas.time_offset_s
    assert abs(estimate.gravity_m_s2) < 1.5 * sigmas.gravity_m_s2
    assert np.all(np.abs(estimate.rotation_rad) < 3.0 * sigmas.rotation_rad)


def test_a_wrong_time_offset_is_corrected_in_6_5_s(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=9.0)
    calibration = OnlineCalibration(flight.rig)
    corrected_ns = [
        k.state.t_ns
        for k in keyframes(flight, Errors(time_offset_s=0.006))
        if calibration.add(k.state, k.rate_rad_s, k.preintegrated, k.observations)
    ]
    assert (corrected_ns[0] - flight.frame_times_ns[0]) * 1e-9 < 6.5
    assert calibration.applied.time_offset_s == pytest.approx(0.006, abs=1e-3)
    assert str(calibration.applied).startswith("time offset +")


def test_few_common_landmarks_discard_the_window_under_way(make_flight: MakeFlight) -> None:
    """Where features are all new after 5.4 s, no window or adjustment goes on from before; the next one corrects."""
    flight = make_flight(1, rest_s=-5.0, duration_s=13.0)
    calibration, corrected_s = OnlineCalibration(flight.rig), []
    for k in keyframes(flight, Errors(time_offset_s=0.006)):
        t_s, seen = (k.state.t_ns - flight.frame_times_ns[0]) * 1e-9, k.observations
        seen = replace(seen, ids=seen.ids + (10_000 if t_s > 5.3 else 0))
        if calibration.add(k.state, k.rate_rad_s, k.preintegrated, seen):
            corrected_s.append(t_s)
    assert corrected_s and corrected_s[0] > 10.0
    assert calibration.applied.time_offset_s == pytest.approx(0.006, abs=1e-3)


def test_parts_that_are_off_are_not_estimated(noiseless: "SyntheticFlight") -> None:
    found = calibrated(noiseless, ALL_OFF, Errors(time_offset_s=0.005, rotation_rad=ROTATION_RAD))
    assert str(found.applied) == str(found.estimate) == "none"


def turned_alike(cameras: int, rotation_rad: float) -> Array:
    """Return corrections by which all cameras are rotated about their x axes, as by a rotation of the IMU."""
    corrections = np.zeros(COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * cameras)
    corrections[COMMON_PARAMETERS::PARAMETERS_PER_CAMERA] = rotation_rad
    return corrections


@pytest.mark.parametrize(("share", "applied"), [(0.95, False), (1.05, True)])
@pytest.mark.parametrize("cameras", [1, 2])
def test_the_smallest_rotation_is_that_of_each_camera(cameras: int, share: float, applied: bool) -> None:
    """A rotation of the IMU in its housing turns all cameras alike."""
    config = CalibrationConfig()
    parameters = ParameterTable.of(config, cameras)
    from_rest = SignificanceTest.of_window(config, cameras, begins_stationary=True, is_complete=True)
    mean = turned_alike(cameras, share * config.rotation.min_correction)
    corrected = ParameterEstimate.prior(parameters).corrected(
        mean, 1e-12 * np.eye(len(mean)), parameters, from_rest, is_complete=True
    )
    assert (corrected is not None) == applied


@pytest.mark.parametrize("cameras", [1, 2])
def test_first_rotation_by_windows_in_motion_is_larger(cameras: int) -> None:
    """Later corrections of rotations that are known to be wrong are as small as by windows from rest."""
    config = CalibrationConfig()
    parameters = ParameterTable.of(config, cameras)
    in_motion = SignificanceTest.of_window(config, cameras, begins_stationary=False, is_complete=True)
    certain = 1e-12 * np.eye(len(parameters.sigmas))

    def corrected(estimate: ParameterEstimate, rotation_rad: float) -> ParameterEstimate | None:
        return estimate.corrected(turned_alike(cameras, rotation_rad), certain, parameters, in_motion, is_complete=True)

    first = config.min_motion_correction
    assert corrected(ParameterEstimate.prior(parameters), 0.95 * first) is None
    wrong = corrected(ParameterEstimate.prior(parameters), 1.05 * first)
    assert wrong is not None
    smallest = config.rotation.refinement * config.rotation.min_correction
    assert corrected(wrong, 1.05 * first + 0.95 * smallest) is None
    assert corrected(wrong, 1.05 * first + 1.05 * smallest) is not None
