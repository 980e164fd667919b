"""The report of a dense map: from above, in slices, its mesh, and figures.

``report.json`` holds the following keys:

    format         "dronevio-map-report/1"
    title, command, open_command               as in `RunInfo`
    figures        the fields of `DenseMapFigures`
    band_m         lowest and highest z of the map of ROS
    configuration, versions, machine           as in `RunInfo`
"""

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import numpy as np

from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.map_pictures import (
    dense_line,
    horizontal_slice,
    mesh_picture,
    plot_from_above,
    ros_layer,
    vertical_slice,
)
from dronevio.eval.report.tables import Cell, Table
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.models.arrays import Array
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid, PlacedSubmap
from dronevio.models.occupancy_maps import layer_of
from dronevio.models.recordings.files import write_bytes, write_text
from dronevio.models.recordings.images import encode_jpeg
from dronevio.models.state import Trajectory
from dronevio.models.surfaces import Mesh, PointCloud

FORMAT = "dronevio-map-report/1"
_SLICES_PERCENT = (10.0, 90.0)  # percentiles of the heights along the path at which slices are drawn


@dataclass(frozen=True)
class DenseMapFigures:
    """The figures of a dense map."""

    frames: int
    """Number of frames of the recording."""
    depth_images: int
    """Number of depth images that entered the map."""
    path_m: float
    """Length of the path [m]."""
    estimator_cpu_ms: float
    """Processor time of the estimator per frame [ms]."""
    depth_cpu_ms: float
    """Median processor time of a depth image with its evidence and its entry in the map [ms]."""
    depth_cpu_p95_ms: float
    """95th percentile of the same [ms]."""
    cell_m: float
    """Side of the cells [m]."""
    free_m3: float
    """Volume that is known to be free [m³]."""
    occupied_m3: float
    """Volume of the cells with a surface [m³]."""
    unknown_m3: float
    """Volume of the other cells within the box of the map [m³]."""
    submaps: int
    """Number of submaps."""
    points: int
    """Number of points of the surfaces."""
    triangles: int
    """Number of triangles of the mesh."""
    peak_memory_gb: float
    """Largest memory of the process [GB]."""

    @classmethod
    def of(
        cls,
        occupancy: OccupancyGrid,
        submaps: Sequence[PlacedSubmap],
        cloud: PointCloud,
        mesh: Mesh,
        *,
        frames: int,
        path_m: float,
        estimator_cpu_ms: Array,
        depth_cpu_ms: Array,
        peak_memory_gb: float,
    ) -> Self:
        """Return the figures of a map, with the processor times of its frames (M,) and depth images (D,) [ms]."""
        cell_m3 = occupancy.cell_m**3
        free, occupied = (int(np.count_nonzero(occupancy.states == state)) for state in (FREE, OCCUPIED))
        median_ms, p95_ms = np.percentile(depth_cpu_ms, [50.0, 95.0]).tolist() if len(depth_cpu_ms) else (0.0, 0.0)
        return cls(
            frames=frames,
            depth_images=len(depth_cpu_ms),
            path_m=path_m,
            estimator_cpu_ms=float(estimator_cpu_ms.mean()) if len(estimator_cpu_ms) else 0.0,
            depth_cpu_ms=median_ms,
            depth_cpu_p95_ms=p95_ms,
            cell_m=occupancy.cell_m,
            free_m3=free * cell_m3,
            occupied_m3=occupied * cell_m3,
            unknown_m3=(occupancy.states.size - free - occupied) * cell_m3,
            submaps=len(submaps),
            points=len(cloud),
            triangles=len(mesh.triangles),
            peak_memory_gb=peak_memory_gb,
        )

    def rows(self) -> tuple[tuple[str, str, str], ...]:
        """Return names, values and units for a table."""
        return (
            ("frames", f"{self.frames}", ""),
            ("depth images in the map", f"{self.depth_images}", ""),
            ("length of the path", f"{self.path_m:.2f}", "m"),
            ("processor time of the estimator per frame", f"{self.estimator_cpu_ms:.1f}", "ms"),
            ("processor time per depth image, median", f"{self.depth_cpu_ms:.1f}", "ms"),
            ("processor time per depth image, 95 %", f"{self.depth_cpu_p95_ms:.1f}", "ms"),
            ("side of the cells", f"{self.cell_m:g}", "m"),
            ("free", f"{self.free_m3:.1f}", "m³"),
            ("occupied", f"{self.occupied_m3:.1f}", "m³"),
            ("unknown within the box of the map", f"{self.unknown_m3:.1f}", "m³"),
            ("submaps", f"{self.submaps}", ""),
            ("points", f"{self.points}", ""),
            ("triangles of the mesh", f"{self.triangles}", ""),
            ("peak memory", f"{self.peak_memory_gb:.2f}", "GB"),
        )


@dataclass(frozen=True, eq=False)
class DenseMapResults:
    """Everything that the report of a dense map shows."""

    occupancy: OccupancyGrid
    """What is free, occupied and unknown, in the map frame."""
    mesh: Mesh
    """Triangles of the surfaces, in the map frame."""
    trajectory: Trajectory
    """Poses of the IMU in the map frame, at least one."""
    band_m: tuple[float, float]
    """Lowest and highest z of the map of ROS [m]."""
    figures: DenseMapFigures
    """The figures."""


def write_dense_map_report(folder: Path, info: RunInfo, results: DenseMapResults) -> None:
    """Write ``report.html``, ``report.json`` and the picture ``mesh.jpg`` if there is a mesh.

    Args:
        folder: Folder for the files; it is created if it does not exist.
        info: Provenance of the map.
        results: The map.

    Raises:
        InputError: A file cannot be written.
    """
    grid, path, figures = results.occupancy, results.trajectory.p_world_imu, results.figures
    picture = encode_jpeg(mesh_picture(results.mesh, path), quality=88) if len(results.mesh.triangles) else b""
    along = dense_line(path, grid.cell_m)  # without rests, in which a drone stands on the ground
    heights_m = np.unique(np.round(np.percentile(along[:, 2], _SLICES_PERCENT) / grid.cell_m)) * grid.cell_m
    values = {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        "figures": asdict(figures),
        "band_m": list(results.band_m),
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }
    rows = tuple((Cell(name), Cell(f"{value} {unit}".strip())) for name, value, unit in figures.rows())
    page = render_page(
        "dense_map.html.j2",
        info.title,
        f"{figures.depth_images} depth images along {figures.path_m:.1f} m",
        tiles=list(_tiles(figures)),
        from_above=plot_from_above(grid, path),
        mesh_base64=base64.b64encode(picture).decode("ascii"),
        slices=[
            ros_layer(layer_of(grid, *results.band_m), results.band_m, path),
            vertical_slice(grid, path),
            *(horizontal_slice(grid, float(z), path) for z in heights_m),
        ],
        figures=Table("Figures", ("quantity", "value"), rows),
        band_m=results.band_m,
        open_command=info.open_command,
        provenance=info.sections,
    )
    write_text(folder / "report.json", json.dumps(values, indent=2, ensure_ascii=False) + "\n")
    write_text(folder / "report.html", page)
    if picture:
        write_bytes(folder / "mesh.jpg", picture)


def _tiles(figures: DenseMapFigures) -> Iterator[Tile]:
    """Yield the numbers at the top of the page."""
    yield Tile("Free", number(figures.free_m3, 1), "m³", "seen through by depth images")
    yield Tile(
        "Occupied", number(figures.occupied_m3, 1), "m³", f"cells of {100.0 * figures.cell_m:g} cm with a surface"
    )
    yield Tile("Triangles", f"{figures.triangles}", "", f"and {figures.points} points")
    yield Tile("Time per depth image", number(figures.depth_cpu_ms, 1), "ms", "median processor time, map included")
