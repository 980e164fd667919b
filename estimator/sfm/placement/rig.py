"""Scale of a reconstruction from the known mounting of several cameras on a rig."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, RelativePose, adjust
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.models.image_sets import ImageSet
from dronevio.models.rotation import inverse_pose

MIN_BASELINE_M = 1e-3
"""Smallest distance between two cameras that determines the scale [m]."""


def rig_poses(images: ImageSet, is_registered: npt.NDArray[np.bool_]) -> list[RelativePose]:
    """Return the known relative poses of the registered images of each frame, in metres."""
    if images.frame is None or images.Ts_imu_cam is None:
        return []
    poses: list[RelativePose] = []
    first_of_frame: dict[int, int] = {}
    for image in np.flatnonzero(is_registered).tolist():
        first = first_of_frame.setdefault(int(images.frame[image]), image)
        if first != image:
            T_imu_first = images.Ts_imu_cam[images.image_camera[first]]
            T_imu_second = images.Ts_imu_cam[images.image_camera[image]]
            poses.append(RelativePose(first, image, inverse_pose(T_imu_first) @ T_imu_second))
    return poses


def rig_scale(state: SfmState, poses: list[RelativePose]) -> float | None:
    """Return the length of a unit of the reconstruction [m], the median over all baselines; None without a baseline."""
    ratios = []
    for pose in poses:
        true = float(np.linalg.norm(pose.T_first_second[:3, 3]))
        p = state.Ts_world_cam[[pose.first, pose.second], :3, 3]
        estimated = float(np.linalg.norm(p[1] - p[0]))
        if true > MIN_BASELINE_M and estimated > 0.0:
            ratios.append(true / estimated)
    return float(np.median(ratios)) if ratios else None


def impose_rig(scene: Scene, state: SfmState, images: ImageSet, cauchy_px: float) -> tuple[SfmState, bool]:
    """Return the reconstruction in metres, adjusted with the known mounting of the cameras, and whether it is metric.

    Without a frame of which two cameras are registered, the reconstruction does not change.

    Args:
        scene: The measurements.
        state: The reconstruction, of arbitrary scale.
        images: The images, with the mounting of their cameras.
        cauchy_px: Scale of the Cauchy loss of the adjustment [px].
    """
    poses = rig_poses(images, state.is_registered)
    scale = rig_scale(state, poses)
    if scale is None:
        return state, False
    Ts_world_cam = state.Ts_world_cam.copy()
    Ts_world_cam[:, :3, 3] *= scale
    config = BundleAdjustmentConfig(relative_tolerance=1e-3, cauchy_px=cauchy_px)
    state = replace(state, Ts_world_cam=Ts_world_cam, points=scale * state.points)
    return adjust(scene, state, state.used(scene), config, poses), True
