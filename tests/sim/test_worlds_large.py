"""Large worlds: clear routes, collision boxes of visible objects, and gates on the route."""

import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.sim.appearance.cutouts import joined
from dronevio.sim.appearance.solids import Box
from dronevio.sim.paths.space import Space
from dronevio.sim.worlds import forest, gates, hall
from dronevio.sim.worlds.assembly import space_of
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M, Layout, WorldBuilder

WORLDS = {"hall": hall.HALL, "forest": forest.FOREST, "gates": gates.GATES}
SEEDS = range(6)


def layout_of(builder: WorldBuilder, seed: int) -> Layout:
    """Return a world's layout."""
    return builder.layout(np.random.default_rng(seed))


def points_along(route: Array) -> Array:
    """Return points (N, 3) every 5 cm or less along the closed route (R, 3)."""
    legs = np.roll(route, -1, axis=0) - route
    count = int(np.linalg.norm(legs, axis=1).max() / 0.05) + 1
    return np.asarray((route[:, None] + np.linspace(0.0, 1.0, count)[:, None] * legs[:, None]).reshape(-1, 3))


def unbounded_space(layout: Layout) -> Space:
    """Return the space of the obstacles, with distant bounds."""
    space = space_of(layout)
    return Space(layout.low - 100.0, layout.high + 100.0, space.centres, space.halves, space.rotations)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", WORLDS)
def test_the_route_is_clear_and_starts_above_the_pad(name: str, seed: int) -> None:
    layout = layout_of(WORLDS[name], seed)
    assert space_of(layout).clearance(points_along(layout.route)).min() >= ROUTE_CLEARANCE_M
    np.testing.assert_allclose(layout.route[0, :2], layout.pad[:2])
    assert len(layout.route) >= 8
    assert np.linalg.norm(np.ptp(layout.route[:, :2], axis=0)) > 20.0


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", WORLDS)
def test_the_free_box_is_free_above_the_pad(name: str, seed: int) -> None:
    layout = layout_of(WORLDS[name], seed)
    low, high = layout.free_box
    axes = [np.linspace(a, b, max(int((b - a) / 0.25), 2)) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)
    assert unbounded_space(layout).clearance(grid).min() > 0.0
    np.testing.assert_allclose(layout.free_box.mean(axis=0)[:2], layout.pad[:2], atol=1e-9)
    assert (low >= layout.low).all()
    assert (high <= layout.high).all()


@pytest.mark.parametrize("name", WORLDS)
def test_layouts_are_determined_by_the_seed(name: str) -> None:
    def places(seed: int) -> Array:
        layout = layout_of(WORLDS[name], seed)
        return np.concatenate([layout.route, [box.centre for box in layout.obstacles]])

    first, again, other = places(3), places(3), places(4)
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or not np.allclose(first, other)


def inside(layout: Layout, points: Array) -> Array:
    """Return the points (M, 3) of (…, 3) that are well within the bounds of a world."""
    flat = points.reshape(-1, 3)
    return flat[np.all((flat > layout.low + 0.08) & (flat < layout.high - 0.08), axis=1)]


def test_visible_surfaces_of_the_hall_have_collision_boxes() -> None:
    layout = layout_of(hall.HALL, 1)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    on_boxes = [box.centre + corners * box.half @ box.R.T for box in layout.boxes]
    on_sheets = [sheet.grid for sheet in layout.shell[6:]]
    seen = np.concatenate([inside(layout, points) for points in (*on_boxes, *on_sheets)])
    assert len(seen) > 2000
    assert unbounded_space(layout).clearance(seen).max() < 0.07


def test_visible_trunks_have_collision_boxes() -> None:
    layout = layout_of(forest.FOREST, 1)
    wood = inside(layout, joined(layout.prints[0].cutouts).corners)
    assert len(wood) > 300
    assert unbounded_space(layout).clearance(wood).max() < 0.02


def test_visible_leaves_have_collision_boxes() -> None:
    layout = layout_of(forest.FOREST, 1)
    leaves = inside(layout, joined(layout.prints[1].cutouts).corners)
    upper = leaves[leaves[:, 2] > 0.75]  # ferns below this height have no collision boxes
    assert len(upper) > 20
    assert unbounded_space(layout).clearance(upper).max() < 0.02


@pytest.mark.parametrize("seed", SEEDS)
def test_the_route_passes_the_centre_of_every_gate(seed: int) -> None:
    layout = layout_of(gates.GATES, seed)
    space = unbounded_space(layout)
    entries, exits = layout.route[1::2], layout.route[2::2]
    assert len(entries) == len(exits) >= 8
    for entry, exit_ in zip(entries, exits, strict=True):
        middle, ahead = 0.5 * (entry + exit_), (exit_ - entry) / np.linalg.norm(exit_ - entry)
        side = np.cross([0.0, 0.0, 1.0], ahead)
        distance = np.linspace(0.7, 1.6, 91)[:, None]
        left, right = (space.clearance(middle + s * distance * side) < 0.0 for s in (1.0, -1.0))
        above = space.clearance(middle + distance * [0.0, 0.0, 1.0]) < 0.0
        assert left.any()
        assert right.any()
        assert above.any()
        np.testing.assert_allclose(left.argmax(), right.argmax(), atol=1)


def test_gates_are_surrounded_by_flags_and_bales() -> None:
    layout = layout_of(gates.GATES, 0)
    frames: list[Box] = [box for box in layout.obstacles if box.pixels_per_m >= 150.0]
    assert len(layout.obstacles) > len(frames) + 20
