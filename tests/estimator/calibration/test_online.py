"""Online calibration: what is hidden in flights made of formulas is found, and nothing where nothing shows it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.calibration.corrections import Corrections
from dronevio.estimator.calibration.online import CalibratedPart, CalibrationConfig, OnlineCalibration
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import PreintegrationConfig, integrate, preintegration_params
from dronevio.estimator.types import Observations
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

NONE = np.zeros(3)
TILT = np.radians([0.6, -0.5, 0.7])
PLACE_M = np.array([0.01, -0.008, 0.006])
ON, OFF = CalibratedPart(True, 0.5, 0.0, 0.0), CalibratedPart(False, 0.02, 0.0, 0.0)
HOVER = {"places_m": np.zeros((3, 2)), "angles_rad": np.zeros((3, 2))}


@dataclass(frozen=True, eq=False)
class Keyframe:
    """What the calibration hears of one keyframe."""

    state: NavState
    rate_rad_s: Array
    preintegrated: gtsam.PreintegratedCombinedMeasurements
    seen: Observations


def changed(rig: Rig, rotation_rad: Array, translation_m: Array, model: Callable[[CameraModel], CameraModel]) -> Rig:
    camera = rig.cameras[0]
    T = camera.T_imu_cam @ pose_matrix(exp_so3(rotation_rad), np.zeros(3))
    T[:3, 3] += translation_m
    return replace(rig, cameras=(replace(camera, T_imu_cam=T, model=model(camera.model)),))


def keyframes(
    flight: object,
    time_offset_s: float = 0.0,
    rotation_rad: Array = NONE,
    translation_m: Array = NONE,
    model: Callable[[CameraModel], CameraModel] = lambda m: m,
    state_error: float = 0.0,
) -> Iterator[Keyframe]:
    """Yield keyframes of a flight whose true rig is not the one that is believed; states are true, or a bit off."""
    believed = flight.rig
    true_rig = replace(changed(believed, rotation_rad, translation_m, model), time_offset_s=time_offset_s)
    front_end, buffer = replace(flight, rig=true_rig).front_end(), ImuBuffer()
    buffer.add(flight.imu)
    params, rng = preintegration_params(believed.imu, PreintegrationConfig()), np.random.default_rng(0)
    for index in range(0, len(flight.frame_times_ns) - 1, 4):
        t_ns = int(flight.frame_times_ns[index])
        truth = flight.truth_at(np.array([t_ns]))
        pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
        integrate(pim, buffer.take_until(t_ns))
        front_end.track(flight.frame(index), np.eye(3))
        seen = front_end.replenish()
        T = truth.Ts_world_imu[0] @ pose_matrix(exp_so3(state_error * rng.normal(size=3)), np.zeros(3))
        velocity = truth.velocity_m_s[0] + 5.0 * state_error * rng.normal(size=3)
        state = NavState(t_ns, T, velocity, truth.gyro_bias_rad_s[0], truth.accel_bias_m_s2[0])
        rate = flight.motion.at(np.array([(t_ns - flight.frame_times_ns[0]) * 1e-9])).omega[0]
        xy = believed.cameras[0].model.normalize(seen.pixels)
        yield Keyframe(state, rate, pim, replace(seen, xy=xy))


def learned(flight: object, config: CalibrationConfig, **hidden: object) -> OnlineCalibration:
    calibration = OnlineCalibration(flight.rig, config)
    for keyframe in keyframes(flight, **hidden):  # type: ignore[arg-type]
        calibration.add(keyframe.state, keyframe.rate_rad_s, keyframe.preintegrated, keyframe.seen)
    return calibration


def of(time_offset: CalibratedPart = OFF, **parts: CalibratedPart) -> CalibrationConfig:
    held = dict.fromkeys(("rotation", "translation", "focal", "principal"), OFF)
    return CalibrationConfig(time_offset=time_offset, **{**held, **parts})


@pytest.fixture(scope="module")
def clean(make_flight: Callable) -> object:
    return make_flight(0, rest_s=-5.0, duration_s=7.0, noisy=False, sampling="increment")


@pytest.mark.parametrize("offset_s", [0.005, -0.003])
def test_finds_the_time_offset(clean: object, offset_s: float) -> None:
    found = learned(clean, of(ON), time_offset_s=offset_s)
    assert found.estimate.time_offset_s == pytest.approx(offset_s, abs=5e-5)
    assert 1e-5 < found.sigmas.time_offset_s < 2e-3


def test_finds_how_the_camera_is_turned(clean: object) -> None:
    found = learned(clean, of(rotation=ON), rotation_rad=TILT)
    np.testing.assert_allclose(found.estimate.rotation_rad[0], TILT, atol=np.radians(0.01))
    np.testing.assert_allclose(
        found.rig.cameras[0].T_imu_cam,
        changed(clean.rig, TILT, np.zeros(3), lambda m: m).cameras[0].T_imu_cam,
        atol=3e-4,
    )


def test_finds_clock_and_turn_together_though_the_states_are_off(clean: object) -> None:
    found = learned(clean, of(ON, rotation=ON), time_offset_s=0.004, rotation_rad=TILT, state_error=0.003)
    assert found.estimate.time_offset_s == pytest.approx(0.004, abs=1e-4)
    np.testing.assert_allclose(found.estimate.rotation_rad[0], TILT, atol=np.radians(0.02))


def test_finds_the_intrinsics(make_flight: Callable) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=7.0, noisy=False, sampling="increment")
    pinhole = replace(flight.rig.cameras[0].model, distortion=(0.0,) * 4)
    flight = replace(flight, rig=changed(flight.rig, np.zeros(3), np.zeros(3), lambda m: pinhole))
    longer = replace(pinhole, fx=1.01 * pinhole.fx, fy=0.99 * pinhole.fy, cx=pinhole.cx + 4.0)
    found = learned(flight, of(focal=ON, principal=ON), model=lambda m: longer)
    np.testing.assert_allclose(found.estimate.focal[0], [0.01, -0.01], atol=1e-3)
    np.testing.assert_allclose(found.estimate.principal[0], [4.0 / pinhole.fx, 0.0], atol=1e-3)
    *_, last = keyframes(flight, model=lambda m: longer)
    corrected = found.corrected(last.seen)
    np.testing.assert_allclose(corrected.xy, longer.normalize(last.seen.pixels), atol=2e-3)


def test_finds_where_the_camera_is(clean: object) -> None:
    found = learned(clean, of(translation=ON), translation_m=PLACE_M)
    np.testing.assert_allclose(found.estimate.translation_m[0], PLACE_M, atol=1e-3)


def test_a_hover_says_nothing_and_leaves_all_as_it_was(make_flight: Callable) -> None:
    """Nothing moves: neither the clock nor the mounting shows, and no one claims to know them better than before."""
    flight = make_flight(0, rest_s=-5.0, duration_s=7.0, motion=HOVER)
    found = learned(flight, CalibrationConfig(), time_offset_s=0.005, rotation_rad=TILT)
    assert found.applied.time_offset_s == 0.0 and not found.applied.rotation_rad.any()
    assert abs(found.estimate.time_offset_s) < 1e-3
    assert found.sigmas.time_offset_s == pytest.approx(CalibrationConfig().time_offset.sigma, rel=0.05)
    assert found.sigmas.rotation_rad.min() > 0.9 * CalibrationConfig().rotation.sigma


def test_a_flight_without_turns_says_nothing_of_the_place(make_flight: Callable) -> None:
    level = {"angles_rad": np.zeros((3, 2))}
    flight = make_flight(0, rest_s=-5.0, duration_s=7.0, noisy=False, sampling="increment", motion=level)
    found = learned(flight, of(translation=ON), translation_m=PLACE_M)
    assert found.sigmas.translation_m.min() > 0.9 * ON.sigma
    assert np.abs(found.estimate.translation_m).max() < 0.1 * ON.sigma


@pytest.mark.parametrize("seed", range(3))
def test_a_right_calibration_is_left_alone(make_flight: Callable, seed: int) -> None:
    flight = make_flight(seed, rest_s=-5.0, duration_s=12.0)
    found = learned(flight, CalibrationConfig())
    assert str(found.applied) == "none"
    off, sigmas = found.estimate, found.sigmas
    assert abs(off.time_offset_s) < 3.0 * sigmas.time_offset_s
    assert np.all(np.abs(off.rotation_rad) < 3.0 * sigmas.rotation_rad)


def test_what_is_wrong_is_corrected_within_seconds(make_flight: Callable) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=9.0)
    calibration = OnlineCalibration(flight.rig)
    corrected = (
        k.state.t_ns
        for k in keyframes(flight, time_offset_s=0.006)
        if calibration.add(k.state, k.rate_rad_s, k.preintegrated, k.seen)
    )
    assert (next(corrected) - flight.frame_times_ns[0]) * 1e-9 < 6.5
    assert calibration.applied.time_offset_s == pytest.approx(0.006, abs=1e-3)
    assert str(calibration.applied).startswith("time offset +")


def test_nothing_is_estimated_that_is_switched_off(clean: object) -> None:
    found = learned(clean, of(), time_offset_s=0.005, rotation_rad=TILT)
    assert str(found.applied) == str(found.estimate) == "none"


def test_corrections_of_several_cameras_keep_their_places() -> None:
    numbers = np.arange(21.0)
    found = Corrections.from_vector(numbers)
    assert found.time_offset_s == 0.0
    np.testing.assert_array_equal(found.rotation_rad, [[1, 2, 3], [11, 12, 13]])
    np.testing.assert_array_equal(found.principal, [[9, 10], [19, 20]])
