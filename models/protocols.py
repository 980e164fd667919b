"""Protocols of recordings, estimators, plants and controllers."""

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState, Trajectory

MAX_WAIT_INTERVALS = 1.5
"""Longest time for which a frame waits for the next IMU sample, in sampling intervals: the nominal interval or, if that
is longer, the median of the last ones. Half an interval allows for the jitter of time stamps."""
RECENT_SAMPLES = 20
"""Number of IMU samples before a frame whose median interval is compared with the nominal one."""


class Recording(Protocol):
    """Measurements of one flight: a simulated flight, an EuRoC folder, a bag or any object with these members."""

    @property
    def name(self) -> str:
        """Name of the recording in reports."""

    @property
    def rig(self) -> Rig:
        """Sensors and their calibration."""

    @property
    def imu(self) -> ImuSamples:
        """IMU samples of the whole recording."""

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames, strictly increasing [ns]."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth, None if it is unknown; it is not given to estimators."""

    def frame(self, index: int) -> CameraFrame:
        """Return the frame with a given index, 0 ≤ index < M.

        Raises:
            InputError: The image of a camera cannot be read.
        """


class Estimator(Protocol):
    """Receives measurements in time order and returns an estimate for each frame."""

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call."""

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate for a frame.

        The IMU samples up to the end of its exposure have to be added before. Later samples may have been added, too,
        since the frames of a live system arrive with a delay.
        """

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU to its last sample not after a time.

        This is the output for controllers, which cannot wait for the next frame. It goes on after a loss, as dead
        reckoning from the last state.

        Args:
            t_ns: Time [ns], not before that of the last call.

        Returns:
            The state with its angular velocity, without covariance; None before the first state.
        """


class Plant(Protocol):
    """A vehicle or a simulation of it, which receives motor commands and returns IMU samples."""

    def step_until(self, t_ns: int, command: Array) -> ImuSamples:
        """Apply a command (M,), one number per motor, until ``t_ns``; return the IMU samples since the last call."""


class Controller(Protocol):
    """Computes motor commands from the state of the vehicle."""

    def command(self, state: NavState, t_ns: int) -> Array:
        """Return the command (M,), one number per motor, for the state at ``t_ns``."""


def measurements(recording: Recording) -> Iterator[ImuSamples | CameraFrame]:
    """Yield the measurements of a recording in the order in which a live system receives them.

    Each frame follows the IMU samples up to the exposure of the last row of its last image, on the IMU clock, and the
    first sample at or after that time, so that the motion up to it can be interpolated. The delay is at most one IMU
    interval (5 ms at 200 Hz). Where that sample is missing, a frame waits for `MAX_WAIT_INTERVALS` intervals in time
    stamps and then follows the samples before it alone, as on a vehicle, which cannot wait for the end of a gap.
    """
    imu, start = recording.imu, 0
    for index in range(len(recording.frame_times_ns)):
        frame = recording.frame(index)
        end_ns = frame.t_ns + exposure_delay_ns(recording.rig, frame.image_delays_ns)
        end = received_count(imu.t_ns, end_ns, recording.rig.imu.rate_hz)
        if end > start:
            yield imu[start:end]
            start = end
        yield frame
    if start < len(imu):
        yield imu[start:]


def received_count(imu_t_ns: Times, t_ns: int, rate_hz: float) -> int:
    """Return the number of IMU samples that a frame follows; see `measurements`.

    Args:
        imu_t_ns: (N,) Their time stamps [ns].
        t_ns: End of the exposure of the frame on the clock of the IMU [ns].
        rate_hz: Nominal rate of the IMU [Hz].
    """
    count = int(np.searchsorted(imu_t_ns, t_ns, side="left"))
    if count == len(imu_t_ns):
        return count
    wait_ns = int(imu_t_ns[count]) - t_ns
    if wait_ns <= MAX_WAIT_INTERVALS * (1e9 / rate_hz):
        return count + 1
    recent_ns = np.diff(imu_t_ns[max(count - RECENT_SAMPLES, 0) : count])
    arrives = len(recent_ns) > 0 and wait_ns <= MAX_WAIT_INTERVALS * float(np.median(recent_ns))
    return count + arrives


def exposure_delay_ns(rig: Rig, image_delays_ns: Sequence[int] = ()) -> int:
    """Return the time from the stamp of a frame to the end of its exposure on the clock of the IMU, 0 or more [ns].

    Args:
        rig: The rig.
        image_delays_ns: Delays of the images of the frame; see `CameraFrame`.
    """
    delays_ns = image_delays_ns or [0] * len(rig.cameras)
    last_s = max(
        (
            1e-9 * delay_ns + camera.time_offset_s + 0.5 * camera.readout_s
            for delay_ns, camera in zip(delays_ns, rig.cameras, strict=True)
        ),
        default=0.0,
    )
    return round(max(rig.time_offset_s + last_s, 0.0) * 1e9)
