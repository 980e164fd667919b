"""A flight through an unknown world in rerun: what a viewer receives while it is flown."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from dronevio.eval.exploration import TimedDecision
from dronevio.eval.rerun.exploration import DECISIONS, GOAL, PAD, PLAN, ROUTE, TRUTH, ExplorationLog

DECISIONS_SO_FAR = tuple(TimedDecision(10**9 * k, f"decision {k}", (float(k), 0.0, 1.0)) for k in range(3))


class Rows:
    """A sink that counts the rows of each entity, and those without a time."""

    def __init__(self) -> None:
        """Begin without any."""
        self.of: Counter[str] = Counter()
        self.static_of: Counter[str] = Counter()

    def static(self, entity: str, *_: object) -> None:
        """Count what has no time."""
        self.static_of[entity] += 1

    def columns(self, entity: str, t_ns: Any, *_: object) -> None:
        """Count rows."""
        self.of[entity] += len(t_ns)


def shown(log: ExplorationLog, seconds: int) -> None:
    """Log the plans and decisions of the first seconds."""
    line = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    for second in range(seconds):
        log.under_way(second * 10**9, np.eye(4), line, line, DECISIONS_SO_FAR[: second + 1])


@pytest.mark.parametrize("goal_m", [np.array([1.0, 2.0, 3.0]), None])
def test_a_viewer_receives_plans_and_each_decision_once(goal_m: np.ndarray | None) -> None:
    sink: Any = Rows()
    log = ExplorationLog(sink, np.zeros(3), goal_m, is_live=True)
    assert (sink.static_of[GOAL], sink.static_of[PAD]) == (1, 1)
    shown(log, 3)
    assert (sink.of[PLAN], sink.of[ROUTE], sink.of[DECISIONS]) == (3, 3, 3)
    assert sink.static_of[TRUTH] == 1


def test_a_file_receives_them_at_the_end() -> None:
    sink: Any = Rows()
    shown(ExplorationLog(sink, np.zeros(3), None), 3)
    assert not sink.of
    assert {GOAL, PAD} <= set(sink.static_of)
    assert TRUTH not in sink.static_of
