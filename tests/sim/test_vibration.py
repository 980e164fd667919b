from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dronevio.models.imu import ImuSamples, Sampling
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import euroc_rig
from dronevio.models.vibration import EUROC_VIBRATION, RotorVibration
from dronevio.sim.flight import fly
from dronevio.sim.inertial.vibration import RotorHarmonics
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.scenario import Scenario

RIG = euroc_rig()
WIDE = replace(RIG, imu=replace(RIG.imu, gyro_bandwidth_hz=float("inf"), accel_bandwidth_hz=float("inf")))
ALIGNED = replace(WIDE, T_vehicle_imu=np.eye(4))
STEP_NS = 5_000_000
N = 2000


def batch(n: int = N, sampling: Sampling = "point", step_ns: int = STEP_NS) -> ImuSamples:
    return ImuSamples(np.arange(1, n + 1, dtype=np.int64) * step_ns, np.zeros((n, 3)), np.zeros((n, 3)), sampling)


def vibrating(**strengths: float) -> Quadrotor:
    return replace(Quadrotor(), vibration=RotorVibration(**strengths))  # type: ignore[arg-type]


def amplitude(signal: np.ndarray, frequency_hz: float) -> float:
    """Return the amplitude of a tone in samples (N,) at 200 Hz, and check that there are no other components."""
    t = np.arange(len(signal)) * 5e-3
    basis = np.stack([np.cos(2.0 * np.pi * frequency_hz * t), np.sin(2.0 * np.pi * frequency_hz * t)], axis=1)
    weights, *_ = np.linalg.lstsq(basis, signal, rcond=None)
    np.testing.assert_allclose(basis @ weights, signal, atol=1e-9 * float(np.linalg.norm(weights)))
    return float(np.linalg.norm(weights))


@pytest.mark.parametrize("frequency_hz", [30.0, 96.5, 104.5, 130.0, 187.0])
def test_imbalance_is_a_tone_at_the_rotor_speed_or_its_alias(frequency_hz: float) -> None:
    speed = 2.0 * np.pi * frequency_hz
    speeds = np.tile([speed, 0.0, 0.0, 0.0], (N, 1))
    alias_hz = min(frequency_hz, 200.0 - frequency_hz)
    tones = RotorHarmonics(vibrating(imbalance_m=1e-6, imbalance_rad=1e-5), ALIGNED, np.random.default_rng(0))
    gyro, accel = tones.sensed(batch(), speeds)
    for axis in (0, 1):
        np.testing.assert_allclose(amplitude(accel[:, axis], alias_hz), 1e-6 * speed**2, rtol=1e-9)
        np.testing.assert_allclose(amplitude(gyro[:, axis], alias_hz), 1e-5 * speed, rtol=1e-9)
    np.testing.assert_array_equal(accel[:, 2], 0.0)
    # The force rotates with the rotor
    np.testing.assert_allclose(np.linalg.norm(accel, axis=1), 1e-6 * speed**2, rtol=1e-12)


@pytest.mark.parametrize("rotor", range(4))
def test_imbalance_rotates_with_the_rotor_speed(rotor: int) -> None:
    quadrotor, speeds = vibrating(imbalance_m=1e-6), np.zeros((N, 4))
    speeds[:, rotor] = np.random.default_rng(8).uniform(50.0, 600.0, N)  # less than half a revolution per interval
    _, accel = RotorHarmonics(quadrotor, ALIGNED, np.random.default_rng(9)).sensed(batch(), speeds)
    force = accel[:, 0] + 1j * accel[:, 1]
    angles = np.angle(force[1:] / force[:-1])
    np.testing.assert_allclose(angles, quadrotor.rotor_directions[rotor] * speeds[:-1, rotor] * 5e-3, atol=1e-9)


@pytest.mark.parametrize(("blades", "harmonics"), [(2, 1), (3, 1)])
def test_blade_passing_acts_along_the_rotor_axis(blades: int, harmonics: int) -> None:
    speed = 2.0 * np.pi * 20.0
    quadrotor = vibrating(blade_pass_m=1e-6, blade_pass_rad=1e-5, blades=blades, harmonics=harmonics)
    gyro, accel = RotorHarmonics(quadrotor, ALIGNED, np.random.default_rng(0)).sensed(
        batch(), np.tile([speed, 0.0, 0.0, 0.0], (N, 1))
    )
    np.testing.assert_allclose(amplitude(accel[:, 2], blades * 20.0), 1e-6 * speed**2, rtol=1e-9)
    np.testing.assert_array_equal(accel[:, :2], 0.0)
    # No torque about the rotor's arm
    np.testing.assert_allclose(gyro @ [*quadrotor.rotor_positions_m[0, :2], 0.0], 0.0, atol=1e-12)
    np.testing.assert_allclose(amplitude(gyro[:, 0], blades * 20.0), 1e-5 * speed / np.sqrt(2.0), rtol=1e-9)


def test_harmonics_decrease_with_the_square_of_their_order() -> None:
    speed = 2.0 * np.pi * 10.0
    speeds = np.tile([speed, 0.0, 0.0, 0.0], (N, 1))
    both = RotorHarmonics(vibrating(blade_pass_m=1e-6, harmonics=2), ALIGNED, np.random.default_rng(0)).sensed(
        batch(), speeds
    )
    one = RotorHarmonics(vibrating(blade_pass_m=1e-6, harmonics=1), ALIGNED, np.random.default_rng(0)).sensed(
        batch(), speeds
    )
    np.testing.assert_allclose(amplitude((both[1] - one[1])[:, 2], 40.0), 0.25e-6 * speed**2, rtol=1e-9)


def test_an_increment_is_the_mean_of_the_points_in_its_interval() -> None:
    """The reference has 500 times as many points; the rotor speeds change randomly between intervals."""
    quadrotor, dense = replace(Quadrotor(), vibration=EUROC_VIBRATION), 500
    speeds = np.random.default_rng(1).uniform(300.0, 900.0, (100, 4))
    means = RotorHarmonics(quadrotor, WIDE, np.random.default_rng(2)).sensed(batch(100, "increment"), speeds)
    t_ns = np.arange(100 * dense + 1, dtype=np.int64) * (STEP_NS // dense)
    points = ImuSamples(t_ns, np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3)))
    held = np.vstack([np.repeat(speeds, dense, axis=0), speeds[-1:]])
    fine = RotorHarmonics(quadrotor, WIDE, np.random.default_rng(2)).sensed(points, held)
    for mean, signal in zip(means, fine, strict=True):
        np.testing.assert_allclose(
            mean, signal[:-1].reshape(100, dense, 3).mean(axis=1), atol=0.01 * np.abs(signal).max()
        )


def test_a_filter_attenuates_by_3_db_at_its_bandwidth() -> None:
    rig = replace(ALIGNED, imu=replace(ALIGNED.imu, gyro_bandwidth_hz=60.0, accel_bandwidth_hz=120.0))
    speed = 2.0 * np.pi * 60.0
    gyro, accel = RotorHarmonics(vibrating(imbalance_m=1e-6, imbalance_rad=1e-5), rig, np.random.default_rng(0)).sensed(
        batch(), np.tile([speed, 0.0, 0.0, 0.0], (N, 1))
    )
    np.testing.assert_allclose(amplitude(gyro[:, 0], 60.0), 1e-5 * speed / np.sqrt(2.0), rtol=1e-9)
    np.testing.assert_allclose(amplitude(accel[:, 0], 60.0), 1e-6 * speed**2 / np.sqrt(1.0 + 0.5**4), rtol=1e-9)


@pytest.mark.parametrize("sampling", ["point", "increment"])
def test_rotor_phases_continue_between_batches(sampling: Sampling) -> None:
    quadrotor = replace(Quadrotor(), vibration=EUROC_VIBRATION)
    speeds = np.random.default_rng(3).uniform(300.0, 900.0, (N, 4))
    samples = batch(N, sampling)
    whole = RotorHarmonics(quadrotor, RIG, np.random.default_rng(4)).sensed(samples, speeds)
    tones, edges = RotorHarmonics(quadrotor, RIG, np.random.default_rng(4)), (0, 1, 4, 4, 700, N)
    parts = [tones.sensed(samples[a:b], speeds[a:b]) for a, b in pairwise(edges)]
    for k in (0, 1):
        np.testing.assert_allclose(np.vstack([part[k] for part in parts]), whole[k], atol=1e-9)


def test_vibration_is_rotated_into_the_imu_frame() -> None:
    quadrotor = replace(Quadrotor(), vibration=EUROC_VIBRATION)
    speeds = np.full((N, 4), 650.0)
    in_vehicle = RotorHarmonics(quadrotor, ALIGNED, np.random.default_rng(5)).sensed(batch(), speeds)
    in_imu = RotorHarmonics(quadrotor, WIDE, np.random.default_rng(5)).sensed(batch(), speeds)
    for k in (0, 1):
        np.testing.assert_allclose(in_imu[k] @ WIDE.T_vehicle_imu[:3, :3].T, in_vehicle[k], atol=1e-12)


def test_balanced_or_stopped_rotors_do_not_vibrate() -> None:
    balanced = RotorHarmonics(Quadrotor(), RIG, np.random.default_rng(6)).sensed(batch(), np.full((N, 4), 650.0))
    stopped = RotorHarmonics(replace(Quadrotor(), vibration=EUROC_VIBRATION), RIG, np.random.default_rng(6)).sensed(
        batch(), np.zeros((N, 4))
    )
    assert not any(part.any() for signals in (balanced, stopped) for part in signals)


def test_preset_has_the_vibration_of_the_euroc_drone() -> None:
    """RMS values of flight V1_02 between 60 and 100 Hz: 1.08, 0.43, 0.86 m/s² and 0.008, 0.039, 0.018 rad/s."""
    gyro, accel = RotorHarmonics(replace(Quadrotor(), vibration=EUROC_VIBRATION), RIG, np.random.default_rng(7)).sensed(
        batch(), np.tile([640.0, 655.0, 662.0, 671.0], (N, 1))
    )
    np.testing.assert_allclose(np.sqrt(np.square(accel).mean(axis=0)), [1.08, 0.65, 0.65], rtol=0.25)
    np.testing.assert_allclose(np.sqrt(np.square(gyro).mean(axis=0))[1:], 0.02, rtol=0.4)


def test_a_flight_has_the_vibration_of_its_rotors() -> None:
    """Vibration appears in the measured IMU only while the rotors spin, and does not change the motion."""
    plan = FlightPlan(
        initial_rest_s=0.3, takeoff_s=1.0, tour_s=1.5, landing_s=1.2, final_rest_s=0.3, height_m=0.6, min_height_m=0.3
    )
    calm = Scenario("calm", "a hover", plan)
    smooth, shaken = fly(calm), fly(replace(calm, quadrotor=replace(Quadrotor(), vibration=EUROC_VIBRATION)))
    step = calm.rig.imu.accel_resolution_m_s2
    # Vibration does not affect the motion
    np.testing.assert_array_equal(shaken.perfect_imu.accel_m_s2, smooth.perfect_imu.accel_m_s2)
    tone = shaken.imu.accel_m_s2 - smooth.imu.accel_m_s2
    t_s = shaken.imu.t_ns * 1e-9
    np.testing.assert_allclose(tone[t_s < 0.3], 0.0, atol=1.01 * step)
    in_flight = (t_s > 1.5) & (t_s < 2.5)
    assert np.all(np.sqrt(np.square(tone[in_flight]).mean(axis=0)) > 0.3)
