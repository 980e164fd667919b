"""The whole odometry on flights made of formulas: landmarks instead of images, so that a flight takes half a second."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Estimator, measurements
from dronevio.models.rotation import exp_so3
from dronevio.models.state import Estimate, Health, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
Flown = Callable[[int, float], "tuple[SyntheticFlight, list[Estimate]]"]

REST, AIR = 1.5, -5.0  # when the motion begins [s]
SEEDS = range(4)


def poses(estimates: list[Estimate]) -> Trajectory:
    return Trajectory.from_states(e.state for e in estimates if e.state is not None)


def ate_m(flight: "SyntheticFlight", found: Trajectory) -> float:
    truth = flight.truth_at(found.t_ns)
    fit = align(truth.p_world_imu, found.p_world_imu, "yaw")
    return float(np.sqrt(np.mean(np.sum((truth.p_world_imu - fit.positions(found.p_world_imu)) ** 2, axis=1))))


def contents(estimate: Estimate) -> bytes:
    """Return everything that an estimate says."""
    owners = [estimate.state, estimate.tracks]
    values = [value for owner in owners if owner is not None for value in vars(owner).values()]
    values += [estimate.landmarks_world, estimate.t_ns, estimate.health, estimate.events]
    parts = [value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode() for value in values]
    return b"|".join(parts)


@pytest.fixture(scope="module")
def flown(make_flight: MakeFlight) -> Flown:
    """Return a flight and its estimates for a seed and a start; each is flown once."""
    done: dict[tuple[int, float], tuple[SyntheticFlight, list[Estimate]]] = {}

    def fly(seed: int, rest_s: float) -> "tuple[SyntheticFlight, list[Estimate]]":
        if (seed, rest_s) not in done:
            flight = make_flight(seed, rest_s=rest_s)
            done[seed, rest_s] = flight, flight.run()
        return done[seed, rest_s]

    return fly


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("rest_s", "latest_s", "bound_m"), [(REST, 1.2, 0.02), (AIR, 2.6, 0.05)])
def test_path_is_that_of_the_flight(flown: Flown, seed: int, rest_s: float, latest_s: float, bound_m: float) -> None:
    flight, estimates = flown(seed, rest_s)
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    found = poses(estimates)
    assert (found.t_ns[0] - flight.frame_times_ns[0]) * 1e-9 < latest_s
    assert len(found) == np.sum(flight.frame_times_ns >= found.t_ns[0])  # no gaps
    assert flight.truth_at(found.t_ns).length_m > 9.0
    assert ate_m(flight, found) < bound_m


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_whole_state_is_that_of_the_flight(flown: Flown, seed: int, rest_s: float) -> None:
    flight, estimates = flown(seed, rest_s)
    found = poses(estimates)[-100:]  # the last five seconds
    truth = flight.truth_at(found.t_ns)
    tilt = np.linalg.norm(np.cross(found.rotations[:, 2], truth.rotations[:, 2]), axis=1)
    assert tilt.max() < np.radians(0.5)
    in_imu = [np.einsum("nji,nj->ni", t.rotations, t.velocity_m_s) for t in (found, truth)]
    assert np.linalg.norm(in_imu[0] - in_imu[1], axis=1).max() < 0.05
    np.testing.assert_allclose(found.gyro_bias_rad_s[-1], truth.gyro_bias_rad_s[-1], atol=1e-3)
    np.testing.assert_allclose(found.accel_bias_m_s2[-1], truth.accel_bias_m_s2[-1], atol=0.02)
    assert np.linalg.norm(truth.gyro_bias_rad_s[-1]) > 2e-3 and np.linalg.norm(truth.accel_bias_m_s2[-1]) > 0.02


@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_without_noise_hardly_any_error_is_left(make_flight: MakeFlight, rest_s: float) -> None:
    flight = make_flight(1, rest_s=rest_s, noisy=False, sampling="increment", duration_s=8.0)
    estimates = flight.run()
    assert ate_m(flight, poses(estimates)) < 1e-3
    for e in estimates:
        if e.landmarks_world is not None and len(e.landmarks_world) and e.t_ns > flight.frame_times_ns[80]:
            found, truth = poses(estimates), flight.truth_at(poses(estimates).t_ns)
            fit = align(truth.p_world_imu, found.p_world_imu, "yaw")
            away = fit.positions(e.landmarks_world)[:, None] - flight.landmarks[None]
            assert np.linalg.norm(away, axis=2).min(axis=1).max() < 0.05
            break
    else:
        pytest.fail("no landmarks")


@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_covariances_are_proper(flown: Flown, rest_s: float) -> None:
    P = poses(flown(0, rest_s)[1]).covariance
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(P).min() > 0.0


@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_what_was_said_does_not_depend_on_what_comes_later(flown: Flown, rest_s: float) -> None:
    """The recording ends after k frames: its k estimates are those of the longer one, to the bit."""
    flight, estimates = flown(0, rest_s)
    for frames in (12, 47, 90):
        cut = flight.cut_after(frames)
        assert len(cut.imu) < len(flight.imu) and len(cut.frame_times_ns) == frames
        assert [contents(e) for e in cut.run()] == [contents(e) for e in estimates[:frames]]


def test_what_was_said_is_never_revised(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=REST, duration_s=6.0)
    vio: Estimator = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    said: list[tuple[Estimate, bytes]] = []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimate = vio.add_frame(measurement)
            said.append((estimate, contents(estimate)))
    assert all(contents(estimate) == then for estimate, then in said)


@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_same_input_same_bytes(flown: Flown, make_flight: MakeFlight, rest_s: float) -> None:
    _, estimates = flown(2, rest_s)
    again = make_flight(2, rest_s=rest_s).run()
    assert [contents(e) for e in again] == [contents(e) for e in estimates]


@pytest.mark.parametrize("batch", [1, 7, 400])
def test_imu_may_come_in_any_batches(flown: Flown, batch: int) -> None:
    flight, estimates = flown(0, REST)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    sent, said = 0, []
    for k, t_ns in enumerate(flight.frame_times_ns[:100]):
        while sent < len(flight.imu) and flight.imu.t_ns[sent - 1 if sent else 0] <= t_ns:
            vio.add_imu(flight.imu[sent : sent + batch])
            sent += batch
        said.append(vio.add_frame(flight.frame(k)))
    for one, other in zip(said, estimates[:100], strict=True):
        assert (one.state is None) == (other.state is None)
        if one.state is not None:
            np.testing.assert_allclose(one.state.T_world_imu, other.state.T_world_imu, atol=1e-9)


@pytest.mark.parametrize("rest_s", [REST, AIR])
@pytest.mark.parametrize("seed", range(3))
def test_imu_may_be_mounted_in_any_way(make_flight: MakeFlight, flown: Flown, seed: int, rest_s: float) -> None:
    """The same flight, sensed by an IMU that is turned in its mount: the same path, up to yaw."""
    R_mount = exp_so3(np.random.default_rng([seed, 77]).normal(size=3) * 2.0)
    turned = make_flight(0, rest_s=rest_s, R_mount=R_mount)
    reference, found = poses(flown(0, rest_s)[1]), poses(turned.run())
    np.testing.assert_array_equal(found.t_ns, reference.t_ns)
    fit = align(reference.p_world_imu, found.p_world_imu, "yaw")
    away = np.linalg.norm(fit.positions(found.p_world_imu) - reference.p_world_imu, axis=1)
    assert away.max() < 0.01
    np.testing.assert_allclose(fit.R_truth_estimate @ found.rotations @ R_mount.T, reference.rotations, atol=5e-3)


@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_front_end_is_told_how_its_camera_turned(make_flight: MakeFlight, rest_s: float) -> None:
    """To a gyroscope's bias before the start, to a hundredth of a degree after it."""
    flight = make_flight(2, rest_s=rest_s, R_mount=exp_so3(np.array([1.0, -2.0, 0.5])), duration_s=8.0)
    front_end = flight.front_end()
    estimates = flight.run(front_end)
    started = next(k for k, e in enumerate(estimates) if e.state is not None)
    errors = np.array(front_end.prediction_errors_rad)
    assert len(errors) == len(estimates) - 1
    assert errors.max() < 0.05 * 1.2 * np.linalg.norm(flight.gyro_bias) + 1e-3
    assert np.degrees(np.median(errors[started:])) < 0.02
    assert np.degrees(errors[started + 20 :].max()) < 0.05


@pytest.mark.parametrize("sampling", ["point", "increment"])
def test_both_kinds_of_samples_do(make_flight: MakeFlight, sampling: str) -> None:
    flight = make_flight(3, rest_s=REST, sampling=sampling, duration_s=8.0)
    assert ate_m(flight, poses(flight.run())) < 0.02


@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_dark_second_is_bridged_by_the_imu(make_flight: MakeFlight, rest_s: float) -> None:
    flight = make_flight(0, rest_s=rest_s, dark_s=(6.0, 7.0))
    estimates = flight.run()
    t_s = (flight.frame_times_ns - flight.frame_times_ns[0]) * 1e-9
    health = np.array([e.health for e in estimates])
    dark = (t_s >= 6.0) & (t_s < 7.0)
    assert np.all(health[dark] == Health.INERTIAL_ONLY)
    assert np.all(health[(t_s > 2.2) & (t_s < 6.0)] == Health.TRACKING)
    assert np.all(health[t_s >= 7.6] == Health.TRACKING)  # it takes three keyframes to know new landmarks
    found = poses(estimates)
    assert ate_m(flight, found) < 0.05
    sigma_m = np.sqrt(np.trace(found.covariance[:, 3:6, 3:6], axis1=1, axis2=2))
    before, after = (int(np.searchsorted(found.t_ns, flight.frame_times_ns[i])) for i in (119, 139))
    assert sigma_m[after] > 1.5 * sigma_m[before]  # and it knows that it is less sure


def test_long_darkness_ends_too(make_flight: MakeFlight) -> None:
    """Five seconds of dead reckoning go astray; sight brings the velocity back, and nothing is ever NaN."""
    flight = make_flight(0, rest_s=REST, dark_s=(4.0, 9.0), duration_s=15.0)
    estimates = flight.run()
    found = poses(estimates)
    assert np.isfinite(found.Ts_world_imu).all() and np.isfinite(found.covariance).all()
    assert estimates[-1].health == Health.TRACKING
    truth = flight.truth_at(found.t_ns)
    speeds = [np.linalg.norm(t.velocity_m_s[-40:], axis=1) for t in (found, truth)]
    assert np.abs(speeds[0] - speeds[1]).max() < 0.1


@pytest.mark.parametrize("seed", range(2))
def test_hover_does_not_drift(make_flight: MakeFlight, seed: int) -> None:
    """Three centimetres to and fro, from the ground on: hardly any landmark is ever seen under 1°."""
    sway = {
        "positions_m": np.array([[0.03, 0.01], [0.03, 0.01], [0.02, 0.01]]),
        "angles_rad": np.array([[0.01, 0.003], [0.006, 0.003], [0.006, 0.003]]),
    }
    flight = make_flight(seed, rest_s=REST, motion=sway)
    found = poses(flight.run())
    assert np.linalg.norm(found.p_world_imu - found.p_world_imu[0], axis=1).max() < 0.2


@pytest.mark.parametrize(
    "settings",
    [{"pixel_noise": 1.0}, {"moving_share": 0.1}, {"max_features": 25}, {"max_features": 150}, {"imu_noise": 10.0}],
    ids=str,
)
@pytest.mark.parametrize("rest_s", [REST, AIR])
def test_hardships_cost_accuracy_and_no_more(make_flight: MakeFlight, rest_s: float, settings: dict[str, Any]) -> None:
    flight = make_flight(1, rest_s=rest_s, **settings)
    found = poses(flight.run())
    assert len(found) > 100
    assert np.isfinite(found.Ts_world_imu).all() and np.isfinite(found.covariance).all()
    assert ate_m(flight, found) < 0.15


def test_nothing_is_said_before_there_is_something_to_say(make_flight: MakeFlight) -> None:
    blind = make_flight(0, rest_s=REST, dark_s=(0.0, 99.0), duration_s=4.0).run()
    assert all(e.health == Health.INITIALIZING and e.state is None for e in blind)


def test_without_an_imu_it_waits(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=REST, duration_s=3.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    said = [vio.add_frame(flight.frame(k)) for k in range(40)]
    assert all(e.health == Health.INITIALIZING and e.state is None for e in said)


def test_frames_may_come_before_the_imu_does(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=2.5, duration_s=8.0)
    late = replace(flight)
    late.__dict__.update(imu=flight.imu[150:], frame_times_ns=flight.frame_times_ns)
    assert ate_m(flight, poses(late.run())) < 0.03


def test_frames_between_samples_do_as_well(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=REST, duration_s=8.0)
    flight.__dict__["frame_times_ns"] = flight.frame_times_ns[:-1] + 2_345_678
    assert ate_m(flight, poses(flight.run())) < 0.02


def test_events_tell_the_start_and_the_keyframes(flown: Flown) -> None:
    _, estimates = flown(0, REST)
    events = [e.events for e in estimates]
    assert sum("initialized" in e for e in events) == 1
    keyframes = [e for e in estimates if "keyframe" in e.events]
    assert 40 < len(keyframes) < 80
    assert all((e.landmarks_world is not None) == ("keyframe" in e.events) for e in estimates)
    assert all(len(e.tracks.ids) == len(e.tracks.pixels) == len(e.tracks.ages) for e in estimates)


@pytest.mark.parametrize("offset_s", [0.012, -0.03])
def test_a_known_time_offset_costs_nothing(make_flight: MakeFlight, offset_s: float) -> None:
    """Frames are taken so much later than stamped; states are those at the stamps by the IMU's clock."""
    flight = make_flight(0, rest_s=REST, duration_s=8.0)
    late = replace(flight, rig=replace(flight.rig, time_offset_s=offset_s))
    estimates = late.run()
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    found = poses(estimates)
    assert ate_m(flight, found) < 0.02
    truth = flight.truth_at(found.t_ns)
    in_imu = [np.einsum("nji,nj->ni", t.rotations, t.velocity_m_s) for t in (found, truth)]
    assert np.linalg.norm(in_imu[0] - in_imu[1], axis=1)[-60:].max() < 0.05


def test_a_rolling_shutter_costs_little(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=REST, duration_s=8.0)
    camera = replace(flight.rig.cameras[0], readout_s=0.03)
    rolling = replace(flight, rig=replace(flight.rig, cameras=(camera,)))
    assert ate_m(flight, poses(rolling.run())) < 0.02


def test_refuses_a_frame_that_is_not_later(make_flight: MakeFlight) -> None:
    flight = make_flight(0, duration_s=1.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    vio.add_frame(flight.frame(1))
    for index in (1, 0):
        with pytest.raises(ConfigError, match="expected a later one"):
            vio.add_frame(flight.frame(index))


@pytest.mark.parametrize("walk", [1e-9, 1.6e-5])
def test_an_imu_whose_biases_hardly_walk_is_no_trouble(make_flight: MakeFlight, walk: float) -> None:
    """The solver cannot take them at their word: it would get numbers beyond its digits."""
    flight = make_flight(0, rest_s=REST, duration_s=8.0)
    imu = replace(flight.rig.imu, gyro_random_walk=0.03 * walk, accel_random_walk=walk)
    steady = replace(flight, rig=replace(flight.rig, imu=imu))
    estimates = steady.run()
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    assert ate_m(flight, poses(estimates)) < 0.02
