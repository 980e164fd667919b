"""What is to be rendered: a rig's frames along a motion through a world."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.cameras.schedule import FrameSchedule
from dronevio.sim.cameras.shutter import LARGEST_MARGIN_PX, Poses, turn_in_pixels
from dronevio.sim.rendering.truth_images import TruthImage

Array = npt.NDArray[np.float64]

_MARGIN_AROUND_PX = 2  # for the interpolation


@dataclass(frozen=True, eq=False)
class RenderJob:
    """One recording's frames, complete: the same job gives the same bytes."""

    world: str
    """A name that `dronevio.sim.world.build_world` knows."""
    seed: int
    """Draws the world's looks and the sensors' noise."""
    rig: Rig
    """The cameras, as they really are."""
    trajectory: Trajectory
    """True motion of the IMU, over all of the frames."""
    schedule: FrameSchedule
    """When the frames are taken."""
    imaging: Imaging = field(default_factory=Imaging)
    """What the sensors make of light."""
    truth_images: tuple[TruthImage, ...] = ()
    """What is written beside the frames of the main camera."""
    T_simworld_world: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) Where the trajectory's world lies in the simulated one."""

    def __post_init__(self) -> None:
        """Check that it fits together.

        Raises:
            ConfigError: There is nothing to see, or with nothing, or frames cannot be taken as fast as they should.
        """
        if not self.rig.cameras:
            raise ConfigError("rig without a camera; expected one at least")
        if not len(self.schedule):
            raise ConfigError("no frame within the motion; expected one at least")
        if len(self.trajectory) < 2:
            raise ConfigError(f"a motion of {len(self.trajectory)} poses; expected two at least")
        for number, camera in enumerate(self.rig.cameras):
            if self.imaging.control.longest_s > 1.0 / camera.rate_hz:
                raise ConfigError(
                    f"camera {number} exposed for {self.imaging.control.longest_s:g} s;"
                    f" expected at most {1.0 / camera.rate_hz:g} s, the time between its frames"
                )

    def poses(self, camera: int) -> Poses:
        """Return where a camera of the rig is in the simulated world, as a function of time."""
        T_imu_cam = self.rig.cameras[camera].T_imu_cam

        def poses_at(t_ns: Times) -> Array:
            return np.asarray(self.T_simworld_world @ interpolated_poses(self.trajectory, t_ns) @ T_imu_cam)

        return poses_at

    def margin_px(self, camera: int) -> int:
        """Return how far a camera's key images must reach beyond its image [px]."""
        half_ns = round(0.5e9 * (self.imaging.control.longest_s + self.rig.cameras[camera].readout_s))
        poses, model = self.poses(camera), self.rig.cameras[camera].model
        first, last = (poses(self.schedule.exposed_ns + sign * half_ns) for sign in (-1, 1))
        return int(np.ceil(min(turn_in_pixels(model, first, last), LARGEST_MARGIN_PX))) + _MARGIN_AROUND_PX
