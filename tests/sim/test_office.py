"""World office: rooms and doors by the plan, and free space that connects all of them."""

import numpy as np
import pytest
from scipy.ndimage import label

from dronevio.models.arrays import Array
from dronevio.sim.streams import generator
from dronevio.sim.world import flight_area, solid_space
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M
from dronevio.sim.worlds.office import OFFICE, OFFICE_WHITE
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


@pytest.mark.parametrize(("world", "seed"), [("office", 0), ("office", 1), ("office", 2), ("office-narrow", 0)])
def test_a_drone_flies_from_each_room_to_each_other(world: str, seed: int) -> None:
    plan, (low, parts) = plan_of(seed), free_components(world, seed)

    def part_at(place: Array) -> int:
        return int(parts[tuple(np.rint((place - low) / STEP_M).astype(int))])

    pad = part_at(plan.pad[:2])
    assert pad > 0
    for area in (*plan.rooms, *plan.stubs, *plan.ring):
        assert part_at(area.middle) == pad
    assert all(part_at(door) == pad for door in plan.doors)


def test_rooms_are_entered_by_doors_only() -> None:
    plan, space = plan_of(3), solid_space("office", 3)
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


@pytest.mark.parametrize(("world", "width_m"), [("office", 1.2), ("office-narrow", 0.9)])
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
