"""The report of dense surfaces: pictures of the points and of the mesh, images beside their depths, and numbers.

``report.json`` holds the following keys:

    format         "dronevio-dense-report/1"
    title, command, open_command               as in `RunInfo`
    statistics     images, points, vertices, triangles, known_percent (pixels with a depth)
    times_s        {stage: processing time}
    configuration, versions, machine           as in `RunInfo`
"""

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.eval.images import DEPTH_PERCENT, depth_colours, downscaled
from dronevio.eval.metrics.clouds import mesh_points
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.tables import Cell, Table
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.eval.scene import VIEWER_FIELD_OF_VIEW_RAD, upright_rotation
from dronevio.eval.splatting import ViewCamera, shaded, splat
from dronevio.eval.surface_view import surface_view
from dronevio.models.arrays import Floats, Image
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.recordings.files import write_bytes, write_text
from dronevio.models.recordings.images import encode_jpeg
from dronevio.models.surfaces import Mesh, PointCloud

FORMAT = "dronevio-dense-report/1"
MAX_PHOTOGRAPHS = 6
"""Number of images that the page shows with their depths."""
_PICTURE_PX = (1600, 1000)
_PHOTOGRAPH_PX = 640  # length of the longer side
_MESH_PX, _TEXTURE_PX = 2.0, 1.0  # distances of the drawn points of the mesh in the middle of the picture


@dataclass(frozen=True, eq=False)
class DenseResults:
    """Everything that the report of dense surfaces shows."""

    reconstruction: Reconstruction
    """Cameras and points from which the surfaces were computed."""
    cloud: PointCloud
    """Points of the surfaces."""
    mesh: Mesh
    """Triangles of the surfaces."""
    inverse_depths: Sequence[Floats]
    """Inverse depths (H, W) of the undistorted images; 0 where unknown."""
    read_image: Callable[[int], Image]
    """Function that returns the undistorted image (H, W, 3) with an index in the reconstruction."""
    point_size: float
    """Distance between neighbouring points on the surfaces, in the unit of the world frame."""
    times_s: Mapping[str, float] = field(default_factory=dict)
    """Processing time of each stage by its name [s]."""

    def known_percent(self) -> float:
        """Return the share of the pixels with a depth [%]."""
        known = sum(int(np.count_nonzero(w)) for w in self.inverse_depths)
        return 100.0 * known / max(sum(w.size for w in self.inverse_depths), 1)


@dataclass(frozen=True)
class DepthPhotograph:
    """An image beside its depths."""

    caption: str
    """Name of the image and range of its depths."""
    image_base64: str
    """JPEG of the image."""
    depth_base64: str
    """JPEG of the coloured depths."""


def write_dense_report(folder: Path, info: RunInfo, results: DenseResults) -> None:
    """Write ``report.html``, ``report.json`` and the pictures ``dense.jpg`` and ``mesh.jpg``.

    Args:
        folder: Folder for the files; it is created if it does not exist.
        info: Provenance of the surfaces.
        results: The surfaces and what belongs to them.

    Raises:
        InputError: A file cannot be written, or an image cannot be read.
    """
    points, mesh = pictures(results)
    textured = textured_picture(results)
    write_text(folder / "report.json", json.dumps(_values(info, results), indent=2, ensure_ascii=False) + "\n")
    page = render_page(
        "dense.html.j2",
        info.title,
        f"{len(results.cloud)} points and {len(results.mesh.triangles)} triangles from "
        f"{len(results.inverse_depths)} images",
        tiles=list(_tiles(results)),
        points_base64=_base64(points),
        mesh_base64=_base64(mesh),
        textured_base64=None if textured is None else _base64(textured),
        photographs=list(_photographs(results)),
        times=_time_table(results),
        open_command=info.open_command,
        provenance=info.sections,
    )
    write_text(folder / "report.html", page)
    write_bytes(folder / "dense.jpg", encode_jpeg(points, quality=90))
    write_bytes(folder / "mesh.jpg", encode_jpeg(mesh, quality=90))
    if textured is not None:
        write_bytes(folder / "textured.jpg", encode_jpeg(textured, quality=90))


def pictures(results: DenseResults) -> tuple[Image, Image]:
    """Return perspective pictures of the points and of the mesh.

    Only surfaces that face the viewpoint are drawn, so that a room is seen into from outside.
    """
    cloud, mesh = results.cloud, results.mesh
    camera, distance = _view(results)
    seen = camera.faces(cloud.points, cloud.normals)
    points = splat(camera, cloud.points[seen], cloud.colours[seen], 1.4 * results.point_size)
    spacing = _MESH_PX * distance / camera.focal_px
    rows = mesh_points(np.hstack([mesh.vertices, mesh.normals]), mesh.triangles[_facing(mesh, camera)], spacing)
    lengths = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    normals = rows[:, 3:] / np.maximum(lengths, np.finfo(float).tiny)
    return points, splat(camera, rows[:, :3], shaded(normals, camera), spacing)


def textured_picture(results: DenseResults) -> Image | None:
    """Return the picture of the mesh with its texture from the same viewpoint; None without a texture."""
    mesh = results.mesh
    if mesh.texture is None:
        return None
    texture, (camera, distance) = mesh.texture, _view(results)
    spacing = _TEXTURE_PX * distance / camera.focal_px
    corners = np.hstack([mesh.vertices[texture.vertices], texture.pixels])
    rows = mesh_points(corners, texture.triangles[_facing(mesh, camera)], spacing)
    column, row = np.rint(rows[:, 3:]).astype(np.int64).T
    return splat(camera, rows[:, :3], texture.image[row, column], spacing)


def _view(results: DenseResults) -> tuple[ViewCamera, float]:
    """Return the viewpoint of the pictures, and its distance from the scene."""
    up = upright_rotation(results.reconstruction)[2]
    placed = surface_view(results.reconstruction, results.cloud.points, _PICTURE_PX[0] / _PICTURE_PX[1])
    camera = ViewCamera.looking_at(*placed, up, VIEWER_FIELD_OF_VIEW_RAD, *_PICTURE_PX)
    return camera, float(np.linalg.norm(placed[1] - placed[0]))


def _facing(mesh: Mesh, camera: ViewCamera) -> npt.NDArray[np.bool_]:
    """Return which triangles (F,) face a camera with all corners."""
    return np.asarray(np.all(camera.faces(mesh.vertices, mesh.normals)[mesh.triangles], axis=1))


def _photographs(results: DenseResults) -> Iterator[DepthPhotograph]:
    """Yield images spread evenly over all, with their depths."""
    count = len(results.inverse_depths)
    shares = (np.arange(MAX_PHOTOGRAPHS) + 0.5) / MAX_PHOTOGRAPHS
    for i in sorted({int(share * count) for share in shares if count}):
        inverse_depth = results.inverse_depths[i]
        known = inverse_depth[inverse_depth > 0.0]
        name = results.reconstruction.image_names[i]
        caption = f"{name}: {100.0 * len(known) / inverse_depth.size:.0f} % of the pixels have a depth"
        if len(known):
            near, far = 1.0 / np.percentile(known, DEPTH_PERCENT[::-1])
            caption += f", {near:.3g} (red) to {far:.3g} (blue)"
        coloured = depth_colours(inverse_depth)
        yield DepthPhotograph(
            caption,
            _base64(downscaled(results.read_image(i), _PHOTOGRAPH_PX)),
            _base64(downscaled(coloured, _PHOTOGRAPH_PX)),
        )


def _tiles(results: DenseResults) -> Iterator[Tile]:
    """Yield the numbers at the top of the page."""
    yield Tile("Points", f"{len(results.cloud)}", "", "with normals and colours")
    yield Tile("Triangles", f"{len(results.mesh.triangles)}", "", f"between {len(results.mesh.vertices)} vertices")
    yield Tile("Pixels with a depth", number(results.known_percent(), 0), "%", "that other images confirm")
    if results.times_s:
        yield Tile("Processing time", number(sum(results.times_s.values()), 1), "s", "sum of all stages")


def _time_table(results: DenseResults) -> Table:
    """Return the processing time of each stage."""
    rows = tuple((Cell(stage), Cell(number(s, 1), order=s)) for stage, s in results.times_s.items())
    return Table("Processing times", ("stage", "time [s]"), rows)


def _values(info: RunInfo, results: DenseResults) -> dict[str, object]:
    """Return the content of ``report.json``."""
    return {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        "statistics": {
            "images": len(results.inverse_depths),
            "points": len(results.cloud),
            "vertices": len(results.mesh.vertices),
            "triangles": len(results.mesh.triangles),
            "known_percent": results.known_percent(),
        },
        "times_s": dict(results.times_s),
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }


def _base64(image: Image) -> str:
    """Return an image as JPEG in base64."""
    return base64.b64encode(encode_jpeg(image)).decode("ascii")
