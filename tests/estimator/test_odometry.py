"""The whole odometry on synthetic flights: landmarks replace images, so that a flight takes half a second."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.backend.marginal_prior import MarginalPrior
from dronevio.estimator.backend.marginalization import PendingMarginalization
from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.noise import ImuNoiseEstimator
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Estimator, measurements
from dronevio.models.rotation import exp_so3
from dronevio.models.state import Estimate, Health, Trajectory
from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., SyntheticFlight]
EstimatedFlight = Callable[[int, float], tuple[SyntheticFlight, list[Estimate]]]

STATIONARY, IN_MOTION = 1.5, -5.0
"""Time at which the motion begins, for a static and a dynamic initialization [s]."""
SEEDS = (0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3)))
GRAVITY_EVENT = re.compile(r"gravity (\S+) m/s²")


def poses(estimates: list[Estimate]) -> Trajectory:
    """Return the states of the estimates that have one."""
    return Trajectory.from_states(e.state for e in estimates if e.state is not None)


def velocities(trajectory: Trajectory) -> Array:
    """Return the velocities (N, 3) of a trajectory that has them, in the world frame [m/s]."""
    assert trajectory.velocity_m_s is not None
    return trajectory.velocity_m_s


def imu_frame_velocities(trajectory: Trajectory) -> Array:
    """Return the velocities (N, 3) of a trajectory that has them, in the IMU frame [m/s]."""
    return np.asarray(np.einsum("nji,nj->ni", trajectory.rotations, velocities(trajectory)))


def covariances(trajectory: Trajectory) -> Array:
    """Return the covariances (N, 15, 15) of a trajectory that has them."""
    assert trajectory.covariance is not None
    return trajectory.covariance


def ate_m(flight: SyntheticFlight, estimated: Trajectory) -> float:
    """Return the absolute trajectory error, aligned in position and yaw [m]."""
    truth = flight.truth_at(estimated.t_ns)
    fit = align(truth.p_world_imu, estimated.p_world_imu, "yaw")
    return float(np.sqrt(np.mean(np.sum((truth.p_world_imu - fit.positions(estimated.p_world_imu)) ** 2, axis=1))))


def contents(estimate: Estimate) -> bytes:
    """Return all values of an estimate as bytes."""
    owners = [estimate.state, estimate.tracks]
    values = [value for owner in owners if owner is not None for value in vars(owner).values()]
    values += [estimate.landmarks_odom, estimate.t_ns, estimate.health, estimate.events]
    parts = [value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode() for value in values]
    return b"|".join(parts)


@pytest.fixture(scope="module")
def estimated_flight(make_flight: MakeFlight) -> EstimatedFlight:
    """Return a function that gives a flight and its estimates, each computed once, for a seed and ``rest_s``."""
    cache: dict[tuple[int, float], tuple[SyntheticFlight, list[Estimate]]] = {}

    def fly(seed: int, rest_s: float) -> "tuple[SyntheticFlight, list[Estimate]]":
        if (seed, rest_s) not in cache:
            flight = make_flight(seed, rest_s=rest_s)
            cache[seed, rest_s] = flight, flight.run()
        return cache[seed, rest_s]

    return fly


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("rest_s", "latest_s", "bound_m"), [(STATIONARY, 1.2, 0.02), (IN_MOTION, 2.6, 0.05)])
def test_trajectory_agrees_with_the_truth(
    estimated_flight: EstimatedFlight, seed: int, rest_s: float, latest_s: float, bound_m: float
) -> None:
    flight, estimates = estimated_flight(seed, rest_s)
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    estimated = poses(estimates)
    assert (estimated.t_ns[0] - flight.frame_times_ns[0]) * 1e-9 < latest_s
    assert len(estimated) == np.sum(flight.frame_times_ns >= estimated.t_ns[0])  # no gaps
    assert flight.truth_at(estimated.t_ns).length_m > 9.0
    assert ate_m(flight, estimated) < bound_m


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
def test_tilt_velocity_and_biases_agree_with_the_truth(
    estimated_flight: EstimatedFlight, seed: int, rest_s: float
) -> None:
    flight, estimates = estimated_flight(seed, rest_s)
    estimated = poses(estimates)[-100:]  # the last five seconds
    truth = flight.truth_at(estimated.t_ns)
    tilt = np.linalg.norm(np.cross(estimated.rotations[:, 2], truth.rotations[:, 2]), axis=1)
    assert tilt.max() < np.radians(0.5)
    velocity_errors = imu_frame_velocities(estimated) - imu_frame_velocities(truth)
    assert np.linalg.norm(velocity_errors, axis=1).max() < 0.05
    last, true_last = estimates[-1].state, flight.state_at(int(truth.t_ns[-1]))
    assert last is not None
    np.testing.assert_allclose(last.gyro_bias_rad_s, true_last.gyro_bias_rad_s, atol=1e-3)
    np.testing.assert_allclose(last.accel_bias_m_s2, true_last.accel_bias_m_s2, atol=0.02)
    assert np.linalg.norm(true_last.gyro_bias_rad_s) > 2e-3 and np.linalg.norm(true_last.accel_bias_m_s2) > 0.02


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
def test_error_is_small_without_noise(make_flight: MakeFlight, rest_s: float) -> None:
    flight = make_flight(1, rest_s=rest_s, noisy=False, sampling="increment", duration_s=8.0)
    estimates = flight.run()
    assert ate_m(flight, poses(estimates)) < 1e-3
    for e in estimates:
        if e.landmarks_odom is not None and len(e.landmarks_odom) and e.t_ns > flight.frame_times_ns[80]:
            estimated, truth = poses(estimates), flight.truth_at(poses(estimates).t_ns)
            fit = align(truth.p_world_imu, estimated.p_world_imu, "yaw")
            errors = fit.positions(e.landmarks_odom)[:, None] - flight.landmarks[None]
            assert np.linalg.norm(errors, axis=2).min(axis=1).max() < 0.05
            break
    else:
        pytest.fail("no landmarks")


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
def test_covariances_are_positive_definite(estimated_flight: EstimatedFlight, rest_s: float) -> None:
    P = covariances(poses(estimated_flight(0, rest_s)[1]))
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(P).min() > 0.0


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
def test_estimates_are_causal(estimated_flight: EstimatedFlight, rest_s: float) -> None:
    """If the recording ends after k frames, its k estimates are those of the longer recording, to the bit."""
    flight, estimates = estimated_flight(0, rest_s)
    for frames in (12, 47, 90):
        cut = flight.cut_after(frames)
        assert len(cut.imu) < len(flight.imu) and len(cut.frame_times_ns) == frames
        assert [contents(e) for e in cut.run()] == [contents(e) for e in estimates[:frames]]


def test_published_estimates_are_never_revised(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=STATIONARY, duration_s=6.0)
    vio: Estimator = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    published: list[tuple[Estimate, bytes]] = []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimate = vio.add_frame(measurement)
            published.append((estimate, contents(estimate)))
    assert all(contents(estimate) == before for estimate, before in published)


def test_keyframes_leave_the_marginal_prior_to_the_next_frame(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A keyframe takes most of the time already."""
    flight, computed = make_flight(1, rest_s=IN_MOTION, duration_s=6.0), list[int]()
    vio, estimates = VisualInertialOdometry(flight.rig, front_end=flight.front_end()), list[Estimate]()
    marginal_prior = PendingMarginalization.prior

    def recorded(*arguments: Any) -> MarginalPrior:
        computed.append(len(estimates))
        return marginal_prior(*arguments)

    monkeypatch.setattr(PendingMarginalization, "prior", recorded)
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimates.append(vio.add_frame(measurement))
    is_keyframe = ["keyframe" in e.events for e in estimates]
    assert len(computed) > 10
    assert all(is_keyframe[k - 1] and not is_keyframe[k] for k in computed)


@pytest.mark.parametrize("rest_s", [STATIONARY, pytest.param(IN_MOTION, marks=pytest.mark.slow)])
def test_same_input_same_bytes(estimated_flight: EstimatedFlight, make_flight: MakeFlight, rest_s: float) -> None:
    _, estimates = estimated_flight(2, rest_s)
    again = make_flight(2, rest_s=rest_s).run()
    assert [contents(e) for e in again] == [contents(e) for e in estimates]


@pytest.mark.parametrize("batch", [1, 7, 400])
def test_imu_batches_may_have_any_size(estimated_flight: EstimatedFlight, batch: int) -> None:
    flight, expected = estimated_flight(0, STATIONARY)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    added, estimates = 0, []
    for k, t_ns in enumerate(flight.frame_times_ns[:100]):
        while added < len(flight.imu) and flight.imu.t_ns[added - 1 if added else 0] <= t_ns:
            vio.add_imu(flight.imu[added : added + batch])
            added += batch
        estimates.append(vio.add_frame(flight.frame(k)))
    for one, other in zip(estimates, expected[:100], strict=True):
        assert (one.state is None) == (other.state is None)
        if one.state is not None and other.state is not None:
            np.testing.assert_allclose(one.state.T_world_imu, other.state.T_world_imu, atol=1e-9)


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_imu_may_have_any_orientation(
    make_flight: MakeFlight, estimated_flight: EstimatedFlight, seed: int, rest_s: float
) -> None:
    """The path of a flight does not depend, up to yaw, on the orientation of the IMU in the vehicle."""
    R_mount = exp_so3(np.random.default_rng([seed, 77]).normal(size=3) * 2.0)
    rotated = make_flight(0, rest_s=rest_s, R_mount=R_mount)
    reference, estimated = poses(estimated_flight(0, rest_s)[1]), poses(rotated.run())
    np.testing.assert_array_equal(estimated.t_ns, reference.t_ns)
    fit = align(reference.p_world_imu, estimated.p_world_imu, "yaw")
    distances = np.linalg.norm(fit.positions(estimated.p_world_imu) - reference.p_world_imu, axis=1)
    assert distances.max() < 0.01
    np.testing.assert_allclose(fit.R_truth_estimate @ estimated.rotations @ R_mount.T, reference.rotations, atol=5e-3)


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
def test_front_end_receives_the_predicted_rotation(make_flight: MakeFlight, rest_s: float) -> None:
    """Before the initialization it is off by the gyroscope bias, afterwards by a hundredth of a degree."""
    flight = make_flight(2, rest_s=rest_s, R_mount=exp_so3(np.array([1.0, -2.0, 0.5])), duration_s=8.0)
    front_end = flight.front_end()
    estimates = flight.run(front_end)
    initialized = next(k for k, e in enumerate(estimates) if e.state is not None)
    errors = np.array(front_end.prediction_errors_rad)
    assert len(errors) == len(estimates) - 1
    assert errors.max() < 0.05 * 1.2 * np.linalg.norm(flight.gyro_bias) + 1e-3
    assert np.degrees(np.median(errors[initialized:])) < 0.02
    assert np.degrees(errors[initialized + 20 :].max()) < 0.05


@pytest.mark.parametrize("sampling", ["point", "increment"])
def test_both_kinds_of_sampling_are_accurate(make_flight: MakeFlight, sampling: str) -> None:
    flight = make_flight(3, rest_s=STATIONARY, sampling=sampling, duration_s=8.0)
    assert ate_m(flight, poses(flight.run())) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
def test_dark_second_is_bridged_by_the_imu(
    make_flight: MakeFlight, known_calibration: VioConfig, rest_s: float
) -> None:
    flight = make_flight(0, rest_s=rest_s, dark_s=(6.0, 7.0))
    estimates = flight.run(config=known_calibration)
    t_s = (flight.frame_times_ns - flight.frame_times_ns[0]) * 1e-9
    health = np.array([e.health for e in estimates])
    dark = (t_s >= 6.0) & (t_s < 7.0)
    assert np.all(health[dark] == Health.INERTIAL_ONLY)
    assert np.all(health[(t_s > 2.2) & (t_s < 6.0)] == Health.TRACKING)
    assert np.all(health[t_s >= 7.6] == Health.TRACKING)  # new landmarks need three keyframes
    estimated = poses(estimates)
    assert ate_m(flight, estimated) < 0.05
    sigma_m = np.sqrt(np.trace(covariances(estimated)[:, 3:6, 3:6], axis1=1, axis2=2))
    before, after = (int(np.searchsorted(estimated.t_ns, flight.frame_times_ns[i])) for i in (119, 139))
    assert sigma_m[after] > 1.5 * sigma_m[before]


@pytest.mark.slow
def test_velocity_is_restored_after_long_darkness(make_flight: MakeFlight) -> None:
    """Dead reckoning drifts for five seconds; landmarks then correct the velocity, and all states are finite."""
    flight = make_flight(0, rest_s=STATIONARY, dark_s=(4.0, 9.0), duration_s=15.0)
    estimates = flight.run()
    estimated = poses(estimates)
    assert np.isfinite(estimated.Ts_world_imu).all() and np.isfinite(covariances(estimated)).all()
    assert estimates[-1].health == Health.TRACKING
    truth = flight.truth_at(estimated.t_ns)
    speeds = [np.linalg.norm(velocities(t)[-40:], axis=1) for t in (estimated, truth)]
    assert np.abs(speeds[0] - speeds[1]).max() < 0.1


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_hover_does_not_drift(make_flight: MakeFlight, seed: int) -> None:
    """The drone moves by 3 cm around its starting point, so that hardly any parallax exceeds 1°."""
    hover = {
        "positions_m": np.array([[0.03, 0.01], [0.03, 0.01], [0.02, 0.01]]),
        "angles_rad": np.array([[0.01, 0.003], [0.006, 0.003], [0.006, 0.003]]),
    }
    flight = make_flight(seed, rest_s=STATIONARY, motion=hover)
    estimated = poses(flight.run())
    assert np.linalg.norm(estimated.p_world_imu - estimated.p_world_imu[0], axis=1).max() < 0.2


@pytest.mark.parametrize(
    "settings",
    [
        {"moving_share": 0.1},
        {"imu_noise": 10.0},
        *(
            pytest.param(settings, marks=pytest.mark.slow)
            for settings in ({"pixel_noise": 1.0}, {"max_features": 25}, {"max_features": 150})
        ),
    ],
    ids=str,
)
@pytest.mark.parametrize("rest_s", [STATIONARY, pytest.param(IN_MOTION, marks=pytest.mark.slow)])
def test_difficult_conditions_reduce_accuracy_only(
    make_flight: MakeFlight, rest_s: float, settings: dict[str, Any]
) -> None:
    flight = make_flight(1, rest_s=rest_s, **settings)
    estimated = poses(flight.run())
    assert len(estimated) > 100
    assert np.isfinite(estimated.Ts_world_imu).all() and np.isfinite(covariances(estimated)).all()
    assert ate_m(flight, estimated) < 0.15


def test_no_state_without_features(make_flight: MakeFlight) -> None:
    estimates = make_flight(0, rest_s=STATIONARY, dark_s=(0.0, 99.0), duration_s=4.0).run()
    assert all(e.health == Health.INITIALIZING and e.state is None for e in estimates)


def test_no_state_without_an_imu(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=STATIONARY, duration_s=3.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    estimates = [vio.add_frame(flight.frame(k)) for k in range(40)]
    assert all(e.health == Health.INITIALIZING and e.state is None for e in estimates)


def test_frames_may_begin_before_the_imu(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=2.5, duration_s=8.0)
    late = replace(flight)
    late.__dict__.update(imu=flight.imu[150:], frame_times_ns=flight.frame_times_ns)
    assert ate_m(flight, poses(late.run())) < 0.03


def test_frames_may_be_stamped_between_imu_samples(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=STATIONARY, duration_s=8.0)
    flight.__dict__["frame_times_ns"] = flight.frame_times_ns[:-1] + 2_345_678
    assert ate_m(flight, poses(flight.run())) < 0.02


def test_initialization_and_keyframes_are_events(estimated_flight: EstimatedFlight) -> None:
    _, estimates = estimated_flight(0, STATIONARY)
    events = [e.events for e in estimates]
    assert sum("initialized" in e for e in events) == 1
    keyframes = [e for e in estimates if "keyframe" in e.events]
    assert 40 < len(keyframes) < 80
    assert all((e.landmarks_odom is not None) == ("keyframe" in e.events) for e in estimates)
    tracks = [e.tracks for e in estimates if e.tracks is not None]
    assert len(tracks) == len(estimates)
    assert all(len(t.ids) == len(t.pixels) == len(t.ages) for t in tracks)


@pytest.mark.parametrize("offset_s", [0.012, -0.03])
def test_a_known_time_offset_costs_nothing(make_flight: MakeFlight, offset_s: float) -> None:
    """Frames are exposed later than stamped; the states are those at the stamps on the clock of the IMU."""
    flight = make_flight(0, rest_s=STATIONARY, duration_s=8.0)
    late = replace(flight, rig=replace(flight.rig, time_offset_s=offset_s))
    estimates = late.run()
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    estimated = poses(estimates)
    assert ate_m(flight, estimated) < 0.02
    velocity_errors = imu_frame_velocities(estimated) - imu_frame_velocities(flight.truth_at(estimated.t_ns))
    assert np.linalg.norm(velocity_errors, axis=1)[-60:].max() < 0.05


@pytest.mark.slow
def test_a_rolling_shutter_costs_little(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=STATIONARY, duration_s=8.0)
    camera = replace(flight.rig.cameras[0], readout_s=0.03)
    rolling = replace(flight, rig=replace(flight.rig, cameras=(camera,)))
    assert ate_m(flight, poses(rolling.run())) < 0.02


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
@pytest.mark.slow
def test_frames_without_an_image_cost_little(make_flight: MakeFlight, rest_s: float) -> None:
    """Every fifth image is missing, and ten in a row: each frame has a pose, no such frame is a keyframe."""
    missing = frozenset({*range(3, 240, 5), *range(150, 160)})
    flight = make_flight(1, rest_s=rest_s)
    estimates = replace(flight, missing=missing).run()
    first = next(k for k, estimate in enumerate(estimates) if estimate.state is not None)
    assert all(estimate.state is not None for estimate in estimates[first:])
    assert not any("keyframe" in estimates[k].events for k in missing)
    clean = flight.run()
    assert first <= 8 + next(k for k, estimate in enumerate(clean) if estimate.state is not None)
    assert ate_m(flight, poses(estimates)) < 2.0 * ate_m(flight, poses(clean))


@pytest.mark.parametrize("rest_s", [STATIONARY, IN_MOTION])
@pytest.mark.slow
def test_gravity_is_a_setting(make_flight: MakeFlight, rest_s: float) -> None:
    """Where gravity is 9.7 m/s², the setting restores the accuracy; without it, a bias or the scale compensates."""
    flight = make_flight(seed=1, rest_s=rest_s, noisy=False, gravity_m_s2=9.7)
    errors_m = [ate_m(flight, poses(flight.run(config=config))) for config in (VioConfig(gravity_m_s2=9.7), None)]
    assert errors_m[0] < min(0.003, errors_m[1] / 3.0)


@pytest.mark.slow
def test_gravity_is_estimated(make_flight: MakeFlight) -> None:
    """After the correction, the measurements contain it, so that later windows agree with it.

    The window begins again with the newest observations, so that the health stays `tracking`.
    """
    flight = make_flight(seed=2, rest_s=IN_MOTION, duration_s=24.0, noisy=False, gravity_m_s2=9.84)
    default = VioConfig().calibration
    calibration = replace(default, gravity=replace(default.gravity, sigma=0.3, significance=0.2))
    runs = [flight.run(config=VioConfig(calibration=c)) for c in (calibration, default)]
    found = [float(text[1]) for e in runs[0] for event in e.events if (text := GRAVITY_EVENT.search(event))]
    assert found == [pytest.approx(0.03, abs=0.005)]
    errors_m = [ate_m(flight, poses(run[-200:])) for run in runs]
    assert errors_m[0] < 0.3 * errors_m[1]
    initialized = next(k for k, e in enumerate(runs[0]) if e.state is not None)
    assert {e.health for e in runs[0][initialized:]} == {Health.TRACKING}


def test_gravity_is_positive() -> None:
    for wrong in (0.0, -9.81, float("nan")):
        with pytest.raises(ConfigError, match="gravity"):
            VioConfig(gravity_m_s2=wrong)


def test_refuses_a_frame_that_is_not_later(make_flight: MakeFlight) -> None:
    flight = make_flight(0, duration_s=1.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    vio.add_frame(flight.frame(1))
    for index in (1, 0):
        with pytest.raises(ConfigError, match="expected a later one"):
            vio.add_frame(flight.frame(index))


@pytest.mark.parametrize("walk", [1e-9, 1.6e-5])
def test_nearly_constant_biases_are_accepted(make_flight: MakeFlight, walk: float) -> None:
    """Random walks this small, used as they are, would make the linear systems too ill-conditioned to solve."""
    flight = make_flight(0, rest_s=STATIONARY, duration_s=8.0)
    imu = replace(flight.rig.imu, gyro_random_walk=0.03 * walk, accel_random_walk=walk)
    steady = replace(flight, rig=replace(flight.rig, imu=imu))
    estimates = steady.run()
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    assert ate_m(flight, poses(estimates)) < 0.02


def test_excessive_noise_is_stated_once_and_with_a_state(make_flight: MakeFlight) -> None:
    """Noise of sixty times the data sheet shows while the first states are too uncertain to be published."""
    estimates = make_flight(5, rest_s=-5.0, duration_s=3.0, imu_noise=60.0).run()
    stated = [any(Cause.EXCESSIVE_NOISE in event for event in estimate.events) for estimate in estimates]
    assert sum(stated) == 1 and estimates[stated.index(True)].state is not None


def test_aliased_vibration_is_no_contradiction_at_a_start(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first state is published where it is without, and no state is tracking."""
    flight = make_flight(0, rest_s=IN_MOTION, duration_s=2.0)
    usual = [estimate.state is not None for estimate in flight.run()]
    monkeypatch.setattr(ImuNoiseEstimator, "is_aliased", True)
    estimates = flight.run()
    assert any(usual) and [estimate.state is not None for estimate in estimates] == usual
    for report in (e.health_report for e in estimates if e.state is not None):
        assert report is not None and (report.health, report.reason) == (Health.INERTIAL_ONLY, Cause.EXCESSIVE_NOISE)
