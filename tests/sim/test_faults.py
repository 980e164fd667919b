"""Sensor and motor faults: their effect, and the ground truth about them."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import log_so3
from dronevio.sim.faults import Faults
from dronevio.sim.flight import fly
from dronevio.sim.scenarios import scenario_named


def test_without_faults_the_rig_is_the_calibrated_one() -> None:
    rig = rig_named("euroc-stereo")
    true = Faults().true_rig(rig, np.random.default_rng(0))
    assert true.imu == rig.imu and true.time_offset_s == rig.time_offset_s
    for camera, calibrated in zip(true.cameras, rig.cameras, strict=True):
        assert np.array_equal(camera.T_imu_cam, calibrated.T_imu_cam)


def test_hidden_tilt_changes_only_the_orientation() -> None:
    rig = rig_named("euroc-stereo")
    true = Faults(hidden_tilt_rad=0.017).true_rig(rig, np.random.default_rng(0))
    for camera, calibrated in zip(true.cameras, rig.cameras, strict=True):
        rotation = log_so3((calibrated.T_imu_cam[:3, :3].T @ camera.T_imu_cam[:3, :3])[None])[0]
        assert np.linalg.norm(rotation) == pytest.approx(0.017)
        assert camera.T_imu_cam[:3, 3] == pytest.approx(calibrated.T_imu_cam[:3, 3])


def test_noise_and_range_of_the_imu() -> None:
    rig = rig_named("euroc")
    true = Faults(imu_noise_factor=2.0, gyro_range_rad_s=1.0).true_rig(rig, np.random.default_rng(0))
    assert true.imu.gyro_noise_density == 2.0 * rig.imu.gyro_noise_density
    assert true.imu.accel_random_walk == 2.0 * rig.imu.accel_random_walk
    assert true.imu.gyro_range_rad_s == 1.0


def test_a_flight_keeps_the_truth_of_its_faults() -> None:
    faults = Faults(dropped_frames=0.5, hidden_time_offset_s=0.005, dark_from_s=2.0, dark_for_s=1.0)
    healthy, flight = fly(scenario_named("short")), fly(replace(scenario_named("short"), faults=faults))
    assert np.array_equal(flight.truth.p_world_imu, healthy.truth.p_world_imu)  # the flight itself is the same
    schedule = flight.schedule
    assert np.all(schedule.exposed_ns - schedule.stamps_ns == 5_000_000)
    assert 35 < len(schedule) < 85 and len(healthy.schedule) == 120
    dark = ~schedule.lit
    assert dark.any() and np.all((schedule.stamps_ns[dark] >= 2e9) & (schedule.stamps_ns[dark] < 3e9))
    assert flight.scenario.rig.time_offset_s == 0.0  # the calibration given to estimators
    assert flight.true_rig.time_offset_s == 0.005


def test_a_failing_rotor_ends_the_flight_with_a_crash() -> None:
    flight = fly(replace(scenario_named("hover"), faults=Faults(failing_rotor=1, rotor_fails_at_s=5.0)))
    assert flight.collision is not None and 5.0 < flight.collision.t_ns * 1e-9 < 7.0
    assert "floor" in str(flight.collision)
    assert flight.truth.t_s[-1] == pytest.approx(flight.collision.t_ns * 1e-9, abs=0.02)
    assert len(flight.schedule) and flight.schedule.exposed_ns[-1] <= flight.truth.t_ns[-1]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("dropped_frames", 1.0),
        ("dropped_frames", -0.1),
        ("stamp_jitter_s", -1.0),
        ("dark_for_s", float("nan")),
        ("imu_noise_factor", -1.0),
        ("gyro_range_rad_s", 0.0),
        ("failing_rotor", 16),
        ("hidden_tilt_rad", 3.0),
    ],
)
def test_invalid_faults_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"{field} .*; expected"):
        Faults(**{field: value})  # type: ignore[arg-type]
