"""The file beside the recording of a simulated flight that states its settings, world and seeds included."""

import json
from pathlib import Path

from dronevio.models.errors import InputError
from dronevio.models.recordings.files import read_text
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE

SCENARIO_FILE = "scenario.json"
"""Name of the file in the folder of a recording."""


def world_of(folder: Path) -> tuple[str, int]:
    """Return name and seed of the world of the recording of a simulated flight.

    Raises:
        InputError: The folder holds no simulated flight, or one by a version that did not state the seed of the world.
    """
    settings = folder / SCENARIO_FILE
    try:
        scenario = json.loads(read_text(settings, "the settings of a simulated flight"))["scenario"]
        return str(scenario["world"]), int(scenario["world_seed"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(settings, f"no world with its seed ({error})", "the settings of a simulated flight") from None


def has_world(folder: Path) -> bool:
    """Return whether a folder holds a simulated flight whose world and true times of exposure are known."""
    try:
        world_of(folder)
    except InputError:
        return False
    return (folder / "mav0" / FRAME_TRUTH_FILE).exists()
