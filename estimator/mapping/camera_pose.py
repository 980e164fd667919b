"""Pose of a camera of the rig in the middle of its exposure, from the estimate of its frame."""

from dataclasses import replace

from dronevio.models.arrays import Array
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose
from dronevio.models.state import CameraFrame, Estimate, NavState


def at_exposure(estimate: Estimate, rig: Rig) -> NavState | None:
    """Return the state in the middle of the exposure of a frame by the clock of the IMU; None without one.

    Estimators that do not tell it have the state at the time stamp, which is moved by the time offset of the rig.
    """
    state = estimate.state
    if state is None or estimate.exposed is not None:
        return estimate.exposed
    return replace(state, T_world_imu=pose_after(state, rig.time_offset_s))


def delay_s(rig: Rig, frame: CameraFrame, camera: int) -> float:
    """Return how much later than its frame a camera was exposed, in its middle row [s]."""
    delays_ns = frame.image_delays_ns
    return rig.cameras[camera].time_offset_s + (1e-9 * delays_ns[camera] if delays_ns else 0.0)


def displaced(rig: Rig, frame: CameraFrame, camera: int, state: NavState) -> RigCamera:
    """Return a camera of the rig that is exposed with the frame, from where the rig has it when it is exposed.

    Args:
        rig: The rig.
        frame: The frame.
        camera: Index of the camera.
        state: The state in the middle of the exposure of the frame.
    """
    later = pose_after(state, delay_s(rig, frame, camera))
    T_imu_cam = inverse_pose(state.T_world_imu) @ later @ rig.cameras[camera].T_imu_cam
    return replace(rig.cameras[camera], T_imu_cam=T_imu_cam, time_offset_s=0.0)


def pose_after(state: NavState, duration_s: float) -> Array:
    """Return the pose T_odom_imu (4, 4) a short time after a state, at constant velocity and rate."""
    T = state.T_world_imu.copy()
    if duration_s:
        T[:3, 3] += duration_s * state.velocity_m_s
        if state.angular_velocity_rad_s is not None:
            T[:3, :3] = T[:3, :3] @ exp_so3(duration_s * state.angular_velocity_rad_s)
    return T
