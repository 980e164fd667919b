"""Vehicles as files in YAML.

The fields are those of `Quadrotor`, with the maps ``battery`` (`Battery`) and ``vibration`` (`RotorVibration`).
``rotors`` is the name of an arrangement, or a list of maps with ``position_m`` and ``direction`` (`Rotor`). ``mjcf`` is
the name of an MJCF file in the same folder, see `dronevio.sim.physics.own_body`.
"""

from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

from dronevio.models.battery import Battery
from dronevio.models.errors import InputError
from dronevio.models.quadrotor import Quadrotor, VehicleError
from dronevio.models.ranges import NumberField, RangeError, number_fields
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, parse_yaml
from dronevio.models.recordings.files import read_text
from dronevio.models.rotors import ARRANGEMENTS, Direction, Rotor
from dronevio.models.vehicles.checks import check_vehicle, unit_hint
from dronevio.models.vibration import RotorVibration

REQUIRED = (
    *("mass_kg", "inertia_kg_m2", "rotors", "rotor_radius_m", "thrust_n_per_rad2_s2", "torque_nm_per_rad2_s2"),
    *("rotor_speed_max_rad_s", "rotor_speed_per_v", "battery"),
)
"""Fields that a file must have, with ``arm_m`` of an arrangement; the others are those of the research quadrotor."""

_OF_ARRANGEMENT = ("arm_m", "rotor_height_m")
_ELSEWHERE = ("mjcf_name", "mjcf_file")


def read_vehicle(path: str | Path) -> Quadrotor:
    """Read a vehicle from a file in YAML, and check that it can fly.

    Args:
        path: The file.

    Raises:
        InputError: The file is missing or damaged, a field is missing, unknown or out of its range, or the vehicle
            cannot fly; the message names file, line and field.
    """
    path = Path(path)
    document = parse_yaml(path, read_text(path, "a vehicle in YAML"))
    _check_names(document)
    values = _numbers(document, Quadrotor, "")
    values["rotors"] = _rotors(document)
    values["battery"] = _group(document, Battery, "battery")
    if "vibration" in document:
        values["vibration"] = _group(document, RotorVibration, "vibration")
    if "mjcf" in document:
        values["mjcf_file"] = _mjcf(document)
    try:
        vehicle: Quadrotor = _made(document, Quadrotor, values, "")
        check_vehicle(vehicle)
    except VehicleError as error:
        line = document.lines.get(error.field)
        of_research = "" if line else " (the value of the research quadrotor, since the file has none)"
        raise InputError(path, f"{error.field}: {error.found}{of_research}", error.expected, line) from None
    return vehicle


def _rotors(document: YamlDocument) -> str | tuple[Rotor, ...]:
    """Return the name of the arrangement, or the rotors.

    Raises:
        InputError: They are missing or wrong.
    """
    given = document.values.get("rotors")
    expected = f"one of {', '.join(ARRANGEMENTS)}, or a list of rotors with position_m and direction"
    if isinstance(given, str) and given in ARRANGEMENTS:
        if "arm_m" not in document:
            raise document.error("arm_m", "a number, the distance of the rotors from the centre of mass [m]")
        return given
    count = len({key.split(".")[1] for key in document.lines if key.startswith("rotors.")})
    if given is not None or f"rotors.{count - 1}" not in {key.rpartition(".")[0] for key in document.lines}:
        raise document.error("rotors", expected)
    for name in _OF_ARRANGEMENT:
        if name in document:
            raise document.error(name, "no such field beside rotors one by one, which have their positions")
    return tuple(_rotor(document, f"rotors.{k}") for k in range(count))


def _rotor(document: YamlDocument, key: str) -> Rotor:
    """Return a rotor of the list, or raise InputError."""
    values: dict[str, Any] = _numbers(document, Rotor, f"{key}.")
    if "position_m" not in values:
        raise document.error(f"{key}.position_m", "three numbers")
    direction = document.values.get(f"{key}.direction")
    if direction not in get_args(Direction):
        raise document.error(f"{key}.direction", "ccw (anticlockwise seen from above) or cw")
    rotor: Rotor = _made(document, Rotor, values | {"direction": direction}, f"{key}.")
    return rotor


def _group(document: YamlDocument, kind: type, key: str) -> Any:
    """Return the settings in a map, or raise InputError."""
    if key in document.values:
        raise document.error(key, f"a map with {', '.join(field.name for field in fields(kind))}")
    values = _numbers(document, kind, f"{key}.")
    if kind is Battery:
        for field in fields(kind):
            if field.name not in values:
                raise document.error(f"{key}.{field.name}", "a number")
    return _made(document, kind, values, f"{key}.")


def _numbers(document: YamlDocument, kind: type, prefix: str) -> dict[str, Any]:
    """Return the numbers of a settings class that the document has; wrong values are found when it is made."""
    known = {field.name: field for field in number_fields(kind)}
    present = {name: field for name, field in known.items() if f"{prefix}{name}" in document}
    return {name: _number(document.values.get(f"{prefix}{name}"), field) for name, field in present.items()}


def _number(value: Any, field: NumberField) -> Any:
    """Return a value, as a whole number where one is expected."""
    return int(value) if field.kind is int and isinstance(value, float) and value.is_integer() else value


def _made(document: YamlDocument, kind: type, values: dict[str, Any], prefix: str) -> Any:
    """Return an instance of a settings class.

    Raises:
        InputError: A number is out of its range; the message proposes a unit in which it is not.
    """
    try:
        return kind(**values)
    except RangeError as error:
        if error.settings is not kind:
            raise
        key = f"{prefix}{error.field}"
        field = next(each for each in number_fields(kind) if each.name == error.field)

        def accepted(value: Any) -> bool:
            numbers = value if isinstance(value, tuple) else (value,)
            return all(number in field.range for number in numbers)

        value = values[error.field]
        is_number = all(isinstance(each, float) for each in (value if isinstance(value, tuple) else (value,)))
        hint = unit_hint(key, value, accepted) if is_number else ""
        raise document.error(key, f"{field.expected()}{hint}") from None


def _mjcf(document: YamlDocument) -> Path:
    """Return the MJCF file, which is in the folder of the document, or raise InputError."""
    folder = document.path.parent
    file = folder / document.word("mjcf")
    if not file.resolve().is_relative_to(folder.resolve()) or not file.is_file():
        raise document.error("mjcf", f"the name of a file in {folder}")
    return file


def _check_names(document: YamlDocument) -> None:
    """Raise InputError for a missing or an unknown field."""
    known = {
        "": {field.name for field in fields(Quadrotor)} - set(_ELSEWHERE) | {"mjcf"},
        "battery": {field.name for field in fields(Battery)},
        "vibration": {field.name for field in fields(RotorVibration)},
        "rotors": {field.name for field in fields(Rotor)},
    }
    for key, line in document.lines.items():
        group, *_, name = ["", *key.split(".")] if "." not in key else key.split(".")
        if group not in known:
            raise InputError(document.path, f"{group}: a map", "a value", line)
        names = sorted(known[group])
        if name not in names:
            like = get_close_matches(name, names, 1, 0.6) or [f"one of {', '.join(names)}"]
            raise InputError(document.path, f"unknown field {key}", like[0], line)
    for name in REQUIRED:
        if name not in document:
            raise document.error(name, "a value")
