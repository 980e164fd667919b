"""Rerun files of dense surfaces: the coloured points, the mesh, and the frusta of the cameras."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dronevio.eval import colours
from dronevio.eval.rerun.blueprint import BACKGROUND
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.scene import frusta, frustum_depth, upright_rotation
from dronevio.eval.surface_view import surface_view
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.recordings.files import check_output_path
from dronevio.models.surfaces import Mesh, PointCloud

POINTS = "dense/points"
MESH = "dense/mesh"
CAMERAS = "dense/cameras"
MAX_POINTS = 3_000_000
"""Largest number of points in a file; of more points, every n-th is written."""
_VIEW_ASPECT = 0.85  # width of one of two views side by side relative to its height


def write_dense_rerun(
    reconstruction: Reconstruction,
    cloud: PointCloud,
    mesh: Mesh,
    path: Path,
    *,
    point_size: float,
    name: str = "dense",
) -> None:
    """Write a rerun file of dense surfaces.

    Args:
        reconstruction: Cameras and points from which the surfaces were computed.
        cloud: Points of the surfaces.
        mesh: Triangles of the surfaces.
        path: File to write, with the suffix ``.rrd``.
        point_size: Distance between neighbouring points, in the unit of the world frame.
        name: Name of the recording in the viewer.

    Raises:
        InputError: The path is a folder, or one of its folders is a file.
    """
    check_output_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with Sink.to_file(path, name, _blueprint(reconstruction, cloud), origin_ns=0) as sink:
        every = -(-len(cloud) // MAX_POINTS) or 1
        radius = 0.5 * point_size * np.sqrt(every)
        positions = cloud.points[::every].astype(np.float32)
        sink.static(POINTS, rr.Points3D(positions, colors=cloud.colours[::every], radii=radius, point_shading="Flat"))
        sink.static(
            MESH,
            rr.Mesh3D(
                vertex_positions=mesh.vertices.astype(np.float32),
                triangle_indices=mesh.triangles.astype(np.uint32),
                vertex_normals=mesh.normals.astype(np.float32),
                vertex_colors=mesh.colours,
                face_rendering="Front",  # rooms are seen into from outside
            ),
        )
        edges = frusta(reconstruction, frustum_depth(reconstruction)).astype(np.float32)
        sink.static(
            CAMERAS, rr.LineStrips3D(edges, colors=colours.rgb(colours.ESTIMATE), radii=rr.Radius.ui_points(0.8))
        )


def _blueprint(reconstruction: Reconstruction, cloud: PointCloud) -> rrb.Blueprint:
    """Return the layout: the points and the mesh side by side, such that they fill the views."""
    R_scene_world = upright_rotation(reconstruction)
    position, target = surface_view(reconstruction, cloud.points, _VIEW_ASPECT)
    views = [
        rrb.Spatial3DView(
            origin="/",
            contents=[f"/{entity}", f"/{CAMERAS}"],
            name=title,
            eye_controls=rrb.EyeControls3D(
                kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=R_scene_world[2]
            ),
            line_grid=False,
            background=BACKGROUND,
        )
        for entity, title in ((POINTS, "Points"), (MESH, "Mesh"))
    ]
    return rrb.Blueprint(
        rrb.Horizontal(*views),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )
