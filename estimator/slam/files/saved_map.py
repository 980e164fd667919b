"""A map that can be saved: all keyframes as arrays, and their pose graph.

The poses are those of the final map. The factors of the pose graph measure these poses, with their covariances, so that
the saved poses are the optimum of the saved graph; rejected loops are left out. All former tracks and flights become
one track, whose odometry frame is the map frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.files.saved_arrays import check_arrays
from dronevio.estimator.slam.map.keyframe import KeyframeFeatures, MapKeyframe
from dronevio.estimator.slam.map.odometry_factors import GravityDirection, RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.estimator.slam.places.localization import LandmarkPatches
from dronevio.models.arrays import Array, Floats
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import inverse_pose

Bytes = npt.NDArray[np.uint8]
Rows = npt.NDArray[np.int32]
Times = npt.NDArray[np.int64]

LAST_KNOWN_NS = -(2**61)
"""Time of the last keyframe of a loaded map, before the measurements of all flights [ns]."""
FIRST_KNOWN_LANDMARK = 2**40
"""Smallest identity of a landmark of a loaded map, above those of all flights."""
MAX_VIEW_ERROR_DEG = 0.5
"""Largest angle between the views of a pixel by two calibrations that are compatible [°]."""
MAX_CAMERA_SHIFT_M = 0.02
"""Largest distance between the positions of a camera by two calibrations that are compatible [m]."""
_PAUSE_NS = 1_000_000_000  # between the keyframes of two flights in one map
_GRID = 7  # pixels along each side of an image at which calibrations are compared


@dataclass(frozen=True, eq=False)
class KnownMap:
    """A saved map in the form that a flight continues."""

    keyframes: tuple[MapKeyframe, ...]
    """The keyframes, all of track 0, numbered by their rows."""
    graph: PoseGraph
    """Their pose graph."""
    patches: Mapping[int, LandmarkPatches]
    """Small images around the landmarks of the keyframes, by their numbers; culled keyframes have none."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map of K keyframes with F corners, L landmarks and P patches of S × S pixels.

    The corners of all keyframes follow one another, and so do the landmarks and the patches.
    """

    cameras: tuple[RigCamera, ...]
    """Calibration of the cameras."""
    first: int
    """Row of the keyframe whose yaw and position are those of the map frame."""
    t_ns: Times
    """(K,) Times of the keyframes, strictly increasing [ns]. Those of a flight end before the next one begins."""
    Ts_map_imu: Array
    """(K, 4, 4) Poses of the IMU in the map frame."""
    corner_counts: Rows
    """(K,) Numbers of the corners of the keyframes."""
    pixels: Floats
    """(F, 2) Image coordinates of the corners [px]."""
    xy: Floats
    """(F, 2) Normalized, undistorted image coordinates of the corners."""
    corner_camera: Bytes
    """(F,) Index of the camera of each corner."""
    descriptors: Bytes
    """(F, 32) Binary descriptors of the corners."""
    corner_landmark: Rows
    """(F,) Identity of the landmark at each corner, -1 without one."""
    landmark_counts: Rows
    """(K,) Numbers of the landmarks of the keyframes."""
    landmark_ids: Rows
    """(L,) Identities of the landmarks, increasing within a keyframe."""
    landmarks_imu: Floats
    """(L, 3) Positions of the landmarks in the IMU frames of their keyframes [m]."""
    patch_counts: Rows
    """(K,) Numbers of the patches of the keyframes."""
    patch_points_imu: Floats
    """(P, 3) Positions of the landmarks of the patches in the IMU frames of their keyframes [m]."""
    patch_pixels: Floats
    """(P, 2) Positions of the landmarks in the images [px]."""
    patch_camera: Bytes
    """(P,) Index of the camera of each patch."""
    tiles: Bytes
    """(P, S, S) The patches, of which the middle pixel is the one nearest to the landmark."""
    first_covariance: Array
    """(6, 6) Prior covariance of the pose of the first keyframe: δθ, then δp, both in the IMU frame."""
    odometry: Rows
    """(E, 2) Rows of the keyframes of the relative poses by the odometry."""
    odometry_covariances: Array
    """(E, 6, 6) Their covariances: δθ, then δp, both in the IMU frame of the second keyframe."""
    gravity: Rows
    """(G,) Rows of the keyframes with a direction of gravity by the odometry."""
    gravity_sigmas_rad: Array
    """(G,) Standard deviations of its two angles [rad]."""
    loops: Rows
    """(C, 2) Rows of the keyframes of the loops."""
    loop_covariances: Array
    """(C, 6, 6) Their covariances, as those of the odometry."""
    joined: Rows
    """(J,) Rows of the keyframes at which joined tracks begin."""

    def __post_init__(self) -> None:
        """Check the arrays; see `check_arrays`.

        Raises:
            ConfigError: An array contradicts the others, or has values that no map has.
        """
        check_arrays(vars(self), self.first, len(self.cameras))

    def check_rig(self, rig: Rig) -> None:
        """Check that a map by another calibration can be used with a rig.

        Raises:
            ConfigError: The rig has another number of cameras, or a camera has another image size, or sees in clearly
                other directions from another position.
        """
        if len(rig.cameras) != len(self.cameras):
            raise ConfigError(
                f"map of a rig with {len(self.cameras)} cameras; expected {len(rig.cameras)}, as the recording has"
            )
        for i, (old, new) in enumerate(zip(self.cameras, rig.cameras, strict=True)):
            sizes = [(camera.model.width, camera.model.height) for camera in (old, new)]
            if sizes[0] != sizes[1]:
                (w, h), (width, height) = sizes
                raise ConfigError(f"map whose camera {i} has {w} × {h} px; expected {width} × {height} px")
            shift_m, angle_deg = _calibration_difference(old, new)
            if shift_m > MAX_CAMERA_SHIFT_M or not angle_deg <= MAX_VIEW_ERROR_DEG:
                raise ConfigError(
                    f"map whose camera {i} differs from that of the recording by {shift_m:.3f} m and {angle_deg:.1f}°;"
                    f" expected the same calibration, within {MAX_CAMERA_SHIFT_M} m and {MAX_VIEW_ERROR_DEG}°"
                )

    def known(self, *, is_fixed: bool = False) -> KnownMap:
        """Return the map in the form that a flight continues.

        Args:
            is_fixed: Whether the poses of the map stay as they are. Its factors are then left out.
        """
        corners, landmarks, patches = (
            [slice(a, b) for a, b in pairwise(np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).tolist())]
            for counts in (self.corner_counts, self.landmark_counts, self.patch_counts)
        )
        t_ns = (self.t_ns - self.t_ns[-1] + LAST_KNOWN_NS).tolist()
        keyframes = tuple(
            MapKeyframe(
                row,
                t_ns[row],
                self.Ts_map_imu[row],
                self._corners(corners[row]),
                _identities(self.landmark_ids[landmarks[row]]),
                self.landmarks_imu[landmarks[row]].astype(np.float64),
            )
            for row in range(len(t_ns))
        )
        tiles = {row: self._patches(rows, keyframes[row]) for row, rows in enumerate(patches) if rows.start < rows.stop}
        return KnownMap(keyframes, self._fixed_graph() if is_fixed else self.graph, tiles)

    @property
    def graph(self) -> PoseGraph:
        """The pose graph, of which the poses are the optimum; keyframes are numbered by their rows."""
        T = self.Ts_map_imu
        directions = zip(self.gravity.tolist(), self.gravity_sigmas_rad.tolist(), strict=True)
        return PoseGraph(
            self.first,
            self.first_covariance,
            dict(enumerate(T)),
            tuple(_relative_poses(T, self.odometry, self.odometry_covariances)),
            tuple(GravityDirection(row, T[row, 2, :3], sigma_rad) for row, sigma_rad in directions),
            loops=tuple(_relative_poses(T, self.loops, self.loop_covariances)),
            joined=tuple(self.joined.tolist()),
        )

    def _fixed_graph(self) -> PoseGraph:
        """Return a graph with fixed poses."""
        poses = dict(enumerate(self.Ts_map_imu))
        return PoseGraph(self.first, self.first_covariance, poses, fixed=tuple(poses))

    def _corners(self, rows: slice) -> KeyframeFeatures:
        """Return some of the corners."""
        return KeyframeFeatures(
            self.pixels[rows].astype(np.float64),
            self.xy[rows].astype(np.float64),
            self.corner_camera[rows].astype(np.int64),
            self.descriptors[rows],
            _identities(self.corner_landmark[rows]),
        )

    def _patches(self, rows: slice, keyframe: MapKeyframe) -> LandmarkPatches:
        """Return the patches of a keyframe, whose landmarks are those of its landmarks at the same position."""
        points = self.patch_points_imu[rows].astype(np.float64)
        is_same = np.all(points[:, None] == keyframe.landmarks_imu, axis=2)
        identities = keyframe.landmark_ids[is_same.argmax(axis=1)] if len(keyframe.landmark_ids) else -1
        return LandmarkPatches(
            np.where(is_same.any(axis=1), identities, -1),
            points,
            self.patch_pixels[rows].astype(np.float64),
            self.patch_camera[rows].astype(np.int64),
            self.tiles[rows],
        )


def saved_map(
    cameras: Sequence[RigCamera],
    graph: PoseGraph,
    keyframes: Sequence[MapKeyframe],
    patches: Mapping[int, LandmarkPatches],
) -> SavedMap:
    """Return a map as arrays that can be saved.

    Args:
        cameras: Calibration of the cameras.
        graph: The pose graph with the final poses, without rejected loops.
        keyframes: Its keyframes in the order of time.
        patches: Small images around landmarks, by the numbers of their keyframes.

    Raises:
        ConfigError: The map has too few keyframes to be saved.
    """
    row = {keyframe.number: i for i, keyframe in enumerate(keyframes)}
    corners = [keyframe.features for keyframe in keyframes]
    of_keyframes = [patches.get(keyframe.number, _no_patches(patches)) for keyframe in keyframes]
    identities = np.concatenate([np.concatenate([k.landmark_ids for k in keyframes]), *(c.landmark for c in corners)])
    known, inverse = np.unique(identities, return_inverse=True)
    renumbered = _rows(inverse - (len(known) > 0 and known[0] < 0))  # -1 stays
    landmark_count = sum(len(keyframe.landmark_ids) for keyframe in keyframes)
    return SavedMap(
        cameras=tuple(cameras),
        first=row[graph.first],
        t_ns=_continued(np.array([keyframe.t_ns for keyframe in keyframes], dtype=np.int64)),
        Ts_map_imu=np.stack([graph.poses[keyframe.number] for keyframe in keyframes]),
        corner_counts=_rows([len(each) for each in corners]),
        pixels=np.concatenate([each.pixels for each in corners]).astype(np.float32),
        xy=np.concatenate([each.xy for each in corners]).astype(np.float32),
        corner_camera=np.concatenate([each.camera for each in corners]).astype(np.uint8),
        descriptors=np.concatenate([each.descriptors for each in corners]),
        corner_landmark=renumbered[landmark_count:],
        landmark_counts=_rows([len(keyframe.landmark_ids) for keyframe in keyframes]),
        landmark_ids=renumbered[:landmark_count],
        landmarks_imu=np.concatenate([keyframe.landmarks_imu for keyframe in keyframes]).astype(np.float32),
        patch_counts=_rows([len(each.tiles) for each in of_keyframes]),
        patch_points_imu=np.concatenate([each.points_imu for each in of_keyframes]).astype(np.float32),
        patch_pixels=np.concatenate([each.pixels for each in of_keyframes]).astype(np.float32),
        patch_camera=np.concatenate([each.camera for each in of_keyframes]).astype(np.uint8),
        tiles=np.concatenate([each.tiles for each in of_keyframes]),
        first_covariance=graph.first_covariance,
        odometry=_rows([(row[each.first], row[each.second]) for each in graph.odometry]).reshape(-1, 2),
        odometry_covariances=_covariances(graph.odometry),
        gravity=_rows([row[each.keyframe] for each in graph.gravity]),
        gravity_sigmas_rad=np.array([each.sigma_rad for each in graph.gravity], dtype=np.float64),
        loops=_rows([(row[each.first], row[each.second]) for each in graph.loops]).reshape(-1, 2),
        loop_covariances=_covariances(graph.loops),
        joined=_rows([row[number] for number in graph.joined]),
    )


def _continued(t_ns: Times) -> Times:
    """Return times (K,) of keyframes, where those of a loaded map end shortly before those of the flight begin."""
    is_known = t_ns <= LAST_KNOWN_NS
    if np.any(is_known):
        begin_ns = 0 if np.all(is_known) else t_ns[~is_known][0]
        t_ns = np.where(is_known, t_ns - LAST_KNOWN_NS + begin_ns - _PAUSE_NS, t_ns)
    return t_ns


def _no_patches(patches: Mapping[int, LandmarkPatches]) -> LandmarkPatches:
    """Return no patches, of the same size as others."""
    side = next(iter(patches.values())).tiles.shape[1] if patches else 0
    none = np.zeros((0, side, side), np.uint8)
    return LandmarkPatches(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, np.int64), none)


def _rows(values: npt.ArrayLike) -> Rows:
    return np.array(values, dtype=np.int32)


def _covariances(relative: Sequence[RelativePose]) -> Array:
    return np.array([each.covariance for each in relative], dtype=np.float64).reshape(-1, 6, 6)


def _identities(saved: Rows) -> Times:
    """Return identities of landmarks that differ from those of flights; -1 stays."""
    identities = saved.astype(np.int64)
    return np.where(identities < 0, identities, identities + FIRST_KNOWN_LANDMARK)


def _relative_poses(Ts_map_imu: Array, rows: Rows, covariances: Array) -> list[RelativePose]:
    """Return relative poses of keyframes, as measured by their poses (K, 4, 4)."""
    T = inverse_pose(Ts_map_imu[rows[:, 0]]) @ Ts_map_imu[rows[:, 1]]
    return [RelativePose(first, second, T[i], covariances[i]) for i, (first, second) in enumerate(rows.tolist())]


def _calibration_difference(old: RigCamera, new: RigCamera) -> tuple[float, float]:
    """Return the distance between the positions [m] and the largest angle between the views of a pixel [°]."""
    u = np.linspace(0.0, old.model.width - 1.0, _GRID)
    v = np.linspace(0.0, old.model.height - 1.0, _GRID)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    one, other = (camera.model.unproject(pixels) @ camera.T_imu_cam[:3, :3].T for camera in (old, new))
    sine = np.linalg.norm(np.cross(one, other), axis=1)
    angle = np.degrees(np.arctan2(sine, np.sum(one * other, axis=1)))
    is_seen = np.isfinite(angle)
    is_same_field = np.array_equal(np.isfinite(one), np.isfinite(other))
    shift_m = float(np.linalg.norm(old.T_imu_cam[:3, 3] - new.T_imu_cam[:3, 3]))
    return shift_m, float(angle[is_seen].max()) if np.any(is_seen) and is_same_field else 180.0
