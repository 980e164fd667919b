"""Texturedness: the number of corners that a camera observes on a flight through a world."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.rig import EUROC_CAM0
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.world import World

GOOD_CORNERS = 150
"""Required number of good corners in a frame of a normal world."""
GOOD_SHARE = 0.95
"""Required fraction of frames with that many corners."""

_SCORE = 4e-4  # smallest eigenvalue of the gradient matrix for image values in [0, 1], as in the tracker
_APART_PX = 15.0
_MOST = 400
_TURN_RAD, _TILT_RAD = 0.5, 0.12  # standard deviations of heading and tilt of an agile flight
_R_LEVEL_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axis along x


@dataclass(frozen=True, eq=False)
class Texturedness:
    """Number of corners and brightness of frames along a route."""

    corners: npt.NDArray[np.int64]
    """(N,) Good corners in each frame."""
    levels: Array
    """(N,) Mean grey level of each frame."""

    @property
    def share_good(self) -> float:
        """Fraction of the frames with `GOOD_CORNERS` or more."""
        return float(np.mean(self.corners >= GOOD_CORNERS))


def good_corners(image: Image) -> int:
    """Return the number of good corners of a grey image (480, 752), at most 400.

    A good corner is one by Shi and Tomasi ("Good features to track", 1994), strong in absolute terms, whatever else the
    image shows: the smaller eigenvalue of the gradient matrix over 5 × 5 pixels is at least 4e-4. No two are closer
    than 15 pixels.
    """
    score = cv2.cornerMinEigenVal(image, blockSize=5, ksize=3)
    best = float(score.max())
    if best < _SCORE:
        return 0
    corners = cv2.goodFeaturesToTrack(image, _MOST, _SCORE / best, _APART_PX, blockSize=5)
    return len(corners)


def poses_along(route: Array, count: int, rng: np.random.Generator | None = None) -> Array:
    """Return camera poses (count, 4, 4) evenly spaced along a closed route (R, 3), looking along it.

    Args:
        route: Corners of the route [m].
        count: How many.
        rng: Draws how far heading and attitude are off the direction of travel; without it they are not.
    """
    legs = np.roll(route, -1, axis=0) - route
    ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(legs, axis=1))])
    at = (np.arange(count) + 0.5) / count * ends[-1]
    leg = np.searchsorted(ends, at, side="right") - 1
    fraction = (at - ends[leg]) / np.diff(ends)[leg]
    positions = route[leg] + fraction[:, None] * legs[leg]
    poses = []
    for position, way in zip(positions, legs[leg], strict=True):
        turn, tilt = (0.0, np.zeros(3)) if rng is None else (_TURN_RAD * rng.standard_normal(), rng.standard_normal(3))
        heading = rotation_z(float(np.arctan2(way[1], way[0])) + turn)
        poses.append(pose_matrix(heading @ _R_LEVEL_CAM @ exp_so3(_TILT_RAD * tilt), position))
    return np.stack(poses)


def texturedness(world: World, frames: int = 60, seed: int = 0, camera: CameraModel = EUROC_CAM0) -> Texturedness:
    """Count good corners along the route of a world, with the headings and attitudes of an agile flight.

    Args:
        world: The world; what moves in it stands still.
        frames: How many views.
        seed: Draws headings and attitudes.
        camera: The camera, of 752 × 480 pixels or so.

    Raises:
        GraphicsError: No off-screen OpenGL.
    """
    poses = poses_along(world.route, frames, np.random.default_rng(seed))
    with OffscreenCamera(world.spec.compile(), camera, supersampling=1.0) as eye:
        images = [eye.render(T) for T in poses]
    corners = np.array([good_corners(image) for image in images])
    return Texturedness(corners, np.array([float(image.mean()) for image in images]))
