"""Estimators inside environments: the settings of the loop, and what it means.

With ``estimator=`` an environment is flown on an estimate. The vehicle starts standing, and `reset` simulates the time
until the estimator has a state; the planned pose of the start, and never the true one, places the odometry frame in the
world. From then on everything that the policy and the inner control loops see of the state is the newest estimate,
propagated to the newest IMU sample (`Estimator.state_at`): position, orientation, velocity, angular velocity, and
goals and gates relative to the vehicle; ``imu_bias`` is the estimated bias. Rotor speeds and battery remain
measurements, and images remain those of the true pose. Rewards, ends, success and the privileged observations of
critics use the true state.

The estimator receives the calibrated rig, IMU samples with errors at once, and frames with blur, exposure and noise
``latency_s`` after the middle of their exposure. The randomization of the mounting of the cameras, of light and of the
errors of the IMU makes the true sensors differ from the calibration. After a loss, the newest state is propagated by
the IMU until the estimator recovers.

An environment with an estimator has these entries in ``info``, beside those of `DroneEnv`:

| key | content |
|---|---|
| ``truth`` | true ``position_m`` (3,), ``quat_wxyz`` (4,), ``velocity_m_s`` (3,) and ``rate_rad_s`` (3,), as the \
observations of the same names |
| ``estimate`` | the same entries of the estimate |
| ``position_error_m`` | distance between estimated and true position [m] |
| ``orientation_error_rad`` | angle between estimated and true orientation [rad] |
| ``covariance`` | (15, 15) covariance of the state at the newest frame that has one, in the order of `NavState` and \
the frame of the estimator, whose z axis is vertical; zeros before |
| ``landmarks`` | number of landmarks that constrain the estimate at the newest frame |
| ``health``, ``health_reason`` | status of the estimator at the newest frame (`Health`), and its reason |
| ``propagated_s`` | time for which the IMU alone has propagated the estimate since the last frame with a state; it \
grows after a loss [s] |
| ``waited_s`` | time for which the reset has waited for the first state [s] |

Such environments are single ones. Their state cannot be saved or pickled after the first reset, since estimators have
no copyable state. `gymnasium.make_vec` makes vectors of processes or of single environments.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Protocol

from dronevio.models.protocols import Estimator
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.closed_loop.frame_source import FrameSource
from dronevio.sim.rendering.live_cameras import LiveCameras

LATENCY_MAX_S = 0.5
"""Largest latency of a frame [s]."""

EstimatorFactory = Callable[[Rig], Estimator]
"""Function that returns a new estimator for a calibrated rig, such as the class `VisualInertialOdometry`."""


class EpisodeCameras(FrameSource, Protocol):
    """Interface of the cameras of one vehicle in one episode."""

    def close(self) -> None:
        """Release the resources of rendering."""


@dataclass(frozen=True, eq=False)
class CameraSetup:
    """Cameras of one episode."""

    rig: Rig
    """The true sensors, with the mounting errors of the cameras."""
    world: str
    """Name of the world."""
    world_seed: int
    """Seed of the layout of the world."""
    texture_seed: int
    """Seed of the textures."""
    noise_seed: int
    """Seed of the image noise."""
    imaging: Imaging
    """Exposure and noise of the image sensors at the light of the episode."""


CameraFactory = Callable[[CameraSetup], EpisodeCameras]
"""Function that returns the cameras of an episode."""


def live_cameras(setup: CameraSetup) -> EpisodeCameras:
    """Return cameras that see the world as in recordings: with motion blur, exposure and noise."""
    return LiveCameras(
        setup.rig,
        setup.world,
        setup.world_seed,
        setup.imaging,
        texture_seed=setup.texture_seed,
        noise_seed=setup.noise_seed,
    )


@dataclass(frozen=True)
class Estimation(Settings):
    """Settings of an estimator inside an environment."""

    latency_s: Annotated[float, Range(0.0, LATENCY_MAX_S)] = 0.03
    """Time from the middle of the exposure of a frame until its estimate is available, but at least until the frame
    has been exposed and read out [s]. The latency of commands is part of the randomization."""
    longest_wait_s: Annotated[float, Range(0.0, 300.0)] = 5.0
    """Longest time for which a reset waits for the first state [s]. Without a state, the first step ends the
    episode."""
    dark_from_s: Annotated[float, Range(low=0.0)] = 0.0
    """Time from the start of the episode, after the wait, at which the images become dark [s]."""
    dark_for_s: Annotated[float, Range(low=0.0)] = 0.0
    """Duration of the darkness, during which the images contain noise only [s]."""
    imaging: Imaging = field(default_factory=Imaging)
    """Exposure and noise of the image sensors."""
    cameras: CameraFactory = live_cameras
    """Function that returns the cameras of an episode; images of the world by default."""

    def is_lit(self, since_start_s: float) -> bool:
        """Return whether light reaches the cameras at a time since the start of an episode [s]."""
        return not self.dark_from_s <= since_start_s < self.dark_from_s + self.dark_for_s
