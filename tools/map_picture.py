"""Make the picture of the dense map for docs/images: a simulated room, mapped from rendered stereo at estimated poses.

``make pictures`` makes it with the others.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from dronevio.cli import main


@dataclass(frozen=True)
class Picture:
    """What to draw, and where to write it."""

    out: Path = Path("docs/images/map.jpg")
    """JPEG file to write."""
    scenario: str = "room"
    """Scenario that is flown."""
    range_m: float = 6.0
    """Largest depth that enters the map [m]."""


def make(picture: Picture) -> None:
    """Fly, map, and copy the picture of the mesh from the report."""
    with tempfile.TemporaryDirectory() as scratch:
        recording, mapped = f"{scratch}/recording", Path(scratch) / "map"
        main(["fly", "--scenario", picture.scenario, "--rig", "euroc-stereo", "--out", recording])
        main(["map", recording, "--out", str(mapped), "--range-m", str(picture.range_m)])
        picture.out.write_bytes((mapped / "mesh.jpg").read_bytes())


if __name__ == "__main__":
    make(tyro.cli(Picture, description=__doc__))
