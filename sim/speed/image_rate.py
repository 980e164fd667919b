"""Rate of small images for learning: frames per second of processor time in each world."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.performance import PerformanceFigure
from dronevio.models.progress import Progress, silent
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.sim.envs.sensing.camera_observation import ImageKind, ImageSettings, RenderedObservation
from dronevio.sim.envs.sensing.image_flow import ImagePoses
from dronevio.sim.world import WORLDS, flight_area

RIG = "euroc"
"""Name of the rig whose first camera is measured."""
REQUIRED_PER_CPU_S = 600.0
"""Required frames per second of processor time in the room, 64 × 64 px."""
_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axis along world x
_KINDS: tuple[ImageKind, ...] = ("grey", "depth")
_STEP_NS, _FIRST = 20_000_000, np.zeros(1, np.intp)
_MOTION = pose_matrix(exp_so3(np.full(3, 0.01)), np.full(3, 0.01))  # from an image to the previous one


@dataclass(frozen=True)
class ImageRate:
    """Rate of the images of one kind in one world."""

    world: str
    """Name of the world."""
    kind: ImageKind
    """Kind of the images."""
    width: int
    """Width of the images [px]."""
    height: int
    """Height of the images [px]."""
    per_cpu_s: float
    """Images per second of processor time of all threads of the process; the median of several runs."""
    load_s: float
    """Time until the first image, of the wall clock [s]; much of it is saved where the process has loaded the world
    before."""


def image_rates(
    worlds: Sequence[str] = tuple(WORLDS),
    kinds: Sequence[ImageKind] = _KINDS,
    frames: int = 64,
    runs: int = 7,
    seed: int = 0,
    progress: Progress = silent,
    size: tuple[int, int] = (64, 64),
) -> list[ImageRate]:
    """Measure the rate of images of one size in several worlds.

    Each run renders as many images as a vector of ``frames`` environments does in a step. Poses are on the route
    through the world, in all directions, and the same in all runs; the flow is that of a motion of 2 cm and 1°. The
    process must do no other work. The first image of each kind is not counted.

    Args:
        worlds: Names of the worlds; all by default.
        kinds: Kinds of images.
        frames: Number of images of a run.
        runs: Number of runs.
        seed: Seed of the worlds.
        progress: Callback that receives the number of completed measurements and their total.
        size: Width and height of the images [px].

    Raises:
        ConfigError: A world or a kind is unknown.
        GraphicsError: Off-screen OpenGL is not available.
    """
    rates: list[ImageRate] = []
    total = len(worlds) * len(kinds)
    progress(0, total)
    for world in worlds:
        for kind in kinds:
            rates.append(_measured(world, ImageSettings((kind,), *size), frames, runs, seed))
            progress(len(rates), total)
    return rates


def image_figures(rates: Sequence[ImageRate]) -> list[PerformanceFigure]:
    """Return a figure for each kind of images: the rate in the first world with its bound; the others are described."""
    figures = []
    for kind in dict.fromkeys(rate.kind for rate in rates):
        first, *others = [rate for rate in rates if rate.kind == kind]
        listed = ", ".join(f"{rate.world} {rate.per_cpu_s:.0f}" for rate in others)
        figures.append(
            PerformanceFigure(
                f"{kind} images of {first.width} × {first.height} px, {first.world}",
                first.per_cpu_s,
                "/s",
                REQUIRED_PER_CPU_S,
                "at least",
                f"images per second of processor time with the lens of {RIG}, along the route and in all directions"
                + (f"; other worlds: {listed}" if listed else ""),
            )
        )
    return figures


def _measured(world: str, settings: ImageSettings, frames: int, runs: int, seed: int) -> ImageRate:
    """Measure the images of one kind and size in one world."""
    camera = rig_named(RIG).cameras[0]
    observation = RenderedObservation(camera, world, seed, settings)
    poses = _camera_poses(flight_area(world, seed).route, frames) @ inverse_pose(camera.T_imu_cam)
    times_ns = np.arange(frames) * _STEP_NS
    previous = ImagePoses(poses @ _MOTION, times_ns - _STEP_NS, np.ones(frames, np.bool_))
    try:
        start_s = time.perf_counter()
        observation.observe(poses[:1], times_ns[:1], previous.rows(_FIRST))
        load_s = time.perf_counter() - start_s
        spent_s = []
        for _ in range(runs):
            start_s = time.process_time()
            observation.observe(poses, times_ns, previous)
            spent_s.append(time.process_time() - start_s)
    finally:
        observation.close()
    return ImageRate(world, settings.kinds[0], settings.width, settings.height, frames / median(spent_s), load_s)


def _camera_poses(route: Array, count: int) -> Array:
    """Return camera poses (count, 4, 4) that are spread evenly over a closed route and look in all directions."""
    corners = np.linspace(0.0, len(route), count, endpoint=False)
    closed = np.vstack([route, route[:1]])
    position = np.stack([np.interp(corners, np.arange(len(closed)), axis) for axis in closed.T], axis=1)
    golden = np.pi * (3.0 - np.sqrt(5.0))
    R = exp_so3((golden * np.arange(count))[:, None] * [0.0, 0.0, 1.0]) @ _FORWARD
    return pose_matrix(R, position)
