"""Structure from motion of simulated survey flights: positions on Earth and north by the GPS tags of the photographs.

Two flights of 50 photographs (1000 × 750 px, a lens of 72° horizontally with a distortion that is estimated) over
fields, paths, trees and houses: ``nadir``, five lines of ten at 100 m above the ground, 27 m along and 40 m across, and
``oblique``, the same with the camera 30° from the vertical, in the direction of flight of each line. The ground is a
height field of 0.15 m cells, with a relief of 8 m and houses of 4 to 9 m, drawn from a seed; rays are traced to it, not
by MuJoCo. The photographs are JPEG files. Only their EXIF and XMP data, which hold noisy positions, differ between
the cases:

- ``rtk``: XMP as DJI writes it, RTK fixed, normally distributed errors of 2 cm in each coordinate, the same stated, and
  gimbal angles with errors of 0.3° in common and 0.1° each in tilt, and of 3° in common in yaw;
- ``gps``: EXIF alone, errors of 3 m in each coordinate, ``GPSHPositioningError`` 3 m;
- ``outlier``: as each of both, with 100 m added to one position, in a random direction.

``dv.sfm`` reads a folder of photographs, and keeps features and matches, which are those of all cases. Its positions
and the origin of its world frame are compared with the truth, without any alignment: their error is the root
mean square of the distances. That of north is the rotation about the vertical of the similarity transformation between
the camera positions and the true ones. Of errors of 3 m in each coordinate, 50 independent positions and the seven
unknowns of a similarity transformation leave 3 · √(7 / 50) = 1.12 m::

    .venv/bin/python benchmarks/survey_flights.py --work build/survey --seeds 0 1 2
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported

import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import tyro
from measuring import print_as_made
from PIL import Image as PillowImage
from PIL.TiffImagePlugin import IFDRational
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

import dronevio as dv
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.geodesy import GeodeticPoint, rotation_enu_cam, yaw_pitch_roll_deg
from dronevio.models.rotation import log_so3

CAMERA = CameraModel(1000, 750, 690.0, 690.0, 499.5, 374.5, (-0.02, 0.01, 0.0, 0.0))
"""The true camera; EXIF states a focal length that is wrong by 2 %."""
ORIGIN = GeodeticPoint(47.3977, 8.5456, 430.0)
"""Where the centre of the ground is on Earth."""
CELL_M, EXTENT_M = 0.15, (540.0, 400.0)
"""Cell of the height field and its extent, east and north [m]."""
RELIEF_M = 8.0
"""Four times the standard deviation of the terrain without trees and houses [m]."""
HEIGHT_M, LINES, PER_LINE, SPACING_M = 100.0, 5, 10, (27.0, 40.0)
"""Height above the ground, lines, photographs of a line, and their distances along and across [m]."""
OBLIQUE_DEG = 30.0
"""Angle of the oblique camera from the vertical [deg]."""
RTK_M, GPS_M, OUTLIER_M = 0.02, 3.0, 100.0
"""Standard deviations of each coordinate of a position, and the length of the outlier [m]."""


@dataclass(frozen=True)
class SurveyCommand:
    """Measure positions on Earth and north in simulated survey flights."""

    work: Path
    """Folder of the photographs and results; photographs that exist are used again."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the noise of the positions; the ground is that of seed 0."""
    flights: tuple[str, ...] = ("nadir", "oblique")
    """Flights."""
    cases: tuple[str, ...] = ("rtk", "rtk outlier", "gps", "gps outlier")
    """Positions."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A height field with colours; the first cell is in the south-west."""

    height_m: Array
    """(H, W) Height of each cell [m]."""
    colours: Image
    """(H, W, 3) Colour of each cell."""


def make_ground(seed: int) -> Ground:
    """Return fields, paths, trees and houses that are drawn from a seed."""
    rng = np.random.default_rng(seed)
    columns, rows = (round(extent / CELL_M) for extent in EXTENT_M)
    height = RELIEF_M / 4.0 * _noise(rng, rows, columns, (160.0, 80.0, 40.0))
    # Fields: the nearest of random centres, each with a colour and furrows, and paths between them
    centres = rng.uniform(0.0, EXTENT_M, (60, 2))
    x, y = np.meshgrid(np.arange(columns) * CELL_M, np.arange(rows) * CELL_M)
    distance, nearest = cKDTree(centres).query(np.column_stack([x.ravel(), y.ravel()]), k=2)
    field = nearest[:, 0].reshape(rows, columns)
    furrow = np.sin((x * np.cos(field) + y * np.sin(field)) * 3.0)
    colours = rng.uniform([60, 80, 40], [190, 170, 110], (60, 3))[field] + 6.0 * furrow[..., None]
    colours[(distance[:, 1] - distance[:, 0]).reshape(rows, columns) < 2.0] = (170, 160, 140)
    colours += 18.0 * _noise(rng, rows, columns, (4.0, 2.0, 1.0, 0.5))[..., None] * np.array([1.0, 0.9, 0.8])
    # Trees with round crowns
    for radius_m in rng.uniform(1.5, 4.0, 500):
        radius = round(radius_m / CELL_M)
        cx, cy = int(rng.integers(radius, columns - radius)), int(rng.integers(radius, rows - radius))
        window = np.s_[cy - radius : cy + radius, cx - radius : cx + radius]
        dx, dy = np.meshgrid(*(np.arange(-radius, radius) + 0.5,) * 2)
        crown = 1.0 - (dx**2 + dy**2) / radius**2
        inside = crown > 0.0
        height[window] += radius_m * np.sqrt(np.maximum(crown, 0.0))
        green = np.array([40, 70, 30]) + rng.uniform(-15, 15, 3) + 25.0 * rng.standard_normal((*crown.shape, 1))
        colours[window] = np.where(inside[..., None], green, colours[window])
    # Houses with flat roofs
    for size_m in rng.uniform(7.0, 18.0, (60, 2)):
        w, h = np.round(size_m / CELL_M).astype(int).tolist()
        cx, cy = int(rng.integers(0, columns - w)), int(rng.integers(0, rows - h))
        window = np.s_[cy : cy + h, cx : cx + w]
        height[window] = height[window].mean() + rng.uniform(4.0, 9.0)
        tiles = 10.0 * np.sign(np.sin(np.arange(w) * 1.0))[None, :, None] + 14.0 * rng.standard_normal((h, w, 1))
        colours[window] = rng.uniform([120, 50, 40], [200, 120, 110]) + tiles
    blurred = cv2.GaussianBlur(colours.astype(np.float32), (0, 0), 0.6)
    return Ground(height, np.clip(blurred, 0, 255).astype(np.uint8))


def _noise(rng: np.random.Generator, rows: int, columns: int, cells_m: tuple[float, ...]) -> Array:
    """Return fractal noise (rows, columns) of unit variance, an octave for each size of cells."""
    total = np.zeros((rows, columns), np.float32)
    for k, cell in enumerate(round(c / CELL_M) for c in cells_m):
        coarse = rng.standard_normal((rows // cell + 3, columns // cell + 3), dtype=np.float32)
        fine = cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        total += 0.7**k * fine[:rows, :columns]
    return np.asarray(total / total.std(), np.float64)


def poses(flight: str, seed: int = 7) -> Array:
    """Return the true poses (50, 4, 4) of the cameras in east, north, up, with the disturbances of a flight."""
    rng = np.random.default_rng(seed)
    tilt_deg = -90.0 if flight == "nadir" else -90.0 + OBLIQUE_DEG
    Ts = np.tile(np.eye(4), (LINES * PER_LINE, 1, 1))
    for i in range(len(Ts)):
        line, along = divmod(i, PER_LINE)
        forward = line % 2 == 0
        step = along if forward else PER_LINE - 1 - along
        east = (step - 0.5 * (PER_LINE - 1)) * SPACING_M[0]
        north = (line - 0.5 * (LINES - 1)) * SPACING_M[1]
        yaw = 90.0 if forward else 270.0
        angles = np.array([yaw, tilt_deg, 0.0]) + rng.normal(scale=[2.0, 1.0, 1.0])
        Ts[i, :3, :3] = rotation_enu_cam(*angles)
        Ts[i, :3, 3] = np.array([east, north, HEIGHT_M]) + rng.normal(scale=[1.0, 1.0, 0.8])
    return Ts


def render(ground: Ground, T: Array) -> Image:
    """Return the image (750, 1000, 3) of a camera: the first cell of the height field that each ray meets."""
    u, v = np.meshgrid(np.arange(CAMERA.width, dtype=np.float64), np.arange(CAMERA.height, dtype=np.float64))
    rays = CAMERA.unproject(np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    rays /= -rays[:, 2:]  # down by one metre
    top, bottom = float(ground.height_m.max()), float(ground.height_m.min())
    depth = np.full(len(rays), T[2, 3] - top)
    is_above = np.ones(len(rays), np.bool_)
    for _ in range(round((top - bottom) / (2.0 * CELL_M)) + 2):  # coarse steps, then bisection
        active = np.flatnonzero(is_above)
        if not len(active):
            break
        after = depth[active] + 2.0 * CELL_M
        p = T[:3, 3] + rays[active] * after[:, None]
        met = p[:, 2] <= _sampled(ground.height_m, p)
        depth[active[~met]] = after[~met]
        is_above[active[met]] = False
    low, high = depth, depth + 2.0 * CELL_M
    for _ in range(9):
        middle = 0.5 * (low + high)
        p = T[:3, 3] + rays * middle[:, None]
        met = p[:, 2] <= _sampled(ground.height_m, p)
        low, high = np.where(met, low, middle), np.where(met, middle, high)
    p = T[:3, 3] + rays * high[:, None]
    x, y = _cells(ground.height_m, p)
    shape = (CAMERA.height, CAMERA.width)
    maps = (x.reshape(shape).astype(np.float32), y.reshape(shape).astype(np.float32))
    return np.asarray(cv2.remap(ground.colours, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


def _cells(height_m: Array, p: Array) -> tuple[Array, Array]:
    """Return columns and rows (N,) of points (N, 3)."""
    rows, columns = height_m.shape
    return p[:, 0] / CELL_M + 0.5 * (columns - 1), p[:, 1] / CELL_M + 0.5 * (rows - 1)


def _sampled(height_m: Array, p: Array) -> Array:
    """Return the heights (N,) at points (N, 3), interpolated between the centres of the cells."""
    x, y = _cells(height_m, p)
    return np.asarray(map_coordinates(height_m, [y, x], order=1, mode="nearest"))


# --- photographs


def photograph(flight: str, folder: Path) -> None:
    """Render the photographs of a flight into a folder, as PNG, unless they exist."""
    if len(list(folder.glob("*.png"))) == LINES * PER_LINE:
        return
    folder.mkdir(parents=True, exist_ok=True)
    ground = make_ground(0)
    with ProcessPoolExecutor(2) as pool:
        for i, image in enumerate(pool.map(partial(render, ground), poses(flight))):
            noise = np.random.default_rng(i).normal(scale=2.0, size=image.shape)
            grey = np.clip(image + noise, 0, 255).astype(np.uint8)
            PillowImage.fromarray(grey).save(folder / f"{i:03d}.png")


def measured(flight: str, case: str, seed: int) -> tuple[Array, Array]:
    """Return noisy positions (50, 3) in east, north, up [m], and yaw, pitch and roll (50, 3) of the gimbal [deg]."""
    rng = np.random.default_rng([seed, 1 if case.startswith("rtk") else 2])
    Ts = poses(flight)
    sigma = RTK_M if case.startswith("rtk") else GPS_M
    positions = Ts[:, :3, 3] + rng.normal(scale=sigma, size=(len(Ts), 3))
    angles = np.array([yaw_pitch_roll_deg(T[:3, :3]) for T in Ts])
    angles += rng.normal(scale=[3.0, 0.3, 0.3]) + rng.normal(scale=0.1, size=angles.shape)
    if case.endswith("outlier"):
        direction = rng.normal(size=3)
        positions[int(rng.integers(len(Ts)))] += OUTLIER_M * direction / np.linalg.norm(direction)
    return positions, angles


def write_photographs(source: Path, folder: Path, flight: str, case: str, seed: int) -> None:
    """Write the photographs as JPEG with their positions in EXIF and, for RTK, in XMP."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    positions, angles = measured(flight, case, seed)
    for file, place, gimbal in zip(sorted(source.glob("*.png")), ORIGIN.from_enu(positions), angles, strict=True):
        is_rtk = case.startswith("rtk")
        exif, xmp = _exif(place, None if is_rtk else GPS_M), _xmp(place, gimbal) if is_rtk else b""
        PillowImage.open(file).save(folder / f"{file.stem}.jpg", quality=95, exif=exif, xmp=xmp)


def _exif(place: Array, sigma_m: float | None) -> PillowImage.Exif:
    """Return EXIF data with a position, its accuracy and a focal length that is wrong by 2 %."""
    exif = PillowImage.Exif()
    camera = exif.get_ifd(0x8769)
    camera[0xA405] = round(1.02 * CAMERA.fx * np.hypot(36.0, 24.0) / np.hypot(CAMERA.width, CAMERA.height))
    gps = exif.get_ifd(0x8825)
    gps[1], gps[2] = "N" if place[0] >= 0.0 else "S", _sexagesimal(place[0])
    gps[3], gps[4] = "E" if place[1] >= 0.0 else "W", _sexagesimal(place[1])
    gps[5], gps[6] = b"\x02", IFDRational(round(1e4 * place[2]), 10_000)  # above the ellipsoid
    if sigma_m is not None:
        gps[31] = IFDRational(round(1e3 * sigma_m), 1000)
    return exif


def _sexagesimal(angle_deg: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Return degrees, minutes and seconds of the magnitude of an angle."""
    seconds = abs(angle_deg) * 3600.0
    degrees, minutes = int(seconds // 3600), int(seconds % 3600 // 60)
    rest = round(1e6 * (seconds - 3600 * degrees - 60 * minutes))
    return IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(rest, 1_000_000)


def _xmp(place: Array, gimbal: Array) -> bytes:
    """Return the XMP of a drone with RTK, as DJI writes it."""
    values = {
        "AltitudeType": "RtkAlt",
        "GpsLatitude": f"{place[0]:+.10f}",
        "GpsLongitude": f"{place[1]:+.10f}",
        "AbsoluteAltitude": f"{place[2]:+.4f}",
        "GimbalYawDegree": f"{gimbal[0]:+.2f}",
        "GimbalPitchDegree": f"{gimbal[1]:+.2f}",
        "GimbalRollDegree": f"{gimbal[2]:+.2f}",
        "RtkFlag": "50",
        **dict.fromkeys(("RtkStdLon", "RtkStdLat", "RtkStdHgt"), f"{RTK_M:.5f}"),
    }
    attributes = "".join(f' drone-dji:{name}="{value}"' for name, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"{attributes}/>'
        "</rdf:RDF></x:xmpmeta>"
    ).encode()


# --- measurement


@dataclass(frozen=True)
class Outcome:
    """Errors of a reconstruction against the truth, and what it states."""

    registered: int
    rms_m: float
    horizontal_m: float
    vertical_m: float
    north_deg: float
    tilt_deg: float
    north_sigma_deg: float
    outliers: int


def measure(folder: Path, workspace: Path, flight: str) -> Outcome:
    """Reconstruct a folder of photographs, whose features and matches are kept, and return the errors."""
    result = dv.sfm(folder, workspace=workspace)
    found, world = result.reconstructions[0], result.worlds[0]
    if world.geo is None or world.origin is None:
        raise SystemExit(f"{folder}: {world.note}")
    geo = world.geo
    Ts = poses(flight)[[int(Path(name).stem) for name in found.image_names]]
    estimated = ORIGIN.to_enu(world.origin.from_enu(found.positions))
    errors = estimated - Ts[:, :3, 3]
    turn = np.degrees(log_so3(umeyama(Ts[:, :3, 3], estimated, with_scale=True).R_truth_estimate))
    return Outcome(
        len(found.image_names),
        float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        float(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))),
        float(np.sqrt(np.mean(errors[:, 2] ** 2))),
        abs(float(turn[2])),
        float(np.linalg.norm(turn[:2])),
        float(np.degrees(geo.north_sigma_rad)),
        int(geo.is_outlier.sum()),
    )


def rows(command: SurveyCommand) -> Iterator[dict[str, str]]:
    """Yield a row for each seed, flight and case."""
    for seed, flight, case in product(command.seeds, command.flights, command.cases):
        source = command.work / flight
        photograph(flight, source)
        folder = command.work / f"{flight}-{case.replace(' ', '-')}-{seed}"
        write_photographs(source, folder, flight, case, seed)
        found = measure(folder, command.work / f"{flight}-workspace", flight)
        yield {
            "flight": flight,
            "positions": case,
            "seed": str(seed),
            "registered": str(found.registered),
            "error RMS [m]": f"{found.rms_m:.3f}",
            "horizontal [m]": f"{found.horizontal_m:.3f}",
            "vertical [m]": f"{found.vertical_m:.3f}",
            "north [°]": f"{found.north_deg:.3f}",
            "stated σ [°]": f"{found.north_sigma_deg:.3f}",
            "vertical axis [°]": f"{found.tilt_deg:.3f}",
            "outliers": str(found.outliers),
        }


if __name__ == "__main__":
    print_as_made(rows(tyro.cli(SurveyCommand, description=__doc__)))
