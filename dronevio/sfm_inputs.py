"""Inputs of structure from motion besides the images: an earlier reconstruction."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from dronevio.estimator.sfm.world import WorldFrame
from dronevio.models.errors import InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_reconstruction


@dataclass(frozen=True, eq=False)
class EarlierResult:
    """A reconstruction to which images are added."""

    reconstruction: Reconstruction
    """Cameras, poses and points."""
    world: WorldFrame = field(default_factory=WorldFrame)
    """How its world frame is determined; arbitrary for files that do not say it."""


def read_earlier(path: Path) -> EarlierResult:
    """Read the folder of a result of ``dronevio sfm``, of which the first component is used, or a model of COLMAP.

    Raises:
        InputError: The path is neither, is damaged, or has no images.
    """
    reconstruction = read_reconstruction(path)
    if not reconstruction.image_names:
        raise InputError(path, "points without images", "the result of dronevio sfm, or a model of COLMAP")
    return EarlierResult(reconstruction, _world(path / "report.json"))


def _world(report: Path) -> WorldFrame:
    """Return what the report of a result states about its world frame."""
    try:
        values = json.loads(report.read_text(encoding="utf-8"))
        is_metric, up = values.get("unit") == "m", values.get("up")
    except (OSError, ValueError, AttributeError):
        return WorldFrame()
    return WorldFrame("earlier" if is_metric else "arbitrary", is_vertical=up == [0.0, 0.0, 1.0])
