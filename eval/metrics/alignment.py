"""Alignment of an estimated trajectory with the true one.

The world frame of an odometry is arbitrary in the directions of its gauge, so these are aligned before errors are
computed. For visual-inertial odometry, gravity and the accelerometer make roll, pitch and scale observable: only
position and yaw are free, and ``yaw`` is the alignment to use. ``se3`` removes errors of roll and pitch as well, and
``sim3`` also errors of the scale. ``first`` makes the first poses coincide; ``scale`` also estimates the scale then, as
the KITTI odometry tools do.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, EvaluationError, unknown_name
from dronevio.models.quaternions import quat_product_wxyz
from dronevio.models.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.models.state import Trajectory

AlignmentMode = Literal["none", "first", "yaw", "se3", "sim3", "scale"]
"""What is aligned: nothing; the first pose; yaw and position; rotation and position; rotation, position and scale; or
the first pose and then the scale."""

_LINE_RATIO = 1e-9  # second over first singular value, below which a path counts as a straight line


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity from the estimate's world frame to that of the truth: p_truth ≈ scale · R · p_estimate + t."""

    R_truth_estimate: Array
    """(3, 3) Rotation from the estimate's world frame to that of the truth."""
    t_m: Array
    """(3,) Translation in the world frame of the truth [m]."""
    scale: float = 1.0
    """Factor by which lengths of the estimate are multiplied."""

    def positions(self, p: Array) -> Array:
        """Return positions (…, 3) [m] of the estimate in the world frame of the truth."""
        return np.asarray(self.scale * (p @ self.R_truth_estimate.T) + self.t_m)

    def vectors(self, v: Array) -> Array:
        """Return vectors (…, 3) of the estimate, such as velocities, in the world frame of the truth."""
        return np.asarray(self.scale * (v @ self.R_truth_estimate.T))

    def orientations(self, quat_wxyz: Array) -> Array:
        """Return orientations (…, 4) of the estimate relative to the world frame of the truth."""
        return quat_product_wxyz(quat_wxyz_from_matrix(self.R_truth_estimate), quat_wxyz)

    def apply(self, estimate: Trajectory) -> Trajectory:
        """Return a trajectory in the world frame of the truth, with its velocities and covariances."""
        velocity, covariance = estimate.velocity_m_s, estimate.covariance
        if covariance is not None:
            # δθ and the biases are in the IMU frame; δp and δv are in the world frame.
            A = np.eye(15)
            A[3:6, 3:6] = A[6:9, 6:9] = self.scale * self.R_truth_estimate
            covariance = _transformed(A, covariance)
        return replace(
            estimate,
            p_world_imu=self.positions(estimate.p_world_imu),
            quat_wxyz=self.orientations(estimate.quat_wxyz),
            velocity_m_s=None if velocity is None else self.vectors(velocity),
            covariance=covariance,
        )


IDENTITY = Alignment(np.eye(3), np.zeros(3))
"""The alignment that leaves a trajectory unchanged."""


def align(
    p_truth: Array,
    p_estimate: Array,
    mode: AlignmentMode = "yaw",
    *,
    n: int | None = None,
    quat_truth_wxyz: Array | None = None,
    quat_estimate_wxyz: Array | None = None,
) -> Alignment:
    """Return the alignment that minimizes Σ |p_truth − aligned p_estimate|² over the first n poses.

    A single position does not determine a rotation: ``first`` and ``scale``, and ``yaw`` and ``se3`` with n = 1, use
    the first orientations instead, ``yaw`` only their difference in yaw.

    Args:
        p_truth: (N, 3) True positions [m].
        p_estimate: (N, 3) Estimated positions [m] at the same times.
        mode: What is aligned.
        n: Number of poses to align, from the first on; None for all.
        quat_truth_wxyz: (N, 4) True orientations, which only alignments to the first pose need.
        quat_estimate_wxyz: (N, 4) Estimated orientations, likewise.

    Raises:
        ConfigError: The mode does not exist, or n is less than one.
        EvaluationError: There are no positions, they do not determine the alignment, or orientations are missing.
    """
    if mode not in get_args(AlignmentMode):
        raise unknown_name("alignment", mode, get_args(AlignmentMode))
    if n is not None and n < 1:
        raise ConfigError(f"an alignment over {n} poses; expected at least one")
    truth, estimate = np.asarray(p_truth, dtype=np.float64), np.asarray(p_estimate, dtype=np.float64)
    if truth.shape != estimate.shape or truth.shape[1:] != (3,) or not len(truth):
        raise EvaluationError(f"positions of shapes {truth.shape} and {estimate.shape}; expected (N, 3) twice, N > 0")
    truth, estimate = truth[:n], estimate[:n]
    if mode == "none":
        return IDENTITY
    if mode in ("first", "scale") or (n == 1 and mode != "sim3"):
        if quat_truth_wxyz is None or quat_estimate_wxyz is None:
            raise EvaluationError("an alignment to the first pose without orientations; expected orientations as well")
        R = matrix_from_quat_wxyz(quat_truth_wxyz[0]) @ matrix_from_quat_wxyz(quat_estimate_wxyz[0]).T
        if mode == "scale":
            return _align_scale(truth, estimate, R)
        return _align_first(truth, estimate, rotation_z(yaw_rad_from_matrix(R)) if mode == "yaw" else R)
    if mode == "yaw":
        return _align_yaw(truth, estimate)
    return umeyama(truth, estimate, with_scale=mode == "sim3")


def umeyama(p_truth: Array, p_estimate: Array, with_scale: bool) -> Alignment:
    """Return the least-squares rotation, translation and, optionally, scale (Umeyama, PAMI 1991, eq. 40 to 43).

    Args:
        p_truth: (N, 3) True positions [m].
        p_estimate: (N, 3) Estimated positions [m].
        with_scale: Whether the scale is estimated as well.

    Raises:
        EvaluationError: A path is a point or a straight line, which leaves the rotation undetermined.
    """
    mean_truth, mean_estimate = p_truth.mean(axis=0), p_estimate.mean(axis=0)
    a, b = p_truth - mean_truth, p_estimate - mean_estimate
    U, D, Vt = np.linalg.svd(a.T @ b / len(a))
    if not D[1] > _LINE_RATIO * D[0] or not D[0] > np.finfo(float).tiny:
        raise EvaluationError(
            "a path that is a point or a straight line does not determine a rotation; expected the alignment yaw"
        )
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # a rotation, not a mirror
    R = (U * signs) @ Vt
    scale = float((D * signs).sum() / np.mean((b * b).sum(axis=1))) if with_scale else 1.0
    return Alignment(R, mean_truth - scale * R @ mean_estimate, scale)


def _align_first(p_truth: Array, p_estimate: Array, R: Array, scale: float = 1.0) -> Alignment:
    """Return the alignment with a given rotation (3, 3) and scale that makes the first positions coincide."""
    return Alignment(R, p_truth[0] - scale * R @ p_estimate[0], scale)


def _align_scale(p_truth: Array, p_estimate: Array, R: Array) -> Alignment:
    """Return the least-squares scale about the first positions, Σ a·b / Σ b·b, after a rotation (3, 3)."""
    a, b = p_truth - p_truth[0], (p_estimate - p_estimate[0]) @ R.T
    size = float(np.sum(b * b))
    scale = float(np.sum(a * b)) / size if size > 0.0 else 0.0
    if not scale > 0.0:
        raise EvaluationError(
            "an estimate that does not move, or moves in the opposite direction, does not determine a scale"
        )
    return _align_first(p_truth, p_estimate, R, scale)


def _align_yaw(p_truth: Array, p_estimate: Array) -> Alignment:
    """Return the least-squares rotation about z and translation.

    The derivative of the squared error with respect to the angle vanishes at
    θ = atan2(Σ(bₓa_y − b_yaₓ), Σ(bₓaₓ + b_ya_y)) for centred truth a and estimate b; it is 0 if θ is undetermined.
    """
    mean_truth, mean_estimate = p_truth.mean(axis=0), p_estimate.mean(axis=0)
    a, b = p_truth - mean_truth, p_estimate - mean_estimate
    sine = np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0])
    cosine = np.sum(b[:, 0] * a[:, 0] + b[:, 1] * a[:, 1])
    R = rotation_z(np.arctan2(sine, cosine))
    return Alignment(R, mean_truth - R @ mean_estimate)


def _transformed(A: Array, P: Array) -> Array:
    """Return A P Aᵀ (N, k, k) of symmetric P (N, k, k), computed as two large products instead of 2 N small ones."""
    half = (P.reshape(-1, P.shape[-1]) @ A.T).reshape(P.shape)
    return np.asarray((np.swapaxes(half, -1, -2).reshape(-1, P.shape[-1]) @ A.T).reshape(P.shape))
