"""Relative pose of two keyframes whose directions of gravity are known: a minimal solver and its consensus.

In level frames, in which gravity points along −z, the relative pose has four unknowns: the yaw ψ and the translation.
A landmark X of one keyframe that the other one sees along the bearing b from the origin o of a camera satisfies

    Rz(ψ)ᵀ (X − t) = o + λ b,

so that two landmarks suffice (Kukelova, Bujnak, Pajdla, "Closed-form solutions to minimal absolute pose problems with
known vertical direction", ACCV 2010). The difference of the two equations, multiplied by n = b₁ × b₂, is one equation
in cos ψ and sin ψ, with D = X₁ − X₂ and δ = o₁ − o₂:

    (n_x D_x + n_y D_y) cos ψ + (n_x D_y − n_y D_x) sin ψ + n_z D_z − n·δ = 0.

The depths λ and the translation follow linearly. All hypotheses are computed at once.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import cross, rotation_z


@dataclass(frozen=True, eq=False)
class LevelMatches:
    """Landmarks of one keyframe and their bearings in another one, in the level frames of both IMUs."""

    points: Array
    """(N, 3) Landmarks in the level frame of their keyframe [m]."""
    bearings: Array
    """(N, 3) Unit vectors to the matched corners, in the level frame of the other keyframe."""
    origins: Array
    """(N, 3) Positions of the cameras of the corners, in the level frame of the other keyframe [m]."""

    def __len__(self) -> int:
        """Return the number of matches."""
        return len(self.points)


@dataclass(frozen=True, eq=False)
class LevelPoses:
    """Hypotheses of the pose of the query's level frame in that of the match."""

    yaw_rad: Array
    """(H,) Rotations about the vertical [rad]."""
    t: Array
    """(H, 3) Positions of the frame [m]."""

    def __len__(self) -> int:
        """Return the number of hypotheses."""
        return len(self.yaw_rad)

    @property
    def inverse(self) -> "LevelPoses":
        """The poses of the match's level frame in that of the query."""
        return LevelPoses(-self.yaw_rad, -_rotated(self.t, self.yaw_rad))


def sample_poses(matches: LevelMatches, samples: int, rng: np.random.Generator) -> LevelPoses:
    """Return the hypotheses (H) of random pairs of matches: the pose of the observing frame in that of the landmarks.

    Args:
        matches: The matches, of which each pair determines up to two hypotheses.
        samples: Number of pairs.
        rng: Random generator that draws the pairs.
    """
    n = len(matches)
    if n < 2:
        return LevelPoses(np.zeros(0), np.zeros((0, 3)))
    first = rng.integers(0, n, samples)
    second = (first + rng.integers(1, n, samples)) % n  # differs from the first
    return solve_two_points(
        LevelMatches(matches.points[first], matches.bearings[first], matches.origins[first]),
        LevelMatches(matches.points[second], matches.bearings[second], matches.origins[second]),
    )


def solve_two_points(first: LevelMatches, second: LevelMatches) -> LevelPoses:
    """Return the poses (H), H ≤ 2 N, on which N pairs of matches agree, with both landmarks in front.

    Args:
        first: First match of each pair.
        second: Second match of each pair.
    """
    # Coplanarity of the two rays and the line between the points: a cos ψ + b sin ψ + c = 0
    D, offset = first.points - second.points, first.origins - second.origins
    n = cross(first.bearings, second.bearings)
    n2 = np.sum(n * n, axis=1)
    a = n[:, 0] * D[:, 0] + n[:, 1] * D[:, 1]
    b = n[:, 0] * D[:, 1] - n[:, 1] * D[:, 0]
    c = n[:, 2] * D[:, 2] - np.sum(n * offset, axis=1)
    amplitude = np.hypot(a, b)
    is_solvable = (amplitude > np.abs(c)) & (n2 > 1e-12)
    cosine = np.divide(-c, amplitude, out=np.zeros_like(c), where=is_solvable)
    mean, half = np.arctan2(b, a), np.arccos(cosine)
    yaw = np.concatenate([mean + half, mean - half])
    # Both solutions of each pair, with points in front of the cameras
    twice = np.tile(np.flatnonzero(is_solvable), 2)
    yaw = yaw[np.concatenate([is_solvable, is_solvable])]
    n, n2 = n[twice], n2[twice]
    rotated = _rotated(D[twice], yaw) - offset[twice]
    depth1 = np.sum(cross(rotated, second.bearings[twice]) * n, axis=1) / n2
    depth2 = np.sum(cross(rotated, first.bearings[twice]) * n, axis=1) / n2
    in_front = (depth1 > 0.0) & (depth2 > 0.0)
    twice, yaw, depth1 = twice[in_front], yaw[in_front], depth1[in_front]
    # Position by the first point
    seen = first.origins[twice] + depth1[:, None] * first.bearings[twice]
    return LevelPoses(yaw, first.points[twice] - _rotated(seen, -yaw))


def squared_errors(poses: LevelPoses, matches: LevelMatches) -> Array:
    """Return the squared sines (H, N) of the angles between bearings and predicted landmarks; 1 for those behind.

    Args:
        poses: Poses of the observing frame in the frame of the landmarks.
        matches: The matches.
    """
    c, s = np.cos(poses.yaw_rad)[:, None], np.sin(poses.yaw_rad)[:, None]
    x, y, z = (matches.points[None, :, k] - poses.t[:, k, None] for k in range(3))
    ox, oy, oz = matches.origins.T
    bx, by, bz = matches.bearings.T
    vx, vy, vz = c * x + s * y - ox, c * y - s * x - oy, z - oz
    along = vx * bx + vy * by + vz * bz
    square = np.maximum(vx * vx + vy * vy + vz * vz, 1e-12)
    return np.where(along > 0.0, np.maximum(1.0 - along * along / square, 0.0), 1.0)


def level_pose_matrix(yaw_rad: float, t: Array, R_match: Array, R_query: Array) -> Array:
    """Return the pose (4, 4) of the query's IMU in that of the match.

    Args:
        yaw_rad: Rotation of the query's level frame in that of the match [rad].
        t: (3,) Its position there [m].
        R_match: (3, 3) Orientation of the match's IMU in its level frame.
        R_query: (3, 3) Orientation of the query's IMU in its level frame.
    """
    T = np.eye(4)
    T[:3, :3] = R_match.T @ rotation_z(yaw_rad) @ R_query
    T[:3, 3] = R_match.T @ t
    return T


def _rotated(v: Array, yaw_rad: Array) -> Array:
    """Return Rz(ψ)ᵀ v for vectors (N, 3) and angles (N,)."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.column_stack([c * v[:, 0] + s * v[:, 1], c * v[:, 1] - s * v[:, 0], v[:, 2]])
