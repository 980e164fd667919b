"""The suite explore: its flights, rows, summaries and command."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from dronevio.autonomy.exploration import _shortest_m, exploration_scenario
from dronevio.autonomy.goals import drawn_goal
from dronevio.autonomy.planning.body import Body
from dronevio.benchmark import exploration
from dronevio.benchmark.exploration import (
    GROUPS,
    RESULTS_FILE,
    FlightKey,
    Group,
    coverage_pairs,
    fly,
    has_reached,
    keys,
    read_rows,
    run_suite,
    summaries,
)
from dronevio.cli import main
from dronevio.models.errors import InputError


def row(seed: int, *, collided: bool = False, distance_m: float = 0.1, path_m: float = 6.0) -> dict[str, Any]:
    """Return the row of a flight whose shortest path has 5 m."""
    return {
        "group": "rays",
        "world": "room",
        "seed": seed,
        "outcome": "collision" if collided else "reached",
        "collided": collided,
        "distance_to_goal_m": distance_m,
        "path_m": path_m,
        "shortest_m": 5.0,
        "time_s": 20.0,
        "ate_m": 0.01,
        "median_speed_m_s": 1.0,
        "reason": "reached",
    }


def test_groups_have_the_flights_that_the_figures_state() -> None:
    assert len(keys(["estimate"])) == 100 and len(keys(["rays"])) == 150
    assert all(group.seeds[0] >= 1200 for group in GROUPS.values())  # constants were tuned on others
    assert set(keys(["true-pose"])) >= {FlightKey("true-pose", "office", 1200)}
    assert {(k.world, k.seed) for k in keys(["no-slam"])} <= {(k.world, k.seed) for k in keys(["estimate"])}
    assert [key.world for key in keys(["rays"])[:5]] == list(GROUPS["rays"].worlds)


def test_summary_by_hand() -> None:
    """Two of four flights reach the goal: one misses it by 0.6 m, one collides."""
    rows = [row(0), row(1, path_m=4.9), row(2, distance_m=0.6), row(3, collided=True, distance_m=3.0)]
    assert [has_reached(each) for each in rows] == [True, True, False, False]
    (found,) = summaries(rows)
    assert (found.flights, found.reached, found.collisions) == (4, 2, 1)
    assert found.path_ratio == pytest.approx(0.5 * (1.2 + 0.98))
    assert found.spl == pytest.approx((1 / 1.2 + 1.0) / 4)
    low, high = beta.ppf(0.025, 2, 3), beta.ppf(0.975, 3, 2)  # Clopper and Pearson, 2 of 4
    assert found.reached_bounds == pytest.approx((low, high))
    assert found.collisions_bounds[0] == pytest.approx(beta.ppf(0.025, 1, 4))


def test_a_flight_without_a_shortest_path_has_no_ratio() -> None:
    (found,) = summaries([row(0), {**row(1), "shortest_m": np.inf}])
    assert found.reached == 2 and found.path_ratio == pytest.approx(1.2)


def test_the_shortest_path_is_that_of_the_body_that_flies() -> None:
    """Doors of 0.9 m are passed by a body of 0.36 m radius, and not by one of 0.45 m."""
    narrow = Body(0.36, 0.35)
    scenario, goal = exploration_scenario("office-narrow", 1202), drawn_goal("office-narrow", 1202, 1202, narrow)
    assert _shortest_m(scenario, goal, narrow) < 30.0
    assert _shortest_m(scenario, goal, Body()) == np.inf


def test_an_error_counts_as_a_failure() -> None:
    failed = {"group": "rays", "world": "room", "seed": 9, "outcome": "error", "collided": False, "reason": "x"}
    (found,) = summaries([row(0), failed])
    assert (found.flights, found.reached) == (2, 1) and found.time_s == 20.0
    both = summaries([row(0), {**row(1), "world": "office"}])
    assert [each.world for each in both] == ["room", "office", "all"] and both[-1].flights == 2


def test_coverage_is_compared_in_pairs_and_counts_no_goals() -> None:
    """A flight that crashed the program has seen nothing; one without its pair is left out."""
    flown = {"outcome": "timeout", "collided": False, "reason": "", "distance_to_goal_m": None, "shortest_m": None}
    by_gain = {**flown, "group": "cover", "world": "office", "seed": 1000, "covered_share": 0.45}
    nearest = {**by_gain, "group": "cover-nearest", "covered_share": 0.3}
    crashed = {"group": "cover", "world": "forest", "seed": 1000, "outcome": "error", "collided": False, "reason": "x"}
    other = {**nearest, "world": "forest", "collided": True}
    pairs = coverage_pairs([by_gain, nearest, crashed, other, {**by_gain, "seed": 1001}])
    assert [(p.world, p.seed, p.collided) for p in pairs] == [("office", 1000, False), ("forest", 1000, True)]
    assert pairs[0].ratio == pytest.approx(1.5) and pairs[1].by_gain == 0.0
    assert [each.group for each in summaries([row(0), by_gain, nearest])] == ["rays"]


def test_suite_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[int] = []

    def flights(missing: Sequence[FlightKey], workers: int) -> Iterator[dict[str, Any]]:
        for key in missing:
            flown.append(key.seed)
            yield row(key.seed)

    monkeypatch.setattr(exploration, "GROUPS", {"rays": Group("rays", "", ("room",), range(2000, 2004))})
    monkeypatch.setattr(exploration, "_flown", flights)
    assert len(run_suite(tmp_path, (), 1, seeds=2)) == 2
    rows = run_suite(tmp_path, (), 1)
    assert flown == [2000, 2001, 2002, 2003] and [each["seed"] for each in rows] == flown
    assert read_rows(tmp_path) == rows


def test_flights_are_processes_of_their_own_and_a_failure_is_a_row() -> None:
    """There are no such worlds; more flights than workers, of which none is left out."""
    keys_ = [FlightKey("rays", f"attic-{number}", 1) for number in range(3)]
    rows = {each["world"]: each for each in exploration._flown(keys_, 2)}
    assert set(rows) == {key.world for key in keys_}
    assert all(each["outcome"] == "error" and "'attic-" in each["reason"] for each in rows.values())
    assert summaries(list(rows.values()))[0].reached == 0


def test_wrong_results_are_named(tmp_path: Path) -> None:
    (tmp_path / RESULTS_FILE).write_text(json.dumps(row(0)) + "\n{}\n")
    with pytest.raises(InputError, match=r"flights.jsonl:2: no flight of the suite"):
        read_rows(tmp_path)


def test_command_flies_and_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    group = Group("rays", "", ("room",), range(2000, 2001), {"rays": {}})
    monkeypatch.setattr(exploration, "GROUPS", {"rays": group})
    monkeypatch.setattr(exploration, "_flown", lambda missing, workers: map(fly, missing))
    arguments = ["benchmark", "--suite", "explore", "--variants", "rays", "--out", str(tmp_path)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "1/1" in printed and "0 to 98 %" in printed and str(tmp_path / RESULTS_FILE) in printed
    assert main([*arguments, "--json"]) == 0
    (only,) = json.loads(capsys.readouterr().out)["rows"]
    assert only["outcome"] == "reached" and only["plan_p99_ms"] > 0.0
    assert 0.0 < only["planning_cpu_per_s"] < only["cpu_per_s"]
    assert main(["benchmark", "--suite", "explore", "--variants", "rain"]) == 2
    assert "unknown variant of the suite explore 'rain'" in capsys.readouterr().err
