"""Recordings that begin later, or are repeated without a break as a long flight."""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.defects import Defect, defects_of
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.rotation import log_so3
from dronevio.models.state import CameraFrame, Trajectory

MAX_DISCONTINUITY_M, MAX_DISCONTINUITY_DEG = 0.1, 1.0
"""Largest distance and angle between the last and the first pose of a recording that can be repeated."""
_START_TOLERANCE_NS = 2_000_000  # time stamps of frames jitter
_IMU_BEFORE_NS = 10_000_000  # IMU samples before the first frame


def excerpt_of(recording: Recording, start_s: float = 0.0, laps: int = 1) -> Recording:
    """Return a recording that begins later, or that is repeated; the recording itself without either.

    Args:
        recording: The whole recording.
        start_s: Time after its first frame at which the excerpt begins [s].
        laps: Number of repetitions.

    Raises:
        ConfigError: The recording is too short, or does not begin and end at the same pose.
    """
    begun = RecordingTail.after(recording, start_s) if start_s else recording
    return RepeatedRecording.of(begun, laps) if laps > 1 else begun


@dataclass(frozen=True, eq=False)
class RecordingTail:
    """A recording from one of its frames on; is a `Recording`."""

    whole: Recording
    """The whole recording."""
    first: int
    """Index of the first frame."""

    @classmethod
    def after(cls, recording: Recording, start_s: float) -> "RecordingTail":
        """Return a recording from the first frame that is ``start_s`` [s] after its first one, or later.

        Raises:
            ConfigError: The recording has no such frame.
        """
        times_ns = recording.frame_times_ns
        first = int(np.searchsorted(times_ns, times_ns[0] + round(start_s * 1e9) - _START_TOLERANCE_NS))
        if first >= len(times_ns):
            duration_s = float(np.ptp(times_ns)) * 1e-9
            raise ConfigError(
                f"a start {start_s:g} s after the first frame; {recording.name} ends after {duration_s:g} s"
            )
        return cls(recording, first)

    @property
    def name(self) -> str:
        """Name of the recording with the time at which this begins."""
        skipped_s = float(self.whole.frame_times_ns[self.first] - self.whole.frame_times_ns[0]) * 1e-9
        return f"{self.whole.name} from {skipped_s:.1f} s"

    @property
    def rig(self) -> Rig:
        """Calibration of the recording."""
        return self.whole.rig

    @property
    def imu(self) -> ImuSamples:
        """IMU samples from 10 ms before the first frame on."""
        return self.whole.imu.after(self._begin_ns)

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return self.whole.frame_times_ns[self.first :]

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth from 10 ms before the first frame on."""
        truth = self.whole.ground_truth
        return None if truth is None else truth[truth.t_ns >= self._begin_ns]

    @property
    def defects(self) -> tuple[Defect, ...]:
        """Defects of the recording from then on."""
        return tuple(defect for defect in defects_of(self.whole) if defect.t_ns >= self._begin_ns)

    def frame(self, index: int) -> CameraFrame:
        """Return a frame of the recording."""
        return self.whole.frame(self.first + index)

    @property
    def _begin_ns(self) -> int:
        return int(self.frame_times_ns[0]) - _IMU_BEFORE_NS


@dataclass(frozen=True, eq=False)
class RepeatedRecording:
    """A recording that is repeated several times without a break; is a `Recording`.

    The biases of the IMU continue their random walk from lap to lap, where the ground truth has them.
    """

    inner: Recording
    """Recording of one lap, which begins and ends at the same pose, at rest."""
    laps: int
    """Number of repetitions."""

    @classmethod
    def of(cls, recording: Recording, laps: int) -> "RepeatedRecording":
        """Return a recording that is repeated.

        Raises:
            ConfigError: The ground truth does not begin and end at the same pose.
        """
        repeated = cls(recording, laps)
        metres, degrees = repeated.discontinuity()
        if not (metres <= MAX_DISCONTINUITY_M and degrees <= MAX_DISCONTINUITY_DEG):
            raise ConfigError(
                f"{recording.name} ends {metres:.3f} m and {degrees:.2f}° from its first pose; expected at most"
                f" {MAX_DISCONTINUITY_M:g} m and {MAX_DISCONTINUITY_DEG:g}°, to repeat it"
            )
        return repeated

    @property
    def name(self) -> str:
        """Name of the recording with the number of laps."""
        return f"{self.inner.name} × {self.laps}"

    @property
    def rig(self) -> Rig:
        """Calibration of the recording."""
        return self.inner.rig

    @property
    def lap_ns(self) -> int:
        """Duration of a lap: from the first frame to the last, and one frame interval [ns]."""
        t_ns = self.inner.frame_times_ns
        return int(t_ns[-1] - t_ns[0] + np.median(np.diff(t_ns)))

    @property
    def imu(self) -> ImuSamples:
        """IMU samples of all laps."""
        one = self.inner.imu
        first, last = np.searchsorted(one.t_ns, self._span_ns)
        one, change = one[int(first) : int(last)], self._bias_change
        laps = range(self.laps)
        return ImuSamples(
            np.concatenate([one.t_ns + lap * self.lap_ns for lap in laps]),
            np.concatenate([one.gyro_rad_s + lap * change[0] for lap in laps]),
            np.concatenate([one.accel_m_s2 + lap * change[1] for lap in laps]),
            one.sampling,
        )

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames of all laps [ns]."""
        return np.concatenate([self.inner.frame_times_ns + lap * self.lap_ns for lap in range(self.laps)])

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth of all laps, without biases."""
        truth = self.inner.ground_truth
        if truth is None:
            return None
        first, last = np.searchsorted(truth.t_ns, self._span_ns)
        one, laps = truth[int(first) : int(last)], range(self.laps)
        return Trajectory(
            np.concatenate([one.t_ns + lap * self.lap_ns for lap in laps]),
            np.tile(one.p_world_imu, (self.laps, 1)),
            np.tile(one.quat_wxyz, (self.laps, 1)),
            None if one.velocity_m_s is None else np.tile(one.velocity_m_s, (self.laps, 1)),
        )

    @property
    def defects(self) -> tuple[Defect, ...]:
        """Defects of one lap."""
        return defects_of(self.inner)

    def frame(self, index: int) -> CameraFrame:
        """Return a frame of the recording with the time stamp of its lap."""
        lap, row = divmod(index, len(self.inner.frame_times_ns))
        frame = self.inner.frame(row)
        return replace(frame, t_ns=frame.t_ns + lap * self.lap_ns)

    def discontinuity(self) -> tuple[float, float]:
        """Return the distance [m] and the angle [°] between the last and the first pose; infinite without a truth."""
        truth = self.inner.ground_truth
        if truth is None:
            return float("inf"), float("inf")
        R = truth.rotations
        angle_rad = np.linalg.norm(log_so3(R[0].T @ R[-1]))
        return float(np.linalg.norm(truth.p_world_imu[-1] - truth.p_world_imu[0])), float(np.degrees(angle_rad))

    @property
    def _span_ns(self) -> tuple[int, int]:
        """Beginning and end of a lap [ns]."""
        first_ns = int(self.inner.frame_times_ns[0])
        return first_ns, first_ns + self.lap_ns

    @property
    def _bias_change(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """(2, 3) Changes of the biases of gyroscope [rad/s] and accelerometer [m/s²] over a lap; 0 if not known."""
        truth = self.inner.ground_truth
        if truth is None or truth.gyro_bias_rad_s is None or truth.accel_bias_m_s2 is None:
            return np.zeros((2, 3))
        return np.array([bias[-1] - bias[0] for bias in (truth.gyro_bias_rad_s, truth.accel_bias_m_s2)])


@dataclass(frozen=True, eq=False)
class SplicedRecording:
    """The beginning of one recording, continued without a break by the end of another one; is a `Recording`.

    It is the test of relocalisation that is called kidnapping: the vehicle is elsewhere from one frame to the next.
    """

    first: Recording
    """Recording whose beginning is used."""
    second: Recording
    """Recording that continues it, with the same rig; another one or the same."""
    frames: int
    """Number of frames of the first recording."""
    start: int
    """Index of the first frame of the second recording that is used."""

    @classmethod
    def at(cls, first: Recording, end_s: float, second: Recording, start_s: float) -> "SplicedRecording":
        """Return a recording that goes over to another one.

        Args:
            first: Recording that comes first.
            end_s: Time after its first frame at which it ends [s].
            second: Recording that continues it.
            start_s: Time after its first frame at which the second one begins [s].

        Raises:
            ConfigError: A recording is too short, or the cameras differ.
        """
        if [camera.model for camera in first.rig.cameras] != [camera.model for camera in second.rig.cameras]:
            raise ConfigError(f"the cameras of {first.name} and {second.name} differ; expected the same rig")
        for recording, time_s in (first, end_s), (second, start_s):
            duration_s = float(np.ptp(recording.frame_times_ns)) * 1e-9
            if not 0.0 <= time_s <= duration_s:
                raise ConfigError(f"a splice at {time_s:g} s; {recording.name} has frames from 0 to {duration_s:g} s")
        ends = (end_s, first), (start_s, second)
        rows = [np.searchsorted(r.frame_times_ns, r.frame_times_ns[0] + round(1e9 * s)) for s, r in ends]
        return cls(first, second, int(rows[0]), int(rows[1]))

    @property
    def name(self) -> str:
        """Name of the recording with those of both parts."""
        return f"{self.first.name} + {self.second.name}"

    @property
    def rig(self) -> Rig:
        """Calibration of the first recording."""
        return self.first.rig

    @property
    def splice_ns(self) -> int:
        """Time stamp of the first frame of the second recording [ns]."""
        times_ns = self.first.frame_times_ns
        return int(times_ns[self.frames - 1]) + int(np.median(np.diff(times_ns)))

    @property
    def imu(self) -> ImuSamples:
        """IMU samples of both parts; the change is half a frame interval before the splice."""
        one, two = self.first.imu, self.second.imu
        border_ns = (int(self.first.frame_times_ns[self.frames - 1]) + self.splice_ns) // 2
        last = int(np.searchsorted(one.t_ns, border_ns))
        begin = int(np.searchsorted(two.t_ns + self._shift_ns, border_ns))
        return ImuSamples(
            np.concatenate([one.t_ns[:last], two.t_ns[begin:] + self._shift_ns]),
            np.concatenate([one.gyro_rad_s[:last], two.gyro_rad_s[begin:]]),
            np.concatenate([one.accel_m_s2[:last], two.accel_m_s2[begin:]]),
            one.sampling,
        )

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames of both parts [ns]."""
        times_ns = self.second.frame_times_ns[self.start :] + self._shift_ns
        return np.concatenate([self.first.frame_times_ns[: self.frames], times_ns])

    @property
    def ground_truth(self) -> Trajectory | None:
        """Poses of both parts; None unless both have a ground truth."""
        one, two = self.first.ground_truth, self.second.ground_truth
        if one is None or two is None:
            return None
        one, two = one[one.t_ns < self.splice_ns], replace(two, t_ns=two.t_ns + self._shift_ns)
        two = two[two.t_ns >= self.splice_ns]
        return Trajectory(
            np.concatenate([one.t_ns, two.t_ns]),
            np.concatenate([one.p_world_imu, two.p_world_imu]),
            np.concatenate([one.quat_wxyz, two.quat_wxyz]),
        )

    @property
    def defects(self) -> tuple[Defect, ...]:
        """Defects of both parts."""
        late = (replace(each, t_ns=each.t_ns + self._shift_ns) for each in defects_of(self.second))
        begun = tuple(each for each in late if each.t_ns >= self.splice_ns)
        return (*(each for each in defects_of(self.first) if each.t_ns < self.splice_ns), *begun)

    def frame(self, index: int) -> CameraFrame:
        """Return a frame with its time stamp in the spliced recording."""
        if index < self.frames:
            return self.first.frame(index)
        frame = self.second.frame(self.start + index - self.frames)
        return replace(frame, t_ns=frame.t_ns + self._shift_ns)

    @property
    def _shift_ns(self) -> int:
        """What is added to the time stamps of the second recording [ns]."""
        return self.splice_ns - int(self.second.frame_times_ns[self.start])
