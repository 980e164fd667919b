"""Placement of the obstacles of a description, of which the scattered ones are drawn from a generator."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.prisms import UNPAINTED
from dronevio.sim.appearance.solids import Box
from dronevio.sim.paths.space import Space
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M
from dronevio.sim.worlds.outdoors import distance_to_legs
from dronevio.sim.worlds.own.bodies import Body, Place, box_body, cylinder_body, ellipsoid_body
from dronevio.sim.worlds.own.description import Description, Obstacle, Scatter, Shape
from dronevio.sim.worlds.own.meshes import mesh_body

_TRIES = 200  # for each scattered obstacle
_FAR_M = 1e3


@dataclass(frozen=True, eq=False)
class Placed:
    """A shape with its lengths at its place."""

    shape: Shape
    """Shape and look."""
    lengths: Array
    """(K,) Its lengths; see `Shape`."""
    position: Array
    """(3,) Its centre [m]."""
    R: Array
    """(3, 3) Its orientation."""

    @property
    def hull(self) -> Box:
        """Box around it."""
        return Box(self.position, _half(self.shape, self.lengths), UNPAINTED, R=self.R)

    def body(self, ppm: float) -> Body:
        """Return the body, with textures of at most a resolution [px/m]."""
        place = Place(self.position, self.R, self.shape.look, ppm, Instance(self.shape.name))
        if self.shape.mesh is not None:
            return mesh_body(replace(self.shape.mesh, triangles=self.lengths[0] * self.shape.mesh.triangles), place)
        if self.shape.kind == "cylinder":
            return cylinder_body(float(self.lengths[0]), float(self.lengths[1]), place)
        if self.shape.kind == "sphere":
            return ellipsoid_body(np.full(3, self.lengths[0]), place)
        return box_body(0.5 * self.lengths, place)


def placed_obstacles(description: Description, rng: np.random.Generator) -> list[Placed]:
    """Return all obstacles of a description.

    Args:
        description: The world.
        rng: Draws lengths, places and headings of the scattered ones.

    Raises:
        InputError: The scattered obstacles do not fit.
    """
    placed = [_at_place(obstacle, float(description.low[2])) for obstacle in description.obstacles]
    for scatter in description.scatters:
        placed += _scattered(scatter, description, [one.hull for one in placed], rng)
    return placed


def _at_place(obstacle: Obstacle, floor_m: float) -> Placed:
    """Return an obstacle at its place."""
    shape = obstacle.shape
    position = np.array(obstacle.position_m)
    if len(position) == 2:
        position = np.array([*position, floor_m + _standing_height(shape, shape.least, shape.R)])
    return Placed(shape, shape.least, position, shape.R)


def _scattered(
    scatter: Scatter, description: Description, hulls: Sequence[Box], rng: np.random.Generator
) -> list[Placed]:
    """Return scattered obstacles, which stand on the floor, apart from each other and from other hulls.

    Raises:
        InputError: They do not fit.
    """
    shape, low = scatter.shape, description.low
    occupied = _columns(hulls, description.free_box_m)
    centres, radii = np.zeros((0, 2)), np.zeros(0)
    placed: list[Placed] = []
    for number in range(scatter.count):
        lengths = rng.uniform(shape.least, shape.greatest)
        R = rotation_z(rng.uniform(0.0, 2.0 * np.pi)) @ shape.R
        radius = _radius(shape, lengths, R)
        thrown = rng.uniform(scatter.region_m[0], scatter.region_m[1], (_TRIES, 2))
        clear = np.linalg.norm(thrown - description.pad_m[:2], axis=1) - radius >= scatter.pad_distance_m
        clear &= np.all((thrown - radius >= low[:2]) & (thrown + radius <= description.high[:2]), axis=1)
        if description.route_m is not None:
            clear &= distance_to_legs(thrown, description.route_m) - radius > ROUTE_CLEARANCE_M + 0.05
        clear &= occupied.clearance(np.column_stack([thrown, np.zeros(_TRIES)])) - radius >= scatter.gap_m
        apart = np.linalg.norm(thrown[:, None] - centres, axis=2) - radii - radius
        clear &= apart.min(axis=1, initial=np.inf) >= scatter.gap_m
        if not clear.any():
            raise InputError(
                description.path,
                f"{scatter.where}: no place for number {number + 1} of {scatter.count} in {_TRIES} draws",
                "a larger region_m, or smaller count, sizes, gap_m or pad_distance_m",
            )
        at = thrown[clear.argmax()]
        centres, radii = np.vstack([centres, at]), np.append(radii, radius)
        height = float(low[2]) + _standing_height(shape, lengths, R)
        placed.append(Placed(shape, lengths, np.array([*at, height]), R))
    return placed


def _columns(hulls: Sequence[Box], free_box_m: Array | None) -> Space:
    """Return a space in which hulls, and a box to keep free, have any height."""
    boxes = [(hull.centre, hull.half, hull.R) for hull in hulls]
    if free_box_m is not None:
        boxes.append((free_box_m.mean(axis=0), 0.5 * np.ptp(free_box_m, axis=0), np.eye(3)))
    centres, halves, rotations = np.zeros((len(boxes), 3)), np.zeros((len(boxes), 3)), np.zeros((len(boxes), 3, 3))
    for row, (centre, half, R) in enumerate(boxes):
        is_upright = abs(R[2, 2]) > 1.0 - 1e-9
        centres[row, :2] = centre[:2]
        halves[row] = half if is_upright else np.abs(R) @ half
        halves[row, 2] = _FAR_M
        rotations[row] = R if is_upright else np.eye(3)
    return Space(np.full(3, -_FAR_M), np.full(3, _FAR_M), centres, halves, rotations)


def _half(shape: Shape, lengths: Array) -> Array:
    """Return the half extents (3,) of a shape in its frame [m]."""
    if shape.mesh is not None:
        return np.asarray(lengths[0] * shape.mesh.half)
    if shape.kind == "box":
        return np.asarray(0.5 * lengths)
    return np.array([lengths[0], lengths[0], 0.5 * lengths[1] if shape.kind == "cylinder" else lengths[0]])


def _radius(shape: Shape, lengths: Array, R: Array) -> float:
    """Return the horizontal radius of a rotated shape around its centre [m]."""
    if shape.kind == "sphere" or (shape.kind == "cylinder" and abs(R[2, 2]) > 1.0 - 1e-9):
        return float(lengths[0])
    return float(np.linalg.norm((np.abs(R) @ _half(shape, lengths))[:2]))


def _standing_height(shape: Shape, lengths: Array, R: Array) -> float:
    """Return the height above the floor of the centre of a rotated shape that stands on it [m]."""
    if shape.mesh is not None:
        return float(-lengths[0] * (shape.mesh.triangles @ R[2]).min())
    if shape.kind == "sphere":
        return float(lengths[0])
    if shape.kind == "cylinder":
        return float(0.5 * lengths[1] * abs(R[2, 2]) + lengths[0] * np.hypot(R[2, 0], R[2, 1]))
    return float(np.abs(R[2]) @ _half(shape, lengths))
