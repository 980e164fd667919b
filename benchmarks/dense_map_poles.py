"""A flight towards poles in an empty concourse, rendered frame by frame, for the dense map."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np
from dense_map_runs import true_estimate

from dronevio.models.arrays import Array
from dronevio.models.rig import Rig
from dronevio.models.rotation import pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import CameraFrame, Estimate, Trajectory
from dronevio.sim.appearance import textures
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.props.furniture import WOODS, block
from dronevio.sim.rendering.live_cameras import LiveCameras
from dronevio.sim.world import WORLDS
from dronevio.sim.worlds.layout import Layout, WorldBuilder

WORLD = "poles"
WIDTHS_M = (0.02, 0.04, 0.08)
"""Sides of the square poles [m]."""
_POLES_M = np.array([[3.04, y, 0.0] for y in (-0.77, 0.03, 0.86)])
_HEIGHT_M, _FROM_M, _TO_M = 2.4, -3.0, 2.2
_FLIGHT_M, _SPEED_M_S, _RATE_HZ = 1.2, 0.6, 10.0
_SWAY_M = 0.1  # amplitude of the flight to both sides, as no drone flies along a straight line


def poles_of(place: int) -> Array:
    """Return the feet (3, 3) of the poles at one of several places in front of the wall, in the order of widths [m]."""
    shift = np.array([0.0, 0.11, -0.17, 0.05, 0.21])[place % 5]
    return np.asarray(np.roll(_POLES_M, place, axis=0) + [0.0, shift, 0.0])


def _layout(rng: np.random.Generator, poles_m: Array) -> Layout:
    """Draw the concourse without what moves, with poles in front of its wall."""
    empty = WORLDS["moving"].layout(rng)
    paint = partial(textures.wood, colour=WOODS[0])
    poles = [block(x, y, z, w, w, _HEIGHT_M, paint) for (x, y, z), w in zip(poles_m, WIDTHS_M, strict=True)]
    return replace(empty, boxes=(*empty.boxes, *poles), moving=(), lanes=(), shading=empty.boxes)


def pole_flight(rig: Rig, place: int) -> Iterator[tuple[CameraFrame, Estimate]]:
    """Yield the frames of a flight towards the poles with their true poses.

    Args:
        rig: A rig whose cameras look along the x axis of the IMU, or nearly so, as those of EuRoC do after its own
            rotation.
        place: Number of the place of the poles, and seed of the concourse.
    """
    WORLDS[WORLD] = WorldBuilder("poles in a concourse", partial(_layout, poles_m=poles_of(place)))
    t_ns = np.arange(0.0, (_TO_M - _FROM_M) / _SPEED_M_S, 0.005)
    position = np.stack(
        [_FROM_M + _SPEED_M_S * t_ns, _SWAY_M * np.sin(1.5 * t_ns), _FLIGHT_M + 0.05 * np.sin(2.0 * t_ns)], axis=1
    )
    R_world_imu = _ahead() @ rig.cameras[0].T_imu_cam[:3, :3].T
    times = np.round(1e9 * t_ns).astype(np.int64)
    quaternion = quat_wxyz_from_matrix(R_world_imu)
    truth = Trajectory(times, position, np.tile(quaternion, (len(times), 1)))
    step = round(200.0 / _RATE_HZ)
    with closing(LiveCameras(rig, WORLD, place, Imaging())) as cameras:
        for row in range(step, len(times) - step, step):
            T_world_imu = pose_matrix(R_world_imu, position[row])
            yield (
                cameras.frame(int(times[row]), int(times[row]), True, truth),
                true_estimate(int(times[row]), T_world_imu),
            )


def _ahead() -> Array:
    """Return the rotation (3, 3) of a camera that looks along the x axis of the world."""
    return np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
