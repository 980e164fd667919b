"""Self-calibration of real photographs, beside COLMAP.

Folders of photographs and videos whose cameras have no calibration are reconstructed by both programs, with a focal
length and radial distortion k1, k2 to estimate; COLMAP (pycolmap) matches all pairs with its default settings and one
seed. Of each program, the largest component counts. Cameras that both register are compared: the median angle
between their relative rotations over all pairs, and the RMS distance of their positions after a similarity
transformation, relative to the RMS distance of the positions from their mean. A focal length that is known, by a
calibration or from the database of sensors, is given as ``--known``::

    .venv/bin/python benchmarks/self_calibration.py sets/sceaux sets/kermit --known sceaux 2905.9
    .venv/bin/python benchmarks/self_calibration.py sets/sacre_coeur --camera per-image
    .venv/bin/python benchmarks/self_calibration.py karma.mp4 --every 10
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from measuring import print_as_made, text

from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.arrays import Array
from dronevio.models.image_sets import ImageSet, open_images
from dronevio.models.image_sets.folder import CameraSharing
from dronevio.models.rotation import log_so3


@dataclass(frozen=True)
class CalibrationCommand:
    """Reconstruct photographs of cameras without a calibration."""

    sets: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of photographs, or videos."""
    camera: CameraSharing = "shared"
    """Whether photographs of one size and lens share a camera, or each has its own."""
    every: int = 1
    """Distance between the frames of a video."""
    known: dict[str, float] = field(default_factory=dict)
    """Known focal length by the name of the set [px]."""
    colmap: bool = True
    """Whether COLMAP reconstructs the photographs, too."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a program found: C images in the largest component, with K cameras."""

    cpu_s: float
    """Processor time [s]."""
    components: int = 0
    """Number of components."""
    points: int = 0
    """Number of points."""
    error_px: float = np.nan
    """Mean over the points of the mean reprojection error of their observations [px]."""
    names: tuple[str, ...] = ()
    """(C,) Names of the images."""
    Ts_world_cam: Array = field(default_factory=lambda: np.empty((0, 4, 4)))
    """(C, 4, 4) Poses of the cameras."""
    focal_px: Array = field(default_factory=lambda: np.empty(0))
    """(K,) Focal lengths [px]."""
    distortion: Array = field(default_factory=lambda: np.empty((0, 2)))
    """(K, 2) Radial distortion k1, k2."""
    of_focal: str = ""
    """What a program says of the focal length of a single camera: its standard deviation, or that it was held."""


def _cpu_s() -> float:
    """Return the processor time of this process and of those that it has waited for [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def ours(images: ImageSet) -> Outcome:
    """Reconstruct with this project."""
    start = _cpu_s()
    result = reconstruct(images)
    cpu_s = _cpu_s() - start
    if not result.reconstructions:
        return Outcome(cpu_s)
    found, calibrations = result.reconstructions[0], result.calibrations[0]
    used = np.unique(found.image_camera)
    calibration = calibrations[used[0]] if len(used) == 1 else None
    of_focal = ""
    if calibration is not None:
        of_focal = " held" if "f" in calibration.held else f" ± {calibration.sigmas['f']:.1f}"
    sums = np.bincount(found.observation_point, found.reprojection_errors_px())
    return Outcome(
        cpu_s,
        len(result.reconstructions),
        len(found.points),
        float(np.mean(sums / found.track_lengths())),
        found.image_names,
        found.Ts_world_cam,
        np.array([found.cameras[k].fx for k in used]),
        np.array([(*found.cameras[k].distortion, 0.0, 0.0)[:2] for k in used]),
        of_focal,
    )


def colmap(path: Path, images: ImageSet) -> Outcome:
    """Reconstruct with COLMAP from the files of a folder, or from the frames of a video; cameras are shared as ours."""
    import pycolmap

    start = _cpu_s()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photographs = path if path.is_dir() else _written(images, folder / "images")
        suffix = "" if path.is_dir() else ".png"
        names = np.array([name + suffix for name in images.names])
        database = folder / "database.db"
        pycolmap.set_random_seed(0)
        for k in range(len(images.cameras)):
            pycolmap.extract_features(
                database,
                photographs,
                image_names=names[images.image_camera == k].tolist(),
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=pycolmap.ImageReaderOptions(camera_model="RADIAL"),
                extraction_options=pycolmap.FeatureExtractionOptions(num_threads=2, use_gpu=False),
            )
        matching = pycolmap.FeatureMatchingOptions(num_threads=2, use_gpu=False)
        pycolmap.match_exhaustive(database, matching_options=matching)
        options = pycolmap.IncrementalPipelineOptions(num_threads=2)
        models = pycolmap.incremental_mapping(database, photographs, folder / "models", options)
    cpu_s = _cpu_s() - start
    if not models:
        return Outcome(cpu_s)
    found = max(models.values(), key=lambda model: model.num_reg_images())
    found.update_point_3d_errors()
    registered = [found.images[i] for i in found.reg_image_ids()]
    cameras = [found.cameras[i] for i in sorted({image.camera_id for image in registered})]
    Ts_cam_world = np.stack([np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in registered])
    return Outcome(
        cpu_s,
        len(models),
        found.num_points3D(),
        found.compute_mean_reprojection_error(),
        tuple(image.name.removesuffix(suffix) for image in registered),
        np.linalg.inv(Ts_cam_world),
        np.array([camera.mean_focal_length() for camera in cameras]),
        np.array([camera.params[3:5] for camera in cameras]),
    )


def _written(images: ImageSet, folder: Path) -> Path:
    """Write the frames of a video under their names as PNG files, and return their folder."""
    folder.mkdir()
    for i, name in enumerate(images.names):
        pixels = images.read(i)
        cv2.imwrite(str(folder / f"{name}.png"), pixels if pixels.ndim == 2 else pixels[..., ::-1])
    return folder


def differences(a: Outcome, b: Outcome) -> tuple[float, float]:
    """Return the rotation [deg] and position [%] between the cameras of two outcomes; NaN without three in common."""
    row = {name: i for i, name in enumerate(b.names)}
    both = [(i, row[name]) for i, name in enumerate(a.names) if name in row]
    if len(both) < 3:
        return np.nan, np.nan
    of_a, of_b = (
        outcome.Ts_world_cam[list(index)] for outcome, index in zip((a, b), zip(*both, strict=True), strict=True)
    )
    first, second = np.triu_indices(len(both), 1)
    R_a, R_b = (np.swapaxes(T[first, :3, :3], 1, 2) @ T[second, :3, :3] for T in (of_a, of_b))
    angles = np.linalg.norm(log_so3(np.swapaxes(R_a, 1, 2) @ R_b), axis=1)
    p_a, p_b = of_a[:, :3, 3], of_b[:, :3, 3]
    distances = np.linalg.norm(umeyama(p_a, p_b, with_scale=True).positions(p_b) - p_a, axis=1)
    return float(np.degrees(np.median(angles))), 100.0 * _rms(distances) / _rms(p_a - p_a.mean(axis=0))


def _rms(values: Array) -> float:
    """Return the root mean square of numbers (N,), or of the lengths of vectors (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(values.reshape(len(values), -1) ** 2, axis=1))))


def _spread(values: Array, form: str) -> str:
    """Return a value, or the smallest and the largest of several; a dash without any."""
    if not len(values):
        return "–"
    return " to ".join(dict.fromkeys(format(value, form) for value in (values.min(), values.max())))


def row(
    name: str, program: str, images: ImageSet, outcome: Outcome, known_px: float | None, other: Outcome | None
) -> dict[str, str]:
    """Return a row of the table; `other` is the outcome with which the cameras are compared."""
    rotation_deg, position_percent = differences(other, outcome) if other else (None, None)
    return {
        "set": name,
        "program": program,
        "registered": f"{len(outcome.names)} of {len(images.names)}",
        "components": f"{outcome.components}",
        "points": f"{outcome.points}",
        "error [px]": text(outcome.error_px, ".2f"),
        "focal length [px]": _spread(outcome.focal_px, ".0f") + outcome.of_focal,
        "known [px]": text(known_px, ".0f"),
        "k1": _spread(outcome.distortion[:, 0], ".3f"),
        "k2": _spread(outcome.distortion[:, 1], ".3f"),
        "rotation [°]": text(rotation_deg, ".2f"),
        "position [%]": text(position_percent, ".2f"),
        "processor [s]": f"{outcome.cpu_s:.0f}",
    }


def rows(command: CalibrationCommand) -> Iterator[dict[str, str]]:
    """Yield a row for each set and program."""
    for path in command.sets:
        name = path.stem
        is_video = path.is_file()
        images = open_images(path, every=command.every) if is_video else open_images(path, camera=command.camera)
        known_px = command.known.get(name)
        outcome = ours(images)
        yield row(name, "dronevio", images, outcome, known_px, None)
        if command.colmap:
            yield row(name, "COLMAP", images, colmap(path, images), known_px, outcome)


if __name__ == "__main__":
    print_as_made(rows(tyro.cli(CalibrationCommand, description=__doc__)))
