"""Other light in the same world."""

import numpy as np
import pytest

from dronevio.sim.streams import generator
from dronevio.sim.world import WORLDS, build_world, illumination_and_movers
from dronevio.sim.worlds.layout import Layout
from dronevio.sim.worlds.lighting import drawn_layout


def layouts(world: str, *light_seeds: int | None) -> list[Layout]:
    """Return the layouts of seed 2 of a world under some lights."""
    lights = [None if seed is None else generator(seed, "light") for seed in light_seeds]
    return [drawn_layout(WORLDS[world], generator(2, "layout"), light) for light in lights]


def corners(layout: Layout) -> np.ndarray:
    """Return all points (N, 3) of the geometry of a layout."""
    parts = [surface.grid.reshape(-1, 3) for surface in layout.shell]
    parts += [np.stack([box.centre, box.half]) for box in (*layout.boxes, *layout.obstacles)]
    parts += [cutouts.corners.reshape(-1, 3) for shared in layout.prints for cutouts in shared.cutouts]
    return np.concatenate([*parts, layout.route])


@pytest.mark.parametrize("world", WORLDS)
def test_other_light_leaves_the_geometry(world: str) -> None:
    own, other, again = layouts(world, None, 1, 1)
    np.testing.assert_array_equal(corners(own), corners(other))
    for layout in (other, again):
        powers = [light.power for light in layout.lights]
        assert powers == [light.power for light in other.lights]
    assert [light.power for light in own.lights] != [light.power for light in other.lights] or any(
        not np.array_equal(a.points, b.points) for a, b in zip(own.lights, other.lights, strict=True)
    )
    assert any(light.power > 0.0 for light in other.lights)
    assert 0.6 * own.illumination <= other.illumination <= own.illumination


@pytest.mark.parametrize("world", ["forest", "gates"])
def test_the_sun_moves_outdoors(world: str) -> None:
    own, other = layouts(world, None, 3)
    suns = [layout.lights[0].points[0] / np.linalg.norm(layout.lights[0].points[0]) for layout in (own, other)]
    assert suns[0] @ suns[1] < 0.99
    for sun in suns:
        assert 35.0 <= np.degrees(np.arcsin(sun[2])) <= 55.0


def textures(light_seed: int | None) -> list[np.ndarray]:
    """Return the textures of the dark world, which is the fastest to paint at low resolution."""
    spec = build_world("low-texture", 2, None, 4, light_seed).spec
    return [np.frombuffer(texture.data, np.uint8) for texture in spec.textures]


def test_the_same_light_seed_gives_the_same_bytes() -> None:
    own, one, same, other = (textures(seed) for seed in (None, 1, 1, 2))
    assert [image.tobytes() for image in one] == [image.tobytes() for image in same]
    for image in (own, other):
        assert [part.shape for part in image] == [part.shape for part in one]
        assert [part.tobytes() for part in image] != [part.tobytes() for part in one]


def test_illumination_is_that_of_the_built_world() -> None:
    assert build_world("low-texture", 2, None, 4, 1).illumination == illumination_and_movers("low-texture", 2, 1)[0]
    assert illumination_and_movers("low-texture", 2)[0] == 1.0 != illumination_and_movers("low-texture", 2, 1)[0]
