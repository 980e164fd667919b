"""World frames of reconstructions: the similarity transformation that brings one into the frame of known poses."""

from dataclasses import replace

import numpy as np

from dronevio.estimator.sfm.model import SfmState
from dronevio.models.arrays import Array


def similarity(Ts_from: Array, Ts_to: Array) -> tuple[float, Array, Array]:
    """Return scale, rotation (3, 3) and translation (3,) that bring some poses nearest to others.

    The rotation is the mean of those of the poses, so that positions on a line suffice.

    Args:
        Ts_from: (N, 4, 4) Poses.
        Ts_to: (N, 4, 4) The same poses in the other frame, in the same order.
    """
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", Ts_to[:, :3, :3], Ts_from[:, :3, :3]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    a, b = Ts_from[:, :3, 3], Ts_to[:, :3, 3]
    spread = float(np.sum((a - a.mean(axis=0)) ** 2))
    scale = float(np.sum((b - b.mean(axis=0)) * ((a - a.mean(axis=0)) @ R.T))) / spread if spread > 0.0 else 1.0
    scale = scale if scale > 0.0 else 1.0
    return scale, R, b.mean(axis=0) - scale * R @ a.mean(axis=0)


def transformed(state: SfmState, scale: float, R: Array, t: Array) -> SfmState:
    """Return a state in a new world frame, as `Reconstruction.transformed`."""
    Ts_world_cam = state.Ts_world_cam.copy()
    Ts_world_cam[:, :3, :3] = R @ state.Ts_world_cam[:, :3, :3]
    Ts_world_cam[:, :3, 3] = scale * state.Ts_world_cam[:, :3, 3] @ R.T + t
    return replace(state, Ts_world_cam=Ts_world_cam, points=scale * state.points @ R.T + t)


def aligned(state: SfmState, Ts_world_cam: Array) -> SfmState:
    """Return a state in the world frame of some known poses.

    Args:
        state: The state; it is returned unchanged if it has fewer than two images with known poses.
        Ts_world_cam: (I, 4, 4) Known poses, NaN where there is none.
    """
    both = state.is_registered & np.isfinite(Ts_world_cam[:, 0, 3])
    if both.sum() < 2:
        return state
    return transformed(state, *similarity(state.Ts_world_cam[both], Ts_world_cam[both]))
