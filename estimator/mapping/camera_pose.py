"""Pose of a camera of the rig at the middle of its exposure, from the state at the time stamp of the frame."""

from dronevio.models.arrays import Array
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3
from dronevio.models.state import CameraFrame, NavState


def delay_s(rig: Rig, frame: CameraFrame, camera: int) -> float:
    """Return how much later than the time stamp of the frame a camera was exposed, in its middle row [s]."""
    delays_ns = frame.image_delays_ns
    return rig.cameras[camera].time_offset_s + (1e-9 * delays_ns[camera] if delays_ns else 0.0)


def pose_after(state: NavState, duration_s: float) -> Array:
    """Return the pose T_odom_imu (4, 4) a short time after a state, at constant velocity and rate."""
    T = state.T_world_imu.copy()
    if duration_s:
        T[:3, 3] += duration_s * state.velocity_m_s
        if state.angular_velocity_rad_s is not None:
            T[:3, :3] = T[:3, :3] @ exp_so3(duration_s * state.angular_velocity_rad_s)
    return T
