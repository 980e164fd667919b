"""Speed of the simulator: figures with their bounds, measured as processor time of this process."""

import time

import numpy as np

from dronevio.models.camera import CameraModel
from dronevio.models.performance import PerformanceFigure
from dronevio.models.progress import Progress, silent
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.flight import fly
from dronevio.sim.scenario import Scenario
from dronevio.sim.speed.camera_cost import camera_cost
from dronevio.sim.world import World

_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axis along world x
_CAMERA_HEIGHT_M = 1.2


def camera_figure(world: World, camera: CameraModel, frames: int) -> PerformanceFigure:
    """Measure the cost of the camera model relative to bare rendering, over one rotation above the landing pad.

    Args:
        world: The world to render.
        camera: The camera model.
        frames: Number of directions.

    Raises:
        GraphicsError: Off-screen OpenGL is not available.
    """
    rotations = exp_so3(np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)[:, None] * [0.0, 0.0, 1.0])
    position = np.broadcast_to(world.pad + [0.0, 0.0, _CAMERA_HEIGHT_M], (frames, 3))
    cost = camera_cost(world.spec.compile(), camera, pose_matrix(rotations @ _FORWARD, position))
    return PerformanceFigure(
        "drawing and lens, by bare drawing",
        cost.ratio,
        "",
        1.3,
        "at most",
        f"{cost.camera_ms:.0f} and {cost.bare_ms:.0f} ms of CPU a frame, {camera.width}×{camera.height} looked up in"
        f" {1e-6 * cost.drawn_pixels:.2f} Mpx, mean of {frames}",
    )


def flight_figure(scenario: Scenario, progress: Progress = silent) -> PerformanceFigure:
    """Measure the speed of a simulation without images: planning, physics, controller and IMU."""
    start_s = time.process_time()
    flight = fly(scenario, progress)
    spent_s = time.process_time() - start_s
    duration_s = float(flight.truth.t_s[-1])
    return PerformanceFigure(
        "flight without images",
        duration_s / spent_s,
        "× real time",
        20.0,
        "at least",
        f"{duration_s:.1f} s in {spent_s:.2f} s of CPU",
    )
