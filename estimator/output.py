"""The output of the odometry: estimates with their events, withheld until they are certain enough."""

from dronevio.estimator.initialization.initializer import InitializerConfig, not_ready_reason
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.health import Assessment, health_report, report_of
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import IMU_GAP_INTERVALS
from dronevio.models.state import Estimate, FeatureTracks, Health, HealthQuantities, HealthReport, NavState

REPEATED_IMAGES = "the image does not change although the vehicle moves: not used"
"""Event at the first of several equal images."""
INCONSISTENT = "inconsistent: images and prediction contradict each other by more than their covariance"
"""Event where `Cause.INCONSISTENT` has lasted longer than a disturbance, such as the jolt of a landing."""
MAX_CONTRADICTION_NS = 3_000_000_000
"""Longest time for which a first state is not published for that reason [ns]: that of a search for the time offset
of camera and IMU."""
SAME_REPETITION_NS = 1_000_000_000
"""Longest time between repeated images that one event states [ns], as where each image comes twice."""
OUTLYING_SAMPLES = "outlying samples of the IMU: left out"
"""Event at the first frame after such samples, preceded by their number."""
MIN_CAUSE_NS = 1_000_000_000
"""Time after which a cause that prevents the initialization becomes an event [ns]. A passing object takes less."""


class Publisher:
    """Makes an `Estimate` of the state at each frame.

    After an initialization no state is published before its covariance is small enough, and a first one not as long as
    images and IMU contradict each other, for some time; from then on every state is published, until a loss.
    """

    def __init__(self, config: InitializerConfig, health: HealthConfig, imu_rate_hz: float) -> None:
        """Begin before the first frame.

        Args:
            config: Determines when the first state is certain enough.
            health: Limits of the health.
            imu_rate_hz: Sampling rate of the IMU [Hz].
        """
        self._config, self._health = config, health
        self._waiting = Health.INITIALIZING  # the health of an estimate without a state
        self._is_publishing = False
        self._ready_ns: int | None = None  # time of the first state that is certain enough
        self._cause: tuple[Cause | None, int] = (None, 0)  # what prevents the initialization, and its first time [ns]
        self._stated_causes: frozenset[Cause] = frozenset()
        self._is_noise_stated = False
        self._inconsistent_ns: int | None = None  # since when the published states are; None where the last was not
        self._is_inconsistency_stated = False
        self._sensors = SensorEvents(imu_rate_hz)

    @property
    def has_stated_cause(self) -> bool:
        """Whether an event has stated a cause that prevented an initialization."""
        return bool(self._stated_causes)

    def withdraw_causes(self) -> None:
        """Withdraw the causes that have been stated, because another one has been found and removed."""
        self._cause, self._stated_causes = (None, 0), frozenset()

    def estimate(
        self,
        packet: FramePacket,
        state: NavState,
        assessment: Assessment,
        events: tuple[str, ...] = (),
        landmarks_odom: Array | None = None,
    ) -> Estimate:
        """Return the estimate of a frame with a state, which is withheld if it is not certain enough.

        Args:
            packet: The frame.
            state: The state at the frame.
            assessment: What is known about it.
            events: Events at the frame, as texts for people.
            landmarks_odom: (L, 3) Landmarks that constrain the estimate [m]; only on keyframes.
        """
        report = health_report(assessment, self._health)
        if not self._is_publishing:
            uncertain = not_ready_reason(state, self._config)
            if uncertain is not None:
                return self.without_state(packet, _not_observable(uncertain), report)
            if self._is_contradicted(packet.t_ns, report):
                return self.without_state(packet, Reason.of(Cause.CONTRADICTION), report)
            self._is_publishing, self._cause = True, (None, 0)
            events = ("initialized" if self._waiting is Health.INITIALIZING else "recovered", *events)
        noise, inconsistency = self._noise_events(assessment), self._inconsistency_events(packet.t_ns, report)
        events = (*events, *self._sensors.of(packet), *noise, *inconsistency)
        tracks = _feature_tracks(packet.observations)
        return Estimate(packet.t_ns, report.health, state, tracks, landmarks_odom, events, report)

    def without_state(
        self,
        packet: FramePacket,
        reason: Reason,
        quantities: HealthQuantities | None = None,
        events: tuple[str, ...] = (),
    ) -> Estimate:
        """Return the estimate of a frame without a state, with the reason."""
        report = report_of(self._waiting, reason, quantities or HealthQuantities(tracks=len(packet.observations)))
        tracks, events = _feature_tracks(packet.observations), (*events, *self._sensors.of(packet))
        return Estimate(packet.t_ns, self._waiting, None, tracks, events=events, health_report=report)

    def not_initialized(self, packet: FramePacket, obstacle: NotObservable) -> Estimate:
        """Return the estimate of a frame without a state, with what prevents the initialization."""
        events = self._cause_events(packet.t_ns, obstacle.cause)
        return self.without_state(packet, _not_observable(obstacle), events=events)

    def lost(self, packet: FramePacket, reason: Reason, quantities: HealthQuantities) -> Estimate:
        """Return the estimate of a frame at which the state is lost; the next one has to be certain again."""
        self._waiting, self._is_publishing, self._inconsistent_ns = Health.LOST, False, None
        return self.without_state(packet, reason, quantities, (f"lost: {reason.text}",))

    def _is_contradicted(self, t_ns: int, report: HealthReport) -> bool:
        """Return whether images and IMU contradict each other, for some time after the first initialization."""
        self._ready_ns = t_ns if self._ready_ns is None else self._ready_ns
        is_early = self._waiting is Health.INITIALIZING and t_ns - self._ready_ns < MAX_CONTRADICTION_NS
        return is_early and report.health is not Health.TRACKING and report.cause is not Cause.EXCESSIVE_NOISE

    def _noise_events(self, assessment: Assessment) -> tuple[str, ...]:
        """Return the cause of excessive noise, once."""
        if self._is_noise_stated or not (assessment.is_noise_excessive or assessment.is_noise_aliased):
            return ()
        self._is_noise_stated = True
        return (f"probable cause: {Cause.EXCESSIVE_NOISE}",)

    def _inconsistency_events(self, t_ns: int, report: HealthReport) -> tuple[str, ...]:
        """Return an event where an estimate has been inconsistent for longer than a disturbance and the time after it.

        Few landmarks do not make it inconsistent.
        """
        if report.cause is not Cause.INCONSISTENT:
            self._inconsistent_ns, self._is_inconsistency_stated = None, False
            return ()
        if self._inconsistent_ns is None:
            self._inconsistent_ns = t_ns
        is_long = (t_ns - self._inconsistent_ns) * 1e-9 > 2.0 * self._health.disturbance_s
        if self._is_inconsistency_stated or not is_long:
            return ()
        self._is_inconsistency_stated = True
        return (INCONSISTENT,)

    def _cause_events(self, t_ns: int, cause: Cause | None) -> tuple[str, ...]:
        """Return an event where the same cause has prevented the initialization for some time; one for each cause."""
        known, since_ns = self._cause
        if cause is not None and cause is not known:
            self._cause = (cause, t_ns)
            return ()
        if cause is None or cause in self._stated_causes or t_ns - since_ns < MIN_CAUSE_NS:
            return ()
        if cause is Cause.ACCEL_DISAGREES and Cause.ROTATION_DISAGREES in self._stated_causes:
            return ()  # it presumes that the gyroscope agrees with the images
        self._stated_causes |= {cause}
        return (f"probable cause: {cause}",)


class SensorEvents:
    """States what is wrong with the sensors: gaps, outliers, repeated images, and cameras against their calibration."""

    def __init__(self, imu_rate_hz: float) -> None:
        """Begin before the first frame, with the sampling rate of the IMU [Hz]."""
        self._imu_rate_hz = imu_rate_hz
        self._miscalibrated: frozenset[int] = frozenset()  # cameras whose extrinsics are contradicted
        self._repeated_ns: int | None = None  # time of the last frame of which an image was left out
        self._gap: tuple[int, float] = (0, 0.0)  # frames without a break since a gap of the IMU began, its length [s]

    def of(self, packet: FramePacket) -> tuple[str, ...]:
        """Return the events of the next frame, as texts for people."""
        outliers = (f"{packet.imu_outliers} {OUTLYING_SAMPLES}",) if packet.imu_outliers else ()
        calibration = self._calibration_events(packet.observations)
        return (*self._gap_events(packet), *calibration, *self._repetition_events(packet), *outliers)

    def _repetition_events(self, packet: FramePacket) -> tuple[str, ...]:
        """Return an event at the first of several repeated images."""
        if not packet.repeats_image:
            return ()
        before_ns, self._repeated_ns = self._repeated_ns, packet.t_ns
        is_same = before_ns is not None and packet.t_ns - before_ns <= SAME_REPETITION_NS
        return () if is_same else (REPEATED_IMAGES,)

    def _gap_events(self, packet: FramePacket) -> tuple[str, ...]:
        """Return an event when a gap of the IMU begins, and one when a gap of several frames ends."""
        longest_s = packet.increments.longest_s
        if longest_s * self._imu_rate_hz > IMU_GAP_INTERVALS:
            self._gap = self._gap[0] + 1, self._gap[1] + longest_s
            return (f"no IMU for {longest_s:.2f} s",) if self._gap[0] == 1 else ()
        (frames, gap_s), self._gap = self._gap, (0, 0.0)
        return (f"IMU again after a gap of {gap_s:.2f} s",) if frames > 1 else ()

    def _calibration_events(self, observations: Observations) -> tuple[str, ...]:
        """Return events for cameras whose matches begin, or cease, to contradict their extrinsic calibration."""
        contradicted = set(observations.miscalibrated.camera.tolist())
        agreeing = set(observations.matches.camera.tolist()) - contradicted
        new, settled = sorted(contradicted - self._miscalibrated), sorted(self._miscalibrated & agreeing)
        self._miscalibrated = (self._miscalibrated | contradicted) - set(settled)
        return (
            *(f"camera {i} contradicts its calibration: not used for depth" for i in new),
            *(f"camera {i} agrees with its calibration: used for depth" for i in settled),
        )


def _not_observable(obstacle: NotObservable) -> Reason:
    """Return what prevents an initialization as the reason of an estimate without a state."""
    return Reason(obstacle.cause or Cause.NOT_OBSERVABLE, str(obstacle))


def _feature_tracks(observations: Observations) -> FeatureTracks:
    """Return the features that the first camera tracks."""
    first = observations.camera == 0
    return FeatureTracks(observations.ids[first], observations.pixels[first], observations.ages[first])
