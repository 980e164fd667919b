"""``dronevio scenarios``, and the registration of the environments."""

import json
import subprocess
import sys

import pytest

from dronevio.cli import main
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.scenario_list import ScenarioRow, list_of_seed, planned_row
from dronevio.sim.scenarios import SCENARIOS, SUITES


def test_table_lists_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios"]) == 0
    table, suites = capsys.readouterr().out.split("Suites of scenarios")
    assert [line.split()[0] for line in table.splitlines()[3:] if line] == list(SCENARIOS)
    assert [line.split()[0] for line in suites.splitlines()[3:] if line] == list(SUITES)


def test_list_of_seed_0_has_every_scenario_and_suite() -> None:
    listed = list_of_seed(0)
    expected = [(name, scenario.world, scenario.description) for name, scenario in SCENARIOS.items()]
    assert [(row.name, row.world, row.description) for row in listed.scenarios] == expected, (
        "run tools/scenario_list.py"
    )
    assert {suite: tuple(names) for suite, names in listed.suites.items()} == SUITES, "run tools/scenario_list.py"


def paths_without_repetition() -> list[ScenarioRow]:
    """Return the rows of seed 0, of scenarios with the same path, which differ by their faults, only the first."""
    rows = {row.name: row for row in list_of_seed(0).scenarios}
    paths: dict[tuple[FlightPlan, str, float], str] = {}
    for name, scenario in SCENARIOS.items():
        paths.setdefault((scenario.plan, scenario.world, scenario.quadrotor.mass_kg), name)
    return [rows[name] for name in paths.values() if name in rows]


def test_scenarios_with_the_same_path_have_the_same_figures() -> None:
    figures = [
        (row.duration_s, row.peak_speed_m_s, row.peak_rate_deg_s)
        for row in list_of_seed(0).scenarios
        if SCENARIOS[row.name].plan == SCENARIOS["room-v0"].plan
    ]
    assert len(figures) > 5 and len(set(figures)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("row", paths_without_repetition(), ids=lambda row: row.name)
def test_listed_figures_are_those_of_the_planned_path(row: ScenarioRow) -> None:
    planned = planned_row(row.name, 0)
    listed, computed = ([r.duration_s, r.peak_speed_m_s, r.peak_rate_deg_s] for r in (row, planned))
    assert computed == pytest.approx(listed, rel=0.01), "run tools/scenario_list.py"


def test_list_of_seed_0_is_printed_without_the_simulator() -> None:
    code = (
        "import sys; from dronevio.cli import main; main(['scenarios', '--json']);"
        "sys.exit(bool({'numpy', 'mujoco', 'scipy', 'rich'} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0
    assert [row["name"] for row in json.loads(ended.stdout)["scenarios"]] == list(SCENARIOS)


def test_other_seeds_are_planned(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    few = {name: SCENARIOS[name] for name in ("room-v0", "short-v0")}  # planning all of them takes seconds
    monkeypatch.setattr("dronevio.sim.scenarios.SCENARIOS", few)
    assert main(["scenarios", "--json", "--seed", "3"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["seed"] == 3
    assert [row["name"] for row in document["scenarios"]] == list(few)
    assert document["suites"] == {suite: list(names) for suite, names in SUITES.items()}
    room, first = document["scenarios"][0], list_of_seed(0).scenarios[0]
    assert room["duration_s"] == pytest.approx(30.0)
    assert room["peak_speed_m_s"] >= 2.0 and room["peak_rate_deg_s"] >= 90.0
    assert room["peak_rate_deg_s"] != first.peak_rate_deg_s


def test_negative_seed_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios", "--seed", "-1"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "seed -1" in error


def test_registration_does_not_load_the_simulator() -> None:
    code = (
        "import sys, dronevio.envs; from dronevio.envs import vio_rig; "
        "sys.exit('mujoco' in sys.modules or 'dronevio.sim' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_scenarios_are_normal_or_have_faults_or_laps() -> None:
    clean, *faults = SUITES["stress"]
    parts = (SUITES["normal"], faults, SUITES["loops"], SUITES["loops-deceptive"], SUITES["office"])
    assert clean in SUITES["normal"]
    assert sorted(name for part in parts for name in part) == sorted(SCENARIOS)
