"""Depth images of flights, from two cameras and from one, at estimated poses, against the simulator's truth.

The true depth of a pixel is any of those in its footprint of three by three pixels of half its size, so that a pixel at
an edge may belong to either surface. Errors are those of the inverse depth in standard deviations; pixels count that
are nearer than a range by truth or by estimate. χ² is the mean of the squared errors, and that of those within 5 σ;
``far`` is the share beyond 5 σ that are estimated too far, which makes false free space. Density is the share of the
pixels nearer than the range with a known depth. The bias at edges is that of the inverse depth, in pixels of disparity
for two cameras, where the true depth jumps within three pixels. Recordings need true depth images::

    .venv/bin/dronevio fly --scenario room-medium-v0 --rig euroc-stereo --truth-images depth --out flight
    .venv/bin/python benchmarks/depth.py flight
    .venv/bin/python benchmarks/depth.py shared/MH_01 --pictures build/depth.png

A picture shows image, depth and standard deviation side by side, and needs no truth.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from measuring import Row, print_as_made, text

from dronevio.estimator.mapping.depth_source import depth_source
from dronevio.estimator.mapping.rectification import rectified_pair
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.threads import single_threaded
from dronevio.models.arrays import Array, Floats, Image
from dronevio.models.depth import DepthImage
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording, measurements
from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import inverse_pose

EVERY_S = 0.1
"""Time between the frames that enter [s], as in the dense map."""
SCORED_EVERY = 4
"""Number of depth images of a pair of which one is scored."""
EDGE_CHANGE_PX = 2.0
"""Change of the disparity at an edge [px]."""
PICTURES = 4
"""Number of depth images in a picture."""


@dataclass(frozen=True)
class DepthCommand:
    """Measure depth images."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings, with true depth images unless there are only pictures."""
    range_m: float = 6.0
    """Depth up to which pixels count [m]."""
    duration_s: float = 10.0
    """Time from the beginning of each recording that enters [s]."""
    cameras: tuple[int, ...] = (2, 1)
    """Numbers of cameras."""
    pictures: Path | None = None
    """PNG file of pictures of the first recording, instead of scores."""


def depth_images(recording: Recording, duration_s: float) -> Iterator[tuple[int, DepthImage, float]]:
    """Yield the depth images of the beginning of a recording with the index of the frame and the processor time [s]."""
    source, last_ns, index = depth_source(recording.rig), None, -1
    slam = VisualInertialOdometry(recording.rig)
    for frame in measurements(recording):
        if isinstance(frame, ImuSamples):
            slam.add_imu(frame)
            continue
        index += 1
        if frame.t_ns - int(recording.frame_times_ns[0]) > duration_s * 1e9:
            return
        estimate = slam.add_frame(frame)
        if estimate.state is None or (last_ns is not None and frame.t_ns - last_ns < (EVERY_S - 1e-3) * 1e9):
            continue
        last_ns = frame.t_ns
        with single_threaded():
            start = time.process_time()
            image = source.depth(frame, estimate)
            spent_s = time.process_time() - start
        if image is not None:
            yield index, image, spent_s


def true_depths(folder: Path, recording: Recording, index: int, image: DepthImage, T_imu_cam: Array) -> Floats:
    """Return the true depths (9, H, W) in the footprint of each pixel of a depth image of the first camera [m]."""
    camera = recording.rig.cameras[0]
    path = folder / "mav0" / "depth0" / "data" / f"{recording.frame_times_ns[index]}.png"
    millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if millimetres is None:
        raise SystemExit(f"{path}: missing; expected a true depth image, as --truth-images depth writes them")
    full = millimetres.astype(np.float32) * np.float32(1e-3)
    T_cam_rectified = inverse_pose(camera.T_imu_cam) @ T_imu_cam
    if np.linalg.norm(T_cam_rectified[:3, 3]) > 1e-6:
        raise SystemExit("depth of the second camera, which has no truth; expected the first one on the left")
    rays = image.camera.rays() @ T_cam_rectified[:3, :3].T.astype(np.float32)
    u, v = np.moveaxis(camera.model.project(rays.astype(np.float64)).astype(np.float32), -1, 0)
    side = 0.5 * camera.model.central_focal_px[0] / float(image.camera.K[0, 0])
    offsets = [(side * i, side * j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    found = [cv2.remap(full, u + np.float32(a), v + np.float32(b), cv2.INTER_NEAREST) for a, b in offsets]
    return np.stack([np.where(z > 0.0, z / rays[..., 2], np.inf) for z in found]).astype(np.float32)


def row_of(folder: Path, cameras: int, range_m: float, duration_s: float) -> Row | None:
    """Return the scores of the depth images of a flight; None if it has fewer cameras."""
    recording = open_recording(folder, None)
    if len(recording.rig.cameras) < cameras:
        return None
    recording = open_recording(folder, cameras)
    errors, sigmas, edges, spent, seen, near_count = [], [], [], [], 0, 0
    pair = rectified_pair(recording.rig)
    T_fixed = recording.rig.cameras[0].T_imu_cam if pair is None else pair.T_imu_left
    scale = 1.0 if pair is None else pair.fb
    for number, (index, image, spent_s) in enumerate(depth_images(recording, duration_s)):
        spent.append(spent_s)
        if cameras > 1 and number % SCORED_EVERY:
            continue
        inverse = scale / true_depths(folder, recording, index, image, T_fixed)
        known = image.known
        w = np.divide(np.float32(scale), image.depth_m, out=np.zeros_like(image.depth_m), where=known)
        error = w - inverse
        least = np.take_along_axis(error, np.abs(error).argmin(axis=0)[None], axis=0)[0]
        near = inverse[4] > scale / range_m
        used = known & (near | (image.depth_m < range_m))
        square = np.ones((7, 7), np.uint8)
        jump = cv2.dilate(inverse.max(axis=0), square) - cv2.erode(inverse.min(axis=0), square)
        errors.append(least[used])
        sigmas.append((image.sigma_m * w * w / scale)[used])
        edges.append((jump > EDGE_CHANGE_PX)[used])
        seen, near_count = seen + int((known & near).sum()), near_count + int(near.sum())
    if not errors:
        return {"flight": folder.name, "cameras": str(cameras), **dict.fromkeys(HEADINGS, "–")}
    error, sigma, edge = (np.concatenate(values) for values in (errors, sigmas, edges))
    normalized = error / sigma
    beyond = np.abs(normalized) > 5.0
    values = (
        str(len(spent)),
        text(float(np.mean(normalized**2)), ".2f"),
        text(float(np.mean(normalized[~beyond] ** 2)), ".2f"),
        text(1e2 * float(beyond.mean()), ".2f"),
        text(1e2 * float((beyond & (error < 0.0)).mean()), ".2f"),
        text(seen / max(near_count, 1), ".2f"),
        text(float(np.median(error[edge])) if edge.any() else None, ".3f"),
        text(1e3 * float(np.median(spent)), ".0f"),
    )
    return {"flight": folder.name, "cameras": str(cameras), **dict(zip(HEADINGS, values, strict=True))}


HEADINGS = ("images", "χ²", "χ² within 5 σ", "beyond 5 σ [%]", "far [%]", "density", "edge bias", "CPU [ms]")


def picture(images: Sequence[DepthImage], range_m: float) -> Image:
    """Return images with their depths and standard deviations, which are black where they are unknown."""
    return np.vstack([np.hstack(panels(image, range_m)) for image in images])


def panels(image: DepthImage, range_m: float) -> tuple[Image, Image, Image]:
    """Return the image, its depth and its standard deviation, as colours (H, W, 3), blue, green and red."""
    known = image.known[..., None]
    near = np.divide(1.0, image.depth_m, out=np.zeros_like(image.depth_m), where=image.known)
    depth = cv2.applyColorMap(np.clip(255.0 * near, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    share = np.clip(image.sigma_m / (0.1 * range_m), 0.0, 1.0)
    sigma = cv2.applyColorMap((255.0 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    grey = cv2.cvtColor(image.grey, cv2.COLOR_GRAY2BGR)
    return np.asarray(grey), np.where(known, depth, 0).astype(np.uint8), np.where(known, sigma, 0).astype(np.uint8)


def main(command: DepthCommand) -> None:
    """Print the table, or write the pictures."""
    if command.pictures is not None:
        recording = open_recording(command.recordings[0], command.cameras[0])
        images = [d for _, d, _ in depth_images(recording, command.duration_s)]
        chosen = [images[k] for k in np.linspace(0, len(images) - 1, PICTURES).astype(int)]
        command.pictures.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(command.pictures), picture(chosen, command.range_m))
        return
    rows = (
        row_of(folder, cameras, command.range_m, command.duration_s)
        for folder in command.recordings
        for cameras in command.cameras
    )
    print_as_made(row for row in rows if row is not None)


if __name__ == "__main__":
    main(tyro.cli(DepthCommand, description=__doc__))
