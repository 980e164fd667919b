"""Grid of clearances of a world, by which contacts are left out where a vehicle can touch nothing."""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.sim.paths.space import Space

Indices = npt.NDArray[np.intp]

WITHOUT_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
"""Flag that disables contacts."""
_CELL_M = 0.2
_BLOCK = 4  # cells along each axis that are evaluated together
_PADDING_M = 1.0  # of the grid around all boxes
_SLACK_M = 0.05  # for the acceleration in an interval: 1000 m/s² for 10 ms
_BLOCK_OFFSETS_M = (np.indices((_BLOCK,) * 3).reshape(3, -1).T + 0.5) * _CELL_M


class ClearanceGrid:
    """Lengths of the way of a vehicle from the middle of each cell to a contact with the static geoms of a world.

    In the search for contacts, MuJoCo descends its tree of all geoms at each step, which takes as long as the rest of
    the physics in a world of some hundred geoms. Where nothing can be touched in an interval, it is left out, and the
    motion remains the same. Cells are evaluated in blocks, when a vehicle is in one for the first time. Boxes and
    planes are exact, other shapes are replaced by their bounding boxes. Outside the grid, all boxes are farther away
    than its padding.
    """

    def __init__(self, model: mujoco.MjModel, interval_s: float, *, with_planes: bool = True) -> None:
        """Take a model.

        Args:
            model: Model of a vehicle among static geoms.
            interval_s: Length of an interval [s].
            with_planes: Whether planes are counted.
        """
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        static = model.geom_bodyid != model.body("quadrotor").id
        is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        boxes, planes = static & ~is_plane, static & is_plane & with_planes
        rotations = data.geom_xmat.reshape(-1, 3, 3)
        self._points, self._normals = data.geom_xpos[planes], rotations[planes, :, 2]
        local, halves = model.geom_aabb[boxes, :3], model.geom_aabb[boxes, 3:]
        centres = data.geom_xpos[boxes] + (rotations[boxes] @ local[..., None])[..., 0]
        unbounded = np.full(3, np.inf)
        self._boxes = Space(-unbounded, unbounded, centres, halves, rotations[boxes].copy())
        extents = (np.abs(rotations[boxes]) @ halves[..., None])[..., 0]
        self.low = (centres - extents).min(axis=0, initial=np.inf) - _PADDING_M
        """(3,) Lower corner of the grid [m]; infinite without boxes."""
        high = (centres + extents).max(axis=0, initial=-np.inf) + _PADDING_M
        blocks = np.ceil((high - self.low) / (_BLOCK * _CELL_M)) if boxes.any() else np.zeros(3)
        self.shape = blocks.astype(np.intp) * _BLOCK
        """(3,) Numbers of cells along each axis."""
        self._way_m = np.full(self.shape, np.nan, dtype=np.float32)
        self._padding_m = _PADDING_M if boxes.any() else np.inf
        self._taken_m = reach_m(model) + _SLACK_M
        self.way_per_speed_s = 2.0 * interval_s
        """Longest way in an interval per speed at its start [s]."""

    def keep_in(self, ways_m: npt.NDArray[np.float32]) -> None:
        """Keep the ways in an array of as many values as there are cells, which are not yet known."""
        self._way_m = ways_m.reshape(self.shape)

    def clears(self, position: Array, velocity: Array) -> bool:
        """Return whether a vehicle touches nothing during an interval, whatever the forces.

        Args:
            position: (3,) Position at its start [m].
            velocity: (3,) Velocity at its start [m/s].
        """
        x, y, z = ((position - self.low) / _CELL_M).tolist()
        across, along, up = self.shape.tolist()
        if 0.0 <= x < across and 0.0 <= y < along and 0.0 <= z < up:
            i, j, k = int(x), int(y), int(z)
            if math.isnan(self._way_m[i, j, k]):
                self.evaluate(np.array([i, j, k]) // _BLOCK)
            off_middle = math.hypot(x - i - 0.5, y - j - 0.5, z - k - 0.5)
            way = float(self._way_m[i, j, k]) - _CELL_M * off_middle
        else:
            way = float(self.outside_m(position[None])[0])
        return way > self.way_per_speed_s * math.hypot(*velocity.tolist())

    def outside_m(self, points: Array) -> Array:
        """Return the ways from points (k, 3) outside the grid."""
        return np.minimum(self._padding_m, self._above_planes(points)) - self._taken_m

    def _above_planes(self, points: Array) -> Array:
        """Return the distances of points (k, 3) to the nearest plane [m]; negative below it."""
        distances = np.einsum("kpi,pi->kp", points[:, None] - self._points, self._normals)
        return np.asarray(distances.min(axis=1, initial=np.inf))

    def evaluate(self, block: npt.NDArray[np.intp]) -> None:
        """Evaluate the cells of a block (3,)."""
        centres = self.low + block * (_BLOCK * _CELL_M) + _BLOCK_OFFSETS_M
        clearance = np.minimum(self._boxes.clearance(centres), self._above_planes(centres))
        i, j, k = block * _BLOCK
        shape = (_BLOCK,) * 3
        self._way_m[i : i + _BLOCK, j : j + _BLOCK, k : k + _BLOCK] = (clearance - self._taken_m).reshape(shape)


class ClearanceGrids:
    """Clearance grids of several worlds, for many vehicles at once.

    The cells of all grids are in one array, of which each grid has a part.
    """

    def __init__(self, grids: Sequence[ClearanceGrid]) -> None:
        """Take the grids, of one length of the interval."""
        self._grids = tuple(grids)
        self._low, self._shape = (np.array([getattr(grid, name) for grid in grids]) for name in ("low", "shape"))
        sizes = self._shape.prod(axis=1)
        self._first = np.cumsum(sizes) - sizes
        self._ways_m = np.full(sizes.sum(), np.nan, dtype=np.float32)
        for grid, first, size in zip(grids, self._first, sizes, strict=True):
            grid.keep_in(self._ways_m[first : first + size])

    def clear(self, position: Array, velocity: Array, world: Indices) -> Mask:
        """Return which of k vehicles touch nothing during an interval, whatever the forces.

        Args:
            position: (3, k) Positions at its start [m].
            velocity: (3, k) Velocities at its start [m/s].
            world: (k,) Indices of their worlds.
        """
        cell, shape = (position.T - self._low[world]) / _CELL_M, self._shape[world]
        inside = ((cell >= 0.0) & (cell < shape)).all(axis=1)  # false for NaN
        cell, shape, own = cell[inside], shape[inside], world[inside]
        cells = cell.astype(np.intp)
        index = self._first[own] + (cells[:, 0] * shape[:, 1] + cells[:, 1]) * shape[:, 2] + cells[:, 2]
        way = self._ways_m[index]
        if np.isnan(way).any():
            unknown = np.isnan(way)
            for number, *block in np.unique(np.column_stack([own, cells // _BLOCK])[unknown], axis=0):
                self._grids[number].evaluate(np.array(block))
            way = self._ways_m[index]
        off_middle = cell - cells - 0.5
        ways, outside = np.empty(len(inside)), ~inside
        ways[inside] = way - _CELL_M * np.sqrt(np.einsum("ki,ki->k", off_middle, off_middle))
        for number in np.unique(world[outside]):
            rows = outside & (world == number)
            ways[rows] = self._grids[number].outside_m(position.T[rows])
        return np.asarray(ways > self._grids[0].way_per_speed_s * np.linalg.norm(velocity, axis=0))


def reach_m(model: mujoco.MjModel) -> float:
    """Return the radius of a ball around the vehicle of a model, centred at its origin [m]."""
    own = model.geom_bodyid == model.body("quadrotor").id
    return float((np.linalg.norm(model.geom_pos[own], axis=1) + model.geom_rbound[own]).max())
