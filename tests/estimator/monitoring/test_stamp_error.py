"""Errors of the time stamps of frames: when they are corrected, by how much, and what the images decide."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.config import VioConfig
from dronevio.estimator.monitoring.innovation import Innovation, PredictionUncertainty
from dronevio.estimator.monitoring.stamp_error import StampConfig, StampCorrection, exposure_error
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.rotation import cross, exp_so3, pose_matrix
from dronevio.models.state import Estimate, Health, NavState, Trajectory
from tests.estimator.conftest import START_NS, SyntheticFrontEnd

if TYPE_CHECKING:
    from dronevio.estimator.types import Calibration, Observations
    from dronevio.models.state import CameraFrame
    from tests.estimator.conftest import SyntheticFlight

Times = npt.NDArray[np.int64]
MakeFlight = Callable[..., "SyntheticFlight"]

PERIOD_NS = 50_000_000
TICKS_NS = START_NS + PERIOD_NS * np.arange(400)
VELOCITY = np.array([1.0, -0.5, 0.3])
OMEGA = np.array([0.4, -0.8, 0.6])
FOCAL_PX = 450.0


def corrections_s(stamps_ns: Times, rate_hz: float = 20.0) -> Array:
    """Return the corrections (N,) of stamps (N,) without any image [s]."""
    correction = StampCorrection(rate_hz, StampConfig())
    return np.array([correction.add_stamp(int(t_ns)) for t_ns in stamps_ns])


def jittered(times_ns: Times, sigma_s: float, seed: int = 0) -> Times:
    """Return times (N,) with random errors, in their order."""
    errors_s = sigma_s * np.random.default_rng(seed).standard_normal(len(times_ns))
    return np.asarray(np.sort(times_ns + np.rint(1e9 * errors_s).astype(np.int64)))


@pytest.mark.parametrize("lost", [0.0, 0.25, 0.75])
def test_regular_stamps_are_exact(lost: float) -> None:
    """Time stamps on a regular clock are not changed by a nanosecond, whichever frames are lost."""
    kept = np.random.default_rng(0).random(len(TICKS_NS)) >= lost
    assert not corrections_s(TICKS_NS[kept]).any()


@pytest.mark.parametrize("rate_hz", [10.0, 24.0, 30.0, 60.0])
def test_a_wrong_nominal_rate_changes_no_stamp(rate_hz: float) -> None:
    assert not corrections_s(TICKS_NS, rate_hz).any()


@pytest.mark.parametrize("sigma_s", [0.001, 0.003, 0.01])
def test_irregular_stamps_follow_the_clock(sigma_s: float) -> None:
    """After five seconds, the exposures are known ten times as exactly as the stamps."""
    stamps_ns = jittered(TICKS_NS, sigma_s)
    errors_s = (stamps_ns - TICKS_NS) * 1e-9 + corrections_s(stamps_ns)
    assert np.sqrt(np.mean(errors_s[100:] ** 2)) < 0.2 * sigma_s
    assert np.abs(errors_s[200:]).max() < 0.3 * sigma_s


def test_irregular_stamps_of_few_frames_follow_the_clock() -> None:
    """Half of the frames are lost, and the clock is 1 % slower than nominal."""
    kept = np.random.default_rng(1).random(len(TICKS_NS)) >= 0.5
    stamps_ns = jittered(TICKS_NS[kept], 0.003)
    errors_s = (stamps_ns - TICKS_NS[kept]) * 1e-9 + corrections_s(stamps_ns, rate_hz=20.2)
    assert np.sqrt(np.mean(errors_s[100:] ** 2)) < 0.2 * 0.003


def test_corrected_times_increase() -> None:
    """Also where stamps err by half a period, and where a camera pauses."""
    stamps_ns = jittered(TICKS_NS, 0.02)
    stamps_ns[200:] += 3_000_000_000
    exposed_ns = stamps_ns + np.rint(1e9 * corrections_s(stamps_ns))
    assert np.diff(exposed_ns).min() > 0.0


def test_a_repeated_stamp_is_ignored() -> None:
    stamps_ns = jittered(TICKS_NS, 0.003)
    correction, other = StampCorrection(20.0, StampConfig()), StampCorrection(20.0, StampConfig())
    expected = [correction.add_stamp(int(t_ns)) for t_ns in stamps_ns]
    found = []
    for t_ns in stamps_ns:
        found.append(other.add_stamp(int(t_ns)))
        assert other.add_stamp(int(t_ns)) == 0.0
    assert found == expected


def innovation_after(delay_s: float, rng: np.random.Generator, outliers: int = 0) -> tuple[Innovation, NavState]:
    """Return the innovation of a frame that is exposed later than predicted, with 0.1 px of noise, and the state."""
    R = exp_so3(np.array([0.2, -0.4, 1.0]))
    points = rng.uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 6.0], (60, 3))  # the IMU frame is that of the camera
    then = points + delay_s * (-cross(np.broadcast_to(OMEGA, points.shape), points) - VELOCITY @ R)
    xy, xy_then = points[:, :2] / points[:, 2:], then[:, :2] / then[:, 2:]
    residual_px = FOCAL_PX * (xy_then - xy) + 0.1 * rng.standard_normal(xy.shape)
    residual_px[:outliers] += rng.uniform(-20.0, 20.0, (outliers, 2))
    axes = np.broadcast_to(np.eye(3), (60, 3, 3))
    J = (FOCAL_PX / points[:, 2])[:, None, None] * (axes[:, :2] - xy[:, :, None] * axes[:, 2:])
    uncertainty = PredictionUncertainty(1e-6 * np.eye(3), 1e-8, 0.01)
    state = NavState(0, pose_matrix(R, np.zeros(3)), VELOCITY, np.zeros(3), np.zeros(3))
    return Innovation(np.arange(60), residual_px, points, J, R, np.full(60, FOCAL_PX), np.ones(60), uncertainty), state


@pytest.mark.parametrize("delay_s", [-0.008, 0.0, 0.003])
def test_exposure_error_is_that_of_the_motion(delay_s: float) -> None:
    """The estimate has the stated standard deviation, a tenth of a millisecond; a fifth of outliers does no harm."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(50):
        found_s, sigma_s = exposure_error(*innovation_after(delay_s, rng), OMEGA)
        errors.append((found_s - delay_s) / sigma_s)
        assert sigma_s < 0.0003
    assert abs(np.mean(errors)) < 0.5
    assert np.std(errors) < 1.2
    for _ in range(20):
        found_s, sigma_s = exposure_error(*innovation_after(delay_s, rng, outliers=12), OMEGA)
        assert abs(found_s - delay_s) < 0.0005


def test_a_hovering_vehicle_shows_no_exposure_error() -> None:
    """Without motion in the image, the standard deviation is unlimited instead of a division by zero."""
    innovation, state = innovation_after(0.0, np.random.default_rng(0))
    still = replace(state, velocity_m_s=np.zeros(3))
    found_s, sigma_s = exposure_error(innovation, still, np.zeros(3))
    assert found_s == 0.0
    assert sigma_s > 1.0


@pytest.mark.parametrize("stamps_are_exact", [True, False])
def test_images_decide_between_stamps_and_clock(stamps_are_exact: bool) -> None:
    """A camera with irregular exposures and exact stamps is not corrected, after a second of motion."""
    correction, stamps_ns, rng = (
        StampCorrection(20.0, StampConfig()),
        jittered(TICKS_NS, 0.003),
        np.random.default_rng(2),
    )
    applied = []
    for t_ns, tick_ns in zip(stamps_ns[:150].tolist(), TICKS_NS.tolist(), strict=False):
        applied_s = correction.add_stamp(t_ns)
        exposed_ns = t_ns if stamps_are_exact else tick_ns
        innovation, state = innovation_after((exposed_ns - t_ns) * 1e-9 - applied_s, rng)
        correction.compare(innovation, state, OMEGA)
        applied.append(applied_s)
    assert bool(np.any(applied[50:])) is not stamps_are_exact


class DelayedFrontEnd(SyntheticFrontEnd):
    """Observes the landmarks at times of exposure that differ from the stamps."""

    def __init__(self, flight: "SyntheticFlight", exposed_ns: dict[int, int]) -> None:
        """Take the flight and the time of exposure by time stamp [ns]."""
        super().__init__(flight)
        self._exposed_ns = exposed_ns

    def track(
        self,
        frame: "CameraFrame",
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: "Calibration | None" = None,
    ) -> "Observations":
        """Observe the landmarks at the frame's exposure."""
        exposed = replace(frame, t_ns=self._exposed_ns[frame.t_ns])
        return super().track(exposed, R_cur_prev, rotation_sigma_rad, calibration)


def estimated(
    flight: "SyntheticFlight", sigma_s: float, exact: bool, config: VioConfig
) -> tuple[float, list[Estimate]]:
    """Return the error [m] and the estimates of a flight with irregular stamps, which may be exact or not."""
    regular_ns = flight.frame_times_ns
    stamps_ns = jittered(regular_ns, sigma_s)
    stamps_ns[0] = max(stamps_ns[0], regular_ns[0])
    flight.__dict__.update(frame_times_ns=stamps_ns)
    exposed_ns = dict(zip(stamps_ns.tolist(), (stamps_ns if exact else regular_ns).tolist(), strict=True))
    estimates = flight.run(DelayedFrontEnd(flight, exposed_ns), config)
    states = Trajectory.from_states(e.state for e in estimates if e.state is not None)
    truth = flight.truth_at(states.t_ns)
    fit = align(truth.p_world_imu, states.p_world_imu, "yaw")
    errors_m = truth.p_world_imu - fit.positions(states.p_world_imu)
    return float(np.sqrt(np.mean(np.sum(errors_m**2, axis=1)))), estimates


@pytest.mark.parametrize("sigma_s", [0.001, 0.003])
@pytest.mark.slow
def test_a_flight_with_irregular_stamps_is_as_accurate(make_flight: MakeFlight, sigma_s: float) -> None:
    """Its estimates are those at the stamps, and it tracks throughout; without correction the error is larger."""
    flight = make_flight(0)
    error_m, estimates = estimated(flight, sigma_s, exact=False, config=VioConfig())
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()
    first = next(i for i, e in enumerate(estimates) if e.health is Health.TRACKING)
    assert all(e.health is Health.TRACKING for e in estimates[first:])
    assert error_m < 0.02
    uncorrected, _ = estimated(make_flight(0), sigma_s, False, VioConfig(stamps=StampConfig(correct=False)))
    assert uncorrected > 1.2 * error_m


@pytest.mark.slow
def test_irregular_exposures_with_exact_stamps_are_kept(make_flight: MakeFlight) -> None:
    """The images show within the first motion that the stamps are right."""
    exact, _ = estimated(make_flight(0), 0.003, True, VioConfig(stamps=StampConfig(correct=False)))
    found, _ = estimated(make_flight(0), 0.003, exact=True, config=VioConfig())
    assert found < 2.0 * exact
