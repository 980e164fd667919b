"""Tracks of features against the epipolar geometry of true poses, without the depth of the scene.

The epipolar residual of a track is the angle between its bearing in the current frame and the epipolar plane of its
first view, times the focal length. It contains one component of the error of the track, that across the epipolar line,
and the errors of the poses. Bearings are free of lens distortion. With a rolling shutter, each row of the image has a
pose of its own.

Measured poses have errors as large as those of tracks: 0.02° is 0.16 px. `refined_poses` therefore estimates small
corrections of the poses that the tracks of all features agree on. What remains cannot be explained by any camera motion
near the measured one.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from dronevio.models.arrays import Array, Integers
from dronevio.models.rotation import exp_so3, log_so3

AGES = (1, 5, 10, 20, 40)
"""Ages of tracks at which residuals are reported [frames]."""
MIN_BASELINE_M = 0.003
"""Shortest baseline of a pair of views. Below it, the epipolar plane depends on errors of the poses."""
REFINEMENT_AGES = (1, 2, 3, 5, 7, 10, 14, 20, 28, 40)
"""Ages of tracks from which corrections of poses are estimated [frames]."""
STEP_SIGMA = np.repeat([2e-4, 5e-4], 3)
"""Standard deviations of the change of the corrections of orientation [rad] and position [m] from one frame to the
next. Those of the first frame are ten times as large."""
ROBUST_PX = 0.3
"""Residual from which a track has less influence on the corrections of poses [px]."""
OFFSET_SIGMA = np.array([0.05, 0.02, 0.02, 0.02])
"""Standard deviations of the constant time offset [s] and rotation [rad] of `constant_offsets` before the fit."""
_ITERATIONS = 6


@dataclass(frozen=True, eq=False)
class TrackTable:
    """Observations of features by one camera, one row for each feature and frame."""

    ids: Integers
    """(N,) Identity of the feature."""
    frame: Integers
    """(N,) Index of the frame."""
    bearings: Array
    """(N, 3) Unit bearing vectors in the camera frame."""
    frames: int
    """Number of frames."""
    row: Integers | None = None
    """(N,) Row of the image that observes the feature, with a rolling shutter; None with a global shutter."""
    rows: int = 1
    """Number of poses of a frame: its rows with a rolling shutter, 1 with a global shutter."""

    @property
    def pose(self) -> Integers:
        """(N,) Index of the pose of each observation: that of the frame, or of the row."""
        return self.frame if self.row is None else self.frame * self.rows + self.row

    @property
    def features_per_frame(self) -> float:
        """Mean number of observed features per frame."""
        return len(self.ids) / max(self.frames, 1)


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """Pairs of the first view of a feature and a later one."""

    first: Integers
    """(M,) Index of the pose of the first view."""
    frame: Integers
    """(M,) Index of the pose of the later view."""
    bearings_first: Array
    """(M, 3) Unit bearing vectors in the first view."""
    bearings: Array
    """(M, 3) Unit bearing vectors in the later view."""
    rows: int = 1
    """Number of poses of a frame."""

    @property
    def ages(self) -> Integers:
        """(M,) Number of frames between the views."""
        return self.frame // self.rows - self.first // self.rows

    def __getitem__(self, chosen: npt.NDArray[np.bool_]) -> "ViewPairs":
        return ViewPairs(
            self.first[chosen], self.frame[chosen], self.bearings_first[chosen], self.bearings[chosen], self.rows
        )

    def joined(self, others: "ViewPairs") -> "ViewPairs":
        """Return these pairs followed by others."""
        return ViewPairs(
            np.concatenate([self.first, others.first]),
            np.concatenate([self.frame, others.frame]),
            np.concatenate([self.bearings_first, others.bearings_first]),
            np.concatenate([self.bearings, others.bearings]),
            self.rows,
        )


def view_pairs(table: TrackTable, ages: tuple[int, ...] = AGES) -> ViewPairs:
    """Return the pairs of views of all features at given ages."""
    order = np.lexsort((table.frame, table.ids))
    ids, frame, pose, bearings = table.ids[order], table.frame[order], table.pose[order], table.bearings[order]
    _, starts, inverse = np.unique(ids, return_index=True, return_inverse=True)
    first = starts[inverse]
    chosen = np.isin(frame - frame[first], ages)
    return ViewPairs(pose[first[chosen]], pose[chosen], bearings[first[chosen]], bearings[chosen], table.rows)


def survival(table: TrackTable, age: int) -> float:
    """Return the share of the features that are observed at an age, of those detected early enough [0, 1]."""
    order = np.lexsort((table.frame, table.ids))
    ids, frame = table.ids[order], table.frame[order]
    _, starts, inverse = np.unique(ids, return_index=True, return_inverse=True)
    early = frame[starts] + age < table.frames
    reached = np.zeros(len(starts), bool)
    reached[inverse[frame - frame[starts[inverse]] == age]] = True
    return float(reached[early].mean()) if early.any() else float("nan")


def residuals_px(Ts_world_cam: Array, pairs: ViewPairs, focal_px: float) -> Array:
    """Return the signed epipolar residuals (M,) of pairs of views [px]; NaN for baselines below `MIN_BASELINE_M`.

    Args:
        Ts_world_cam: (F, 4, 4) Poses of the camera at the frames, or at all rows of the frames.
        pairs: M pairs of views.
        focal_px: Focal length, which converts angles to pixels [px].
    """
    first, later, baseline = _in_world(Ts_world_cam, pairs)
    normals = np.cross(baseline, first)
    sines = np.einsum("ij,ij->i", later, normals) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    short = np.linalg.norm(baseline, axis=1) < MIN_BASELINE_M
    return np.where(short, np.nan, focal_px * np.arcsin(np.clip(sines, -1.0, 1.0)))


def refined_poses(Ts_world_cam: Array, pairs: ViewPairs, focal_px: float) -> tuple[Array, Array]:
    """Return poses (F, 4, 4) with the corrections that the tracks agree on, and these corrections (F, 6).

    Corrections are small rotations [rad] and translations [m] of each pose in the world frame. They are a random walk
    with the standard deviations `STEP_SIGMA`, and the residuals of the tracks have a Cauchy distribution of scale
    `ROBUST_PX`.

    Args:
        Ts_world_cam: (F, 4, 4) Poses of the camera.
        pairs: Pairs of views.
        focal_px: Focal length [px].
    """
    count = len(Ts_world_cam)
    weights = np.ones(count)
    weights[0] = 0.01
    steps = sp.identity(count) - sp.eye(count, k=-1)
    precision = sp.kron(steps.T @ sp.diags(weights) @ steps, sp.diags(1.0 / STEP_SIGMA**2))
    poses, found = _fitted(Ts_world_cam, pairs, focal_px, sp.identity(6 * count), precision)
    return poses, found.reshape(-1, 6)


def constant_offsets(Ts_world_cam: Array, pairs: ViewPairs, focal_px: float, interval_s: float) -> tuple[float, Array]:
    """Return the constant time offset [s] and rotation (3,) of the camera [rad] that the tracks agree on.

    The true time of a frame is its time stamp plus the offset. The rotation is that of the true camera in the frame of
    the given one.

    Args:
        Ts_world_cam: (F, 4, 4) Poses of the camera at regular intervals.
        pairs: Pairs of views.
        focal_px: Focal length [px].
        interval_s: Interval of the poses [s].
    """
    R, p = Ts_world_cam[:, :3, :3], Ts_world_cam[:, :3, 3]
    rates = log_so3(R[1:] @ np.swapaxes(R[:-1], 1, 2)) / interval_s
    rates = 0.5 * (np.concatenate([rates[:1], rates]) + np.concatenate([rates, rates[-1:]]))
    moved = np.concatenate([rates, np.gradient(p, interval_s, axis=0)], axis=1)
    turned = np.concatenate([R, np.zeros_like(R)], axis=1)
    basis = sp.csr_matrix(np.concatenate([moved[:, :, None], turned], axis=2).reshape(-1, 4))
    _, found = _fitted(Ts_world_cam, pairs, focal_px, basis, sp.diags(1.0 / OFFSET_SIGMA**2))
    return float(found[0]), found[1:]


def _fitted(
    Ts_world_cam: Array, pairs: ViewPairs, focal_px: float, basis: sp.spmatrix, precision: sp.spmatrix
) -> tuple[Array, Array]:
    """Return corrected poses (F, 4, 4) and the parameters (K,) that minimize the residuals of the tracks.

    Args:
        Ts_world_cam: (F, 4, 4) Poses of the camera.
        pairs: Pairs of views.
        focal_px: Focal length [px].
        basis: (6 F, K) Effect of the parameters on the corrections of the poses.
        precision: (K, K) Inverse of the prior covariance of the parameters.
    """
    found, poses = np.zeros(basis.shape[1]), Ts_world_cam
    for _ in range(_ITERATIONS):
        residual = residuals_px(poses, pairs, focal_px)
        known = np.isfinite(residual)
        residual = residual[known]
        jacobian = (_jacobian(poses, pairs[known], focal_px) @ basis).tocsr()
        weight = sp.diags(1.0 / (ROBUST_PX**2 + residual**2))
        normal = (jacobian.T @ weight @ jacobian + precision).tocsc()
        found = found - spsolve(normal, jacobian.T @ (weight @ residual) + precision @ found)
        poses = _corrected(Ts_world_cam, (basis @ found).reshape(-1, 6))
    return poses, found


def _in_world(Ts_world_cam: Array, pairs: ViewPairs) -> tuple[Array, Array, Array]:
    """Return both bearings (M, 3) and the vector (M, 3) from the later view to the first, in the world frame."""
    first = np.einsum("mij,mj->mi", Ts_world_cam[pairs.first, :3, :3], pairs.bearings_first)
    later = np.einsum("mij,mj->mi", Ts_world_cam[pairs.frame, :3, :3], pairs.bearings)
    return first, later, Ts_world_cam[pairs.first, :3, 3] - Ts_world_cam[pairs.frame, :3, 3]


def _jacobian(Ts_world_cam: Array, pairs: ViewPairs, focal_px: float) -> sp.csr_matrix:
    """Return the derivatives (M, 6 F) of the residuals with respect to rotations and translations of the poses.

    The residual is the triple product b₁ · (d × b₀) of bearings and baseline, over the length of d × b₀.
    """
    first, later, baseline = _in_world(Ts_world_cam, pairs)
    scale = focal_px / np.linalg.norm(np.cross(baseline, first), axis=1, keepdims=True)
    of_first = np.hstack([np.cross(first, np.cross(later, baseline)), np.cross(first, later)])
    of_later = np.hstack([np.cross(later, np.cross(baseline, first)), -np.cross(first, later)])
    rows = np.repeat(np.arange(len(pairs.first)), 12)
    columns = np.hstack([6 * pairs.first[:, None] + np.arange(6), 6 * pairs.frame[:, None] + np.arange(6)])
    values = np.hstack([scale * of_first, scale * of_later])
    return sp.csr_matrix((values.ravel(), (rows, columns.ravel())), (len(pairs.first), 6 * len(Ts_world_cam)))


def _corrected(Ts_world_cam: Array, corrections: Array) -> Array:
    """Return poses after rotations and translations (F, 6) in the world frame."""
    poses = Ts_world_cam.copy()
    poses[:, :3, :3] = exp_so3(corrections[:, :3]) @ Ts_world_cam[:, :3, :3]
    poses[:, :3, 3] += corrections[:, 3:]
    return poses
