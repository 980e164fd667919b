"""Losses of tracking, worked out by hand."""

import numpy as np
import pytest

from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import longest_loss_s
from dronevio.models.state import Estimate, Health

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
