"""The script that measures the cost of the map: its pace, its differences, and a run on a short flight."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dronevio.eval.run import EstimatorRun
from dronevio.models.imu import ImuSamples
from dronevio.models.state import CameraFrame, Estimate, Health


@pytest.fixture(scope="module")
def map_cost(script: Callable[[str], Any]) -> Any:
    """The script."""
    return script("map_cost")


def run_of(cpu_ms: list[float]) -> EstimatorRun:
    """A run at 20 Hz with given processor times, and elapsed times of 10 ms."""
    n = len(cpu_ms)
    estimates = tuple(Estimate(50_000_000 * i, Health.INITIALIZING, None) for i in range(n))
    return EstimatorRun(estimates, np.array(cpu_ms), np.full(n, 10.0))


def test_added_times_are_those_of_the_same_turn(map_cost: Any) -> None:
    cost = map_cost.MapCost
    turns = [
        map_cost.Turn(run_of([4.0] * 101), run_of([4.5] * 101), cost(101, 40, 1, 0.303)),
        map_cost.Turn(run_of([9.0] * 101), run_of([9.0] * 100 + [19.1]), cost(101, 40, 3, 0.404)),
        map_cost.Turn(run_of([6.0] * 99 + [8.0] * 2), run_of([8.0] * 101), cost(101, 40, 2, 0.505)),
    ]
    expected = ("2", "6.0", "0.5 (0.1, 2.0)", "0.0 (0.0, 0.5)", "4.0", "40", "2, at 5.0 times the rate", "0")
    assert tuple(map_cost.row_of(2, turns, cost(101, 40, 0, 0.5)).values()) == expected


def test_frames_come_at_their_times(map_cost: Any) -> None:
    now_s, slept = [7.0], list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now_s[0] += seconds

    pace = map_cost.Pace(np.array([5, 5.05, 5.1, 5.2]) * 1e9, lambda: now_s[0], sleep)
    for work_s in (0.4, 0.01, 0.12, 0.01):  # the start of the worker is not counted, and the third frame takes too long
        now_s[0] += work_s
        pace.imu(ImuSamples.empty())
        pace.frame(CameraFrame(0, ()), Estimate(0, Health.INITIALIZING, None), 0.0)
    np.testing.assert_allclose(slept, [0.05, 0.04], atol=1e-9)


@pytest.mark.slow
def test_the_cost_of_a_short_flight(map_cost: Any, flown: Any, capsys: pytest.CaptureFixture[str]) -> None:
    map_cost.main(map_cost.MapCostCommand(flown.folder, cameras=(1,), turns=1))
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[-1].strip("|").split("|")]
    assert float(row[1]) > 0.0 and float(row[4]) > 0.0 and int(row[5]) > 0
