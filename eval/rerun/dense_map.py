"""A dense map that grows in a recording: submaps that move when a loop closes, the path, the camera and its depth.

The occupied cells of a submap are points in its odometry frame, and its pose in the map is a transform over time: a
correction moves the whole submap. What has arrived is logged once per second of flight.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dronevio.eval import colours
from dronevio.eval.images import depth_colours
from dronevio.eval.rerun.blueprint import BACKGROUND, TIMELINE, collapsed_panels
from dronevio.eval.rerun.images import JpegLog
from dronevio.eval.rerun.log import first_time_ns
from dronevio.eval.rerun.sink import Sink
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.imu import Times
from dronevio.models.occupancy import OCCUPIED, PlacedSubmap
from dronevio.models.protocols import Recording
from dronevio.models.state import Estimate, Trajectory
from dronevio.models.surfaces import Mesh

CHUNK_S = 1.0
"""Duration that is logged at a time [s]."""
CAMERA = "world/camera"
"""Path of the camera whose depths enter the map."""
IMAGE = f"{CAMERA}/image"
"""Path of its undistorted images."""
DEPTH = "depth"
"""Path of the pictures of its depths."""
PATH_SO_FAR = "world/path_so_far"
"""Path of the flight up to the time cursor."""
SUBMAPS = "world/submaps"
"""Path of the submaps: their cells up to `HEADROOM_M` above the flight."""
ABOVE = "world/above"
"""Path of the cells above those, such as ceilings, which are not shown unless somebody switches them on."""
HEADROOM_M = 0.3
"""Height above the flight up to which cells are shown, so that one sees into rooms [m]."""
FINAL = "final"
"""Path of the world frame of the final mesh."""
_FAR_M = 0.3  # distance of the image plane from the drawn camera
_MIN_HEIGHT_M = 2.5  # between the ends of the colour scale of heights


class DenseMapLog:
    """Logs a dense map while it grows."""

    def __init__(self, sink: Sink, chunk_s: float = CHUNK_S) -> None:
        """Log how the map is drawn; see `CHUNK_S`."""
        self._sink, self._chunk_ns = sink, round(chunk_s * 1e9)
        batch = 10
        self._images, self._depths = JpegLog(sink, IMAGE, batch), JpegLog(sink, DEPTH, batch)
        self._t_ns: list[int] = []
        self._poses: list[Array] = []
        self._last_p: Array = np.zeros((0, 3))
        self._next_ns: int | None = None
        self._poses_shown: dict[int, Array] = {}
        self._cells_shown: dict[str, int] = {}
        self._top_m = -np.inf  # of the cells that are shown
        self._heights_m: tuple[float, float] | None = None
        for entity in ("world", FINAL):
            sink.static(entity, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        style = rr.LineStrips3D.from_fields(colors=colours.rgb(colours.ESTIMATE), radii=rr.Radius.ui_points(2.0))
        sink.static(PATH_SO_FAR, style)

    def depth(self, depth: DepthImage, estimate: Estimate, submaps: Callable[[], Sequence[PlacedSubmap]]) -> None:
        """Add a depth image.

        Args:
            depth: The image.
            estimate: The estimate of its frame.
            submaps: Returns the submaps that contain it; it is called once per second of flight.
        """
        if not self._t_ns and self._next_ns is None:
            self._log_camera(depth)
            self._next_ns = depth.t_ns
        T_map_odom = np.eye(4) if estimate.T_map_odom is None else estimate.T_map_odom
        self._top_m = max(self._top_m, float(depth.T_odom_cam[2, 3]) + HEADROOM_M)
        self._t_ns.append(depth.t_ns)
        self._poses.append(np.asarray(T_map_odom @ depth.T_odom_cam))
        self._images.add(depth.t_ns, depth.grey)
        inverse = np.divide(1.0, depth.depth_m, out=np.zeros_like(depth.depth_m), where=depth.known)
        self._depths.add(depth.t_ns, depth_colours(inverse)[..., ::-1])  # OpenCV writes blue, green, red
        if self._next_ns is not None and depth.t_ns >= self._next_ns:
            self._next_ns = depth.t_ns + self._chunk_ns
            self._flush(submaps())

    def finish(self, submaps: Sequence[PlacedSubmap], mesh: Mesh, trajectory: Trajectory) -> None:
        """Log the final map: its submaps at the end, and the mesh with the path at all times."""
        self.close(submaps)
        faces = rr.Mesh3D(
            vertex_positions=mesh.vertices.astype(np.float32),
            triangle_indices=mesh.triangles.astype(np.uint32),
            vertex_normals=mesh.normals.astype(np.float32),
            vertex_colors=mesh.colours,
            face_rendering="Front",
        )
        self._sink.static(f"{FINAL}/mesh", faces)
        path, rgb = trajectory.p_world_imu.astype(np.float32), colours.rgb(colours.ESTIMATE)
        self._sink.static(f"{FINAL}/path", rr.LineStrips3D([path], colors=rgb, radii=rr.Radius.ui_points(1.5)))

    def close(self, submaps: Sequence[PlacedSubmap]) -> None:
        """Log all that has not been logged yet, and the submaps at the end."""
        self._flush(submaps)
        self._images.close()
        self._depths.close()

    def _flush(self, submaps: Sequence[PlacedSubmap]) -> None:
        """Log everything that has been received, and the submaps that have changed."""
        if not self._t_ns:
            return
        t_ns, Ts = np.array(self._t_ns, dtype=np.int64), np.stack(self._poses)
        self._t_ns, self._poses = [], []
        self._sink.poses(CAMERA, t_ns, Ts)
        p = np.concatenate([self._last_p, Ts[:, :3, 3]])
        self._last_p = p[-1:]
        if len(p) > 1:
            self._sink.segments(PATH_SO_FAR, t_ns[1 - len(p) :], p[:-1], p[1:])
        for submap in submaps:
            self._log_submap(submap, t_ns[-1:])

    def _log_submap(self, submap: PlacedSubmap, t_ns: Times) -> None:
        """Log the pose of a submap and its occupied cells where they have changed."""
        cells, T = submap.grid.points(OCCUPIED), submap.T_map_odom
        before = self._poses_shown.get(submap.number)
        is_moved = T is not None and (before is None or not np.array_equal(T, before))
        is_above = cells[:, 2] > self._top_m
        for parent, chosen in ((SUBMAPS, cells[~is_above]), (ABOVE, cells[is_above])):
            entity = f"{parent}/{submap.number}"
            if T is not None and is_moved:
                self._sink.poses(entity, t_ns, T[None])
                self._poses_shown[submap.number] = T
            self._log_cells(f"{entity}/cells", chosen, submap.grid.cell_m, t_ns)

    def _log_cells(self, entity: str, cells: Array, cell_m: float, t_ns: Times) -> None:
        """Log cells (N, 3) if they differ from those that were logged last."""
        digest = hash(cells.tobytes())
        if self._cells_shown.get(entity) == digest:
            return
        self._cells_shown[entity] = digest
        columns = rr.Points3D.columns(
            positions=cells.astype(np.float32),
            colors=self._colours(cells),
            radii=np.full(len(cells), 0.5 * cell_m, np.float32),
        )
        self._sink.columns(entity, t_ns, columns.partition([len(cells)]))

    def _colours(self, cells: Array) -> Array:
        """Return colours (N, 3) of cells (N, 3) by their height; the scale is that of the first cells."""
        if self._heights_m is None and len(cells):
            low, high = np.percentile(cells[:, 2], [2.0, 98.0])
            self._heights_m = float(low), float(max(high, low + _MIN_HEIGHT_M))
        low_m, high_m = self._heights_m or (0.0, _MIN_HEIGHT_M)
        return np.asarray(colours.height_colours(cells[:, 2], low_m, high_m))

    def _log_camera(self, depth: DepthImage) -> None:
        """Log the camera of the undistorted images."""
        camera = depth.camera
        pinhole = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FAR_M,
            color=colours.rgb(colours.ESTIMATE),
            line_width=-0.8,  # in points of the screen, because it is negative
        )
        self._sink.static(IMAGE, pinhole)


@contextmanager
def dense_map_file(path: Path, recording: Recording) -> Iterator[DenseMapLog]:
    """Open the rerun file of a map, which is complete when the context is left."""
    with Sink.to_file(path, recording.name, _blueprint(), first_time_ns(recording)) as sink:
        yield DenseMapLog(sink)


@contextmanager
def dense_map_viewer(url: str, recording: Recording) -> Iterator[DenseMapLog]:
    """Show a map in a viewer at a URL such as ``rerun+http://127.0.0.1:9876/proxy`` while it grows."""
    with Sink.to_viewer(url, recording.name, _blueprint(is_live=True), first_time_ns(recording)) as sink:
        yield DenseMapLog(sink)


def _blueprint(*, is_live: bool = False) -> rrb.Blueprint:
    """Return the layout: the map beside the image, depths and final mesh; a live one follows the newest time."""
    beginning, cursor = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    so_far = rrb.VisibleTimeRanges(timeline=TIMELINE, start=beginning, end=cursor)
    growing = rrb.Spatial3DView(
        origin="world",
        name="Map: occupied cells by height",
        line_grid=False,
        background=BACKGROUND,
        overrides={PATH_SO_FAR: so_far, ABOVE: rrb.EntityBehavior(visible=False)},
    )
    final = rrb.Spatial3DView(origin=FINAL, name="Final mesh", line_grid=False, background=BACKGROUND)
    images = rrb.Vertical(
        rrb.Spatial2DView(origin=IMAGE, name="Undistorted image"),
        rrb.Spatial2DView(origin=DEPTH, name="Depth: near (red) to far (blue)"),
        final,
    )
    return rrb.Blueprint(
        rrb.Horizontal(growing, images, column_shares=[1.9, 1.0]),
        *collapsed_panels(is_live),
        auto_views=False,
        auto_layout=False,
    )
