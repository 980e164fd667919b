"""The growing dense map in rerun: what is logged, and where."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dronevio.eval.rerun.dense_map import ABOVE, HEADROOM_M, SUBMAPS, DenseMapLog
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.occupancy import OCCUPIED, OccupancyGrid, PlacedSubmap
from dronevio.models.state import Estimate, Health

CAMERA = Pinhole(16, 12, np.array([[10.0, 0.0, 7.5], [0.0, 10.0, 5.5], [0.0, 0.0, 1.0]]))
HEIGHT_M = 1.0


class Calls:
    """A sink that lists which entities are logged by which method."""

    def __init__(self) -> None:
        """Begin without any."""
        self.of: list[tuple[str, str]] = []

    def __getattr__(self, method: str) -> Callable[..., None]:
        """Return what notes the name of an entity."""
        return lambda entity, *_: self.of.append((method, entity))


def added(log: DenseMapLog, t_s: int, states: Array, T_map_odom: Array, sink: Calls) -> list[tuple[str, str]]:
    """Add a depth image with a submap, and return what is logged of submaps."""
    sink.of = []
    shape, T = (12, 16), np.eye(4)
    T[2, 3] = HEIGHT_M
    depth = DepthImage(
        t_s * 10**9, CAMERA, T, np.ones(shape, np.float32), np.ones(shape, np.float32), np.zeros(shape, np.uint8)
    )
    grid = OccupancyGrid(np.zeros(3), 0.1, states.astype(np.uint8))
    submap = PlacedSubmap(3, 0, 0, T_map_odom, grid)
    log.depth(depth, Estimate(depth.t_ns, Health.TRACKING, None), lambda: [submap])
    return [call for call in sink.of if call[1].startswith((SUBMAPS, ABOVE))]


def test_cells_above_the_flight_are_apart_and_only_changes_are_logged() -> None:
    sink: Any = Calls()
    log, states, moved = DenseMapLog(sink), np.zeros((2, 2, 30)), np.eye(4)
    states[0, 0, [2, 29]] = OCCUPIED  # below the camera, and a ceiling
    parts = {f"{parent}/3" for parent in (SUBMAPS, ABOVE)}
    first = added(log, 0, states, np.eye(4), sink)
    assert {entity for method, entity in first if method == "poses"} == parts
    assert {entity for method, entity in first if method == "columns"} == {f"{part}/cells" for part in parts}
    assert added(log, 2, states, np.eye(4), sink) == []
    states[1, 1, int((HEIGHT_M + HEADROOM_M) / 0.1) + 2] = OCCUPIED
    assert added(log, 4, states, np.eye(4), sink) == [("columns", f"{ABOVE}/3/cells")]
    moved[0, 3] = 0.5
    assert added(log, 6, states, moved, sink) == [("poses", f"{SUBMAPS}/3"), ("poses", f"{ABOVE}/3")]
