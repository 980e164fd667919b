"""Pictures of the points and cameras of a reconstruction: from above, from the side, and in perspective.

Each function draws into axes that it is given. Points are drawn as pixels, so that a page with many points remains
small.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle

from dronevio.eval import colours
from dronevio.eval.scene import (
    VIEW_ASPECT,
    VIEWER_FIELD_OF_VIEW_RAD,
    frusta,
    frustum_depth,
    reconstruction_view,
    scene_points,
    upright_rotation,
)
from dronevio.models.arrays import Array
from dronevio.models.reconstruction import Reconstruction

RASTER_DPI = 200
"""Resolution of points that are drawn as pixels [1/in]."""
_BACKGROUND = "#12151a"  # that of the 3D view in the rerun viewer; light points remain visible
_LIMIT_MARGIN = 0.06  # around the scene, as a share of its extent
_NEAR_SHARE = 0.02  # of the distance of the viewpoint, below which points are not drawn


@dataclass(frozen=True)
class CloudView:
    """An orthographic view of a reconstruction along a horizontal or vertical axis."""

    title: str
    """Title of the plot."""
    vertical: int
    """Index of the axis on the y axis of the plot; the x axis is horizontal, along the largest extent."""
    depth: int
    """Index of the axis along which points cover each other."""
    sign: float
    """Sign of the coordinates of the points that are in front."""


FROM_ABOVE = CloudView("From above", vertical=1, depth=2, sign=1.0)
FROM_SIDE = CloudView("From the side", vertical=2, depth=1, sign=-1.0)


def upright(component: Reconstruction, up: Array | None) -> Reconstruction:
    """Return a component in the frame of the drawings, with z up; see `upright_rotation`."""
    return component.transformed(1.0, upright_rotation(component, up), np.zeros(3))


def draw_cloud(ax: Axes, view: CloudView, component: Reconstruction, unit: str) -> None:
    """Draw the points, in their colours, and the camera frusta of an upright component to scale.

    Args:
        ax: Axes to draw into.
        view: Direction of view.
        component: The component in the frame of the drawings.
        unit: Unit of the axes; empty if the scale is arbitrary.
    """
    axes = [0, view.vertical]
    order = np.argsort(view.sign * component.points[:, view.depth], kind="stable")
    x, y = component.points[order][:, axes].T
    size = _marker_size(len(order))
    _draw_background(ax)
    ax.grid(visible=False)
    ax.scatter(x, y, s=size, c=component.colours[order] / 255.0, linewidths=0.0, rasterized=True)
    _draw_frusta(ax, frusta(component, frustum_depth(component))[..., axes])
    shown = np.concatenate([scene_points(component), frusta(component, frustum_depth(component))[:, 1]])
    if len(shown):
        ax.dataLim.set_points(np.stack([shown[:, axes].min(axis=0), shown[:, axes].max(axis=0)]))
        ax.margins(_LIMIT_MARGIN)
    ax.set_aspect("equal", adjustable="datalim")
    label = unit or "arbitrary unit"
    ax.set(title=view.title, xlabel=f"x [{label}]", ylabel=f"{'xyz'[view.vertical]} [{label}]")


def draw_perspective(ax: Axes, component: Reconstruction) -> None:
    """Draw an upright component as it is seen from behind its cameras; near points cover distant ones."""
    ax.set_axis_off()
    ax.set(xlim=(-VIEW_ASPECT, VIEW_ASPECT), ylim=(-1.0, 1.0))
    fig = ax.get_figure(root=True)
    assert fig is not None
    fig.set_layout_engine("none")  # the axes fill the figure
    ax.set_position((0.0, 0.0, 1.0, 1.0))
    _draw_background(ax)
    if not len(component.points) and not len(component.image_names):
        return
    position, target = reconstruction_view(component, np.eye(3))
    distance = float(np.linalg.norm(target - position))
    forward = (target - position) / distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    in_view = (component.points - position) @ axes.T
    order = np.argsort(-in_view[:, 2], kind="stable")
    order = order[in_view[order, 2] > _NEAR_SHARE * distance]
    seen = in_view[order]
    size = _marker_size(len(order)) * 3.0 * np.clip(distance / seen[:, 2], 0.3, 3.0) ** 2
    x, y = _projected(seen).T
    ax.scatter(x, y, s=size, c=component.colours[order] / 255.0, linewidths=0.0, rasterized=True)
    edges = (frusta(component, frustum_depth(component)) - position) @ axes.T
    edges = edges[np.all(edges[..., 2] > _NEAR_SHARE * distance, axis=1)]
    _draw_frusta(ax, _projected(edges))


def _projected(in_view: Array) -> Array:
    """Return perspective projections (…, 2) of points (…, 3) in the frame of a view; ±1 is the upper and lower edge."""
    return np.asarray(in_view[..., :2] / in_view[..., 2:] / np.tan(0.5 * VIEWER_FIELD_OF_VIEW_RAD))


def _draw_background(ax: Axes) -> None:
    """Fill the axes; figures of pages are saved without the colour that axes have themselves."""
    ax.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, transform=ax.transAxes, facecolor=_BACKGROUND, zorder=-1.0))


def _draw_frusta(ax: Axes, segments: Array) -> None:
    """Draw line segments (S, 2, 2) of camera frusta."""
    ax.add_collection(LineCollection(list(segments), colors=colours.ESTIMATE, linewidths=0.7), autolim=False)


def _marker_size(count: int) -> float:
    """Return the area of a marker [pt²] for a number of points, so that they neither vanish nor cover each other."""
    return float(np.clip(12_000.0 / max(count, 1), 0.5, 8.0))
