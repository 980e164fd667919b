"""``dronevio vehicles``, and vehicles of one's own at the command line; the example is that of the documentation."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from dronevio.cli import main
from dronevio.cli.flight_options import FlightOptions
from dronevio.models.quadrotor import NANO
from dronevio.models.vehicles import read_vehicle
from dronevio.sim.scenarios import scenario_named

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "own-vehicle.md"

pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="not a checkout")


@pytest.fixture
def hexa(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write the file of the page into the current folder, and return its name."""
    text = PAGE.read_text(encoding="utf-8")
    found = re.search(r"The file\n`(my-hexa\.yaml)`:\n\n```yaml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert found is not None and len(found[2].splitlines()) <= 30
    monkeypatch.chdir(tmp_path)
    Path(found[1]).write_text(found[2], encoding="utf-8")
    return found[1]


def test_vehicles_are_described(hexa: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vehicles", "--json"]) == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)["vehicles"]] == ["research", "nano"]
    assert main(["vehicles", "nano", hexa, "--json"]) == 0
    nano, own = json.loads(capsys.readouterr().out)["vehicles"]
    assert nano["thrust_to_weight"] == NANO.thrust_to_weight
    assert (own["rotors"], own["arrangement"], own["mass_kg"]) == (6, "hexa-x", 3.2)
    # 3.2 kg · 9.81 m/s² on six rotors of 8.5e-6 N/(rad/s)²
    assert own["hover_speed_rad_s"] == pytest.approx(784.5, abs=0.1)
    assert own["thrust_to_weight"] == pytest.approx((1000.0 / 784.5) ** 2, rel=1e-3)
    assert main(["vehicles", hexa]) == 0
    assert re.search(r"my-hexa\.yaml +3\.2 +hexa-x \(6\) +0\.85 +1\.62 +785 ", capsys.readouterr().out)


def test_wrong_vehicles_are_told_on_one_line(hexa: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(hexa).read_text(encoding="utf-8")
    Path("wrong.yaml").write_text(text.replace("mass_kg: 3.2 ", "mass_kg: 3200 "), encoding="utf-8")
    for words in (["vehicles", "wrong.yaml"], ["fly", "short", "--vehicle", "wrong.yaml", "--out", "flight"]):
        assert main(words) == 2
        found = "dronevio: wrong.yaml:1: mass_kg: 3200.0; expected a number, 0.001 to 1000; if it is in g, write 3.2\n"
        assert capsys.readouterr().err == found
    assert not Path("flight").exists()


def test_the_other_rotors_of_the_page_are_a_part_of_a_vehicle(hexa: str) -> None:
    [listed] = re.findall(r"```yaml\n(rotors:\n.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    mirrored = []
    for sign_x, sign_y, swaps in ((1, 1, True), (-1, -1, True), (-1, 1, False)):
        for z, direction in ((0.05, "ccw"), (-0.02, "cw")):
            turns = direction if not swaps else {"ccw": "cw", "cw": "ccw"}[direction]
            place = f"[{0.25 * sign_x}, {0.20 * sign_y}, {z}]"
            mirrored.append(f"  - {{position_m: {place}, direction: {turns}}}\n")
    rest = re.sub(
        r"^(rotors|arm_m|rotor_height_m):.*\n", "", Path(hexa).read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    Path("x8.yaml").write_text(rest + listed + "".join(mirrored), encoding="utf-8")
    assert read_vehicle("x8.yaml").rotor_count == 8


def test_scenarios_take_the_vehicle(hexa: str) -> None:
    options = replace(FlightOptions.of(scenario_named("short")), vehicle=hexa)
    assert options.chosen().quadrotor == read_vehicle(hexa)


@pytest.mark.slow
def test_a_hexacopter_of_ones_own_runs(hexa: str) -> None:
    assert main(["run", "short", "--vehicle", hexa, "--out", "run", "--json"]) == 0
    stored = json.loads(Path("run/configuration.json").read_text(encoding="utf-8"))
    assert stored["scenario"]["quadrotor"]["rotors"] == "hexa-x"
