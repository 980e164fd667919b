"""Make the picture of explorations that fail for docs/images: the end of three flights of ``dv.explore``.

Of each flight: the map that the drone has at its last depth image, with path, route, plan and goal, beside the image of
its left camera, and a line that says what happened. The hash of the picture is recorded in ``figures.json``::

    .venv/bin/python tools/explore_failures.py

``make pictures`` makes it with the others. It takes three minutes.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from environment_pictures import IMAGES, record_hashes
from explore_picture import INK_GREY, PAPER_GREY, Drawing, Picture, Recorder, font
from PIL import Image, ImageDraw

import dronevio as dv

TITLE_PX = 34


@dataclass(frozen=True)
class Failure:
    """A flight that does not reach its goal, and why."""

    scenario: str
    """World or scenario."""
    seed: int
    """Seed of world, goal and errors."""
    outcome: str
    """How the flight ends."""
    why: str
    """What happened, in a line below the picture."""


FAILURES = (
    Failure("office", 1203, "lost", "a plain wall 0.5 m ahead: no track connects two images"),
    Failure("room", 1211, "unreachable", "eight cells before the goal in the corner cannot be seen"),
    Failure("office-glass", 1203, "collision", "a wall of glass is not seen"),
)
"""The flights of the picture."""


@dataclass(frozen=True)
class ExploreFailures:
    """Where to write the picture."""

    out: Path = IMAGES / "explore-failures.jpg"
    """JPEG file to write."""


def picture_of(failure: Failure) -> Picture:
    """Return the end of a flight (H, W, 3) below its title.

    Raises:
        RuntimeError: The flight ends otherwise.
    """
    recorder = Recorder()
    flight = dv.explore(failure.scenario, seed=failure.seed, listeners=[recorder.depth], on_frame=recorder.frame)
    if flight.scores.outcome != failure.outcome:
        raise RuntimeError(f"{failure.scenario}, seed {failure.seed}: {flight.scores.outcome}, not {failure.outcome}")
    return titled(Drawing(flight, recorder.path).picture(recorder.moments[-1]), failure)


def titled(picture: Picture, failure: Failure) -> Picture:
    """Return a picture below the title of a failure."""
    high, wide = picture.shape[:2]
    canvas = Image.new("RGB", (wide, high + TITLE_PX), (PAPER_GREY,) * 3)
    canvas.paste(Image.fromarray(picture), (0, TITLE_PX))
    text = f"{failure.scenario}, seed {failure.seed}: {failure.why}"
    ImageDraw.Draw(canvas).text((8, 8), text, (INK_GREY,) * 3, font(16))
    return np.asarray(canvas)


def stacked(pictures: list[Picture]) -> Picture:
    """Return pictures (H, W, 3) of different widths, one above the other."""
    widest = max(picture.shape[1] for picture in pictures)
    sides = [((0, 0), (0, widest - picture.shape[1]), (0, 0)) for picture in pictures]
    return np.concatenate(
        [np.pad(p, side, constant_values=PAPER_GREY) for p, side in zip(pictures, sides, strict=True)]
    )


if __name__ == "__main__":
    command = tyro.cli(ExploreFailures, description=__doc__)
    shown = stacked([picture_of(failure) for failure in FAILURES])
    cv2.imwrite(str(command.out), shown[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    record_hashes()
