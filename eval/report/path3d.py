"""The path of a run in three dimensions: a static picture, which a script of the page rotates.

The picture is an orthographic projection. Each element holds its coordinates in the world frame beside its projected
ones, so that the script draws the same from other directions.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dronevio.eval import colours
from dronevio.models.arrays import Array
from dronevio.models.state import Trajectory

AZIMUTH_DEG, ELEVATION_DEG = -60.0, 30.0
"""Direction from the scene to the viewer: angle around z from the x axis, and angle above the horizontal plane [°]."""
MARGIN = 1.08
"""Size of the picture relative to that of the scene."""
_MAX_POINTS = 800  # of one path
_MAX_SEGMENTS = 1500  # of the surroundings
_AXIS_SHARE = 0.25  # largest length of an axis relative to the radius of the scene
_FONT_SHARE = 0.055  # size of letters relative to half of the width of the picture
_LABEL_LETTERS = 2.2  # mean width of "start" and "end", relative to the size of letters


@dataclass(frozen=True, eq=False)
class SpatialPath:
    """A line of the picture."""

    name: str
    """Name for the legend; empty for none."""
    style: str
    """Style of the line, as CSS."""
    points: Array
    """(N, 3) Points in the world frame, relative to the centre of the scene [m]."""
    pairs: bool = False
    """Whether each two points are a segment of their own."""

    @property
    def coordinates(self) -> str:
        """The points as text, in millimetres."""
        return " ".join(map(str, np.round(self.points * 1e3).astype(np.int64).ravel().tolist()))

    @property
    def drawing(self) -> str:
        """The projected points as the value of ``d`` of an SVG path."""
        words = [f"{u:.3f} {v:.3f}" for u, v in projected(np.round(self.points, 3)).tolist()]
        return "".join(("M" if i == 0 or (self.pairs and i % 2 == 0) else "L") + word for i, word in enumerate(words))


@dataclass(frozen=True, eq=False)
class SpatialMark:
    """A symbol or text at a point of the picture."""

    text: str
    """Text of the mark."""
    point: Array
    """(3,) Point in the world frame, relative to the centre of the scene [m]."""

    @property
    def coordinates(self) -> str:
        """The point as text, in millimetres."""
        return " ".join(map(str, np.round(self.point * 1e3).astype(np.int64).tolist()))

    @property
    def position(self) -> tuple[float, float]:
        """The projected point [m]."""
        u, v = projected(np.round(self.point, 3)[None])[0].tolist()
        return u, v


@dataclass(frozen=True, eq=False)
class PathScene:
    """The picture of a path; lengths in the picture are in metres."""

    paths: tuple[SpatialPath, ...]
    """Surroundings, axes, and the true and the estimated path, in the order in which they are drawn."""
    marks: tuple[SpatialMark, ...]
    """Names of the axes, and the start and the end of the path."""
    half_width_m: float
    """Half of the width of the picture [m]."""
    half_height_m: float
    """Half of the height of the picture [m]."""
    axis_m: float
    """Length of the axes [m]."""
    azimuth_deg: float = AZIMUTH_DEG
    """Direction of the viewer around the z axis [°]."""
    elevation_deg: float = ELEVATION_DEG
    """Direction of the viewer above the horizontal plane [°]."""

    @property
    def font_m(self) -> float:
        """Size of the letters of the marks [m]."""
        return _FONT_SHARE * self.half_width_m


def path_scene(
    estimate: Trajectory, truth: Trajectory | None, outline: Array, corrected: Trajectory | None = None
) -> PathScene | None:
    """Return the picture of a path, or None if there are no poses.

    Args:
        estimate: The estimated trajectory, in the world frame of the ground truth.
        truth: The true trajectory; None if it is not known.
        outline: (L, 2, 3) Line segments of the surroundings in the same frame [m].
        corrected: The trajectory corrected by a map, in the same frame; None without a map.
    """
    tracks = [track for track in _tracks(estimate, truth, corrected) if len(track[0])]
    if not tracks:
        return None
    segments = outline[:: max(1, math.ceil(len(outline) / _MAX_SEGMENTS))].reshape(-1, 3)
    every = np.concatenate([*(points for points, *_ in tracks), segments])
    centre, radius_m, half_height_m = scene_extent(every)
    axis_m = _round_length(_AXIS_SHARE * radius_m)
    origin = every.min(axis=0) - centre
    axes = (
        SpatialPath("", "stroke: var(--ink); stroke-width: 2", np.stack([origin, tip]))
        for tip in origin + axis_m * np.eye(3)
    )
    tips = origin + 1.15 * axis_m * np.eye(3)
    half_width_m = MARGIN * radius_m
    return PathScene(
        (
            SpatialPath("", f"stroke: {colours.SURROUNDINGS}; stroke-width: .8; opacity: .6", segments - centre, True),
            *axes,
            *(SpatialPath(name, style, points - centre) for points, name, style in tracks),
        ),
        (
            *(SpatialMark(name, tip) for name, tip in zip("xyz", tips, strict=True)),
            *_ends(tracks[0][0] - centre, _LABEL_LETTERS * _FONT_SHARE * half_width_m),
        ),
        half_width_m,
        MARGIN * half_height_m,
        axis_m,
    )


def scene_extent(points: Array) -> tuple[Array, float, float]:
    """Return the centre (3,) of points (N, 3), and half of the width and of the height of their picture [m].

    The width suffices for all directions of view.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    centre = 0.5 * (low + high)
    radius_m = max(float(np.linalg.norm((points - centre)[:, :2], axis=1).max()), 0.1)
    elevation = math.radians(ELEVATION_DEG)
    return centre, radius_m, radius_m * math.sin(elevation) + 0.5 * float(high[2] - low[2]) * math.cos(elevation)


def projected(points: Array) -> Array:
    """Return the (N, 2) positions in the picture, right and down, of points (N, 3) seen from the first direction."""
    azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
    right = [-math.sin(azimuth), math.cos(azimuth), 0.0]
    tilt = math.sin(elevation)
    down = [tilt * math.cos(azimuth), tilt * math.sin(azimuth), -math.cos(elevation)]
    return np.asarray(points @ np.array([right, down]).T, dtype=np.float64)


def _ends(points: Array, label_m: float) -> tuple[SpatialMark, ...]:
    """Return the marks of the ends of a path, as one where the names of two would overlap.

    Args:
        points: (N, 3) Points of the path [m].
        label_m: Width of a name in the picture [m].
    """
    if np.linalg.norm(points[-1] - points[0]) < label_m:
        return (SpatialMark("start, end", 0.5 * (points[0] + points[-1])),)
    return SpatialMark("start", points[0]), SpatialMark("end", points[-1])


def _tracks(
    estimate: Trajectory, truth: Trajectory | None, corrected: Trajectory | None
) -> Iterable[tuple[Array, str, str]]:
    """Yield the thinned points, the name and the style of the true, the estimated and the corrected path."""
    if truth is not None:
        style = f"stroke: {colours.TRUTH}; stroke-width: 2.6; opacity: .75"
        yield _thinned(truth.p_world_imu), "truth", style
    yield _thinned(estimate.p_world_imu), "estimate", f"stroke: {colours.ESTIMATE}; stroke-width: 1.3"
    if corrected is not None:
        yield _thinned(corrected.p_world_imu), "corrected by the map", "stroke: var(--blue); stroke-width: 1.3"


def _thinned(points: Array) -> Array:
    step = max(1, math.ceil(len(points) / _MAX_POINTS))
    return np.concatenate([points[::step], points[-1:]])


def _round_length(length_m: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not larger than a length."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(step for step in (1.0, 2.0, 5.0) if step * power <= length_m * (1.0 + 1e-9)) * power
