"""Vehicles in files and modules: what is read, and what is wrong is told with line, field and unit."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dronevio.models.battery import Battery
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.quadrotor import NANO, RESEARCH, VEHICLES, Quadrotor, VehicleError
from dronevio.models.rotors import Rotor
from dronevio.models.vehicles import check_vehicle, read_vehicle, vehicle_of

HEXA = """\
mass_kg: 3.2
inertia_kg_m2: [0.055, 0.055, 0.1]
rotors: hexa-x
arm_m: 0.3
rotor_height_m: 0.04
rotor_radius_m: 0.127
thrust_n_per_rad2_s2: 8.5e-6
torque_nm_per_rad2_s2: 1.4e-7
rotor_speed_max_rad_s: 1000
rotor_speed_per_v: 70
battery: {cells: 4, capacity_ah: 8, resistance_ohm: 0.02}
"""
COAXIAL = HEXA.replace("rotors: hexa-x\narm_m: 0.3\nrotor_height_m: 0.04\n", "") + "rotors:\n"
COAXIAL += "".join(
    f"  - {{position_m: [{x}, {y}, {z}], direction: {'ccw' if x * y * (z - 0.02) > 0 else 'cw'}}}\n"
    for z in (0.05, -0.02)
    for x, y in ((0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2))
)


def written(folder: Path, text: str) -> Path:
    """Write a vehicle into a file."""
    path = folder / "drone.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_hexacopter_is_read(tmp_path: Path) -> None:
    drone = read_vehicle(written(tmp_path, HEXA + "vibration: {blades: 3, imbalance_m: 1e-6}\n"))
    assert drone == replace(
        RESEARCH,
        mass_kg=3.2,
        inertia_kg_m2=(0.055, 0.055, 0.1),
        rotors="hexa-x",
        arm_m=0.3,
        rotor_height_m=0.04,
        thrust_n_per_rad2_s2=8.5e-6,
        torque_nm_per_rad2_s2=1.4e-7,
        rotor_speed_per_v=70.0,
        battery=Battery(4, 8.0, 0.02),
        vibration=drone.vibration,
    )
    assert (drone.vibration.blades, drone.vibration.imbalance_m) == (3, 1e-6)
    assert drone.mjcf is None
    assert vehicle_of(str(tmp_path / "drone.yaml")) == drone


def test_rotors_one_by_one_are_read(tmp_path: Path) -> None:
    drone = read_vehicle(written(tmp_path, COAXIAL))
    assert drone.rotor_count == 8
    assert drone.rotors[:2] == (Rotor((0.2, 0.2, 0.05), "ccw"), Rotor((-0.2, 0.2, 0.05), "cw"))


@pytest.mark.parametrize(
    ("line", "instead", "found"),
    [
        (
            1,
            "mass_kg: 3200",
            "drone.yaml:1: mass_kg: 3200.0; expected a number, 0.001 to 1000; if it is in g, write 3.2",
        ),
        (1, "mass_kg: heavy", "drone.yaml:1: mass_kg: heavy; expected a number, 0.001 to 1000"),
        (
            1,
            "mass_kg: 9.0",
            "drone.yaml:1: mass_kg: a thrust-to-weight ratio of 0.578: 6 rotors lift 51 N at 1000 rad/s",
        ),
        (1, "mas_kg: 3.2", "drone.yaml:1: unknown field mas_kg; expected mass_kg"),
        (1, "", "drone.yaml: no field mass_kg; expected mass_kg: a value"),
        (1, "mass_kg: {g: 3200}", "drone.yaml:1: mass_kg: a map; expected a value"),
        (2, "inertia_kg_m2: [550000, 550000, 1000000]", "if it is in g cm², write [0.055, 0.055, 0.1]"),
        (2, "inertia_kg_m2: [550, 550, 1000]", "if it is in kg cm², write [0.055, 0.055, 0.1]"),
        (
            2,
            "inertia_kg_m2: [0.055, 0.055, 0.2]",
            "drone.yaml:2: inertia_kg_m2: 0.055, 0.055, 0.2: the largest exceeds",
        ),
        (2, "inertia_kg_m2: [0.055, 0.055]", "drone.yaml:2: inertia_kg_m2: [0.055, 0.055]; expected 3 numbers"),
        (3, "rotors: hexa-y", "drone.yaml:3: rotors: hexa-y; expected one of quad-x, quad-plus, hexa-x"),
        (
            4,
            "arm_m: 300",
            "drone.yaml:4: arm_m: 300.0; expected a number, more than 0, at most 10; if it is in mm, write 0.3",
        ),
        (4, "", "no field arm_m; expected arm_m: a number"),
        (4, "arm_m: 0.2", "drone.yaml:6: rotor_radius_m: 0.127: the discs of rotors 0 and 3 overlap"),
        (6, "rotor_radius_m: 5", "if rotor_radius_m is in inches, write 0.127"),
        (7, "thrust_n_per_rad2_s2: 9.32e-8", "if thrust_n_per_rad2_s2 is in N/rpm², write 8.49"),
        (8, "torque_nm_per_rad2_s2: 1.535e-9", "if it is in N m/rpm², write 1.399"),
        (9, "rotor_speed_max_rad_s: 9550", "drone.yaml:9: rotor_speed_max_rad_s: 9550 rad/s, at which the tips"),
        (10, "rotor_speed_per_v: 7", "drone.yaml:1: mass_kg: a thrust-to-weight ratio of 0.0"),
        (11, "battery: {cells: 4, capacity_ah: 8000, resistance_ohm: 0.02}", "if it is in mA h, write 8"),
        (11, "battery: {cells: 4.5, capacity_ah: 8, resistance_ohm: 0.02}", "drone.yaml:11: battery.cells: 4.5"),
        (11, "battery: {cells: 4, capacity_ah: 8}", "no field battery.resistance_ohm"),
        (11, "battery: {cels: 4}", "drone.yaml:11: unknown field battery.cels; expected cells"),
        (11, "battery: 4S", 'drone.yaml:11: battery: "4S"; expected a map with cells, capacity_ah, resistance_ohm'),
        (5, "mjcf: ../body.xml", 'drone.yaml:5: mjcf: "../body.xml"; expected the name of a file in'),
        (5, "rotor_inertia_kg_m2: 0.5", "drone.yaml:5: rotor_inertia_kg_m2: 0.5 for rotors with a radius of 0.127 m"),
        (5, "drag_n_s2_per_rad_m: 0.08", "drone.yaml:5: drag_n_s2_per_rad_m: 0.08, which at hover is"),
        (5, "vibration: !!python/name:os.system x", "drone.yaml:5: the tag"),
    ],
)
def test_what_is_wrong_is_told(tmp_path: Path, line: int, instead: str, found: str) -> None:
    lines = HEXA.splitlines()
    lines[line - 1] = instead
    with pytest.raises(InputError) as error:
        read_vehicle(written(tmp_path, "\n".join(lines)))
    assert found in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("direction: cw", "direction: ccw", "rotors: 8 rotors turn anticlockwise (ccw) and 0 clockwise (cw)"),
        ("direction: ccw", "direction: left", "rotors.0.direction: left; expected ccw (anticlockwise seen from above)"),
        (", direction: ccw", "", "no field rotors.0.direction"),
        ("direction", "turns", "unknown field rotors.0.turns; expected one of direction, position_m"),
        ("[0.2, 0.2,", "[200, 0.2,", "rotors.0.position_m: [200.0, 0.2, 0.05]; expected 3 numbers, each -10 to 10"),
        ("mass_kg", "arm_m: 0.3\nmass_kg", "drone.yaml:1: arm_m: 0.3; expected no such field beside rotors one by one"),
        ("-0.02]", "0.045]", "the discs of rotors 0 and 4 overlap"),
    ],
)
def test_wrong_rotors_are_told(tmp_path: Path, old: str, new: str, found: str) -> None:
    with pytest.raises(InputError) as error:
        read_vehicle(written(tmp_path, COAXIAL.replace(old, new)))
    assert found in str(error.value)


@pytest.mark.parametrize("name", VEHICLES)
def test_the_vehicles_by_name_are_plausible(name: str) -> None:
    check_vehicle(vehicle_of(name))


def test_a_nano_quadrotor_in_grams_is_recognised() -> None:
    with pytest.raises(
        VehicleError, match=r"^mass_kg: a thrust-to-weight ratio of 0\.00198.*; if it is in g, write 0\.03$"
    ):
        check_vehicle(replace(NANO, mass_kg=30.0))


OWN_DRONES = """
from dataclasses import replace
from dronevio.models.quadrotor import RESEARCH

LIGHT, HEAVY, NAME = replace(RESEARCH, mass_kg=1.2), replace(RESEARCH, mass_kg=9.0), "x"
"""


def test_vehicles_of_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_drones.py").write_text(OWN_DRONES, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert vehicle_of("python:own_drones:LIGHT") == Quadrotor(mass_kg=1.2)
    for text, found in (
        ("python:own_drones:HEAVY", "python:own_drones:HEAVY: mass_kg: a thrust-to-weight ratio of 0.38"),
        ("python:own_drones:NAME", "an object of type str; expected an instance of dronevio.models.Quadrotor"),
        ("python:own_drones:NONE", "no such name"),
        ("python:own_drones", "expected python:package.module:NAME"),
        ("python:no_such_module:A", "cannot import no_such_module"),
        ("missing.yaml", "no such file; expected a vehicle in YAML"),
        ("reserch", "unknown vehicle 'reserch'.*python:package.module:NAME; did you mean research"),
    ):
        with pytest.raises(ConfigError if "yaml" not in text else InputError, match=found):
            vehicle_of(text)
