"""Runs of estimators: valid poses, real-time factor, and consistency with the recording."""

from dataclasses import astuple, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.output import REPEATED_IMAGES
from dronevio.eval.run import EstimatorRun, tracks_of
from dronevio.models.errors import EvaluationError
from dronevio.models.state import Health, HealthReport

if TYPE_CHECKING:
    from tests.eval.conftest import SyntheticFlight


def test_the_trajectory_holds_only_valid_poses(flight: "SyntheticFlight") -> None:
    estimates = list(flight.run.estimates)
    estimates[20] = replace(estimates[20], health=Health.LOST)
    estimates[30] = replace(estimates[30], health=Health.INERTIAL_ONLY)
    run = replace(flight.run, estimates=tuple(estimates))
    expected = [e.t_ns for i, e in enumerate(estimates) if i >= 10 and i != 20]
    assert run.trajectory.t_ns.tolist() == expected
    assert run.trajectory.covariance is not None


def test_the_real_time_factor_is_flight_time_by_processor_time(flight: "SyntheticFlight") -> None:
    costs_ms = np.full(len(flight.run.estimates), 5.0)
    run = EstimatorRun(flight.run.estimates, costs_ms, costs_ms)
    frames = len(costs_ms)
    assert run.real_time_factor == pytest.approx(((frames - 1) * 0.05) / (frames * 0.005))


def test_an_empty_run_has_no_poses_and_no_real_time_factor() -> None:
    run = EstimatorRun((), np.zeros(0), np.zeros(0))
    assert len(run.trajectory) == 0
    assert run.n_tracks.shape == (0,)
    assert run.real_time_factor is None


def test_costs_must_belong_to_the_estimates(flight: "SyntheticFlight") -> None:
    with pytest.raises(EvaluationError, match=r"expected \(121,\)"):
        EstimatorRun(flight.run.estimates, np.zeros(3), np.zeros(3))


def test_a_run_must_belong_to_its_recording(flight: "SyntheticFlight") -> None:
    flight.run.check_belongs_to(flight.recording)
    shorter = replace(flight.recording, frame_times_ns=flight.recording.frame_times_ns[:-1])
    with pytest.raises(EvaluationError, match="120 frames"):
        flight.run.check_belongs_to(shorter)


def test_an_estimate_without_tracks_has_empty_tracks(flight: "SyntheticFlight") -> None:
    tracks = tracks_of(replace(flight.run.estimates[0], tracks=None))
    assert (tracks.ids.shape, tracks.pixels.shape) == ((0,), (0, 2))


def test_innovations_are_percentiles_over_frames(flight: "SyntheticFlight") -> None:
    assert flight.run.innovations is None
    reports = [
        HealthReport(Health.TRACKING, "", innovation_px=0.01 * i, innovation_nis=0.1 * i) if i < 101 else None
        for i in range(121)
    ]
    reports[-1] = HealthReport(Health.LOST, "no landmarks")
    estimates = zip(flight.run.estimates, reports, strict=True)
    run = replace(flight.run, estimates=tuple(replace(e, health_report=report) for e, report in estimates))
    found = run.innovations
    assert found is not None
    assert astuple(found) == pytest.approx((0.5, 0.95, 5.0, 9.5))


def test_losses_and_contradictions_are_warnings(flight: "SyntheticFlight") -> None:
    first, second, *rest = flight.run.estimates
    lost = replace(first, events=("keyframe", "lost: a speed of 90 m/s", f"probable cause: {Cause.ROTATION_DISAGREES}"))
    repeated = replace(second, events=("recovered", REPEATED_IMAGES, "camera 1 contradicts its calibration"))
    run = replace(flight.run, estimates=(lost, repeated, *(replace(e, events=("initialized",)) for e in rest)))
    assert run.warnings == (
        (first.t_ns, "lost: a speed of 90 m/s"),
        (first.t_ns, f"probable cause: {Cause.ROTATION_DISAGREES}"),
        (second.t_ns, REPEATED_IMAGES),
        (second.t_ns, "camera 1 contradicts its calibration"),
    )
