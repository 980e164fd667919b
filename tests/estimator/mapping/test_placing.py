"""Submaps in the map frame: they move with their keyframes, and neither thin nor other obstacles become free."""

import numpy as np
import pytest

from dronevio.estimator.mapping.evidence import Evidence
from dronevio.estimator.mapping.log_odds import LEAST, MOST, LogOdds
from dronevio.estimator.mapping.placing import bounds, fused, placed
from dronevio.estimator.mapping.submap import LOG_ODDS_STEP, ActiveSubmap, Anchor, PackedSubmap, covering
from dronevio.estimator.mapping.submap_store import SubmapStore
from dronevio.models.arrays import Array
from dronevio.models.map_correction import MapCorrection
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z
from dronevio.models.state import Estimate, Health

CELL_M = 0.1
ANCHOR = Anchor(0, 0, 1000)


def random_submap(
    rng: np.random.Generator, number: int = 0, shape: tuple[int, int, int] = (20, 17, 13)
) -> PackedSubmap:
    """Return a submap with cells in all states around a random place."""
    values = rng.choice([0.0, LEAST, -0.4, MOST], size=shape, p=[0.3, 0.5, 0.1, 0.1]).astype(np.float32)
    low = rng.integers(-50, 50, 3)
    return PackedSubmap.of(Anchor(number, 0, 1000 * number), LogOdds(low, values))


def rigid(rng: np.random.Generator, tilt_rad: float = 0.03) -> Array:
    """Return a pose with any yaw and a small tilt."""
    R = rotation_z(rng.uniform(-3.0, 3.0)) @ exp_so3(tilt_rad * rng.normal(size=3))
    return pose_matrix(R, rng.normal(size=3))


def whole(*submaps: tuple[PackedSubmap, Array]) -> OccupancyGrid:
    """Return the map of submaps with their poses."""
    boxes = np.array([bounds(submap.low, submap.shape, T, CELL_M) for submap, T in submaps])
    return fused(submaps, boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0), CELL_M)


def test_a_packed_submap_has_the_same_cells() -> None:
    rng = np.random.default_rng(0)
    values = np.zeros((30, 31, 32), np.float32)
    values[3:9, 20:31, 5:7] = rng.uniform(LEAST, MOST, (6, 11, 2))
    box = LogOdds(np.array([-5, 7, 100]), values)
    packed = PackedSubmap.of(ANCHOR, box)
    assert packed.shape == (6, 11, 2) and packed.low.tolist() == [-2, 27, 105]
    np.testing.assert_allclose(packed.log_odds.values, values[3:9, 20:31, 5:7], atol=0.5 * LOG_ODDS_STEP + 1e-6)
    assert PackedSubmap.of(ANCHOR, None).steps.size == 0


def test_a_box_grows_with_its_evidence() -> None:
    rng, submap, found = np.random.default_rng(1), ActiveSubmap(ANCHOR, np.zeros(3)), dict[tuple[int, ...], float]()
    for _ in range(5):
        low, values = rng.integers(-40, 40, 3), rng.choice([-0.4, 0.85], (7, 5, 6)).astype(np.float32)
        submap.add(Evidence(low, values), np.zeros(3))
        for cell in np.ndindex(values.shape):
            key = tuple((low + cell).tolist())
            found[key] = np.clip(found.get(key, 0.0) + values[cell], LEAST, MOST)
    box = submap.log_odds
    assert box is not None
    assert covering(box, Evidence(box.low, np.ones((1, 1, 1), np.float32))) is box
    for key, value in found.items():
        assert box.values[tuple(np.array(key) - box.low)] == pytest.approx(value, abs=1e-5)
    assert np.count_nonzero(box.values) == np.count_nonzero(list(found.values()))


def test_a_submap_moves_exactly_with_its_keyframe() -> None:
    """By whole cells and a quarter turn, each cell is found again with its state."""
    submap = random_submap(np.random.default_rng(2))
    before, T = whole((submap, np.eye(4))), pose_matrix(np.rint(rotation_z(np.pi / 2)), np.array([1.2, -0.7, 0.3]))
    after = whole((submap, T))
    for state in (FREE, OCCUPIED):
        points = before.points(state)
        assert len(points) > 100 and after.frame == "map"
        assert np.all(after.at(points @ T[:3, :3].T + T[:3, 3]) == state)
        assert np.count_nonzero(after.states == state) == len(points)


def test_a_taken_back_correction_leaves_the_map_as_it_was() -> None:
    rng = np.random.default_rng(3)
    submaps = [random_submap(rng, number) for number in range(4)]
    Ts, wrong = [rigid(rng) for _ in submaps], [rigid(rng) for _ in submaps]
    before = whole(*zip(submaps, Ts, strict=True))
    whole(*zip(submaps, wrong, strict=True))
    after = whole(*zip(submaps, Ts, strict=True))
    assert before.states.tobytes() == after.states.tobytes() and np.array_equal(before.low_m, after.low_m)


def test_a_window_is_a_part_of_the_whole() -> None:
    rng = np.random.default_rng(4)
    submaps = [(random_submap(rng, number), rigid(rng)) for number in range(3)]
    grid = whole(*submaps)
    low = np.rint(grid.low_m / CELL_M).astype(np.int64)
    a, b = low + 5, low + np.array(grid.states.shape) - 7
    window = fused(submaps, a, b, CELL_M)
    assert np.array_equal(window.states, grid.states[5:-7, 5:-7, 5:-7]) and np.any(window.states == OCCUPIED)
    np.testing.assert_allclose(window.low_m, grid.low_m + 5 * CELL_M)


@pytest.mark.parametrize("seed", range(5))
def test_thin_obstacles_do_not_fall_between_cells(seed: int) -> None:
    """Every occupied cell is occupied where it is moved to, however the submap is turned."""
    rng = np.random.default_rng(seed)
    values = np.full((40, 40, 10), LEAST, np.float32)
    values[rng.integers(0, 40, 30), rng.integers(0, 40, 30)] = MOST  # poles as thin as a cell
    submap, T = PackedSubmap.of(ANCHOR, LogOdds(np.array([-20, 5, 0]), values)), rigid(rng)
    points = submap.log_odds.grid(CELL_M).points(OCCUPIED) @ T[:3, :3].T + T[:3, 3]
    assert np.all(whole((submap, T)).at(points) == OCCUPIED)


@pytest.mark.parametrize("occupied_last", [False, True])
def test_occupied_outweighs_free(occupied_last: bool) -> None:
    """What is seen as occupied by one submap is not free by another that disagrees, whichever is newer."""
    free, wall = (
        PackedSubmap.of(ANCHOR, LogOdds(np.zeros(3, np.int64), np.full((4, 4, 4), value, np.float32)))
        for value in (LEAST, MOST)
    )
    pair = [(free, np.eye(4)), (wall, np.eye(4))]
    states = whole(*(pair if occupied_last else pair[::-1])).states
    assert np.all(states != FREE) and np.all(states == OCCUPIED)


def test_what_has_moved_away_is_forgotten() -> None:
    free, wall = (
        (PackedSubmap.of(ANCHOR, LogOdds(np.zeros(3, np.int64), np.full((4, 4, 4), value, np.float32))), np.eye(4))
        for value in (LEAST, MOST)
    )
    assert np.all(whole(wall, free, free).states == UNKNOWN)
    assert np.all(whole(wall, free, free, free).states == FREE)
    assert np.all(whole(*(10 * [free]), wall).states == OCCUPIED)  # new obstacles at once


def test_a_submap_is_where_its_anchor_is() -> None:
    """At the anchor by its own track; by the newest correction while no keyframe of it is in the map."""
    T, other = rigid(np.random.default_rng(5)), rigid(np.random.default_rng(6))
    none = MapCorrection.empty()

    def newest(track: int, correction: MapCorrection | None, T_map_odom: Array | None) -> Estimate:
        return Estimate(0, Health.TRACKING, None, track=track, map_correction=correction, T_map_odom=T_map_odom)

    def at(track: int) -> MapCorrection:
        return MapCorrection(np.array([1000]), T[None], np.array([track]), np.array([0, 5000]))

    np.testing.assert_array_equal(placed(ANCHOR, newest(0, at(0), other)), T)
    np.testing.assert_array_equal(placed(ANCHOR, newest(1, at(0), other)), T)
    np.testing.assert_array_equal(placed(ANCHOR, newest(0, none, other)), other)
    assert placed(ANCHOR, newest(1, at(1), other)) is None  # lost, and not joined
    assert placed(ANCHOR, newest(0, none, None)) is None  # not yet localized in a saved map
    np.testing.assert_array_equal(placed(ANCHOR, newest(0, None, None)), np.eye(4))  # an odometry without a map
    assert placed(ANCHOR, newest(1, None, None)) is None


def test_memory_is_bounded_and_files_are_deleted() -> None:
    rng, limit_mb = np.random.default_rng(7), 0.05
    submaps, store = [random_submap(rng, number) for number in range(60)], SubmapStore(limit_mb)
    for submap in submaps:
        store.add(submap)
        assert store.memory_bytes <= limit_mb * 1e6
    assert len(store) == 60
    for submap, found in zip(submaps, store, strict=True):
        assert found.anchor == submap.anchor and np.array_equal(found.low, submap.low)
        assert np.array_equal(found.steps, submap.steps)
    assert store._folder is not None
    folder = store._folder
    assert 10 < len(list(folder.iterdir())) < 60 and not list(folder.glob("*.part*"))
    store.close()
    assert not folder.exists() and len(store) == 0


def test_files_are_deleted_with_the_last_reference() -> None:
    store = SubmapStore(0.0)
    store.add(random_submap(np.random.default_rng(8)))
    assert store._folder is not None
    folder = store._folder
    assert list(folder.iterdir())
    del store
    assert not folder.exists()
