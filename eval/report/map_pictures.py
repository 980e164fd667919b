"""Pictures of a dense map: from above, in slices, and its mesh in perspective."""

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from dronevio.eval import colours
from dronevio.eval.metrics.clouds import mesh_points
from dronevio.eval.report.figures import draw_line, svg_plot
from dronevio.eval.scene import VIEWER_FIELD_OF_VIEW_RAD, fit_view
from dronevio.eval.splatting import ViewCamera, shaded, splat
from dronevio.models.arrays import Array, Image
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, States
from dronevio.models.occupancy_maps import RosMap
from dronevio.models.surfaces import Mesh

STATE_COLOURS = {FREE: "#cfe8fb", OCCUPIED: "#24292f", UNKNOWN: "#9aa2ad"}
"""Colours of the states of cells in slices."""
_STATE_NAMES = {FREE: "free", OCCUPIED: "occupied", UNKNOWN: "unknown"}
_PICTURE_PX = (1600, 900)
_MESH_PX = 2.0  # distance of the drawn points of the mesh in the middle of the picture
_HEADROOM_M = 0.3  # above the flight, where the view from above cuts the map open, so that no ceiling hides it
_WIDTH_IN, _MAX_HEIGHT_IN = 5.4, 4.9
_INNER_PERCENT = (1.0, 99.0)  # percentiles of the coordinates of the mesh that fill a picture


def plot_from_above(grid: OccupancyGrid, path: Array) -> Markup:
    """Return the map from above with the path (N, 3): the highest surface of each column below the headroom."""
    top_m = float(path[:, 2].max()) + _HEADROOM_M
    count = int(np.clip(np.ceil((top_m - grid.low_m[2]) / grid.cell_m), 1, grid.states.shape[2]))
    below = grid.states[:, :, :count]
    occupied = below == OCCUPIED
    is_surface, is_free = occupied.any(axis=2), (below == FREE).any(axis=2)
    highest = count - 1 - np.argmax(occupied[:, :, ::-1], axis=2)
    z_m = grid.low_m[2] + (highest + 0.5) * grid.cell_m
    low_m, high_m = (float(v) for v in np.percentile(z_m[is_surface], [2.0, 98.0])) if is_surface.any() else (0.0, 1.0)
    picture = np.zeros((*is_surface.shape, 4), np.uint8)
    picture[is_free] = (*colours.rgb(STATE_COLOURS[FREE]), 255)
    picture[is_surface, :3] = colours.height_colours(z_m[is_surface], low_m, high_m)
    picture[is_surface, 3] = 255

    def draw(ax: Axes) -> None:
        _show(ax, picture, grid.low_m[:2], grid.cell_m)
        draw_line(ax, path[:, :2], color=colours.ESTIMATE, linewidth=1.3, label="path")
        for z, label in ((low_m, f"{low_m:.1f} m or lower"), (high_m, f"{high_m:.1f} m or higher")):
            rgb = colours.height_colours(np.array([z]), low_m, high_m)[0] / 255.0
            ax.add_patch(Rectangle((0, 0), 0, 0, facecolor=tuple(rgb), label=label))
        ax.add_patch(Rectangle((0, 0), 0, 0, facecolor=STATE_COLOURS[FREE], label="free, no surface below"))
        ax.set(title="From above", xlabel="x [m]", ylabel="y [m]")

    return svg_plot(_height_in(picture), draw, "highest surfaces by height, with the path", _WIDTH_IN)


def plot_layer(states: States, low_m: Array, cell_m: float, path: Array, title: str, names: tuple[str, str]) -> Markup:
    """Return a slice of a map.

    Args:
        states: (A, B) States of the cells of a plane.
        low_m: (2,) Lower corner of the first cell [m].
        cell_m: Side of a cell [m].
        path: (N, 2) Path in the plane [m].
        title: Title of the plot.
        names: Names of the two axes.
    """
    picture = np.zeros((*states.shape, 4), np.uint8)
    for state, colour in STATE_COLOURS.items():
        picture[states == state] = (*colours.rgb(colour), 255)

    def draw(ax: Axes) -> None:
        _show(ax, picture, low_m, cell_m)
        draw_line(ax, path, color=colours.ESTIMATE, linewidth=1.1, label="path")
        for state, colour in STATE_COLOURS.items():
            ax.add_patch(Rectangle((0, 0), 0, 0, facecolor=colour, label=_STATE_NAMES[state]))
        ax.set(title=title, xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]")

    return svg_plot(_height_in(picture), draw, "free, occupied and unknown cells", _WIDTH_IN)


def horizontal_slice(grid: OccupancyGrid, z_m: float, path: Array) -> Markup:
    """Return the layer of cells at a height, with the path (N, 3)."""
    k = int(np.clip(np.floor((z_m - grid.low_m[2]) / grid.cell_m), 0, grid.states.shape[2] - 1))
    title = f"Horizontal slice at z = {z_m:.1f} m"
    return plot_layer(np.asarray(grid.states[:, :, k]), grid.low_m[:2], grid.cell_m, path[:, :2], title, ("x", "y"))


def vertical_slice(grid: OccupancyGrid, path: Array) -> Markup:
    """Return the upright layer of cells along x or y of which most is free, with the path (N, 3).

    That of which most is known would lie within a wall.
    """
    free = grid.states == FREE
    counts = [free.sum(axis=(1, 2)), free.sum(axis=(0, 2))]
    across = int(np.argmax([count.max() for count in counts]))
    k, along = int(np.argmax(counts[across])), 1 - across
    at_m = grid.low_m[across] + (k + 0.5) * grid.cell_m
    title, names = f"Vertical slice at {'xy'[across]} = {at_m:.1f} m", ("xy"[along], "z")
    layer: States = np.take(grid.states, k, axis=across)
    return plot_layer(layer, grid.low_m[[along, 2]], grid.cell_m, path[:, [along, 2]], title, names)


def ros_layer(layer: RosMap, band_m: tuple[float, float], path: Array) -> Markup:
    """Return the map of ROS, which combines a band of heights [m], with the path (N, 3)."""
    title = f"Map of ROS: z = {band_m[0]:.2f} to {band_m[1]:.2f} m"
    return plot_layer(layer.states, layer.low_m, layer.cell_m, path[:, :2], title, ("x", "y"))


def mesh_picture(mesh: Mesh, path: Array, size_px: tuple[int, int] = _PICTURE_PX) -> Image:
    """Return a perspective picture (H, W, 3) of a mesh, coloured by height and shaded, with the path (N, 3).

    Only surfaces that face the viewpoint are drawn, so that a room is seen into from outside.
    """
    low, high = np.percentile(mesh.vertices, _INNER_PERCENT, axis=0)
    inner = mesh.vertices[np.all((mesh.vertices >= low) & (mesh.vertices <= high), axis=1)]
    position, target = fit_view(np.concatenate([inner, path]), elevation_deg=50.0)
    camera = ViewCamera.looking_at(position, target, np.array([0.0, 0.0, 1.0]), VIEWER_FIELD_OF_VIEW_RAD, *size_px)
    spacing = _MESH_PX * float(np.linalg.norm(position - target)) / camera.focal_px
    drawn = np.all(camera.faces(mesh.vertices, mesh.normals)[mesh.triangles], axis=1)
    rows = mesh_points(np.hstack([mesh.vertices, mesh.normals]), mesh.triangles[drawn], spacing)
    normals = rows[:, 3:] / np.maximum(np.linalg.norm(rows[:, 3:], axis=1, keepdims=True), np.finfo(float).tiny)
    shade = shaded(normals, camera).astype(np.float32) / 235.0
    coloured = colours.height_colours(rows[:, 2], float(low[2]), float(high[2])).astype(np.float32)
    line = dense_line(path, 0.5 * spacing)
    points = np.concatenate([rows[:, :3], line])
    rgb = np.concatenate(
        [coloured * shade, np.tile(np.array(colours.rgb(colours.ESTIMATE), np.float32), (len(line), 1))]
    )
    return splat(camera, points, np.round(rgb).astype(np.uint8), spacing)


def dense_line(path: Array, step: float) -> Array:
    """Return points (M, 3) along a path (N, 3) with its coordinates, at equal distances; the first is its beginning."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.append(0.0, np.arange(step, length[-1], step))
    return np.stack([np.interp(at, length, column) for column in path.T], axis=1)


def _show(ax: Axes, picture: Image, low_m: Array, cell_m: float) -> None:
    """Draw a picture (A, B, 4) of cells to scale, its first axis to the right and its second up."""
    high_m = low_m + cell_m * np.array(picture.shape[:2])
    extent = (float(low_m[0]), float(high_m[0]), float(low_m[1]), float(high_m[1]))
    ax.imshow(picture.transpose(1, 0, 2), origin="lower", extent=extent, interpolation="nearest")
    ax.grid(visible=False)


def _height_in(picture: Image) -> float:
    """Return the height of a plot of a picture (A, B, 4) whose width is fixed, with room for labels [in]."""
    return float(min(_MAX_HEIGHT_IN, 1.2 + _WIDTH_IN * picture.shape[1] / picture.shape[0]))
