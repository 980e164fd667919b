"""The start: from a rest, or in motion, whichever can be had first.

It watches frames with their IMU until gravity and velocity can be told, and launches a smoother over what it has
watched. What is not certain then, above all the scale, stays open, as in DM-VIO (von Stumberg and Cremers, RA-L 2022):
the smoother goes on, and nothing is told until its own covariance says that it is worth telling. Where nothing can be
told, it says why.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.smoother import Keyframe, KeyframeSmoother
from dronevio.estimator.imu.buffer import joined
from dronevio.estimator.imu.preintegration import integrate
from dronevio.estimator.initialization.dynamic import DynamicInitializationConfig, initialize_dynamic, is_stereo
from dronevio.estimator.initialization.gauge import GYRO_BIAS_SIGMA_RAD_S, LastBelieved, Origin, Zero
from dronevio.estimator.initialization.static import InitialSigmas, NotObservable, initialize_static, mean_gyro
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.rig import RigCamera
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

SmootherMaker = Callable[[NavState, Array, Observations], KeyframeSmoother]
"""Makes a smoother that begins at a state, of a covariance (15, 15), from which some features are seen."""

MIN_FEATURES = 100
"""With fewer, new ones are looked for at every frame while waiting for a start."""
HALF_TICK_NS = 1_000_000
"""Time stamps jitter: a window of 1.5 s may span 1.5001 s [ns]."""


@dataclass(frozen=True)
class InitialiserConfig:
    """When to start, and how sure a start is."""

    rest_s: float = 0.8
    """How long the drone must stand still for a start from rest [s]."""
    static_sigmas: InitialSigmas = field(default_factory=InitialSigmas)
    """How sure a start from rest is."""
    motion: DynamicInitializationConfig = field(default_factory=DynamicInitializationConfig)
    """When a start in motion is tried and believed."""
    dynamic_sigmas: InitialSigmas = field(
        default_factory=lambda: InitialSigmas(
            tilt_rad=0.05, velocity_m_s=0.3, gyro_bias_rad_s=0.02, accel_bias_m_s2=0.1
        )
    )
    """How sure a start in motion is."""
    certain_scale: float = 0.05
    """A start is told as soon as its velocity has a standard deviation of less than this share of it ..."""
    certain_velocity_m_s: float = 0.03
    """... or than this [m/s]: near hover, a share of it means nothing."""
    unknown_gyro_bias_sigma: float = 0.05
    """How large the gyroscope's bias may be before anything is known of it [rad/s]; EuRoC's is 0.08."""


class Initializer:
    """Waits until the drone stands still for a while, or moves so that its velocity can be told."""

    def __init__(
        self,
        cameras: Sequence[RigCamera],
        config: InitialiserConfig,
        keyframes: KeyframePolicy,
        params: gtsam.PreintegrationCombinedParams,
        new_smoother: SmootherMaker,
    ) -> None:
        """Begin with nothing seen.

        Args:
            cameras: The rig's cameras.
            config: Settings.
            keyframes: When a frame becomes a keyframe.
            params: How the IMU is preintegrated.
            new_smoother: Makes the smoother.
        """
        self._config, self._keyframes, self._params, self._new_smoother = config, keyframes, params, new_smoother
        self.recalibrate(cameras)
        self._focal_px = cameras[0].model.fx
        self._window: list[FramePacket] = []
        self._last_try_ns = self._replenished_ns = 0
        self._not_yet = NotObservable("nothing has been tried")
        self.origin: Origin = Zero()
        """Where position and yaw begin."""
        self.gyro_bias_rad_s: Array = np.zeros(3)
        """(3,) What is known of the gyroscope's bias [rad/s] ..."""
        self.gyro_bias_sigma_rad_s = config.unknown_gyro_bias_sigma
        """... and how well [rad/s]."""

    def recalibrate(self, cameras: Sequence[RigCamera]) -> None:
        """Take over a better calibration of the cameras' mounting."""
        self._Ts_imu_cam = np.stack([camera.T_imu_cam for camera in cameras])

    def believe(self, state: NavState) -> None:
        """Take a state from which to go on, should the estimate be lost after it."""
        self.origin = LastBelieved(state)
        self.gyro_bias_rad_s, self.gyro_bias_sigma_rad_s = state.gyro_bias_rad_s, GYRO_BIAS_SIGMA_RAD_S

    def begin_anew(self) -> None:
        """Forget what was seen: the estimate has been lost."""
        self._window.clear()

    def wants_features(self, packet: FramePacket) -> bool:
        """Say whether new features are to be looked for in a frame: if there are few, or as on keyframes."""
        late = self._keyframes.is_interval_over((packet.t_ns - self._replenished_ns) * 1e-9, stationary=False)
        if late or len(packet.observations) < MIN_FEATURES:
            self._replenished_ns = packet.t_ns
            return True
        return False

    def add(self, packet: FramePacket, stationary_s: float) -> KeyframeSmoother | NotObservable:
        """Take a frame; answer a smoother that has started, or why there is none yet.

        Args:
            packet: The frame, and the IMU before it.
            stationary_s: For how long the drone has not moved [s].
        """
        c, t_ns = self._config, packet.t_ns
        self._window.append(packet)
        while t_ns - self._window[0].t_ns > max(c.rest_s, c.motion.window_s) * 1e9 + HALF_TICK_NS:
            self._window.pop(0)
        if stationary_s > 0.0:
            return self._from_rest(self._since(t_ns, stationary_s))
        needed_s = c.motion.stereo_window_s if is_stereo(self._window, c.motion) else c.motion.window_s
        window = self._since(t_ns, needed_s)
        span_s = (t_ns - window[0].t_ns + HALF_TICK_NS) * 1e-9
        if span_s < needed_s:
            return NotObservable(f"seen for {span_s:.1f} s; {needed_s:g} s are needed")
        if t_ns - self._last_try_ns >= c.motion.every_s * 1e9:
            self._last_try_ns = t_ns
            return self._in_motion(window)
        return self._not_yet

    def doubt(self, state: NavState) -> NotObservable | None:
        """Say why a state is not certain enough yet to be told; None where it is.

        A start in motion leaves the scale open, and with it the velocity. The smoother narrows it down.
        """
        c, P = self._config, state.covariance
        speed_m_s = float(np.linalg.norm(state.velocity_m_s))
        sigma_m_s = float(np.sqrt(np.linalg.eigvalsh(P[6:9, 6:9])[-1])) if P is not None else 0.0
        if sigma_m_s <= max(c.certain_velocity_m_s, c.certain_scale * speed_m_s):
            return None
        return NotObservable(f"a velocity of {speed_m_s:.2f} ± {sigma_m_s:.2f} m/s")

    def _from_rest(self, rest: Sequence[FramePacket]) -> KeyframeSmoother | NotObservable:
        increments = [packet.increments for packet in rest[1:]]
        self.gyro_bias_rad_s, self.gyro_bias_sigma_rad_s = mean_gyro(increments), 0.0
        stationary_s, rest_s = (rest[-1].t_ns - rest[0].t_ns + HALF_TICK_NS) * 1e-9, self._config.rest_s
        if stationary_s < rest_s:
            return NotObservable(f"at rest for {stationary_s:.1f} s; {rest_s:g} s are needed")
        start = initialize_static(rest[0].t_ns, increments)
        smoother, _ = self._launched(start, self._config.static_sigmas, rest, still=True)
        return smoother or NotObservable("the smoother finds no solution")

    def _in_motion(self, window: Sequence[FramePacket]) -> KeyframeSmoother | NotObservable:
        c = self._config
        start = initialize_dynamic(window, self._Ts_imu_cam, self._focal_px, c.motion)
        if isinstance(start, NotObservable):
            self._not_yet = start
            return start
        smoother, error_px = self._launched(start, c.dynamic_sigmas, window, still=False)
        if smoother is not None and error_px <= c.motion.max_residual_px:
            return smoother
        self._not_yet = NotObservable(f"what is seen and what is sensed disagree by {error_px:.1f} px")
        return self._not_yet

    def _since(self, t_ns: int, span_s: float) -> list[FramePacket]:
        """Return the sightings of the last ``span_s`` seconds."""
        return [s for s in self._window if t_ns - s.t_ns <= span_s * 1e9 + HALF_TICK_NS]

    def _launched(
        self, start: NavState, sigmas: InitialSigmas, sightings: Sequence[FramePacket], still: bool
    ) -> tuple[KeyframeSmoother | None, float]:
        """Start a smoother at the first of some sightings.

        Returns:
            The smoother, None where it found no solution; and the landmarks' typical reprojection error [px].
        """
        first, *later = sightings
        start = self.origin.place(start, joined([packet.increments for packet in later]))
        smoother = self._new_smoother(start, self.origin.covariance(start, sigmas), first.observations)
        keyframes: list[Keyframe] = []
        bias = smoother.gtsam_state[1]
        preintegrated = gtsam.PreintegratedCombinedMeasurements(self._params, bias)
        for packet in later:
            integrate(preintegrated, packet.increments, self._params)
            if packet is later[-1] or self._keyframes.is_interval_over(preintegrated.deltaTij(), still):
                keyframes.append(Keyframe(packet.t_ns, preintegrated, packet.observations, still))
                preintegrated = gtsam.PreintegratedCombinedMeasurements(self._params, bias)
        error_px = smoother.launch(keyframes)
        return (None, float("inf")) if error_px is None else (smoother, error_px)
