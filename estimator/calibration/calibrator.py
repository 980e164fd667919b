"""The calibration of the odometry: corrected online, replaced where clocks differ, as uncertain as it is known."""

from dataclasses import dataclass, replace

from dronevio.estimator.backend.smoother import Keyframe, KeyframeSmoother
from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.offset_search import OffsetSearch
from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.calibration.rotation_offset import RotationOffset
from dronevio.estimator.calibration.uncertainty import Origin, calibration_covariance
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.types import Calibration, CalibrationSigmas, FramePacket
from dronevio.models.arrays import Array
from dronevio.models.rig import Rig
from dronevio.models.state import NavState

TIME_OFFSET_FOUND = "time offset of camera and IMU estimated from their rotation:"
"""Beginning of the event at which another time offset is adopted."""


@dataclass(frozen=True, eq=False)
class Correction:
    """A correction of the calibration."""

    smoother: KeyframeSmoother
    """The smoother with the corrected calibration."""
    has_kept_window: bool
    """Whether it has kept its window; otherwise it begins at the newest state."""
    corrects_displacement: bool
    """Whether it begins at a state without errors of the previous calibration; see `OnlineCalibration`."""
    events: tuple[str, ...]
    """What has been corrected, and the cause where that is not plausible, as texts for people."""


class Calibrator:
    """Holds the calibration in use."""

    def __init__(self, rig: Rig, config: CalibrationConfig, gravity_m_s2: float) -> None:
        """Begin with a given calibration and magnitude of gravity.

        Args:
            rig: The given calibration.
            config: Settings.
            gravity_m_s2: Given magnitude of gravity [m/s²].
        """
        self._rig, self._config, self._gravity_m_s2 = rig, config, gravity_m_s2
        self._online = OnlineCalibration(rig, config, gravity_m_s2)
        self._offset_search = OffsetSearch()

    @property
    def calibration(self) -> Calibration:
        """The calibration in use; the same object until it changes."""
        return self._online.calibration

    @property
    def is_plausible(self) -> bool:
        """Whether all corrections so far have been plausible."""
        return self._online.is_plausible

    @property
    def is_known(self) -> bool:
        """Whether the given calibration has not been refuted, or the calibration is known again."""
        return self._online.is_known

    @property
    def gravity_m_s2(self) -> float:
        """The magnitude of gravity in use [m/s²]."""
        return self._gravity_m_s2 + self.calibration.gravity_correction_m_s2

    @property
    def time_offset_s(self) -> float:
        """The time offset of camera and IMU in use, t_imu = t_cam + offset [s]."""
        return self.calibration.rig.time_offset_s + self.calibration.time_offset_correction_s

    @property
    def sigmas(self) -> CalibrationSigmas:
        """Standard deviations of the calibration in use."""
        return self._online.uncertainty

    def add_frame(self, packet: FramePacket) -> None:
        """Add the next frame, from which another time offset may be found."""
        self._offset_search.add(packet)

    def other_offset(self, *, at_once: bool = False) -> RotationOffset | None:
        """Return another time offset, relative to the one in use, that the rotation shows; see `OffsetSearch`."""
        return self._offset_search.offset(self.calibration.Ts_imu_cam, at_once=at_once)

    def adopt(self, offset: RotationOffset) -> tuple[float, str]:
        """Begin anew with another time offset; return its difference to the given one [s], and an event."""
        before_s = self.time_offset_s
        offset_s = before_s + offset.offset_s
        self._begin(offset_s)
        event = (
            f"{TIME_OFFSET_FOUND} {1e3 * offset_s:+.1f} ± {1e3 * offset.sigma_s:.1f} ms instead of"
            f" {1e3 * before_s:+.1f} ms"
        )
        return offset_s - self._rig.time_offset_s, event

    def restart(self) -> None:
        """Discard the windows under way, since the estimate is lost, and corrections that are not plausible."""
        if self.is_plausible:
            self._online.restart()
        else:
            self._begin(self.calibration.rig.time_offset_s)

    def step(self) -> None:
        """Perform one step of an adjustment under way, at a frame between keyframes."""
        self._online.step()

    def add_keyframe(
        self, smoother: KeyframeSmoother, keyframe: Keyframe, rate_rad_s: Array, *, is_restored: bool, is_degraded: bool
    ) -> Correction | None:
        """Add the newest keyframe of a smoother and return a correction, if there is one.

        Args:
            smoother: The smoother.
            keyframe: Its newest keyframe, without outliers.
            rate_rad_s: (3,) Angular velocity of the IMU at the keyframe, bias removed [rad/s].
            is_restored: Whether the smoother has begun anew at the keyframe, after a failure of its solver.
            is_degraded: Whether a sensor of the IMU has been saturated, or has had a gap, since the keyframe before.
        """
        online, was_plausible, before = self._online, self.is_plausible, self.calibration.without_depth
        if is_restored or is_degraded:
            online.restart()
        if is_degraded or not online.add(
            smoother.state, rate_rad_s, keyframe.preintegrated, keyframe.observations, keyframe.stationary
        ):
            return None
        # The window is kept, unless its depths are wrong, the correction determines the newest state, or there is no
        # solution
        inflation, corrected = online.covariance_inflation, online.corrected_state
        has_depth = self.calibration.without_depth <= before
        keeps_window = has_depth and corrected is None and smoother.recalibrate(self.calibration, inflation)
        if not keeps_window:
            smoother = smoother.restarted(self.calibration, inflation, corrected)
        self._offset_search = OffsetSearch()
        has_failed = was_plausible and not self.is_plausible
        causes = (f"probable cause: {Cause.IMPLAUSIBLE_CALIBRATION}",) if has_failed else ()
        events = (f"calibration corrected: {online.applied}", *causes)
        return Correction(smoother, keeps_window, corrected is not None and online.corrects_displacement, events)

    def with_uncertainty(self, state: NavState, origin: Origin, rate_rad_s: Array) -> NavState:
        """Return a state with the uncertainty of the calibration in use; see `OnlineCalibration.uncertainty`.

        Args:
            state: The state.
            origin: Where its displacement begins.
            rate_rad_s: (3,) Angular velocity of the IMU, bias removed [rad/s].
        """
        if state.covariance is None:
            return state
        added = calibration_covariance(state, origin, rate_rad_s, self.sigmas)
        return replace(state, covariance=state.covariance + added)

    def _begin(self, offset_s: float) -> None:
        """Begin with the given calibration, without corrections, and a time offset of camera and IMU [s]."""
        rig = replace(self._rig, time_offset_s=offset_s)
        self._online = OnlineCalibration(rig, self._config, self._gravity_m_s2)
        self._offset_search = OffsetSearch()
