"""Answers: what is told of a frame, and what is kept back until it is certain."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import IMU_GAP
from dronevio.estimator.initialization.initializer import Initializer
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.state import Estimate, FeatureTracks, Health, HealthReport, NavState

Array = npt.NDArray[np.float64]


class Answers:
    """Makes an `Estimate` of what is known at a frame.

    After a start, nothing is told until the initializer's doubt is gone; from then on, all is, until a loss.
    """

    def __init__(self, initializer: Initializer, imu_rate_hz: float, max_innovation_px: float) -> None:
        """Begin before the first frame.

        Args:
            initializer: Doubts a start, and remembers what was believed last.
            imu_rate_hz: Samples of the IMU a second [Hz].
            max_innovation_px: A state with a larger innovation is told, but not believed [px].
        """
        self._initializer, self._max_innovation_px = initializer, max_innovation_px
        self._imu_rate_hz = imu_rate_hz
        self._waiting = Health.INITIALIZING  # what it is called to be without a state
        self._is_told = False  # whether the state is certain enough to be told
        self._doubted: set[int] = set()  # cameras that contradict their calibration
        self._silence_s: list[float] = []  # for how long in each of the last frames the IMU has been silent

    def known(
        self,
        packet: FramePacket,
        state: NavState,
        report: HealthReport,
        events: tuple[str, ...] = (),
        landmarks_world: Array | None = None,
    ) -> Estimate:
        """Return what is known at a frame, if it is certain enough to be told."""
        if not self._is_told:
            doubt = self._initializer.doubt(state)
            if doubt is not None:
                return self.unknown(packet, str(doubt), report)
            self._is_told = True
            events = ("initialized" if self._waiting is Health.INITIALIZING else "recovered", *events)
        if (report.innovation_px or 0.0) <= self._max_innovation_px:
            self._initializer.believe(state)
        events = (*events, *self._gaps(packet), *self._doubts(packet))
        tracks = _feature_tracks(packet.observations)
        return Estimate(packet.t_ns, report.health, state, tracks, landmarks_world, events, report)

    def unknown(
        self, packet: FramePacket, why: str, report: HealthReport | None = None, events: tuple[str, ...] = ()
    ) -> Estimate:
        """Return an estimate without a state, and why there is none."""
        known = report or HealthReport(self._waiting, why, tracks=len(packet.observations))
        report = replace(known, health=self._waiting, reason=why)
        events = (*events, *self._gaps(packet), *self._doubts(packet))
        tracks = _feature_tracks(packet.observations)
        return Estimate(packet.t_ns, self._waiting, None, tracks, events=events, health_report=report)

    def lost(self, packet: FramePacket, report: HealthReport) -> Estimate:
        """Return an estimate that has been given up; what starts next is miscalibrated anew."""
        self._waiting, self._is_told = Health.LOST, False
        return self.unknown(packet, report.reason, report, (f"lost: {report.reason}",))

    def _gaps(self, packet: FramePacket) -> tuple[str, ...]:
        """Say when the IMU falls silent; and where that lasts for frames, when it is back."""
        longest_s, silence_s = packet.increments.longest_s, self._silence_s
        if longest_s * self._imu_rate_hz > IMU_GAP:
            silence_s.append(longest_s)
            return (f"no IMU for {longest_s:.2f} s",) if len(silence_s) == 1 else ()
        self._silence_s = []
        return (f"no IMU for {sum(silence_s):.2f} s: it is back",) if len(silence_s) > 1 else ()

    def _doubts(self, packet: FramePacket) -> tuple[str, ...]:
        """Say which cameras turn out not to be where the calibration says, and which are used again."""
        seen = packet.observations
        miscalibrated, agreeing = set(seen.miscalibrated.camera.tolist()), set(seen.matches.camera.tolist())
        new, settled = sorted(miscalibrated - self._doubted), sorted(self._doubted & (agreeing - miscalibrated))
        self._doubted = (self._doubted | miscalibrated) - set(settled)
        return (
            *(f"camera {i} is not mounted as calibrated: not used for depth" for i in new),
            *(f"camera {i} agrees with its calibration: used for depth" for i in settled),
        )


def _feature_tracks(observations: Observations) -> FeatureTracks:
    """Return the features that the main camera follows."""
    main = observations.camera == 0
    return FeatureTracks(observations.ids[main], observations.pixels[main], observations.ages[main])
