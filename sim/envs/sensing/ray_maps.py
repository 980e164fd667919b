"""Maps of many vehicles: what the rays of a depth camera have shown to be free or occupied, without rendering.

The rays of all environments are cast together through a lattice of the solids of the world, with cells of half the
side of those of the maps. They see what collides, and neither moving objects nor leaves that can be flown through. The
maps are exact: depth has no noise, and poses and mounting are the true ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import yaw_rad_from_matrix
from dronevio.sim.paths.solid_cells import SolidCells, solid_cells
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.world import solid_space

FINER = 2
"""Number of cells of the solids along a side of a cell of the maps."""
_SHOWN = np.zeros(3, np.float32)
_SHOWN[UNKNOWN], _SHOWN[FREE], _SHOWN[OCCUPIED] = 0.0, -1.0, 1.0


@dataclass(frozen=True)
class MapSettings(Settings):
    """Rays, cells and observed part of the map of an environment."""

    cell_m: Annotated[float, Range(0.05, 2.0)] = 0.25
    """Side of a cell [m]."""
    reach_m: Annotated[float, Range(0.5, 50.0)] = 4.0
    """Length of the rays [m]."""
    rays: Annotated[tuple[int, int], Range(1, 512)] = (24, 16)
    """Number of columns and rows of rays, evenly over the image of the rig's camera."""
    rate_hz: Annotated[float, Range(0.1, 1000.0)] = 5.0
    """Rate at which rays are cast, a fraction of that of the actions [Hz]."""
    side: Annotated[int, Range(1, 512)] = 32
    """Number of cells along a side of the observed part of the map, in whose middle the vehicle is."""
    layers: Annotated[int, Range(1, 64)] = 3
    """Number of observed layers, the middle one at the height of the vehicle."""
    layer_m: Annotated[float, Range(0.05, 10.0)] = 0.5
    """Distance between observed layers [m]."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the observed part of the map of one environment: layers, cells forward, cells to the left."""
        return self.layers, self.side, self.side


@lru_cache(maxsize=4)
def world_cells(world: str, world_seed: int, cell_m: float) -> SolidCells:
    """Return the solid cells of a world.

    Raises:
        ConfigError: The world is unknown.
    """
    return solid_cells(solid_space(world, world_seed), cell_m)


class RayMaps:
    """The maps of n environments, each with the extent of its world."""

    def __init__(
        self, count: int, solids: Sequence[SolidCells], camera: RigCamera, settings: MapSettings, period: int
    ) -> None:
        """Begin with unknown maps.

        Args:
            count: Number n of environments.
            solids: Solids of the worlds, with cells of half the side of those of the maps.
            camera: The camera whose lens the rays have.
            settings: Settings.
            period: Number of steps from one cast to the next.
        """
        self._settings, self._period = settings, period
        self._cell_m, self._low_m = solids[0].cell_m, np.stack([each.low_m for each in solids])
        self._extent = np.stack([each.high_m - each.low_m for each in solids]) / self._cell_m  # in cells of the solids
        shapes = np.array([each.is_solid.shape for each in solids])
        self._is_solid = np.zeros((len(solids), *shapes.max(axis=0)), np.bool_)  # the cells of all worlds
        for into, each in zip(self._is_solid, solids, strict=True):
            into[tuple(map(slice, each.is_solid.shape))] = each.is_solid
        self._shapes = -(-shapes // FINER)  # of the maps in each world
        self._T_imu_cam = camera.T_imu_cam
        columns, rows = settings.rays
        u, v = np.meshgrid(np.arange(columns), np.arange(rows))
        pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
        bearings = camera.model.resized(columns, rows).unproject(pixels)
        self._bearings = bearings[np.isfinite(bearings).all(axis=1)]
        self._shape = self._shapes.max(axis=0)
        self.states = np.full((count, *self._shape), UNKNOWN, np.uint8)
        """(n, X, Y, Z) States of the cells: `UNKNOWN`, `FREE` or `OCCUPIED`."""
        self.known_m3 = np.zeros(count)
        """(n,) Volumes of the known cells [m³]."""
        self._due_in, self._world = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.intp)

    def restart(self, mask: Mask, T_world_imu: Array, world: npt.NDArray[np.intp]) -> None:
        """Forget the maps in a mask (n,), and begin those of worlds (n,) with what is seen from poses (n, 4, 4)."""
        self._world = np.where(mask, world, self._world)
        self.states[mask], self.known_m3[mask] = UNKNOWN, 0.0
        self._see(np.flatnonzero(mask), T_world_imu)

    def advance(self, T_world_imu: Array) -> Array:
        """Return the newly observed volumes (n,) after a step to poses (n, 4, 4) [m³]; 0 where no rays are due."""
        self._due_in -= 1
        rows = np.flatnonzero(self._due_in <= 0)
        seen_m3 = np.zeros(len(self.states))
        seen_m3[rows] = self._see(rows, T_world_imu)
        return seen_m3

    def around(self, states: VehicleStates) -> Array:
        """Return the cells (n, L, N, N) around vehicles: 0 unknown, −1 free, 1 occupied or outside the world.

        Axes are layers from below, cells from behind to ahead, and cells from right to left, by the heading alone.
        """
        c, shape = self._settings, self._shape
        within = self._shapes[self._world].T[:, :, None, None]
        offset = (np.arange(c.side) - 0.5 * (c.side - 1)).astype(np.float32)
        yaw = yaw_rad_from_matrix(states.R_world_vehicle).astype(np.float32)[:, None, None]
        middle = ((states.position_m - self._low_m[self._world]) / c.cell_m).astype(np.float32)
        ahead, left = offset[:, None], offset
        x = np.floor(middle[:, 0, None, None] + np.cos(yaw) * ahead - np.sin(yaw) * left).astype(np.int32)
        y = np.floor(middle[:, 1, None, None] + np.sin(yaw) * ahead + np.cos(yaw) * left).astype(np.int32)
        heights = (np.arange(c.layers) - 0.5 * (c.layers - 1)) * c.layer_m / c.cell_m
        z = np.floor(middle[:, 2, None] + heights).astype(np.int32)
        outside = (x < 0) | (x >= within[0]) | (y < 0) | (y >= within[1])
        above = (z < 0) | (z >= within[2, :, 0])
        first = (np.arange(len(x)) * np.prod(shape))[:, None, None, None]
        column = ((x * shape[1] + y) * shape[2])[:, None]
        found = self.states.ravel().take(first + column + z[..., None, None], mode="clip")
        shown = _SHOWN[found]
        shown[np.broadcast_to(outside[:, None] | above[..., None, None], shown.shape)] = 1.0
        return np.asarray(shown)

    def save(self) -> dict[str, Any]:
        """Return the maps, as arrays of their own."""
        return {
            "states": self.states.copy(),
            "known_m3": self.known_m3.copy(),
            "due_in": self._due_in.copy(),
            "world": self._world,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to the maps of `save`."""
        self.states, self._due_in = saved["states"].copy(), saved["due_in"].copy()
        self.known_m3, self._world = saved["known_m3"].copy(), saved["world"]

    def _see(self, rows: npt.NDArray[np.intp], T_world_imu: Array) -> Array:
        """Cast the rays of some environments (k,), and return the volumes (k,) that become known [m³]."""
        if not rows.size:
            return np.zeros(0)
        self._due_in[rows] = self._period
        free, occupied = self._cast(T_world_imu[rows] @ self._T_imu_cam, self._world[rows])
        before = self.states[rows]
        after = np.where(occupied, np.uint8(OCCUPIED), before)
        after[free & (after == UNKNOWN)] = FREE
        self.states[rows] = after
        new = np.count_nonzero((before == UNKNOWN) & (after != UNKNOWN), axis=(1, 2, 3))
        seen_m3 = new * self._settings.cell_m**3
        self.known_m3[rows] += seen_m3
        return np.asarray(seen_m3)

    def _cast(self, T_world_cam: Array, world: npt.NDArray[np.intp]) -> tuple[Mask, Mask]:
        """Return through which cells (k, X, Y, Z) rays from poses (k, 4, 4) in worlds (k,) pass, and where they end."""
        k = len(T_world_cam)
        # Rays in units of cells of the solids, sampled at each of them
        origin = (T_world_cam[:, None, :3, 3] - self._low_m[world, None]) / self._cell_m
        direction = self._bearings @ T_world_cam[:, :3, :3].mT
        along = np.arange(0.5, self._settings.reach_m / self._cell_m, 1.0).astype(np.float32)
        # The place at which they leave the world; rays from outside see nothing
        extent = self._extent[world, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            leaves = np.abs(np.where(direction > 0.0, extent - origin, origin) / direction)
        is_within = np.all((origin >= 0.0) & (origin < extent), axis=-1)
        end = np.where(is_within, np.fmin.reduce(leaves, axis=-1), 0.0)
        fine = [
            (origin[..., axis, None].astype(np.float32) + direction[..., axis, None].astype(np.float32) * along).astype(
                np.int32
            )
            for axis in range(3)
        ]
        inside = along < end[..., None]
        _, nx, ny, nz = self._is_solid.shape
        first = (world * nx)[:, None, None]
        hit = self._is_solid.ravel().take(((first + fine[0]) * ny + fine[1]) * nz + fine[2], mode="clip") & inside
        # Samples before the first one in a solid are free
        is_hit = hit.any(axis=-1)
        last = np.where(is_hit, hit.argmax(axis=-1), len(along))
        passed = inside & (np.arange(len(along)) < last[..., None])
        # Cells of the maps, with one more for all other samples
        x, y, z = (axis // FINER for axis in fine)
        cells = int(np.prod(self._shape))
        index = (x * self._shape[1] + y) * self._shape[2] + z
        index += (np.arange(k) * cells)[:, None, None]
        free = np.zeros(k * cells + 1, np.bool_)
        free[np.where(passed, index, k * cells)] = True
        occupied = np.zeros(k * cells, np.bool_)
        rays = np.nonzero(is_hit)
        occupied[index[(*rays, last[rays])]] = True
        shape = (k, *self._shape)
        return free[:-1].reshape(shape), occupied.reshape(shape)
