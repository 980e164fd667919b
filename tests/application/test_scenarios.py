"""``dronevio scenarios``, and the registration of the environments."""

import json
import subprocess
import sys

import pytest

from dronevio.cli import main
from dronevio.sim.scenarios import SCENARIOS, SUITES


def test_table_lists_every_scenario(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    few = dict(list(SCENARIOS.items())[:4])  # planning all of them takes seconds; the other format does it
    monkeypatch.setattr("dronevio.sim.scenarios.SCENARIOS", few)
    assert main(["scenarios"]) == 0
    table, suites = capsys.readouterr().out.split("Suites of scenarios")
    assert [line.split()[0] for line in table.splitlines()[3:] if line] == list(few)
    assert [line.split()[0] for line in suites.splitlines()[3:] if line] == list(SUITES)


def test_json_lists_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios", "--json", "--seed", "3"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["seed"] == 3
    assert [row["name"] for row in document["scenarios"]] == list(SCENARIOS)
    room = document["scenarios"][0]
    assert room["duration_s"] == pytest.approx(30.0)
    assert room["peak_speed_m_s"] >= 2.0 and room["peak_rate_deg_s"] >= 90.0


def test_negative_seed_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios", "--seed", "-1"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "seed -1" in error


def test_registration_does_not_load_the_simulator() -> None:
    code = "import sys, dronevio.envs; sys.exit('mujoco' in sys.modules or 'dronevio.sim' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
