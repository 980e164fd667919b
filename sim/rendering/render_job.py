"""Render jobs: the frames of a rig along a trajectory through a world."""

from dataclasses import dataclass, field

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.cameras.interpolation import camera_poses
from dronevio.sim.cameras.schedule import FrameSchedule
from dronevio.sim.cameras.shutter import Poses, margin_px, turn_in_pixels
from dronevio.sim.rendering.truth_images import TruthImage


@dataclass(frozen=True, eq=False)
class RenderJob:
    """Complete description of the frames of a recording: the same job gives the same bytes."""

    world: str
    """Name of the world; see `dronevio.sim.world.resolved_world`."""
    seed: int
    """Seed of the noise of the image sensors, and of the world."""
    rig: Rig
    """The true rig with its cameras."""
    trajectory: Trajectory
    """True trajectory of the IMU over the time span of all frames."""
    schedule: FrameSchedule
    """Recorded and true times of the frames."""
    imaging: Imaging = field(default_factory=Imaging)
    """Exposure control and noise of the image sensors."""
    truth_images: tuple[TruthImage, ...] = ()
    """Kinds of ground-truth images of the first camera to write."""
    T_simworld_world: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) Pose of the trajectory's world frame in the simulated world."""
    world_seed: int | None = None
    """Seed of the world instead of ``seed``; None for ``seed``."""
    light_seed: int | None = None
    """Seed of other light in the world; None for the light of the world itself."""

    def __post_init__(self) -> None:
        """Check that the settings are consistent.

        Raises:
            ConfigError: There is no camera or no frame, the trajectory has fewer than two poses, or an exposure exceeds
                the frame interval.
        """
        require_cameras(self.rig, self.imaging)
        if not len(self.schedule):
            raise ConfigError("no frame within the motion; expected at least one")
        if len(self.trajectory) < 2:
            raise ConfigError(f"a motion of {len(self.trajectory)} poses; expected at least two")

    def poses(self, camera: int) -> Poses:
        """Return the poses T_simworld_cam of a camera of the rig as a function of time.

        A camera with a time offset of its own is later in its motion by it; movers in the world are not.
        """
        poses = camera_poses(self.trajectory, self.rig.cameras[camera])

        def poses_at(t_ns: Times) -> Array:
            return np.asarray(self.T_simworld_world @ poses(t_ns))

        return poses_at

    def margin_px(self, camera: int) -> int:
        """Return the margin of a camera's key images around its image, for the fastest turn of the flight [px]."""
        half_ns = round(0.5e9 * (self.imaging.control.longest_s + self.rig.cameras[camera].readout_s))
        poses, model = self.poses(camera), self.rig.cameras[camera].model
        first, last = (poses(self.schedule.exposed_ns + sign * half_ns) for sign in (-1, 1))
        return margin_px(turn_in_pixels(model, first, last))


def require_cameras(rig: Rig, imaging: Imaging) -> None:
    """Check that a rig has cameras, and that their exposures fit between their frames.

    Raises:
        ConfigError: There is no camera, or an exposure exceeds the frame interval.
    """
    if not rig.cameras:
        raise ConfigError("rig without a camera; expected at least one")
    for number, camera in enumerate(rig.cameras):
        if imaging.control.longest_s > 1.0 / camera.rate_hz:
            raise ConfigError(
                f"camera {number} exposed for {imaging.control.longest_s:g} s;"
                f" expected at most {1.0 / camera.rate_hz:g} s, the time between its frames"
            )
