"""Accuracy of dense reconstruction in simulated worlds, beside OpenCV's semi-global block matching.

For each scenario, 100 moving frames are spread evenly over a flight, as in ``sfm_accuracy.py``, and reconstructed with
the true calibration. Their surfaces are compared with the true depths of the same frames, fused in voxels of 1 cm up to
a depth of 10 m, after the similarity transformation that aligns the camera positions; the points are not registered to
each other. The estimated points, and points on the triangles of the mesh, are reduced to the same voxels, and those
beyond 10 m of all images are left out. Accuracy is the share of estimated points that are near a true one, completeness
the share of true points that are near an estimated one, and F their harmonic mean.

The baseline is a fusion of `cv2.StereoSGBM` of rectified pairs of the same images with the same poses: each image is
matched to its best neighbours with which it can be rectified, the median of the depths is taken, and consistency and
fusion are the same as ours.

COLMAP's patch matching needs CUDA, but its fusion does not: ``colmap-fusion`` gives it our depth maps before their
consistency is checked, and their normals, with its default settings (in pycolmap). Time is that of the fusion alone::

    .venv/bin/python benchmarks/dense_accuracy.py --work build/dense
    .venv/bin/python benchmarks/dense_accuracy.py --work build/dense --scenarios room-v0 --seed 7 --programs dronevio
"""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
import tyro
from measuring import Stopwatch, opened, print_rows
from sfm_accuracy import SCENARIOS, moving_frames, true_positions

from dronevio.cli import main as dronevio
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.estimator.dense.fusion import fuse, surface_normals
from dronevio.estimator.dense.meshing.tsdf import pixel_size
from dronevio.estimator.dense.neighbours import observed_points, select_neighbours
from dronevio.estimator.dense.pipeline import densify, estimate_depths, filter_depths
from dronevio.estimator.dense.views import View, ViewLoader
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.eval.metrics.alignment import umeyama
from dronevio.eval.metrics.clouds import CloudScore, compare_clouds, mesh_points, voxel_means
from dronevio.models.arrays import Array, Floats
from dronevio.models.camera import CameraModel
from dronevio.models.depth import Pinhole
from dronevio.models.image_sets import ImageSet, image_recording
from dronevio.models.protocols import Recording
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_reconstruction, write_reconstruction
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.models.surfaces import Mesh

Indices = npt.NDArray[np.int64]
Cost = tuple[float, float]
"""Elapsed and processor time [s]."""

VOXEL_M = 0.01
"""Side of the voxels to which both clouds are reduced [m]."""
FARTHEST_M = 10.0
"""Largest depth of a true point, and of an estimated one in its nearest image [m]."""
DISTANCES_M = (0.01, 0.05, 0.1)
"""Distances below which a point counts as right [m]."""
SCORED_EVERY = 10  # of millions of points, whose shares it determines to 0.001
MERGED_FRAMES = 10
MIN_ANGLE_DEG = 35.0  # between the baseline and the optical axes of a pair that is rectified
MAX_TANGENT = 1.3  # of the angles from the rectified axis that a rectified image contains
CANDIDATES = 30  # neighbours among which those are found that can be rectified


@dataclass(frozen=True)
class SgbmConfig:
    """Settings of the baseline."""

    pairs: int = 2
    """Number of neighbours with which each image is matched."""
    block: int = 5
    """Side of the blocks [px]."""
    uniqueness: int = 10
    """Margin by which the best cost must be lower than the second best [%]."""


@dataclass(frozen=True)
class DenseAccuracyCommand:
    """Measure the accuracy of dense reconstruction in simulated worlds."""

    work: Path
    """Folder of recordings, reconstructions and results; existing ones are used again."""
    scenarios: tuple[str, ...] = SCENARIOS
    """Scenarios that are flown."""
    seed: int | None = None
    """Seed of the flights; by default, each scenario has its own."""
    frames: int = 100
    """Number of frames of each flight."""
    programs: tuple[Literal["dronevio", "sgbm", "colmap-fusion"], ...] = ("dronevio", "sgbm")
    """Programs that are measured."""
    dense: DenseConfig = field(default_factory=DenseConfig)
    """Settings of dense reconstruction."""
    baseline: SgbmConfig = field(default_factory=SgbmConfig)
    """Settings of the baseline."""


@dataclass(frozen=True)
class Outcome:
    """Scores of one program in one world."""

    program: str
    """Name of the program."""
    points: int
    """Number of points before they are reduced to voxels."""
    time_s: float
    """Elapsed time [s]."""
    processor_s: float
    """Processor time [s]."""
    scores: tuple[CloudScore, ...]
    """Scores at each distance."""


def true_depth(flight: Path, recording: Recording, frame: int) -> Array:
    """Return the true z (H, W) of the first camera at a frame [m]; 0 for the sky."""
    path = flight / "mav0" / "depth0" / "data" / f"{recording.frame_times_ns[frame]}.png"
    millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert millimetres is not None, path
    return np.asarray(millimetres, dtype=np.float64) * 1e-3


def true_cloud(flight: Path, recording: Recording, frames: Indices) -> Array:
    """Return the true points (N, 3) that the frames see, one in each voxel, in the world frame of the truth [m]."""
    truth, camera = recording.ground_truth, recording.rig.cameras[0]
    assert truth is not None
    rows, columns = np.mgrid[: camera.model.height, : camera.model.width]
    rays = camera.model.unproject(np.stack([columns, rows], axis=-1).astype(np.float64))
    rays /= rays[..., 2:]
    merged, pending = np.zeros((0, 3)), []
    for number, frame in enumerate(frames, 1):
        depth = true_depth(flight, recording, int(frame))
        row = np.searchsorted(truth.t_ns, recording.frame_times_ns[frame])
        R_world_imu = matrix_from_quat_wxyz(truth.quat_wxyz[row])
        seen = (depth > 0.0) & (depth <= FARTHEST_M) & np.isfinite(rays[..., 0])
        in_imu = (rays[seen] * depth[seen][:, None]) @ camera.T_imu_cam[:3, :3].T + camera.T_imu_cam[:3, 3]
        pending.append(voxel_means(in_imu @ R_world_imu.T + truth.p_world_imu[row], VOXEL_M))
        if number % MERGED_FRAMES == 0 or number == len(frames):
            merged, pending = voxel_means(np.concatenate([merged, *pending]), VOXEL_M), []
    return merged


def are_near(points: Array, reconstruction: Reconstruction) -> npt.NDArray[np.bool_]:
    """Return of which points (N, 3) the depth in an image that contains them is within the limit."""
    is_near = np.zeros(len(points), bool)
    for camera, T in zip(reconstruction.image_camera, reconstruction.Ts_world_cam, strict=True):
        model = reconstruction.cameras[camera]
        rest = np.flatnonzero(~is_near)
        in_camera = (points[rest] - T[:3, 3]) @ T[:3, :3]
        ahead = (in_camera[:, 2] > 0.0) & (in_camera[:, 2] <= FARTHEST_M)
        pixels = model.project(in_camera[ahead])
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels >= -0.5) & (pixels <= [model.width - 0.5, model.height - 0.5]), axis=1)
        is_near[rest[ahead][inside]] = True
    return is_near


def score(true: Array, points: Array, reconstruction: Reconstruction) -> tuple[CloudScore, ...]:
    """Return the scores of estimated points (N, 3) in the world frame of the truth."""
    reduced = voxel_means(points, VOXEL_M)
    some = reduced[::SCORED_EVERY]
    some = some[are_near(some, reconstruction)]
    return compare_clouds(true, reduced, DISTANCES_M, scored_true=true[::SCORED_EVERY], scored_estimated=some)


def sample_mesh(mesh: Mesh, reconstruction: Reconstruction) -> Array:
    """Return points (N, 3) on the triangles whose centre is within the limit, at most a voxel apart."""
    is_near = are_near(mesh.vertices[mesh.triangles].mean(axis=1), reconstruction)
    return mesh_points(mesh.vertices, mesh.triangles[is_near], VOXEL_M)


def sgbm_depth(view: View, others: Iterable[View], points: Array, config: SgbmConfig, margin: float) -> PosedDepth:
    """Return the depth map of an image, the median over its first pairs that can be rectified."""
    maps: list[Floats] = []
    for other in others:
        found = sgbm_pair(view, other, points, config, margin)
        if found is not None:
            maps.append(found)
        if len(maps) == config.pairs:
            break
    stack = np.stack([np.where(m > 0.0, m, np.nan) for m in maps] or [np.full(view.grey.shape, np.nan)])
    known = np.isfinite(stack).any(axis=0)
    median = np.zeros(view.grey.shape, np.float32)
    median[known] = np.nanmedian(stack[:, known], axis=0)
    return PosedDepth(view.camera, view.T_world_cam, median)


def sgbm_pair(view: View, other: View, points: Array, config: SgbmConfig, margin: float) -> Floats | None:
    """Return the inverse depths (H, W) of an image from one pair; None if the pair cannot be rectified.

    The rectified cameras have the x axis along the baseline (Fusiello, Trucco and Verri, "A compact algorithm for
    rectification of stereo pairs", 2000). Pairs along the optical axis are left out.
    """
    baseline = other.T_world_cam[:3, 3] - view.T_world_cam[:3, 3]
    length = float(np.linalg.norm(baseline))
    x = baseline / length
    forward = view.T_world_cam[:3, 2] + other.T_world_cam[:3, 2]
    forward -= (forward @ x) * x
    if np.linalg.norm(forward) < 2.0 * np.sin(np.radians(MIN_ANGLE_DEG)):
        return None
    z = forward / np.linalg.norm(forward)
    R_rectified_world = np.stack([x, np.cross(z, x), z])
    f = view.camera.K[0, 0]
    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]]) * [
        view.camera.width - 1,
        view.camera.height - 1,
        1,
    ]
    rays = corners @ np.linalg.inv(view.camera.K).T @ (R_rectified_world @ view.T_world_cam[:3, :3]).T
    tangents = np.clip(rays[:, :2] / np.maximum(rays[:, 2:], 1e-3), -MAX_TANGENT, MAX_TANGENT)
    low, high = f * tangents.min(axis=0), f * tangents.max(axis=0)
    size = np.ceil(high - low).astype(int).tolist()
    K = np.array([[f, 0.0, -low[0]], [0.0, f, -low[1]], [0.0, 0.0, 1.0]])
    depths = (points - view.T_world_cam[:3, 3]) @ z
    near, far = np.percentile(depths[depths > 0.0], (1.0, 99.0)) * [1.0 - margin, 1.0 + margin]
    first = int(f * length / far)
    count = 16 * int(np.clip(np.ceil((f * length / near - first) / 16), 1, 24))
    pad = first + count  # columns on the left, of which the right image has contents
    shift = np.array([[1.0, 0.0, pad], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    H = [shift @ K @ R_rectified_world @ v.T_world_cam[:3, :3] @ np.linalg.inv(v.camera.K) for v in (view, other)]
    left, right = (
        cv2.warpPerspective(np.where(v.mask, v.grey, 0.0).round().astype(np.uint8), h, (size[0] + pad, size[1]))
        for v, h in zip((view, other), H, strict=True)
    )
    matcher = cv2.StereoSGBM.create(
        first,
        count,
        config.block,
        P1=8 * config.block**2,
        P2=32 * config.block**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=config.uniqueness,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = matcher.compute(left, right)[:, pad:].astype(np.float32) / 16.0
    inverse = np.where(disparity >= max(first, 1), disparity / np.float32(f * length), 0.0).astype(np.float32)
    # Inverse depth along the rectified axis at each pixel of the image, then along its own axis.
    in_rectified = view.camera.rays().astype(np.float64) @ (R_rectified_world @ view.T_world_cam[:3, :3]).T
    uv = (in_rectified @ K.T)[..., :2] / in_rectified[..., 2:]
    u, v = (np.ascontiguousarray(a, dtype=np.float32) for a in np.moveaxis(uv, -1, 0))
    sampled = cv2.remap(inverse, u, v, cv2.INTER_NEAREST, borderValue=0.0)
    return np.asarray(np.where(view.mask, sampled * in_rectified[..., 2], 0.0), dtype=np.float32)


def baseline(images: ImageSet, reconstruction: Reconstruction, command: DenseAccuracyCommand) -> Array:
    """Return the points (N, 3) of the baseline, which shares neighbours, consistency and fusion with ours."""
    config, sgbm = command.dense, command.baseline
    load = ViewLoader(images, reconstruction, config.views)
    neighbours = select_neighbours(reconstruction, config.views)
    candidates = select_neighbours(reconstruction, replace(config.views, neighbours=CANDIDATES))
    depths = [
        sgbm_depth(
            load(i),
            (load(int(j)) for j in candidates[i]),
            observed_points(reconstruction, i),
            sgbm,
            config.depth.range_margin,
        )
        for i in range(len(load))
    ]
    found = filter_depths(depths, neighbours, config)
    return fuse(((d, load(i).colours) for i, d in enumerate(found)), config.spacing_px * pixel_size(found)).points


def colmap_fusion(
    images: ImageSet, reconstruction: Reconstruction, command: DenseAccuracyCommand
) -> tuple[Array, Cost]:
    """Return the points (N, 3) that COLMAP fuses from our depth maps, and the elapsed and the processor time [s]."""
    import pycolmap

    load = ViewLoader(images, reconstruction, command.dense.views)
    neighbours = select_neighbours(reconstruction, command.dense.views)
    depths = estimate_depths(load, reconstruction, neighbours, command.dense)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_colmap_scene(folder, load, reconstruction, depths)
        stopwatch = Stopwatch()
        fused = pycolmap.stereo_fusion(folder / "fused.ply", folder, output_type="ply")
        cost = stopwatch.lap()
    return np.array([point.xyz for point in fused.points3D.values()]).reshape(-1, 3), cost


def write_colmap_scene(
    folder: Path, load: ViewLoader, reconstruction: Reconstruction, depths: Sequence[PosedDepth]
) -> None:
    """Write undistorted images, their model, depth maps and normals as COLMAP's fusion reads them."""
    names = [f"{i:06d}.png" for i in range(len(depths))]
    for part in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / part).mkdir(parents=True)
    first = [int(np.flatnonzero(reconstruction.image_camera == k)[0]) for k in range(len(reconstruction.cameras))]
    cameras = tuple(pinhole_model(depths[i].camera) for i in first)
    undistorted = replace(reconstruction, cameras=cameras, image_names=tuple(names))
    write_reconstruction(undistorted, folder / "sparse", "colmap-binary")
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(names) + "\n")
    (folder / "stereo" / "patch-match.cfg").write_text("".join(f"{n}\n__auto__, 20\n" for n in names))
    for i, (name, depth) in enumerate(zip(names, depths, strict=True)):
        cv2.imwrite(str(folder / "images" / name), load(i).colours[..., ::-1])
        w, normals = depth.inverse_depth, surface_normals(depth)
        z = np.divide(1.0, w, out=np.zeros_like(w), where=(w > 0.0) & np.isfinite(normals[..., 0]))
        write_matrix(folder / "stereo" / "depth_maps" / f"{name}.geometric.bin", z[..., None])
        write_matrix(folder / "stereo" / "normal_maps" / f"{name}.geometric.bin", np.nan_to_num(normals))


def pinhole_model(camera: Pinhole) -> CameraModel:
    """Return the camera of an undistorted image as a model of a reconstruction."""
    fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return CameraModel(camera.width, camera.height, fx, fy, cx, cy)


def write_matrix(path: Path, values: Floats) -> None:
    """Write an array (H, W, C) as COLMAP stores it: sizes as text, then the channels, one after the other."""
    height, width, channels = values.shape
    data = np.ascontiguousarray(np.moveaxis(values, -1, 0), dtype="<f4")
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + data.tobytes())


def reconstructed(
    work: Path, scenario: str, seed: int | None, count: int
) -> tuple[Path, Recording, Indices, ImageSet, Reconstruction]:
    """Return a flight with its frames, their images and their reconstruction, which are made if they do not exist.

    Args:
        work: Folder of the recordings and reconstructions.
        scenario: Name of the scenario.
        seed: Seed of the flight, None for that of the scenario.
        count: Number of frames.

    Returns:
        Folder of the recording, the recording, indices (F,) of the frames, the images, and the reconstruction in the
        world frame of the truth.
    """
    name = scenario if seed is None else f"{scenario}-{seed}"
    flight = work / name
    if not (flight / "mav0" / "depth0").exists():  # a flight of `sfm_accuracy.py` has no depths
        seeds = [] if seed is None else ["--seed", str(seed)]
        truth_images = ["--truth-images", "depth", "--overwrite"]
        dronevio(["fly", "--scenario", scenario, *seeds, *truth_images, "--out", str(flight)])
    recording, truth = opened(flight)
    frames = moving_frames(recording, count)
    images = image_recording(recording, frames=frames.tolist())
    model = work / f"{name}-{count}"
    if not model.exists():
        write_reconstruction(reconstruct(images).reconstructions[0], model, "colmap-binary")
    reconstruction = read_reconstruction(model)
    rows = [images.names.index(image) for image in reconstruction.image_names]
    true_m, _ = true_positions(truth, images)
    found = umeyama(true_m[rows], reconstruction.positions, with_scale=True)
    in_truth = reconstruction.transformed(found.scale, found.R_truth_estimate, found.t_m)
    return flight, recording, frames[rows], images, in_truth


def measure_world(scenario: str, command: DenseAccuracyCommand) -> Iterator[Outcome]:
    """Yield the scores of the programs in a world."""
    made = reconstructed(command.work, scenario, command.seed, command.frames)
    flight, recording, frames, images, reconstruction = made
    true = true_cloud(flight, recording, frames)
    if "dronevio" in command.programs:
        stopwatch = Stopwatch()
        result = densify(images, reconstruction, command.dense)
        cost = stopwatch.lap()
        sampled = sample_mesh(result.mesh, reconstruction)
        for name, points in (("points", result.cloud.points), ("mesh", sampled)):
            yield Outcome(f"dronevio, {name}", len(points), *cost, score(true, points, reconstruction))
    if "sgbm" in command.programs:
        stopwatch = Stopwatch()
        points = baseline(images, reconstruction, command)
        cost = stopwatch.lap()
        yield Outcome("StereoSGBM, points", len(points), *cost, score(true, points, reconstruction))
    if "colmap-fusion" in command.programs:
        points, cost = colmap_fusion(images, reconstruction, command)
        yield Outcome("COLMAP's fusion, points", len(points), *cost, score(true, points, reconstruction))


def measure(command: DenseAccuracyCommand) -> None:
    """Fly, reconstruct and print the table whenever a row is complete."""
    rows: list[dict[str, str]] = []
    for scenario in command.scenarios:
        for outcome in measure_world(scenario, command):
            row = {"scenario": scenario, "program": outcome.program}
            for d, s in zip(DISTANCES_M, outcome.scores, strict=True):
                values = {"accuracy": s.accuracy, "completeness": s.completeness, "F": s.f_score}
                row |= {f"{name} {1e2 * d:.0f} cm": f"{value:.3f}" for name, value in values.items()}
            row["points"] = f"{outcome.points}"
            row |= {"processor [s]": f"{outcome.processor_s:.0f}", "elapsed [s]": f"{outcome.time_s:.0f}"}
            rows.append(row)
            print_rows("Dense reconstruction", rows, left=("program",))


if __name__ == "__main__":
    measure(tyro.cli(DenseAccuracyCommand, description=__doc__))
