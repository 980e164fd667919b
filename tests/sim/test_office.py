"""World office: rooms and doors by the plan, and free space that connects all of them."""

import numpy as np
import pytest
from scipy.ndimage import label

from dronevio.models.arrays import Array
from dronevio.models.rotation import pose_matrix
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box
from dronevio.sim.paths.space import Space
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.streams import generator
from dronevio.sim.world import flight_area, solid_space
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M, Layout
from dronevio.sim.worlds.office import OFFICE, OFFICE_GLASS, OFFICE_WHITE
from dronevio.sim.worlds.office_plan import EAST, SOUTH, Plan, drawn_plan

STEP_M = 0.1
HEIGHT_M = 1.6
RADIUS_M = 0.35


def plan_of(seed: int) -> Plan:
    """Return the plan of the world of a seed."""
    return drawn_plan(generator(seed, "layout"))


def free_components(world: str, seed: int) -> tuple[Array, Array]:
    """Return the lower corner of a grid (2,) [m] and the connected parts (N, M) at flight height; 0 is not free.

    A drone of 0.7 m fits wherever a part is not 0.
    """
    space = solid_space(world, seed)
    xs, ys = (np.arange(a, b, STEP_M) for a, b in zip(space.low[:2], space.high[:2], strict=True))
    points = np.stack([*np.meshgrid(xs, ys, indexing="ij"), np.full((len(xs), len(ys)), HEIGHT_M)], axis=-1)
    return space.low[:2], label(space.clearance(points) >= RADIUS_M)[0]


@pytest.mark.parametrize(
    ("world", "seed"), [("office", 0), ("office", 1), ("office", 2), ("office-narrow", 0), ("office-glass", 1)]
)
def test_a_drone_flies_from_each_room_to_each_other(world: str, seed: int) -> None:
    plan, (low, parts) = plan_of(seed), free_components(world, seed)

    def part_at(place: Array) -> int:
        return int(parts[tuple(np.rint((place - low) / STEP_M).astype(int))])

    pad = part_at(plan.pad[:2])
    assert pad > 0
    for area in (*plan.rooms, *plan.stubs, *plan.ring):
        assert part_at(area.middle) == pad
    assert all(part_at(door) == pad for door in plan.doors)


@pytest.mark.parametrize("world", ["office", "office-glass"])
def test_rooms_are_entered_by_doors_only(world: str) -> None:
    plan, space = plan_of(3), solid_space(world, 3)
    for room in plan.rooms:
        for part in room.partitions:
            wall = room.wall(part.side)
            x = np.arange(-0.5 * wall.length_m + 0.02, 0.5 * wall.length_m, 0.05)
            inside = np.array([wall.at(u, -0.07, HEIGHT_M) for u in x])
            doors = np.array([*plan.openings(wall), np.inf])
            from_door = np.abs(x[:, None] - doors).min(axis=1)
            clear = space.clearance(inside) > 0.0
            np.testing.assert_array_equal(
                clear[np.abs(from_door - 0.6) > 0.02], (from_door < 0.6)[np.abs(from_door - 0.6) > 0.02]
            )


@pytest.mark.parametrize(("world", "width_m"), [("office", 1.2), ("office-narrow", 0.9), ("office-glass", 1.2)])
def test_doors_have_their_width(world: str, width_m: float) -> None:
    middles = np.column_stack([plan_of(4).doors, np.full(len(plan_of(4).doors), 1.2)])
    np.testing.assert_allclose(2.0 * solid_space(world, 4).clearance(middles), width_m, atol=0.003)


def test_plans_have_many_rooms_loops_and_dead_ends() -> None:
    counts = set()
    for seed in range(60):
        plan = plan_of(seed)
        counts.add(len(plan.rooms))
        entrances = np.array([sum(len(plan.openings(room.wall(side))) for side in range(4)) for room in plan.rooms])
        assert entrances.min() >= 1
        assert (entrances == 2).sum() == 5  # two in each strip and one in the core
        assert all(np.ptp([room.low[k], room.high[k]]) > 3.0 for room in plan.rooms for k in (0, 1))
        assert len(plan.stubs) == 2
    assert counts == set(range(7, 13))


def test_partitions_name_the_room_behind_them() -> None:
    rooms = plan_of(5).rooms
    for room in rooms:
        for part in room.partitions:
            if part.back is not None:
                assert part.side == EAST
                np.testing.assert_allclose(rooms[part.back].low - [room.high[0], room.low[1]], [0.14, 0.0])
            assert part.side != EAST or EAST not in room.facades
        assert SOUTH in room.facades or any(part.side == SOUTH for part in room.partitions)


def test_the_route_enters_rooms_if_doors_let_it_pass() -> None:
    wide, narrow = flight_area("office", 0), flight_area("office-narrow", 0)
    assert np.abs(wide.route[:, 1]).max() > 6.0 > 4.0 > np.abs(narrow.route[:, 1]).max()
    legs = np.roll(narrow.route, -1, axis=0) - narrow.route
    along = narrow.route[:, None] + np.linspace(0.0, 1.0, 200)[:, None] * legs[:, None]
    assert narrow.space.clearance(along).min() >= ROUTE_CLEARANCE_M


def test_white_walls_stand_where_the_others_do() -> None:
    painted, white = (world.layout(generator(0, "layout")) for world in (OFFICE, OFFICE_WHITE))
    walls = [[box for box in layout.boxes if box.instance.kind == "wall"] for layout in (painted, white)]
    places, in_white = ([box.centre for box in boxes] for boxes in walls)
    np.testing.assert_array_equal(places, in_white)
    contrast, white_contrast = (boxes[0].paint(np.random.default_rng(0), 200, 200)[..., 1].std() for boxes in walls)
    assert white_contrast < 2.0 < 5.0 < contrast


def glass_of(seed: int) -> tuple[Layout, tuple[Box, ...]]:
    """Return the layout of the office with walls of glass, and its panes."""
    layout = OFFICE_GLASS.layout(generator(seed, "layout"))
    assert {box.instance.kind for box in layout.filling} == {"glass"}
    return layout, layout.filling


def test_panes_are_solid_and_not_seen() -> None:
    layout, panes = glass_of(0)
    space, caster = solid_space("office-glass", 0), RayCaster("office-glass", 0)
    assert "glass" not in {box.instance.kind for box in layout.boxes}
    assert len(panes) > 6
    for pane in panes:
        np.testing.assert_allclose([pane.centre[2] - pane.half[2], pane.centre[2] + pane.half[2]], [0.0, 2.1])
        along, across = pane.R[:, 0], pane.R[:, 1]
        x = np.linspace(-0.95, 0.95, 60) * pane.half[0]
        places = pane.centre + x[:, None] * along + [0.0, 0.0, 0.02]  # between the stripes
        assert space.clearance(places).max() < 0.0
        poses = [pose_matrix(np.eye(3), place - 0.1 * across) for place in places]
        ranges = caster.ranges_m(np.array(poses), across[None])[:, 0]
        assert np.median(ranges) > 0.5 and (ranges < 0.1).any()  # there are posts


def test_half_of_the_walls_of_glass_have_stripes() -> None:
    layout, _ = glass_of(2)
    frames: dict[Instance, list[Box]] = {}
    for box in layout.boxes:
        if box.instance.kind == "glass_frame":
            frames.setdefault(box.instance, []).append(box)
    marked = [any(box.half[1] < 0.01 for box in boxes) for boxes in frames.values()]
    assert 0.25 < np.mean(marked) < 0.75
    heights = {round(float(box.centre[2]), 3) for boxes in frames.values() for box in boxes if box.half[1] < 0.01}
    assert heights == {0.55, 1.4}


@pytest.mark.parametrize("seed", range(4))
def test_nothing_hangs_on_glass(seed: int) -> None:
    layout, panes = glass_of(seed)
    around = Space(
        layout.low - 100.0,
        layout.high + 100.0,
        np.array([pane.centre for pane in panes]),
        np.array([pane.half for pane in panes]),
        np.array([pane.R for pane in panes]),
    )
    hung = [box.centre for box in layout.boxes if box.instance.kind in ("hung_picture", "board", "posters", "window")]
    assert len(hung) > 20
    assert around.clearance(np.array(hung)).min() > 0.2


def test_walls_of_glass_leave_the_plan() -> None:
    painted, glass = (world.layout(generator(0, "layout")) for world in (OFFICE, OFFICE_GLASS))
    doors = [[box.centre for box in layout.boxes if box.instance.kind == "door_frame"] for layout in (painted, glass)]
    np.testing.assert_array_equal(doors[0], doors[1])
    np.testing.assert_array_equal(painted.route, glass.route)
    masonry = [sum(8.0 * b.half.prod() for b in x.boxes if b.instance.kind == "wall") for x in (painted, glass)]
    assert 0.4 < masonry[1] / masonry[0] < 0.9
