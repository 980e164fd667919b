"""The odometry and the clocks: a wrong time offset is found, and the origin of the clock makes no difference."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.calibration.calibrator import TIME_OFFSET_FOUND
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.types import Calibration, Observations
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rotation import log_so3
from dronevio.models.state import CameraFrame, Estimate, Health, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
IN_MOTION = -5.0
LIVELY = {
    "angles_rad": np.array([[0.9, 0.15], [0.2, 0.12], [0.2, 0.12]]),
    "angle_rates": np.array([[0.5, 5.0], [3.1, 7.0], [2.9, 6.3]]),
}
"""Rotations with 0.5 to 1.1 Hz, as those of a small vehicle or of a hand-held camera."""


class Restamped:
    """The front end of a flight whose frames have other time stamps than those of their exposures."""

    def __init__(self, front_end: FrontEnd, exposed_ns: dict[int, int]) -> None:
        """Take the true time of each stamp."""
        self._front_end, self._exposed_ns = front_end, exposed_ns

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
    ) -> Observations:
        """Observe the landmarks at the true time."""
        true = replace(frame, t_ns=self._exposed_ns[frame.t_ns])
        return self._front_end.track(true, R_cur_prev, rotation_sigma_rad, calibration)

    def replenish(self, calibration: Calibration | None = None, at_exposure_of: object = None) -> Observations:
        """Observe further landmarks."""
        return self._front_end.replenish(calibration)

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking features."""
        self._front_end.discard(ids)


def run(
    flight: "SyntheticFlight", delay_s: Callable[[Array], Array], origin_ns: int = 0
) -> tuple[VisualInertialOdometry, list[Estimate]]:
    """Return the odometry and its estimates where frames are stamped late, by a function of the time since the start.

    Frames whose stamp is not later than the last one are left out. All stamps are relative to another origin.
    """
    exposed_ns = flight.frame_times_ns
    stamps_ns = exposed_ns + np.rint(1e9 * delay_s((exposed_ns - exposed_ns[0]) * 1e-9)).astype(np.int64)
    later = np.concatenate([[True], stamps_ns[1:] > np.maximum.accumulate(stamps_ns)[:-1]])
    stamps_ns, exposed_ns = stamps_ns[later] + origin_ns, exposed_ns[later]
    changed = replace(flight)
    changed.__dict__.update(imu=replace(flight.imu, t_ns=flight.imu.t_ns + origin_ns), frame_times_ns=stamps_ns)
    front_end = Restamped(flight.front_end(), dict(zip(stamps_ns.tolist(), exposed_ns.tolist(), strict=True)))
    vio, estimates = VisualInertialOdometry(flight.rig, front_end=front_end), []
    for measurement in measurements(changed):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimates.append(vio.add_frame(measurement))
    assert [e.t_ns for e in estimates] == stamps_ns.tolist()
    return vio, estimates


def ate_m(flight: "SyntheticFlight", estimates: list[Estimate]) -> float:
    """Return the error after alignment; the estimate of a frame is the state when the IMU's clock shows its stamp."""
    estimated = Trajectory.from_states(e.state for e in estimates if e.state is not None)
    p, truth = estimated.p_world_imu, flight.truth_at(estimated.t_ns).p_world_imu
    return float(np.sqrt(((align(truth, p).positions(p) - truth) ** 2).sum(axis=1).mean()))


def exposure_errors(flight: "SyntheticFlight", estimates: list[Estimate], delay_s: float) -> tuple[float, float]:
    """Return the errors [m], [rad] of the last two seconds' states at the exposures of frames that are stamped late."""
    exposed = [e.exposed for e in estimates[-40:] if e.exposed is not None]
    assert len(exposed) == 40
    estimated = Trajectory.from_states(exposed)
    truth = flight.truth_at(np.array([e.t_ns for e in estimates[-40:]]) - round(1e9 * delay_s))
    to_truth = align(truth.p_world_imu, estimated.p_world_imu)
    away_m = np.linalg.norm(to_truth.positions(estimated.p_world_imu) - truth.p_world_imu, axis=1)
    R = to_truth.R_truth_estimate @ estimated.rotations
    turn_rad = np.linalg.norm(log_so3(np.swapaxes(truth.rotations, 1, 2) @ R), axis=1)
    return float(np.median(away_m)), float(np.median(turn_rad))


def events_of(estimates: list[Estimate], text: str) -> list[str]:
    """Return the events that contain a text."""
    return [event for e in estimates for event in e.events if text in event]


@pytest.mark.parametrize("delay_s", [0.06, -0.06, pytest.param(0.2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rest_s", [IN_MOTION, pytest.param(1.5, marks=pytest.mark.slow)])
def test_a_time_offset_that_prevents_tracking_is_found(make_flight: MakeFlight, delay_s: float, rest_s: float) -> None:
    duration_s = 8.0 if rest_s < 0.0 else 14.0  # a start at rest is lost before the offset is found
    flight = make_flight(0, rest_s=rest_s, duration_s=duration_s, motion=LIVELY, max_features=100)
    vio, estimates = run(flight, lambda t: np.full(len(t), delay_s))
    (event,) = events_of(estimates, TIME_OFFSET_FOUND)
    assert "instead of +0.0 ms" in event
    assert vio.time_offset_s == pytest.approx(-delay_s, abs=0.003)
    assert all(e.health is Health.TRACKING for e in estimates[-40:])
    begun = next(k for k, e in enumerate(estimates) if TIME_OFFSET_FOUND in "".join(e.events))
    assert ate_m(flight, estimates[begun:]) < 0.05
    away_m, turn_rad = exposure_errors(flight, estimates, delay_s)
    assert away_m < 0.02 and turn_rad < (0.01 if delay_s > 0.0 else 0.015)  # predicted until its samples come


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_the_state_at_the_exposure_of_a_frame_by_the_estimated_offset(make_flight: MakeFlight, seed: int) -> None:
    """The frames are exposed 15 ms before they are stamped, in which the vehicle turns by up to a degree.

    In seed 0, the offset is found after 4.4 s, and the estimate begins after 6 s.
    """
    flight = make_flight(seed, rest_s=IN_MOTION, duration_s=9.0, motion=LIVELY, max_features=100)
    vio, estimates = run(flight, lambda t: np.full(len(t), 0.015))
    assert vio.time_offset_s == pytest.approx(-0.015, abs=0.002)
    away_m, turn_rad = exposure_errors(flight, estimates, 0.015)
    assert away_m < 0.02 and turn_rad < 0.006
    stamped = exposure_errors(flight, [replace(e, exposed=e.state) for e in estimates], 0.015)
    assert stamped[1] > 2.0 * turn_rad
    last = estimates[-1]
    assert last.rig is not None and last.rig.time_offset_s == pytest.approx(vio.time_offset_s)
    assert last.exposed is not None and last.exposed.angular_velocity_rad_s is not None


def test_without_an_offset_the_exposure_is_at_the_stamp(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=IN_MOTION, duration_s=3.0)
    _, estimates = run(flight, lambda t: np.zeros(len(t)))
    state, exposed = estimates[-1].state, estimates[-1].exposed
    assert state is not None and exposed is not None and exposed.t_ns == state.t_ns
    assert np.array_equal(exposed.T_world_imu, state.T_world_imu) and estimates[-1].rig is flight.rig


def test_the_right_offset_is_kept(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=IN_MOTION, duration_s=5.0)
    vio, estimates = run(flight, lambda t: np.zeros(len(t)))
    assert not events_of(estimates, TIME_OFFSET_FOUND) and abs(vio.time_offset_s) < 0.002
    assert [e.t_ns for e in estimates] == flight.frame_times_ns.tolist()


@pytest.mark.parametrize("step_s", [0.1, pytest.param(-0.1, marks=pytest.mark.slow)])
def test_a_step_of_one_clock_is_named_and_the_offset_found_again(make_flight: MakeFlight, step_s: float) -> None:
    flight = make_flight(1, rest_s=IN_MOTION, duration_s=10.0, motion=LIVELY, max_features=100)
    vio, estimates = run(flight, lambda t: np.where(t > 4.0, step_s, 0.0))
    assert events_of(estimates, TIME_OFFSET_FOUND)
    assert not events_of(estimates, Cause.TIME_OFFSET) or events_of(estimates, "recovered")
    assert vio.time_offset_s == pytest.approx(-step_s, abs=0.003)
    assert all(e.health is Health.TRACKING for e in estimates[-20:])


@pytest.mark.parametrize("rest_s", [1.5, IN_MOTION])
def test_the_origin_of_the_clock_makes_no_difference(make_flight: MakeFlight, rest_s: float) -> None:
    """A run whose stamps begin at −10 s, at 0 or at 2^61 ns is the same, shifted."""
    flight = make_flight(0, rest_s=rest_s, duration_s=4.0)
    _, expected = run(flight, lambda t: np.zeros(len(t)))
    assert expected[-1].state is not None
    for begin_ns in (-10_000_000_000, 0, 2**61):
        origin_ns = begin_ns - int(flight.frame_times_ns[0])
        _, estimates = run(flight, lambda t: np.zeros(len(t)), origin_ns)
        for found, known in zip(estimates, expected, strict=True):
            assert (found.t_ns, found.health, found.events) == (known.t_ns + origin_ns, known.health, known.events)
            assert (found.state is None) == (known.state is None)
            if found.state is not None and known.state is not None:
                np.testing.assert_array_equal(found.state.T_world_imu, known.state.T_world_imu)


@pytest.mark.parametrize("every", [2, 3])
def test_missing_images_change_neither_start_nor_health(make_flight: MakeFlight, every: int) -> None:
    """As where each image comes several times and the copies are left out."""
    flight = make_flight(0, rest_s=IN_MOTION, duration_s=8.0)
    count = len(flight.frame_times_ns)
    estimates = replace(flight, missing=frozenset(k for k in range(count) if k % every)).run()
    first = next(k for k, e in enumerate(estimates) if e.state is not None)
    assert first * 0.05 < 2.6
    assert all(e.health is Health.TRACKING for e in estimates[first:])
    assert ate_m(flight, estimates) < 0.05
