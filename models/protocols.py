"""The contracts between the rooms: who produces measurements, who consumes them."""

from collections.abc import Iterator
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import ImuSamples, Times
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState, Trajectory

Array = npt.NDArray[np.float64]


class Recording(Protocol):
    """Measurements of one flight: a simulation, an EuRoC folder, or anything else that has these members."""

    @property
    def name(self) -> str:
        """What to call it in a report."""

    @property
    def rig(self) -> Rig:
        """The calibration."""

    @property
    def imu(self) -> ImuSamples:
        """All IMU samples, in time order."""

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns], strictly increasing."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """The true motion, where it is known; estimators never see it."""

    def frame(self, index: int) -> CameraFrame:
        """Return the frame of the given index, 0 ≤ index < M.

        Raises:
            InputError: Its image cannot be read.
        """


class Estimator(Protocol):
    """Turns measurements, pushed in time order, into one estimate a frame."""

    def add_imu(self, samples: ImuSamples) -> None:
        """Take the IMU samples since the last call."""

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Take a frame, when the IMU up to the end of its exposure has been added, and say where the IMU is."""


class Plant(Protocol):
    """Something that flies: it takes motor commands and returns what its IMU measured meanwhile."""

    def step_until(self, t_ns: int, command: Array) -> ImuSamples:
        """Hold a command (one number a motor) until ``t_ns`` and return the IMU samples since the last call."""


class Controller(Protocol):
    """Something that steers: it turns where the drone is and where it should be into motor commands."""

    def command(self, state: NavState, t_ns: int) -> Array:
        """Return the command (one number a motor) for the state at ``t_ns``."""


def measurements(recording: Recording) -> Iterator[ImuSamples | CameraFrame]:
    """Yield a recording's measurements as a live system would get them.

    Each frame comes right after the IMU samples up to the exposure of its last row, on the IMU's clock, and the first
    one beyond, so that the motion up to there can be interpolated. That is a wait of at most one IMU interval (5 ms at
    200 Hz).
    """
    imu, start, rig = recording.imu, 0, recording.rig
    late_s = max(rig.time_offset_s + 0.5 * max((camera.readout_s for camera in rig.cameras), default=0.0), 0.0)
    for index, t_ns in enumerate(recording.frame_times_ns + round(late_s * 1e9)):
        end = min(int(np.searchsorted(imu.t_ns, t_ns, side="left")) + 1, len(imu))
        if end > start:
            yield imu[start:end]
            start = end
        yield recording.frame(index)
    if start < len(imu):
        yield imu[start:]
