"""Vehicles of one's own: files in YAML, Python objects, and checks that they can fly."""

from dronevio.models.vehicles.checks import check_vehicle
from dronevio.models.vehicles.chosen import vehicle_of
from dronevio.models.vehicles.file import read_vehicle

__all__ = ["check_vehicle", "read_vehicle", "vehicle_of"]
