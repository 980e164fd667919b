"""Memory and time of long runs: nothing accumulates without an estimate, or after a loss."""

import gc
import tracemalloc
from collections.abc import Callable
from typing import Any

import pytest

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.models.rig import euroc_rig

WARM_S, END_S = 20.0, 45.0
MAX_MB_PER_MINUTE = 0.05


def memory_mb() -> float:
    """Return the memory that is in use [MB], without cycles that the collector has not reached yet."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0] * 1e-6


@pytest.fixture(scope="module")
def long_runs(script: Callable[[str], Any]) -> Any:
    return script("long_runs")


@pytest.mark.slow
@pytest.mark.parametrize("seen_s", [0.0, 4.0], ids=["never started", "lost"])
def test_memory_does_not_grow_without_an_estimate(long_runs: Any, seen_s: float) -> None:
    case, rig = long_runs.Case(seen_s > 0.0, lambda t_s: t_s < seen_s), euroc_rig()
    vio = VisualInertialOdometry(rig, front_end=long_runs.Landmarks(rig, case))
    warm_mb, poses = 0.0, 0
    tracemalloc.start()
    for samples, frame in long_runs.frames(END_S / 60.0, case):
        vio.add_imu(samples)
        poses += vio.add_frame(frame).state is not None
        if warm_mb == 0.0 and frame.t_ns >= WARM_S * 1e9:
            warm_mb = memory_mb()
    grown_mb = memory_mb() - warm_mb
    tracemalloc.stop()
    assert (poses > 0) == (seen_s > 0.0)
    assert grown_mb * 60.0 / (END_S - WARM_S) <= MAX_MB_PER_MINUTE


def test_cases_of_the_measurement_are_what_they_say(long_runs: Any) -> None:
    flight, lost = (long_runs.growth_of(long_runs.Case(True, lambda t, s=s: t < s), 0.5) for s in (60.0, 4.0))
    assert flight.poses > 500 and 50 < lost.poses < flight.poses - 100
    assert flight.early_ms > 0.0 and flight.slowest_ms >= flight.late_ms
