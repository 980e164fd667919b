"""Range beams: distances along rays fixed to each vehicle, as multi-zone time-of-flight sensors and lidars have them.

Rays are cast by MuJoCo through the solids of the world, which see what collides: neither moving objects, nor leaves
that can be flown through, nor the vehicle itself. Nothing is rendered.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from dronevio.models.arrays import Array, Mask
from dronevio.models.ranges import Range, Settings
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.world import collision_spec


@dataclass(frozen=True)
class BeamSettings(Settings):
    """Directions, reach and errors of the beams; by default those of a sensor of 8 × 8 zones such as the VL53L5CX."""

    beams: Annotated[tuple[int, int], Range(1, 512)] = (8, 8)
    """Number of columns and rows."""
    field_deg: Annotated[tuple[float, float], Range(0.0, 360.0)] = (45.0, 45.0)
    """Width and height of the field of view, which the beams divide evenly; a width of 360 is a full circle [deg]."""
    reach_m: Annotated[float, Range(above=0.0, high=1000.0)] = 4.0
    """Largest distance; what is farther away, or lost, has this value [m]."""
    rate_hz: Annotated[float, Range(0.1, 1000.0)] = 10.0
    """Rate of the measurements, a fraction of that of the actions [Hz]."""
    sigma_m: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Standard deviation of a distance near the sensor [m]."""
    relative_sigma: Annotated[float, Range(0.0, 1.0)] = 0.02
    """Standard deviation in proportion to the distance, which is added to the other in quadrature."""
    lost: Annotated[float, Range(0.0, 1.0)] = 0.01
    """Probability that a measurement is lost."""
    position_m: Annotated[tuple[float, float, float], Range(-10.0, 10.0)] = (0.0, 0.0, 0.0)
    """Place of the sensor in the vehicle frame [m]."""
    yaw_deg: Annotated[float, Range(-360.0, 360.0)] = 0.0
    """Direction of the middle of the field of view, from ahead to the left [deg]."""
    pitch_deg: Annotated[float, Range(-90.0, 90.0)] = 0.0
    """Direction of the middle of the field of view, downwards [deg]."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the measurements of one vehicle: rows from above, columns from the left."""
        return self.beams[1], self.beams[0]

    @property
    def directions(self) -> Array:
        """(rows · columns, 3) Unit vectors of the beams in the vehicle frame."""
        azimuth, elevation = (
            np.radians(extent) * (0.5 - (np.arange(count) + 0.5) / count)
            for extent, count in zip(self.field_deg, self.beams, strict=True)
        )
        el, az = (angle.ravel() for angle in np.meshgrid(elevation, azimuth, indexing="ij"))
        in_sensor = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=1)
        turned = Rotation.from_euler("ZY", [self.yaw_deg, self.pitch_deg], degrees=True)
        return np.asarray(turned.apply(in_sensor))


DEFAULT_BEAMS = BeamSettings()
"""The settings of 8 × 8 zones."""


@lru_cache(maxsize=4)
def _solids(world: str, world_seed: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the compiled solids of a world."""
    model = collision_spec(world, world_seed).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


class RangeBeams:
    """The range sensors of n vehicles."""

    def __init__(self, count: int, world: str, seeds: Sequence[int], settings: BeamSettings, period: int) -> None:
        """Compile the solids of the worlds.

        Args:
            count: Number n of vehicles.
            world: Name of the worlds.
            seeds: Seeds of the worlds.
            settings: Settings.
            period: Number of steps from one measurement to the next.
        """
        self._solids, self._settings, self._period = [_solids(world, seed) for seed in seeds], settings, period
        self._position_m, self._directions = np.array(settings.position_m), settings.directions
        self._due_in, self._world = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.intp)
        self._rng = np.random.default_rng(0)
        self.ranges_m = np.full((count, *settings.shape), settings.reach_m)
        """(n, rows, columns) Newest measurements [m]."""

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw the errors from a stream of another generator from now on."""
        self._rng = rng.spawn(1)[0]

    def restart(self, mask: Mask, states: VehicleStates, world: npt.NDArray[np.intp]) -> None:
        """Measure in a mask (n,) of vehicles at once, which are now in worlds of given indices (n,)."""
        self._world = np.where(mask, world, self._world)
        self._measure(np.flatnonzero(mask), states)

    def advance(self, states: VehicleStates) -> None:
        """Measure after a step, where a measurement is due."""
        self._due_in -= 1
        self._measure(np.flatnonzero(self._due_in <= 0), states)

    def save(self) -> dict[str, Any]:
        """Return the state, as arrays of its own."""
        return {
            "ranges_m": self.ranges_m.copy(),
            "due_in": self._due_in.copy(),
            "world": self._world,
            "rng": self._rng.bit_generator.state,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`."""
        self.ranges_m, self._due_in = saved["ranges_m"].copy(), saved["due_in"].copy()
        self._world = saved["world"]
        self._rng.bit_generator.state = saved["rng"]

    def _measure(self, rows: npt.NDArray[np.intp], states: VehicleStates) -> None:
        """Renew the measurements of some vehicles."""
        if not rows.size:
            return
        c, R = self._settings, states.R_world_vehicle[rows]
        origins_m = states.position_m[rows] + R @ self._position_m
        true_m = self._cast(self._world[rows].tolist(), origins_m, self._directions @ R.mT)
        is_hit = (true_m >= 0.0) & (true_m < c.reach_m) & (self._rng.random(true_m.shape) >= c.lost)
        noise_m = np.hypot(c.sigma_m, c.relative_sigma * true_m) * self._rng.standard_normal(true_m.shape)
        measured_m = np.where(is_hit, np.clip(true_m + noise_m, 0.0, c.reach_m), c.reach_m)
        self.ranges_m[rows] = measured_m.reshape(-1, *c.shape)
        self._due_in[rows] = self._period

    def _cast(self, worlds: Sequence[int], origins_m: Array, directions: Array) -> Array:
        """Return the distances (k, B) from origins (k, 3) along directions (k, B, 3) [m]; −1 where nothing is hit."""
        k, count, _ = directions.shape
        distances_m, geoms = np.empty((k, count)), np.empty(count, np.int32)
        rays = zip(worlds, origins_m, np.ascontiguousarray(directions), distances_m, strict=True)
        for world, origin, along, found in rays:
            model, data = self._solids[world]
            mujoco.mj_multiRay(
                model, data, origin, along.ravel(), None, True, -1, geoms, found, None, count, self._settings.reach_m
            )
        return distances_m
