"""Recordings as other programs expect them: with time stamps since 1970, and with the IMU samples that they integrate.

The stamps of a simulated flight count from its start. A stamp of zero means "unset" in ROS, and some programs wait
until the stamps exceed the length of their initialization.
"""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.imu import ImuSamples, Sampling, Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3
from dronevio.models.state import CameraFrame, Trajectory

EPOCH_NS = 1_600_000_000 * 10**9
"""Time stamp of the start of a simulated flight in exports: 13 September 2020, 12:26:40 UTC [ns]."""

_LAST_COUNTED_NS = 100_000_000 * 10**9  # stamps below three years count from the start of a flight


@dataclass(frozen=True, eq=False)
class ExportedRecording:
    """A recording with other time stamps or other IMU samples; satisfies the `Recording` protocol."""

    source: Recording
    """The recording that the images come from."""
    shift_ns: int
    """Difference of the time stamps to those of the source [ns]."""
    imu: ImuSamples
    """IMU samples of the whole recording."""
    frame_truth: FrameTruth | None
    """Ground truth of the frames, None if it is unknown."""

    @property
    def name(self) -> str:
        """Name of the source."""
        return self.source.name

    @property
    def rig(self) -> Rig:
        """Calibration of cameras and IMU."""
        return self.source.rig

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return self.source.frame_times_ns + self.shift_ns

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth of the IMU, None if it is unknown."""
        truth = self.source.ground_truth
        return None if truth is None else replace(truth, t_ns=truth.t_ns + self.shift_ns)

    def frame(self, index: int) -> CameraFrame:
        """Return the frame with a given index, 0 ≤ index < M.

        Raises:
            InputError: The image of a camera cannot be read.
        """
        frame = self.source.frame(index)
        return replace(frame, t_ns=frame.t_ns + self.shift_ns)


def exported(
    recording: Recording, frame_truth: FrameTruth | None, sampling: Sampling | None = None, from_epoch: bool = True
) -> ExportedRecording:
    """Return a recording as it is exported.

    Args:
        recording: The recording.
        frame_truth: Ground truth of its frames, None if it is unknown.
        sampling: ``increment`` for means over the intervals between the IMU samples; None for the samples themselves.
        from_epoch: Whether stamps that count from the start of the flight begin at `EPOCH_NS`; other stamps are kept.
    """
    imu = recording.imu.increments() if sampling == "increment" else recording.imu
    times = [t_ns for t_ns in (recording.imu.t_ns, recording.frame_times_ns) if len(t_ns)]
    counted = max((int(t_ns[-1]) for t_ns in times), default=0) < _LAST_COUNTED_NS
    shift_ns = EPOCH_NS if from_epoch and counted else 0
    if frame_truth is not None:
        frame_truth = replace(
            frame_truth, t_ns=frame_truth.t_ns + shift_ns, exposed_ns=frame_truth.exposed_ns + shift_ns
        )
    return ExportedRecording(recording, shift_ns, replace(imu, t_ns=imu.t_ns + shift_ns), frame_truth)


def interval_means(increments: ImuSamples) -> ImuSamples:
    """Return increments with the specific force in the frame at the middle of the interval, instead of at its start.

    A program that holds a sample over the interval before it, and rotates the specific force by half of the rotation of
    the interval, such as Basalt, then integrates the motion without error of the sampling.
    """
    return _turned(increments, -0.5)


def increments_of_means(means: ImuSamples) -> ImuSamples:
    """Return the increments of `interval_means`, the inverse up to rounding."""
    return _turned(means, 0.5)


def _turned(samples: ImuSamples, intervals: float) -> ImuSamples:
    """Return samples (N,) with the specific force rotated by a multiple of the rotation of their interval."""
    dt_s = np.diff(samples.t_ns) * 1e-9
    dt_s = np.concatenate([[np.median(dt_s) if len(dt_s) else 0.0], dt_s])[: len(samples)]
    turn = exp_so3(intervals * samples.gyro_rad_s * dt_s[:, None])
    return replace(samples, accel_m_s2=np.einsum("nij,nj->ni", turn, samples.accel_m_s2), sampling="increment")
