"""Light maps: the brightness of each surface patch under lamps and windows, with soft shadows.

MuJoCo's renderer computes light at the corners of faces only, and its shadows dominate the cost of a frame. Since the
lighting is static, it is computed once and multiplied into the textures, at no cost per frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.sim.appearance.solids import Box, Surface, size_m
from dronevio.sim.appearance.textures import PIXELS_PER_M

Field = npt.NDArray[np.float32]

_PATCHES_PER_M = 7.0  # at the full resolution of a texture
_SKY_DIRECTIONS = 20
_SKY_REACH_M = 0.9  # more distant occluders have little influence in a lit room
_OFFSET_M = 0.004  # distance of the origins of rays from their face
_SMALLEST_SHADOW_M = 0.16  # half diagonal; smaller boxes cast no shadows
_MARGIN_M = 0.02  # for rounding errors where rays are selected
_LAMP_SIZE_M2 = 0.3  # size of a lamp, which bounds the irradiance close to it
_AMBIENT, _DIRECT = 0.50, 0.55  # fractions of scattered and direct light in a well-lit place
_BRIGHTEST = 1.15
_SIDE, _FROM_ABOVE = 0.82, 0.2  # moving objects: brightness of sides, and addition of tops


@dataclass(frozen=True, eq=False)
class AreaLight:
    """An area light, sampled at a few points."""

    points: Array
    """(S, 3) Sample points of the light [m]."""
    power: float
    """Irradiance at a distance of one metre in front, relative to the other lights."""
    normal: Array | None = None
    """(3,) Normal of the emitting side; None emits in all directions."""

    def moved(self, R: Array, position: Array) -> "AreaLight":
        """Return the light rotated by R (3, 3) about the origin, then translated by ``position`` (3,)."""
        normal = None if self.normal is None else R @ self.normal
        return AreaLight(self.points @ R.T + position, self.power, normal)


def bake(
    faces: Sequence[Surface], blockers: Sequence[Box], lights: Sequence[AreaLight], scattered: float = 1.0
) -> list[Field]:
    """Return the light map (rows, columns) of each face, 1 in a well-lit place.

    Direct light is computed from the samples of every light with shadow rays against the boxes; scattered light is
    reduced by ambient occlusion (Zhukov, Iones, Kronin, "An ambient light illumination model", 1998).

    Args:
        faces: The surfaces to light.
        blockers: Boxes that cast shadows.
        lights: The area lights.
        scattered: Scattered light, relative to a well-lit place.
    """
    shapes, points, normals = [], [], []
    for face in faces:
        density = _PATCHES_PER_M * face.pixels_per_m / PIXELS_PER_M
        rows, columns = (max(round(v * density), 2) for v in size_m(face))
        on_face, normal = _spread_over(face.grid, rows, columns)
        shapes.append((rows, columns))
        points.append((on_face + _OFFSET_M * normal).reshape(-1, 3))
        normals.append(normal.reshape(-1, 3))
    p, n = (np.concatenate(parts).T.astype(np.float32, order="C") for parts in (points, normals))
    direct = _direct_light(p, n, blockers, lights)
    direct *= _DIRECT / max(float(np.percentile(direct, 80)), 1e-6)
    light = (scattered * _AMBIENT * _openness(p, n, blockers) + direct) ** 0.75  # tone curve
    light = np.minimum(light, _BRIGHTEST)
    cuts = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
    return [
        np.maximum(part.reshape(shape), np.float32(face.glow))
        for part, shape, face in zip(np.split(light, cuts), shapes, faces, strict=True)
    ]


def daylight(faces: Sequence[Surface]) -> list[Field]:
    """Return the light maps (2, 2) of faces of moving objects, under uniform light from above.

    Tops are brightest; sides become darker towards their lower edge.
    """
    maps = []
    for face in faces:
        normal_z = _spread_over(face.grid, 2, 2)[1][..., 2]
        fall = np.array([[0.05], [-0.05]]) * (1.0 - np.abs(normal_z))
        maps.append(np.maximum(_SIDE + _FROM_ABOVE * normal_z + fall, face.glow).astype(np.float32))
    return maps


def _spread_over(grid: Array, rows: int, columns: int) -> tuple[Array, Array]:
    """Return points and unit normals (rows, columns, 3), evenly spread over a surface's grid (R + 1, C + 1, 3)."""
    cells = np.array(grid.shape[:2]) - 1
    (i, v), (j, u) = (
        np.divmod((np.arange(count) + 0.5) / count * cell, 1.0)
        for count, cell in zip((rows, columns), cells, strict=True)
    )
    rc, v, u = np.ix_(i.astype(int), j.astype(int)), v[:, None, None], u[None, :, None]
    a, b, c, d = (
        grid[1 - p : len(grid) - p, 1 - q : grid.shape[1] - q][rc] for p, q in ((1, 1), (1, 0), (0, 1), (0, 0))
    )
    right, down = (1.0 - v) * (b - a) + v * (d - c), (1.0 - u) * (c - a) + u * (d - b)
    normal = np.cross(down, right)
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    return a + u * (b - a) + v * ((1.0 - u) * (c - a) + u * (d - b)), normal / np.maximum(length, 1e-12)


def apply_light(image: npt.NDArray[np.uint8], light: Field) -> npt.NDArray[np.uint8]:
    """Return an image (H, W, 3) multiplied by a light map."""
    height, width = image.shape[:2]
    smooth = cv2.resize(light, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(image, cv2.merge([smooth] * 3), dtype=cv2.CV_8U), dtype=np.uint8)


def _direct_light(p: Field, n: Field, blockers: Sequence[Box], lights: Sequence[AreaLight]) -> Field:
    """Return the irradiance (N,) at points p (3, N) with normals n (3, N)."""
    casting = [box for box in blockers if np.linalg.norm(box.half) > _SMALLEST_SHADOW_M]
    total = np.zeros(p.shape[1], np.float32)
    for light in lights:
        for sample in light.points.astype(np.float32):
            ray = sample[:, None] - p
            distance = np.sqrt(np.sum(ray * ray, axis=0))
            arriving = np.maximum(np.sum(ray * n, axis=0), 0.0) / distance
            if light.normal is not None:
                arriving *= np.maximum(-(light.normal.astype(np.float32) @ ray) / distance, 0.0)
            strength = light.power / len(light.points) * arriving / (_LAMP_SIZE_M2 + distance**2)
            lit = np.flatnonzero(strength > 1e-3)
            start, way, length = p[:, lit], ray[:, lit], distance[lit]
            backward = way / -length  # from the sample to the points
            clear = np.ones(len(lit), np.bool_)
            for box in casting:
                near = _rays_near(sample, backward, length, box)
                clear[near] &= _entry(start[:, near], way[:, near], box) >= 1.0
            total[lit] += strength[lit] * clear
    return total


def _rays_near(start: Field, direction: Field, length: Field, box: Box) -> npt.NDArray[np.intp]:
    """Return the indices of rays from a point (3,) that come close to the sphere around a box.

    Args:
        start: (3,) Start of all rays [m].
        direction: (3, N) Unit vectors.
        length: (N,) Lengths of the rays [m].
        box: The box.
    """
    offset = box.centre.astype(np.float32) - start
    radius = np.float32(np.linalg.norm(box.half) + _MARGIN_M)
    along = offset @ direction
    return np.flatnonzero((along * along > offset @ offset - radius**2) & (along > -radius) & (along < length + radius))


def _entry(origin: Field, ray: Field, box: Box) -> Field:
    """Return the fractions (N,) of their length at which rays (3, N) enter a box; inf without an intersection.

    Source: Kay, Kajiya, "Ray tracing complex scenes", 1986 (slabs).
    """
    R_box_world = box.R.T.astype(np.float32)
    start = R_box_world @ origin - (R_box_world @ box.centre.astype(np.float32))[:, None]
    step = R_box_world @ ray
    near, far = np.zeros(origin.shape[1], np.float32), np.full(origin.shape[1], np.inf, np.float32)
    for x, dx, half in zip(start, step, box.half.astype(np.float32), strict=True):
        inverse = 1.0 / np.where(np.abs(dx) < 1e-9, np.float32(1e-9), dx)
        middle, reach = -x * inverse, half * np.abs(inverse)
        np.maximum(near, middle - reach, out=near)
        np.minimum(far, middle + reach, out=far)
    return np.where(near <= far, near, np.float32(np.inf))


def _openness(p: Field, n: Field, blockers: Sequence[Box]) -> Field:
    """Return the unoccluded fraction (N,) of the cosine-weighted hemisphere over each point (3, N)."""
    sky = _sphere(_SKY_DIRECTIONS)
    covered = np.zeros((p.shape[1], len(sky)), np.float32)
    for box in blockers:
        reach = float(np.linalg.norm(box.half)) + _SKY_REACH_M
        offset = p - box.centre.astype(np.float32)[:, None]
        near = np.flatnonzero(np.sum(offset * offset, axis=0) < reach**2)
        if len(near) == 0:
            continue
        rays = np.tile(sky.T * np.float32(_SKY_REACH_M), len(near))
        entry = _entry(np.repeat(p[:, near], len(sky), axis=1), rays, box).reshape(len(near), -1)
        covered[near] = np.maximum(covered[near], np.sqrt(1.0 - np.minimum(entry, 1.0)))
    weight = np.maximum(n.T @ sky.T, 0.0)
    return np.asarray(1.0 - np.sum(weight * covered, axis=1) / np.sum(weight, axis=1))


def _sphere(count: int) -> Field:
    """Return directions (count, 3) evenly distributed over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1).astype(np.float32)
