"""Availability and cost of runs of a few frames, with values worked out by hand."""

import numpy as np
import pytest

from dronevio.eval.run import EstimatorRun, Latency, score_run
from dronevio.models.state import Estimate, Health, NavState

SECOND_NS = 1_000_000_000


def run_of(letters: str) -> EstimatorRun:
    """Return a run at one frame a second; a letter per frame: T tracking, L lost, I inertial only, dot initializing."""
    health_of = {"T": Health.TRACKING, "L": Health.LOST, "I": Health.INERTIAL_ONLY, ".": Health.INITIALIZING}
    estimates = []
    for index, letter in enumerate(letters):
        state = None if letter == "." else NavState(index * SECOND_NS, np.eye(4), *np.zeros((3, 3)))
        estimates.append(Estimate(index * SECOND_NS, health_of[letter], state))
    return EstimatorRun(tuple(estimates), np.full(len(letters), 100.0), np.full(len(letters), 200.0))


@pytest.mark.parametrize(
    ("letters", "poses", "lost", "resets", "coverage_percent"),
    [
        ("..TTTTTT", 6, 0, 0, 100.0),
        ("..TTTLLL", 3, 3, 0, 25.0),  # no pose follows the loss; one of the four frames after 3 s has a pose
        ("..TLLTLT", 3, 3, 2, 50.0),
        ("..TIITLT", 5, 1, 1, 75.0),
        ("........", 0, 0, 0, 0.0),
    ],
)
def test_losses_resets_and_coverage(letters: str, poses: int, lost: int, resets: int, coverage_percent: float) -> None:
    found = score_run(run_of(letters))
    assert (found.frames, found.poses, found.lost_frames, found.resets) == (8, poses, lost, resets)
    assert found.coverage_percent == coverage_percent
    assert found.initialization_s == (2.0 if poses else None)
    assert (found.real_time_factor, found.real_time_factor_wall) == pytest.approx((7.0 / 0.8, 7.0 / 1.6))


def test_percentiles_of_latencies() -> None:
    found = Latency.of(np.random.default_rng(0).permutation(np.arange(101.0) ** 2))
    assert (found.median, found.p95, found.p99, found.max) == pytest.approx((50.0**2, 95.0**2, 99.0**2, 100.0**2))
    assert found.mean == pytest.approx(100.0 * 201.0 / 6.0)  # the sum of the squares is n (n + 1) (2 n + 1) / 6


def test_growth_compares_the_second_quarter_with_the_last() -> None:
    run = run_of("TTTTTTTT")
    costs = np.array([90.0, 90.0, 10.0, 30.0, 70.0, 70.0, 20.0, 40.0])
    assert EstimatorRun(run.estimates, costs, costs).cpu_growth == pytest.approx(30.0 / 20.0)
    assert EstimatorRun(run.estimates, np.zeros(8), costs).cpu_growth is None
    assert run_of("TTT").cpu_growth is None
