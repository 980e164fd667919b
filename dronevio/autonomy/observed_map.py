"""Map of an episode by the depth images that an environment observes, in a frame in which the pose is known."""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.log_odds import LogOdds
from dronevio.estimator.mapping.rectification import PinholeMap
from dronevio.estimator.mapping.submap import covering
from dronevio.models.arrays import Array, Floats
from dronevio.models.camera import CameraModel
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.occupancy import UNKNOWN, OccupancyGrid
from dronevio.models.rig import RigCamera

LOCAL_M = np.array([8.0, 8.0, 4.0])
"""Extent of the map around the vehicle [m]."""
_MOVED = 0.01  # change of an element of the pose, metres or sines of angles, from which images must change
_SIGMA_M = 0.02  # of depth without noise, for its change within a pixel


class ObservedMap:
    """Free and occupied cells by depth images, of which nothing is forgotten."""

    def __init__(self, camera: RigCamera, T_vehicle_imu: Array, cell_m: float, range_m: float) -> None:
        """Begin with an empty map.

        Args:
            camera: The camera that observes depth; its images may have any size.
            T_vehicle_imu: (4, 4) Mounting of the IMU.
            cell_m: Side of the cells [m].
            range_m: Largest depth that enters the map [m].
        """
        self._model, self._T_vehicle_cam = camera.model, T_vehicle_imu @ camera.T_imu_cam
        self._cell_m, self._range_m = cell_m, range_m
        self._pinholes: dict[tuple[int, int], tuple[Pinhole, PinholeMap]] = {}
        self._cells: LogOdds | None = None
        self._newest: tuple[npt.NDArray[np.floating], Array] | None = None

    def is_held(self, image: npt.NDArray[np.floating], T_map_vehicle: Array) -> bool:
        """Return whether an image (H, W, 1) repeats the last one that entered the map, though the vehicle has moved."""
        if self._newest is None or not np.array_equal(image, self._newest[0]):
            return False
        return bool(np.abs(T_map_vehicle - self._newest[1]).max() > _MOVED)

    def add(self, image: npt.NDArray[np.floating], T_map_vehicle: Array) -> None:
        """Add a depth image (H, W, 1) [m] that was taken at a pose (4, 4) of the vehicle."""
        self._newest = image.copy(), T_map_vehicle
        height, width = image.shape[:2]
        if (width, height) not in self._pinholes:
            self._pinholes[width, height] = pinhole_of(self._model.fitted(width, height))
        camera, pinhole_map = self._pinholes[width, height]
        columns = np.clip(np.rint(pinhole_map.u).astype(int), 0, width - 1)
        rows = np.clip(np.rint(pinhole_map.v).astype(int), 0, height - 1)
        depth: Floats = np.where(pinhole_map.mask, image[rows, columns, 0], 0.0).astype(np.float32)
        sigma = np.where(depth > 0.0, np.float32(_SIGMA_M), np.float32(0.0))
        T_map_cam = T_map_vehicle @ self._T_vehicle_cam
        seen = DepthImage(0, camera, T_map_cam, depth, sigma, np.zeros(depth.shape, np.uint8))
        if seen.known.any():
            found = evidence(seen, self._cell_m, self._range_m)
            self._cells = covering(self._cells, found)
            self._cells.add(found)

    @property
    def known(self) -> OccupancyGrid | None:
        """All cells; None before the first image."""
        return None if self._cells is None else self._cells.grid(self._cell_m)

    def around(self, position: Array) -> OccupancyGrid:
        """Return the cells around a position (3,) [m]."""
        shape = np.round(LOCAL_M / self._cell_m).astype(np.int64)
        low = np.floor(position / self._cell_m).astype(np.int64) - shape // 2
        if self._cells is None:
            states = np.full(shape, UNKNOWN, np.uint8)
            return OccupancyGrid(self._cell_m * low.astype(np.float64), self._cell_m, states)
        cells = self._cells
        first, last = np.maximum(low, cells.low), np.minimum(low + shape, cells.low + cells.values.shape)
        local = LogOdds(low, np.zeros(shape, np.float32))
        if np.all(last > first):
            own = tuple(slice(a, b) for a, b in zip(first - low, last - low, strict=True))
            part = tuple(slice(a, b) for a, b in zip(first - cells.low, last - cells.low, strict=True))
            local.values[own] = cells.values[part]
        return local.grid(self._cell_m)


def pinhole_of(model: CameraModel) -> tuple[Pinhole, PinholeMap]:
    """Return a pinhole with square pixels that sees what a lens sees along its axes, and the map of its pixels."""
    focal_px = max(model.central_focal_px)
    middle = np.array([(model.width - 1) / 2, (model.height - 1) / 2])
    left, right = model.normalize(np.array([[-0.5, middle[1]], [model.width - 0.5, middle[1]]]))[:, 0]
    top, bottom = model.normalize(np.array([[middle[0], -0.5], [middle[0], model.height - 0.5]]))[:, 1]
    width, height = round(focal_px * (right - left)), round(focal_px * (bottom - top))
    K = np.array([[focal_px, 0.0, -focal_px * left - 0.5], [0.0, focal_px, -focal_px * top - 0.5], [0.0, 0.0, 1.0]])
    camera = Pinhole(width, height, K)
    return camera, PinholeMap.of(model, camera, np.eye(3))
