"""Sensing without images, for many flights: depth by rays with the errors of stereo, and the true motion with drift.

Nothing is rendered, so that a flight costs a tenth of one with images. The cameras and the odometry of a flight belong
together: the cameras see the truth, as all cameras do, and pass it on to the odometry, which adds its drift.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.imu import ImuSamples
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState, Trajectory
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.streams import generator

_WIDTH, _HEIGHT, _FOCAL = 96, 52, 46.8  # 91.5° × 58°, those of the rectified pair of EuRoC
_FARTHEST_M = 12.0  # of surfaces; what is farther counts as a surface there, as leaves and haze do


@dataclass(frozen=True)
class RaySensing(Settings):
    """Errors of depth and odometry."""

    depth_sigma_per_m: Annotated[float, Range(0.0, 1.0)] = 0.008
    """Standard deviation of a depth divided by its square [1/m]: 0.2 px of disparity at a baseline of 11 cm."""
    drift_m_per_sqrt_m: Annotated[float, Range(0.0, 1.0)] = 0.004
    """Random walk of each axis of the position by the square root of the path [m/√m]."""
    yaw_drift_rad_per_sqrt_m: Annotated[float, Range(0.0, 1.0)] = 0.001
    """Random walk of the heading by the square root of the path [rad/√m]."""


class RayCameras:
    """Depth of a world along rays; implements `FrameSource` and `DepthSource`."""

    def __init__(self, world: str, world_seed: int, rig: Rig, seed: int, errors: RaySensing | None = None) -> None:
        """Load a world.

        Args:
            world: Name of the world.
            world_seed: Seed of its layout.
            rig: The rig, whose first camera sees.
            seed: Seed of the errors.
            errors: Sizes of the errors.
        """
        self._caster, self.rig = RayCaster(world, world_seed), rig
        self._errors, self._rng = errors or RaySensing(), generator(seed, "frames", 1)
        K = np.array([[_FOCAL, 0.0, 0.5 * (_WIDTH - 1)], [0.0, _FOCAL, 0.5 * (_HEIGHT - 1)], [0.0, 0.0, 1.0]])
        self._camera = Pinhole(_WIDTH, _HEIGHT, K)
        rays = self._camera.rays().reshape(-1, 3).astype(np.float64)
        self._scale = 1.0 / np.linalg.norm(rays, axis=1)
        self._bearings = rays * self._scale[:, None]
        self._lit = True
        self.T_world_imu = np.eye(4)
        self.velocity_m_s = np.zeros(3)

    def ready_ns(self, exposed_ns: int) -> int:
        """Return the time from which a frame can be taken [ns], given the middle of its exposure."""
        return exposed_ns

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        """Return a frame without images."""
        self.T_world_imu = interpolated_poses(truth, np.array([exposed_ns]))[0]
        assert truth.velocity_m_s is not None
        self.velocity_m_s = truth.velocity_m_s[max(int(np.searchsorted(truth.t_ns, exposed_ns, side="right")) - 1, 0)]
        self._lit = lit
        return CameraFrame(t_ns, ())

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth of the newest frame with errors; None in darkness."""
        if not self._lit or estimate.state is None:
            return None
        T_world_cam = self.T_world_imu @ self.rig.cameras[0].T_imu_cam
        ranges = self._caster.ranges_m(T_world_cam[None], self._bearings, _FARTHEST_M)[0]
        depth = np.where(np.isfinite(ranges), ranges, _FARTHEST_M) * self._scale
        true = depth.reshape(_HEIGHT, _WIDTH).astype(np.float32)
        sigma = np.float32(self._errors.depth_sigma_per_m) * true * true
        noisy = true + sigma * self._rng.standard_normal(true.shape, dtype=np.float32)
        T_odom_cam = estimate.state.T_world_imu @ self.rig.cameras[0].T_imu_cam
        grey = np.zeros(true.shape, np.uint8)
        return DepthImage(frame.t_ns, self._camera, T_odom_cam, np.maximum(noisy, 0.0), sigma, grey)


class DriftingOdometry:
    """The true motion at frames with drift, and the IMU between them; implements `Estimator`."""

    def __init__(self, cameras: RayCameras, seed: int, errors: RaySensing | None = None) -> None:
        """Begin without drift.

        Args:
            cameras: What sees the truth.
            seed: Seed of the drift.
            errors: Sizes of the errors.
        """
        self._cameras, self._errors, self._rng = cameras, errors or RaySensing(), generator(seed, "frames", 2)
        self._imu = ImuRatePropagator(cameras.rig.imu)
        self._drift = np.eye(4)
        self._last: Array | None = None

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call."""
        self._imu.push(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate for the newest frame of the cameras."""
        T, velocity, c = self._cameras.T_world_imu, self._cameras.velocity_m_s, self._errors
        step_m = 0.0 if self._last is None else float(np.linalg.norm(T[:3, 3] - self._last))
        self._last = T[:3, 3].copy()
        noise = np.sqrt(step_m) * self._rng.standard_normal(4)
        # The heading drifts about the vehicle.
        turn = rotation_z(c.yaw_drift_rad_per_sqrt_m * noise[3])
        here = self._drift[:3, :3] @ T[:3, 3] + self._drift[:3, 3]
        shift = here - turn @ here + c.drift_m_per_sqrt_m * noise[:3]
        self._drift = pose_matrix(turn, shift) @ self._drift
        state = NavState(frame.t_ns, self._drift @ T, self._drift[:3, :3] @ velocity, np.zeros(3), np.zeros(3))
        estimate = Estimate(frame.t_ns, Health.TRACKING, state, exposed=state)
        self._imu.correct(estimate)
        return estimate

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU to its last sample not after a time [ns]."""
        return self._imu.state_at(t_ns)
