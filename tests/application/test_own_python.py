"""Scenarios, rigs and metrics of one's own, by the pages that describe them."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio.benchmark.jobs import scenario_flights
from dronevio.cli import main
from dronevio.cli.commands.run import RunCommand, repeating_command
from dronevio.cli.flight_options import parse_flight
from dronevio.envs import DroneEnv
from dronevio.models.errors import ConfigError
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig_presets import rig_named
from dronevio.sim.scenarios import scenario_named

PAGES = Path(__file__).resolve().parents[2] / "docs" / "how-to"
FLIGHT, WIDE = "python:my_flights:DOUBLE_HOP", "python:my_flights:WIDE"

pytestmark = pytest.mark.skipif(not PAGES.exists(), reason="not a checkout")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with the files of the pages."""
    for page in ("own-scenario.md", "own-metric.md"):
        text = (PAGES / page).read_text(encoding="utf-8")
        [(name, code)] = re.findall(r"[Tt]he file\s`([\w-]+\.py)`:\n\n```python\n(.*?)^```$", text, re.M | re.S)
        assert len(code.splitlines()) <= 30
        (tmp_path / name).write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_flight_of_ones_own_has_its_sensors(capsys: pytest.CaptureFixture[str], single_renderer: None) -> None:
    assert main(["fly", FLIGHT, "--out", "recordings/double-hop", "--seed", "2", "--json"]) == 0
    capsys.readouterr()
    recording = dv.open_recording("recordings/double-hop")
    assert (recording.rig.cameras[0].model.width, recording.rig.cameras[0].model.fx) == (320, 160.0)
    stated = json.loads(Path("recordings/double-hop/scenario.json").read_text(encoding="utf-8"))["scenario"]
    assert (stated["name"], stated["seed"], stated["plan"]["tour_s"]) == ("double-hop-v0", 2, 2.0 * known_tour_s())


def known_tour_s() -> float:
    return scenario_named("short").plan.tour_s


def test_the_command_that_repeats_a_run_finds_the_scenario_again() -> None:
    arguments = ["--scenario", FLIGHT, "--rig", WIDE, "--seed", "3"]
    command = parse_flight(RunCommand, arguments, "run")
    repeat = repeating_command(command.flight.scenario, command.flight.chosen(), arguments).split()
    assert repeat[:2] == ["dronevio", "run"] and f"--scenario={FLIGHT}" in repeat
    again = parse_flight(RunCommand, repeat[2:], "run").flight.chosen()
    assert (again.name, again.seed, again.rig.cameras[0].model) == (
        "double-hop-v0",
        3,
        rig_named(WIDE).cameras[0].model,
    )


def test_benchmarks_and_environments_take_them() -> None:
    flights = scenario_flights(("short", FLIGHT), (0, 1), rig=WIDE)
    assert [each.scenario for each in flights] == ["short-v0", "double-hop-v0"] * 2
    env = DroneEnv("hover", rig=WIDE, observations=("position", "imu"))
    assert env.reset(seed=0)[0]["imu"].shape[1] == 6
    env.close()
    with pytest.raises(ConfigError, match="no such name"):
        DroneEnv("hover", rig="python:my_flights:NONE")


def test_a_metric_of_ones_own_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    times = np.arange(100) / 10.0
    path = np.column_stack([np.cos(times), np.sin(times), 0.1 * times])
    for name, shift in (("truth.tum", 0.0), ("estimate.tum", 0.05)):
        moved = path + np.where(times[:, None] > 9.85, shift, 0.0)  # the last pose
        rows = np.column_stack([times, moved, np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))])
        np.savetxt(name, rows)
    metric = "python:my_metrics:FINAL_ERROR"
    command = ["evaluate", "truth.tum", "estimate.tum", "--alignment", "none", "--metrics", metric]
    assert main(command) == 0
    assert re.search(r"final position error\s+0.0866\s+m", capsys.readouterr().out)
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["own"]
    assert found == {metric: pytest.approx(0.05 * np.sqrt(3.0))}
    assert len(read_tum(Path("truth.tum"))) == 100


@pytest.mark.parametrize(
    ("name_of", "name", "message"),
    [
        (
            scenario_named,
            "python:my_flights:NONE",
            "scenario python:my_flights:NONE: no such name; expected an instance of",
        ),
        (scenario_named, WIDE, "an object of type Rig; expected an instance of dronevio.sim.Scenario"),
        (scenario_named, "python:nothing:X", "cannot import nothing"),
        (rig_named, "python:my_flights", "expected python:package.module:NAME"),
        (rig_named, FLIGHT, "an object of type Scenario; expected an instance of dronevio.models.Rig"),
        (scenario_named, "python:bad:NAMED", "its name '../up'; expected letters, digits, hyphens and dots"),
    ],
)
def test_a_wrong_name_is_explained(name_of: Callable[[str], Any], name: str, message: str, folder: Path) -> None:
    code = "from dataclasses import replace\nimport dronevio as dv\n"
    (folder / "bad.py").write_text(
        code + "NAMED = replace(dv.scenario_named('short'), name='../up')\n", encoding="utf-8"
    )
    with pytest.raises(ConfigError, match=re.escape(message)):
        name_of(name)
