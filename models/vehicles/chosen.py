"""Vehicles by name, from a file, or as Python objects."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.python_names import PREFIX, PythonName
from dronevio.models.quadrotor import VEHICLES, Quadrotor, vehicle_named
from dronevio.models.vehicles.checks import check_vehicle
from dronevio.models.vehicles.file import read_vehicle


@dataclass(frozen=True)
class PythonVehicle(PythonName):
    """Name of a vehicle in a module."""

    what: ClassVar[str] = "vehicle"


def vehicle_of(text: str) -> Quadrotor:
    """Return a vehicle by its name, from a file, or from a module.

    Args:
        text: One of `VEHICLES`, a file in YAML (`read_vehicle`), or ``python:package.module:NAME``, a `Quadrotor`.

    Raises:
        ConfigError: There is no such vehicle, or that of a module cannot fly.
        InputError: The file is missing, or its vehicle is wrong.
    """
    if text in VEHICLES:
        return vehicle_named(text)
    if text.startswith(PREFIX):
        return _of_module(PythonVehicle.parse(text))
    path = Path(text)
    if path.suffix or len(path.parts) > 1 or path.exists():
        return read_vehicle(path)
    raise unknown_name("vehicle", text, (*VEHICLES, "FILE.yaml", "python:package.module:NAME"))


def _of_module(named: PythonVehicle) -> Quadrotor:
    """Return a vehicle of a module.

    Raises:
        ConfigError: There is none, or it cannot fly.
    """
    found = named.instance_of(Quadrotor)
    try:
        check_vehicle(found)
    except ConfigError as error:
        raise ConfigError(f"vehicle {named}: {error}") from None
    return found
