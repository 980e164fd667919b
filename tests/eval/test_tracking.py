"""Losses of tracking, worked out by hand."""

import numpy as np
import pytest

from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import longest_loss_s, tracking_errors, tracking_sigmas
from dronevio.models.state import Estimate, Health, NavState, Trajectory

STATES = {"i": Health.INITIALIZING, "t": Health.TRACKING, "n": Health.INERTIAL_ONLY, "l": Health.LOST}


@pytest.mark.parametrize(
    ("states", "expected_s"),
    [
        ("iittttt", 0.0),
        ("iittntt", 0.2),
        ("ttllttnt", 0.3),
        ("ttnn", 0.2),
        ("tn", 0.1),
        ("tt", 0.0),
        ("t", 0.0),
        ("iinn", None),
        ("", None),
    ],
)
def test_longest_loss_of_tracking(states: str, expected_s: float | None) -> None:
    """A loss lasts from the last tracked frame to the next one or to the end; the initialization is no loss."""
    t_ns = np.arange(len(states)) * 10**8
    estimates = tuple(Estimate(int(t), STATES[s], None) for t, s in zip(t_ns, states, strict=True))
    run = EstimatorRun(estimates, np.zeros(len(states)), np.zeros(len(states)))
    found = longest_loss_s(run)
    assert found == (None if expected_s is None else pytest.approx(expected_s))


def test_missing_frames_are_no_loss() -> None:
    """Two consecutive frames that are tracked have no loss between them, however far apart they are."""
    estimates = tuple(Estimate(t, Health.TRACKING, None) for t in (0, 10**8, 5 * 10**9))
    assert longest_loss_s(EstimatorRun(estimates, np.zeros(3), np.zeros(3))) == 0.0


def run_with(states: str, errors_m: tuple[float, ...], sigma_m: float | None) -> EstimatorRun:
    """Return a run along the x axis at 1 m/s with errors of the height."""
    estimates = []
    for k, (state, error_m) in enumerate(zip(states, errors_m, strict=True)):
        T, P = np.eye(4), None if sigma_m is None else sigma_m**2 * np.eye(15)
        T[:3, 3] = 0.1 * k, 0.0, error_m
        zeros = np.zeros(3)
        estimates.append(Estimate(k * 10**8, STATES[state], NavState(k * 10**8, T, zeros, zeros, zeros, P)))
    return EstimatorRun(tuple(estimates), np.zeros(len(states)), np.zeros(len(states)))


def test_errors_while_tracking_are_in_standard_deviations() -> None:
    """Of the poses at which the run tracks, from the height of the first pose."""
    times_ns, x_m = np.arange(4) * 10**8, 0.1 * np.arange(4)
    truth = Trajectory(times_ns, np.stack([x_m, 0.0 * x_m, 0.0 * x_m], axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)))
    run = run_with("ttnt", (0.5, 0.56, 1.5, 0.48), 0.02)
    errors = tracking_errors(run, truth)
    assert errors is not None
    np.testing.assert_allclose(errors, [0.0, 3.0, 1.0])
    assert tracking_sigmas(run, truth) == pytest.approx(3.0)
    assert tracking_sigmas(run_with("nn", (0.0, 0.0), 0.02), truth) is None
    assert tracking_errors(run_with("tt", (0.0, 0.0), None), truth) is None
