"""Delay of frames in `measurements`: up to the exposure of their last row on the IMU clock, plus one sample."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import measurements
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.state import CameraFrame, Trajectory

IMU_STEP_NS, FRAME_STEP_NS = 5_000_000, 50_000_000


@dataclass(frozen=True, eq=False)
class Stamps:
    """A recording with time stamps only."""

    rig: Rig
    imu: ImuSamples
    frame_times_ns: Times
    name: str = "stamps"
    ground_truth: Trajectory | None = None

    def frame(self, index: int) -> CameraFrame:
        return CameraFrame(int(self.frame_times_ns[index]), ())


def recording(time_offset_s: float, readouts_s: tuple[float, ...]) -> Stamps:
    """Return two seconds of an IMU at 200 Hz, with frames in the middle of cameras with the given readout times."""
    t_ns = IMU_STEP_NS * np.arange(400)
    camera = euroc_rig().cameras[0]
    cameras = tuple(replace(camera, readout_s=readout_s) for readout_s in readouts_s)
    rig = replace(euroc_rig(), cameras=cameras, time_offset_s=time_offset_s)
    rows = np.zeros((len(t_ns), 3))
    return Stamps(rig, ImuSamples(t_ns, rows, rows), 1_001_000_000 + FRAME_STEP_NS * np.arange(4))


def imu_lead_ns(flight: Stamps) -> list[int]:
    """Return for each frame the time of the newest preceding IMU sample relative to its time stamp [ns]."""
    newest, lead = -1, []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            newest = int(measurement.t_ns[-1])
        else:
            lead.append(newest - measurement.t_ns)
    return lead


@pytest.mark.parametrize(
    ("time_offset_s", "readouts_s", "expected_ms"),
    [
        (0.0, (0.0,), 4),  # the time stamps are 1 ms after a sample
        (0.012, (0.0,), 14),  # the exposure is at +12 ms
        (0.012, (0.02,), 24),  # its last row at +22 ms
        (0.0, (0.02,), 14),
        (0.0, (0.0, 0.02), 14),  # the largest readout time applies
        (-0.002, (0.02,), 9),  # its last row at +8 ms
        (-0.012, (0.0,), 4),  # the exposure is over, and the estimate is that at the time stamp
        (-0.012, (0.02,), 4),
    ],
)
def test_frames_wait_for_their_last_row(time_offset_s: float, readouts_s: tuple[float, ...], expected_ms: int) -> None:
    """The newest sample is the first at or after the last row, less than one interval after it."""
    assert imu_lead_ns(recording(time_offset_s, readouts_s)) == [expected_ms * 1_000_000] * 4
