"""Accuracy and time of structure from motion in simulated worlds, beside COLMAP.

For each scenario, 100 moving frames are spread evenly over a flight and reconstructed with the true calibration. The
error is the root mean square distance of the camera positions from the true ones after a similarity transformation.
The scale of that transformation and the direction of z show how well a rig or the IMU determines metres and gravity.
COLMAP (pycolmap) matches the same pairs of images as this project, with two threads, and maps them with several seeds,
of which the median error counts. Times are elapsed times on this machine, and the processor time of all stages::

    .venv/bin/python benchmarks/sfm_accuracy.py --work build/sfm
    .venv/bin/python benchmarks/sfm_accuracy.py --work build/sfm --scenarios room-v0 --colmap-seeds 0
    .venv/bin/python benchmarks/sfm_accuracy.py --work build/sfm --scenarios --recordings MH_01_real
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported

import shutil
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import tyro
from measuring import Stopwatch, opened, print_rows, text

from dronevio.cli import main as dronevio
from dronevio.estimator.sfm.config import SfmConfig
from dronevio.estimator.sfm.features import detect_features
from dronevio.estimator.sfm.pairs import select_pairs
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.eval.metrics.alignment import umeyama
from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array
from dronevio.models.image_sets import ImageSet, image_recording
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording, read_trajectory
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.models.state import Trajectory

MIN_SPEED_M_S = 0.1
"""Speed above which a frame counts as moving [m/s]."""
SCENARIOS = (
    "room-v0",
    "corridor-medium-v0",
    "warehouse-medium-v0",
    "hall-medium-v0",
    "forest-medium-v0",
    "gates-medium-v0",
)


@dataclass(frozen=True)
class SfmAccuracyCommand:
    """Measure the accuracy and the time of structure from motion in simulated worlds."""

    work: Path
    """Folder of the recordings and of COLMAP's files; existing recordings are used again."""
    scenarios: tuple[str, ...] = SCENARIOS
    """Scenarios that are flown with their own seeds."""
    recordings: tuple[Path, ...] = ()
    """Further recordings, in which all cameras are used; the truth is that of the recording or groundtruth.tum."""
    frames: int = 100
    """Number of frames of each flight or recording."""
    colmap_seeds: int = 3
    """Number of mappings by COLMAP in each world; 0 measures only this project."""


@dataclass(frozen=True)
class Outcome:
    """One reconstruction."""

    registered: int
    """Number of registered images in the largest component."""
    rmse_mm: float
    """Root mean square error of the positions of the registered cameras [mm]."""
    times_s: dict[str, float]
    """Elapsed time of each stage [s]."""
    cpu_s: float
    """Processor time of all stages [s]."""
    scale_percent: float = np.nan
    """Error of the scale that the IMU or a rig determines [%]; NaN without one."""
    tilt_deg: float = np.nan
    """Angle between the z axis and the true vertical [deg]; NaN if the z axis is arbitrary."""


def true_positions(truth: Trajectory, images: ImageSet) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the true positions (I, 3) of the cameras [m], and at which images (I,) they are known; NaN elsewhere."""
    assert images.t_ns is not None
    assert images.Ts_imu_cam is not None
    times, frame = np.unique(images.t_ns, return_inverse=True)
    poses, known = interpolate(truth, times)
    p_world_imu, R = np.full((len(times), 3), np.nan), np.full((len(times), 3, 3), np.nan)
    p_world_imu[known], R[known] = poses.p_world_imu, matrix_from_quat_wxyz(poses.quat_wxyz)
    offsets = images.Ts_imu_cam[images.image_camera, :3, 3]
    positions = p_world_imu[frame] + np.einsum("nij,nj->ni", R[frame], offsets)
    return positions, np.isfinite(positions[:, 0])


def moving_frames(recording: Recording, count: int) -> npt.NDArray[np.int64]:
    """Return the indices of some moving frames, spread evenly, at which the true pose is known or can be interpolated.

    Raises:
        ValueError: The recording has fewer such frames.
    """
    assert recording.ground_truth is not None
    true, rows = interpolate(recording.ground_truth, recording.frame_times_ns)
    assert true.velocity_m_s is not None
    moving = rows[np.linalg.norm(true.velocity_m_s, axis=1) > MIN_SPEED_M_S]
    if len(moving) < count:
        raise ValueError(f"{len(moving)} moving frames with a true pose; expected at least {count}")
    return np.asarray(moving[np.round(np.linspace(0, len(moving) - 1, count)).astype(np.int64)])


@dataclass(frozen=True)
class Alignment:
    """Differences of estimated positions to the true ones by the best similarity transformation."""

    rmse_mm: float
    """Root mean square distance after the transformation [mm]."""
    scale_percent: float
    """Relative error of estimated lengths [%]."""
    tilt_deg: float
    """Angle between the z axis of the estimate and the true vertical [deg]."""


def align(true: Array, estimated: Array) -> Alignment:
    """Return the differences between positions (N, 3), without those whose true value is NaN."""
    known = np.isfinite(true[:, 0])
    true, estimated = true[known], estimated[known]
    found = umeyama(true, estimated, with_scale=True)
    residuals = true - (found.scale * estimated @ found.R_truth_estimate.T + found.t_m)
    vertical = found.R_truth_estimate[:, 2]
    return Alignment(
        float(1e3 * np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        100.0 * (1.0 / found.scale - 1.0),
        float(np.degrees(np.arctan2(np.hypot(*vertical[:2]), vertical[2]))),
    )


def matched_pairs(images: ImageSet) -> list[tuple[int, int]]:
    """Return the pairs of images that this project matches."""
    config = SfmConfig()
    features = [detect_features(images.read(i), config.features) for i in range(len(images.names))]
    return select_pairs(features, images.is_ordered, config.pairs)


def ours(images: ImageSet, true: Array) -> Outcome:
    """Return our reconstruction."""
    start_s = time.process_time()
    result = reconstruct(images)
    cpu_s = time.process_time() - start_s
    if not result.reconstructions:
        return Outcome(0, np.inf, result.times_s, cpu_s)
    largest, world = result.reconstructions[0], result.worlds[0]
    rows = [images.names.index(name) for name in largest.image_names]
    found = align(true[rows], largest.positions)
    scale_percent = found.scale_percent if world.is_metric else np.nan
    tilt_deg = found.tilt_deg if world.is_vertical else np.nan
    return Outcome(len(rows), found.rmse_mm, result.times_s, cpu_s, scale_percent, tilt_deg)


def colmap(
    images: ImageSet,
    true: Array,
    pairs: Sequence[tuple[int, int]] | None,
    folder: Path,
    seeds: int,
    is_global: bool = False,
) -> list[Outcome]:
    """Return COLMAP's reconstructions of the same images and pairs, one for each seed of the mapping.

    Without pairs, COLMAP's sequential matcher chooses them. Its mapper is the incremental or the global one (GLOMAP).
    """
    import pycolmap

    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    names = [f"{i:06d}.png" for i in range(len(images.names))]
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / "images" / name), images.read(i))
    camera = images.cameras[0]
    values = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *camera.distortion)
    reader = pycolmap.ImageReaderOptions(camera_model="OPENCV", camera_params=",".join(map(str, values)))
    extraction = pycolmap.FeatureExtractionOptions(num_threads=2, use_gpu=False)
    matching = pycolmap.FeatureMatchingOptions(num_threads=2, use_gpu=False)
    database = folder / "database.db"
    pycolmap.set_random_seed(0)
    clock, costs = Stopwatch(), dict[str, tuple[float, float]]()
    pycolmap.extract_features(
        database,
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    costs["features"] = clock.lap()
    if pairs is None:
        pycolmap.match_sequential(database, matching_options=matching)
    else:
        (folder / "pairs.txt").write_text("\n".join(f"{names[i]} {names[j]}" for i, j in pairs))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=folder / "pairs.txt")
        pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=pairing)
    costs["matching"] = clock.lap()
    outcomes = []
    for seed in range(seeds):
        pycolmap.set_random_seed(seed)
        clock.lap()
        models = colmap_models(folder, folder / f"models-{seed}", is_global)
        costs["mapping"] = clock.lap()
        times_s, cpu_s = {name: cost[0] for name, cost in costs.items()}, sum(cost[1] for cost in costs.values())
        if not models:
            outcomes.append(Outcome(0, np.inf, times_s, cpu_s))
            continue
        largest = max(models.values(), key=lambda model: model.num_reg_images())
        posed = [image for image in largest.images.values() if image.has_pose]
        rows = [int(image.name[:6]) for image in posed]
        positions = np.stack([image.projection_center() for image in posed])
        outcomes.append(Outcome(len(rows), align(true[rows], positions).rmse_mm, times_s, cpu_s))
    return outcomes


def colmap_models(folder: Path, out: Path, is_global: bool) -> dict[int, Any]:
    """Return the models of COLMAP's mapper from the database and the images in a folder."""
    import pycolmap

    if is_global:
        options = pycolmap.GlobalPipelineOptions(num_threads=2)
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
        return dict(pycolmap.global_mapping(folder / "database.db", folder / "images", out, options=options))
    mapping = pycolmap.IncrementalPipelineOptions(
        num_threads=2,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    return dict(pycolmap.incremental_mapping(folder / "database.db", folder / "images", out, options=mapping))


def row(name: str, program: str, outcome: Outcome, images: int) -> dict[str, str]:
    """Return a row of the table."""
    return {
        "images": name,
        "program": program,
        "registered": f"{outcome.registered} of {images}",
        "RMSE [mm]": f"{outcome.rmse_mm:.2f}",
        "scale [%]": text(outcome.scale_percent),
        "tilt [°]": text(outcome.tilt_deg),
        **{f"{stage} [s]": f"{outcome.times_s[stage]:.1f}" for stage in ("features", "matching", "mapping")},
        "all [s]": f"{sum(outcome.times_s.values()):.1f}",
        "processor [s]": f"{outcome.cpu_s:.1f}",
    }


def simulated(command: SfmAccuracyCommand) -> Iterator[dict[str, str]]:
    """Fly the scenarios, reconstruct them with both programs, and yield the rows of the table."""
    for scenario in command.scenarios:
        flight = command.work / scenario
        if not flight.exists():
            dronevio(["fly", "--scenario", scenario, "--out", str(flight)])
        recording, truth = opened(flight)
        images = image_recording(recording, frames=moving_frames(recording, command.frames).tolist())
        true, _ = true_positions(truth, images)
        outcome = ours(images, true)
        yield row(scenario, "dronevio", outcome, len(images.names))
        if command.colmap_seeds > 0:
            pairs = matched_pairs(images)
            others = colmap(images, true, pairs, command.work / "colmap", command.colmap_seeds)
            median = statistics.median_low([other.rmse_mm for other in others])
            chosen = next(other for other in others if other.rmse_mm == median)
            yield row(scenario, f"COLMAP, median of {len(others)}", chosen, len(images.names))


def recorded(command: SfmAccuracyCommand) -> Iterator[dict[str, str]]:
    """Reconstruct recordings from all their cameras, and yield the rows of the table."""
    for folder in command.recordings:
        recording = open_recording(folder)
        truth = recording.ground_truth or read_trajectory(folder / "groundtruth.tum")
        cameras = range(len(recording.rig.cameras))
        images = image_recording(recording, cameras=cameras, frames=command.frames)
        outcome = ours(images, true_positions(truth, images)[0])
        yield row(folder.name, "dronevio", outcome, len(images.names))


def measure(command: SfmAccuracyCommand) -> None:
    """Reconstruct all scenarios and recordings, and print the table after each row."""
    rows = []
    for added in chain(simulated(command), recorded(command)):
        rows.append(added)
        print_rows("Structure from motion", rows, left=("program",))


if __name__ == "__main__":
    measure(tyro.cli(SfmAccuracyCommand, description=__doc__))
