"""Cameras of a flight that goes on: frames one at a time, for estimators in the loop.

The frames have the image formation of recordings (`dronevio.sim.rendering.render`): motion blur, rolling shutter,
exposure control, vignetting and noise. For the same motion, seed and margin of the key images, they are equal to those
of a recording to the byte.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import CameraFrame, Trajectory
from dronevio.sim.cameras.exposure import Exposures
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.cameras.interpolation import camera_poses
from dronevio.sim.cameras.shutter import half_span_ns, margin_px, turn_in_pixels
from dronevio.sim.rendering.frame_renderer import FrameExposure, FrameRenderer, image_noise
from dronevio.sim.rendering.loaded_world import LoadedWorld, WorldKey, lease_world
from dronevio.sim.rendering.render_job import require_cameras
from dronevio.sim.rendering.scene import Scene
from dronevio.sim.rendering.shared import Lease

DESIGN_RATE_RAD_S = 3.0
"""Design angular velocity of the rig [rad/s]: the peak of difficult flights; races reach twice as much."""


@dataclass(frozen=True, eq=False)
class _Loaded:
    """The world and the renderers of all cameras in it."""

    lease: Lease[LoadedWorld]
    renderers: tuple[FrameRenderer, ...]


class LiveCameras:
    """All cameras of a rig in a world, which share one trigger, during a flight. Close them after use.

    The world is loaded at the first frame, in seconds, and shared with the other users of the process. Use the cameras
    in one thread only, since an OpenGL context belongs to a thread.
    """

    def __init__(
        self,
        rig: Rig,
        world: str,
        seed: int,
        imaging: Imaging,
        *,
        texture_seed: int | None = None,
        noise_seed: int | None = None,
        light_seed: int | None = None,
        start_ns: int = 0,
        design_rate_rad_s: float = DESIGN_RATE_RAD_S,
    ) -> None:
        """Define cameras and world.

        Args:
            rig: The true rig.
            world: Name of the world; see `dronevio.sim.world.resolved_world`.
            seed: Seed of the world.
            imaging: Exposure control and noise of the image sensors.
            texture_seed: Seed of the textures, by default that of the world.
            noise_seed: Seed of the noise of the image sensors, by default that of the world.
            light_seed: Seed of other light in the world, by default the light that belongs to its layout.
            start_ns: True time of the start of the flight, from which moving objects move [ns].
            design_rate_rad_s: Angular velocity of the rig that determines the margin of the key images around the
                image [rad/s]. Frames during faster rotation are rendered from more key images and take longer.

        Raises:
            ConfigError: The rig has no camera, or an exposure can exceed the time between frames.
        """
        require_cameras(rig, imaging)
        self._rig, self._imaging = rig, imaging
        self._key = WorldKey(world, seed, seed if texture_seed is None else texture_seed, light_seed=light_seed)
        self._noise_seed, self._start_ns = seed if noise_seed is None else noise_seed, start_ns
        longest_s = imaging.control.longest_s
        self._margins_px = [_margin_px(camera, longest_s, design_rate_rad_s) for camera in rig.cameras]
        self._half_span_ns = max(half_span_ns(camera, longest_s) for camera in rig.cameras)
        self._loaded: _Loaded | None = None
        self._exposures = imaging.exposure_sequence()
        self._stamps_ns: list[int] = []
        self._frames: list[FrameExposure] = []

    @property
    def frames(self) -> FrameTruth:
        """True time and exposure of all frames since the start of the flight."""
        exposures = Exposures.of([frame.exposure for frame in self._frames])
        return FrameTruth(
            np.array(self._stamps_ns, dtype=np.int64),
            np.array([frame.middle_ns for frame in self._frames], dtype=np.int64),
            exposures.time_s,
            exposures.gain,
            np.array([frame.lit for frame in self._frames], dtype=np.bool_),
        )

    def ready_ns(self, exposed_ns: int) -> int:
        """Return the true time to which the motion must be known for a frame [ns].

        It is the end of exposure and readout of all cameras, for the longest exposure.

        Args:
            exposed_ns: True middle of the exposure of the middle row [ns].
        """
        return exposed_ns + self._half_span_ns

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        """Return the next frame of the flight.

        Args:
            t_ns: Time stamp of the frame [ns].
            exposed_ns: True middle of the exposure of the middle row, on the clock of the IMU [ns].
            lit: Whether light reaches the cameras.
            truth: True trajectory of the IMU; a part of it that covers the exposure is enough, as far before
                ``exposed_ns`` as `ready_ns` is after it. Outside it, the motion of the nearest interval is
                extrapolated, as it is in recordings before the first pose and after the last.

        Raises:
            ConfigError: The trajectory has fewer than two poses or does not contain ``exposed_ns``, the time stamp is
                not after that of the previous frame, or the world is unknown.
            GraphicsError: Off-screen OpenGL is not available.
        """
        if len(truth) < 2 or not truth.t_ns[0] <= exposed_ns <= truth.t_ns[-1]:
            raise ConfigError(f"frame exposed at {exposed_ns} ns; expected a true motion around it")
        if self._stamps_ns and t_ns <= self._stamps_ns[-1]:
            raise ConfigError(f"time stamp of {t_ns} ns after {self._stamps_ns[-1]} ns; expected increasing ones")
        loaded = self._opened()
        world = loaded.lease.value
        motion = _around(truth, exposed_ns, self._half_span_ns)
        scene = Scene.sampled(world.illumination, world.movers, motion.t_ns, self._start_ns)
        poses = [camera_poses(motion, camera) for camera in self._rig.cameras]
        histogram = np.zeros(256)
        if self._imaging.control.needs_histograms:
            T_world_cam = poses[0](np.array([exposed_ns]))[0]
            histogram = loaded.renderers[0].thumbnail.histogram(T_world_cam, scene.movers_at(exposed_ns))
        exposure = self._exposures.expose(histogram, scene.illumination * float(lit))
        frame = FrameExposure(exposed_ns, exposure, lit)
        index = len(self._frames)
        images = tuple(
            renderer.render(frame, poses[number], scene, image_noise(self._noise_seed, index, number))
            for number, renderer in enumerate(loaded.renderers)
        )
        self._stamps_ns.append(t_ns)
        self._frames.append(frame)
        return CameraFrame(t_ns, images)

    def restart(self, noise_seed: int, start_ns: int = 0) -> None:
        """Start another flight with the same cameras and world.

        Args:
            noise_seed: Seed of the noise of the image sensors.
            start_ns: True time of the start of the flight [ns].
        """
        self._noise_seed, self._start_ns = noise_seed, start_ns
        self._exposures = self._imaging.exposure_sequence()
        self._stamps_ns.clear()
        self._frames.clear()

    def close(self) -> None:
        """Release the world and the renderers; the process keeps recently used worlds for other users.

        Further calls have no effect, and another frame loads the world again.
        """
        if self._loaded is not None:
            loaded, self._loaded = self._loaded, None
            loaded.lease.release()

    def _opened(self) -> _Loaded:
        """Return the world and the renderers, which are created if there are none."""
        if self._loaded is None:
            lease = lease_world(self._key, grey=True)
            model, context = lease.value.model, lease.value.context
            renderers = tuple(
                FrameRenderer(camera, self._imaging, model, context, margin)
                for camera, margin in zip(self._rig.cameras, self._margins_px, strict=True)
            )
            self._loaded = _Loaded(lease, renderers)
        return self._loaded


def _margin_px(camera: RigCamera, exposure_s: float, rate_rad_s: float) -> int:
    """Return the margin of the key images for rotation at an angular velocity about any axis of the camera [px]."""
    angle_rad = rate_rad_s * (exposure_s + camera.readout_s)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    turned = pose_matrix(exp_so3(angle_rad * axes), np.zeros((6, 3)))
    return margin_px(turn_in_pixels(camera.model, np.eye(4), turned))


def _around(trajectory: Trajectory, t_ns: int, half_span_ns: int) -> Trajectory:
    """Return the part of a trajectory that determines the motion within a time span around a time [ns]."""
    first = int(np.searchsorted(trajectory.t_ns, t_ns - half_span_ns, side="right")) - 1
    last = int(np.searchsorted(trajectory.t_ns, t_ns + half_span_ns, side="right"))
    first = min(max(first, 0), len(trajectory) - 2)
    return trajectory[first : max(last + 1, first + 2)]
