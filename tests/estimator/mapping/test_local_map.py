"""The rolling local map: what it remembers, and when it forgets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.mapping.evidence import Evidence, evidence
from dronevio.estimator.mapping.local_map import LocalMap
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.estimator.mapping.scenes import image, pose, wall, with_box

LOW, HIGH = np.array([-0.3, -0.3, 1.62]), np.array([0.3, 0.3, 2.2])
HERE = pose((0.0, 0.0, 0.0))
EMPTY = evidence(image(wall(3.5), HERE, 0.03), 0.1, 4.0)
BLOCKED = evidence(image(with_box(wall(3.5), LOW, HIGH), HERE, 0.03), 0.1, 4.0)
ON_THE_BOX = np.array([1.65, 0.05, 0.05])


def updates_until(local: LocalMap, found: Evidence, state: int) -> int:
    for count in range(1, 50):
        local.add(found)
        if local.grid().at(ON_THE_BOX) == state:
            return count
    raise AssertionError("never")


def test_moving_things_are_mapped_and_forgotten() -> None:
    local = LocalMap(0.1)
    assert updates_until(local, EMPTY, FREE) == 2
    for _ in range(100):
        local.add(EMPTY)
    assert updates_until(local, BLOCKED, OCCUPIED) <= 3
    for _ in range(100):  # however long it stood there
        local.add(BLOCKED)
    assert updates_until(local, EMPTY, FREE) <= 12


def test_contradictory_cells_are_unknown() -> None:
    local = LocalMap(0.1)
    seen = set()
    for _ in range(30):
        local.add(BLOCKED)
    for _ in range(30):
        local.add(EMPTY)
        seen.add(int(local.grid().at(ON_THE_BOX)))
    assert seen == {OCCUPIED, UNKNOWN, FREE}


def test_it_moves_by_whole_cells_with_the_drone() -> None:
    local = LocalMap(0.1)
    for position in np.linspace([0.0, 0.0, 0.0], [7.03, -3.01, 1.77], 60):
        local.centre_on(position)
        grid = local.grid()
        np.testing.assert_allclose(grid.low_m / 0.1, np.rint(grid.low_m / 0.1), atol=1e-9)
        assert np.all(np.abs(0.5 * (grid.low_m + grid.high_m) - position) <= 0.5 + 0.1 + 1e-9)
    np.testing.assert_array_equal(grid.states.shape, (80, 80, 40))


@given(st.tuples(*[st.integers(-100, 100)] * 3))
@settings(max_examples=40, deadline=None)
def test_cells_that_stay_in_the_box_are_kept_and_others_forgotten(cells: tuple[int, int, int]) -> None:
    local = LocalMap(0.1)
    for _ in range(3):
        local.add(BLOCKED)
    before = local.grid()
    local.centre_on(0.1 * (np.array(cells) + 0.5))
    there = local.grid()
    local.centre_on(np.array([0.05, 0.05, 0.05]))
    after = local.grid()
    centres = before.centres(np.argwhere(before.states != UNKNOWN))
    kept = np.all((centres > there.low_m) & (centres < there.high_m), axis=1)
    np.testing.assert_array_equal(there.at(centres), np.where(kept, before.at(centres), UNKNOWN))
    shift = np.rint((after.low_m - there.low_m) / 0.1)
    np.testing.assert_array_equal(after.at(centres), np.where(kept | ~shift.any(), before.at(centres), UNKNOWN))


@pytest.mark.parametrize("cell_m", [0.05, 0.1, 0.2])
def test_its_extent_does_not_depend_on_the_cells(cell_m: float) -> None:
    grid = LocalMap(cell_m).grid()
    np.testing.assert_allclose(grid.high_m - grid.low_m, [8.0, 8.0, 4.0])
    assert np.all(grid.states == UNKNOWN)


def test_its_distances_are_those_of_the_wall() -> None:
    local = LocalMap(0.1)
    for _ in range(3):
        local.add(EMPTY)
    field = local.distance_field(unknown_is_obstacle=False)
    i, j, k = np.floor((np.array([2.05, 0.05, 0.05]) - field.low_m) / 0.1).astype(int)
    assert field.distance_m[i, j, k] == pytest.approx(1.4, abs=0.11)
