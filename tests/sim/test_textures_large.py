"""Textures of large worlds: contrast at any size, periodic tiles, and a panorama without a seam."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import pytest

from dronevio.models.arrays import Image
from dronevio.sim.appearance import textures_industrial as works
from dronevio.sim.appearance import textures_nature as nature
from dronevio.sim.appearance import textures_race as race
from dronevio.sim.props import vegetation

Draw = Callable[[np.random.Generator, int, int], Image]

GREY = (130.0, 128.0, 122.0)
BROWN = ((150.0, 104.0, 58.0), (110.0, 84.0, 56.0))
PATTERNS: dict[str, Draw] = {
    "concrete": partial(works.concrete_floor, colour=GREY, ppm=100.0),
    "masonry": partial(works.masonry, colour=BROWN[0], dado=GREY, ppm=90.0),
    "roof": partial(works.profiled_roof, colour=GREY, ppm=60.0),
    "panes": works.panes,
    "casing": partial(works.casing, colour=GREY, ppm=120.0),
    "console": partial(works.console, colour=GREY, ppm=120.0),
    "tank": partial(works.tank_side, colour=GREY, ppm=120.0, number=3),
    "pipe": partial(works.pipe, colour=GREY, ppm=120.0),
    "hazard": works.hazard,
    "grating": partial(works.grating, colour=GREY, ppm=90.0),
    "crate": partial(works.crate, colour=BROWN[0], ppm=120.0),
    "drum": partial(works.drum, colour=GREY, ppm=120.0),
    "door": partial(works.roller_door, colour=GREY, ppm=90.0),
    "sign": partial(works.sign, colour=GREY, words="HALL 1"),
    "fan": partial(works.fan, colour=GREY),
    "litter": partial(nature.forest_floor, colours=BROWN, moss=GREY, ppm=100.0),
    "meadow": partial(nature.meadow, colour=GREY, ppm=80.0),
    "distance": partial(nature.distance, colours=BROWN),
    "bark": partial(nature.bark, colour=GREY),
    "leaves": partial(nature.leaves, colour=GREY),
    "stone": partial(nature.stone, colour=GREY),
    "chequers": partial(race.chequers, colour=GREY),
    "bars": partial(race.bars, colour=GREY),
    "lettered": partial(race.lettered, colour=GREY),
    "numbered": partial(race.numbered, colour=GREY, number=7),
    "banner": race.banner,
    "crowd": partial(race.crowd, colour=GREY),
    "bale": partial(race.bale, colour=BROWN[0]),
    "container": partial(race.container, colour=BROWN[0]),
}


PRINTS = [PATTERNS[name] for name in ("chequers", "bars", "lettered", "numbered", "banner", "crowd")]  # long and low


@pytest.mark.slow
@pytest.mark.parametrize("name", PATTERNS)
def test_textures_have_contrast_at_any_size(name: str) -> None:
    draw = PATTERNS[name]
    for height, width in ((6, 90), (90, 6)):
        image = draw(np.random.default_rng(0), height, width)
        assert image.shape == (height, width, 3)
        assert image.dtype == np.uint8
    shape = (60, 900) if draw in PRINTS else (300, 420)
    large, again = (draw(np.random.default_rng(0), *shape) for _ in range(2))
    np.testing.assert_array_equal(large, again)
    grey = large.mean(axis=2)
    assert grey.std() > 4.0
    corners = cv2.goodFeaturesToTrack(grey.astype(np.uint8), 100, 0.01, 10.0)
    assert len(corners) >= 25


def seam(image: Image, axis: int) -> float:
    """Return the mean difference of opposite borders, relative to that of neighbouring lines."""
    lines = np.moveaxis(image.astype(float), axis, 0)
    steps = np.abs(np.diff(lines, axis=0)).mean()
    return float(np.abs(lines[0] - lines[-1]).mean() / steps)


@pytest.mark.parametrize("axis", [0, 1])
def test_tiles_are_periodic(axis: int) -> None:
    rng = np.random.default_rng(0)
    for tile in (nature.grass_tile(rng, GREY, 3000, 256), nature.litter_tile(rng, BROWN, 1500, 256)):
        assert seam(tile, axis) < 1.5
        assert nature.tiled(tile, 300, 700).shape == (300, 700, 3)


def test_bark_and_sky_are_periodic_around_the_axis() -> None:
    rng = np.random.default_rng(0)
    assert seam(nature.bark(rng, 300, 200, GREY), 1) < 1.5
    sky = nature.sky(rng, 200, 800, (80, 120, 180), (220, 220, 220), 0.4)
    closed = nature.ridges(rng, sky, (150, 160, 170), (80, 90, 60), 0.9)
    assert np.abs(sky[:, 0].astype(int) - sky[:, -1]).mean() < 3.0
    assert seam(closed[170:], 1) < 2.0
    assert closed[-1].mean() < sky[-1].mean() - 30.0  # hills are darker than the haze


def test_text_runs_along_a_tall_texture() -> None:
    lying, standing = (race.lettered(np.random.default_rng(4), h, w, GREY) for h, w in ((60, 400), (400, 60)))
    rotated = cv2.rotate(standing, cv2.ROTATE_90_CLOCKWISE)
    assert np.corrcoef(lying.mean(axis=2).ravel(), rotated.mean(axis=2).ravel())[0, 1] > 0.9


def test_bark_is_brighter_towards_the_sun() -> None:
    sun = np.array([0.0, 0.8, 0.6])  # a quarter of the way around
    image = vegetation.bark_image(np.random.default_rng(0), 200, 400, (GREY,) * vegetation.BARKS, sun)
    each = image.mean(axis=(0, 2)).reshape(vegetation.BARKS, -1)
    assert (each[:, 20:30].mean(axis=1) > 1.3 * each[:, 70:80].mean(axis=1)).all()
