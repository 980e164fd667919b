"""Order of the measurements of a recording."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import measurements
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.state import CameraFrame, Trajectory


@dataclass(frozen=True, eq=False)
class Stamps:
    """A recording with time stamps only."""

    imu: ImuSamples
    frame_times_ns: Times
    name: str = "stamps"
    ground_truth: Trajectory | None = None

    @property
    def rig(self) -> Rig:
        return euroc_rig()

    def frame(self, index: int) -> CameraFrame:
        return CameraFrame(int(self.frame_times_ns[index]), ())


def recording(imu_ns: list[int], frames_ns: list[int]) -> Stamps:
    t_ns = np.array(sorted(set(imu_ns)), dtype=np.int64)
    rows = np.arange(3.0 * len(t_ns)).reshape(-1, 3)
    return Stamps(ImuSamples(t_ns, rows, -rows), np.array(sorted(set(frames_ns)), dtype=np.int64))


times = st.lists(st.integers(0, 60), max_size=40)


@given(times, times)
@settings(max_examples=300, deadline=None)
def test_measurements_are_ordered_and_complete(imu_ns: list[int], frames_ns: list[int]) -> None:
    flight = recording(imu_ns, frames_ns)
    samples, frames = ImuSamples.empty(), []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            assert len(measurement) > 0
            samples = samples.extended(measurement)
            continue
        frames.append(measurement.t_ns)
        arrived = set(samples.t_ns.tolist())
        due = set(flight.imu.t_ns[flight.imu.t_ns <= measurement.t_ns].tolist())
        later = flight.imu.t_ns[flight.imu.t_ns > measurement.t_ns]
        # All samples up to the frame and the first one after it, unless a sample has the time stamp of the frame.
        assert due <= arrived
        assert arrived - due <= set(later[:1].tolist())
        assert measurement.t_ns in arrived or len(arrived - due) == min(len(later), 1)
    assert frames == flight.frame_times_ns.tolist()
    np.testing.assert_array_equal(samples.t_ns, flight.imu.t_ns)
    np.testing.assert_array_equal(samples.gyro_rad_s, flight.imu.gyro_rad_s)


@pytest.mark.parametrize("equal_stamps", [True, False])
def test_delay_is_at_most_one_imu_interval(equal_stamps: bool) -> None:
    flight = recording(list(range(0, 100, 5)), [20, 40, 60] if equal_stamps else [22, 42, 62])
    newest, waits = -1, []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            newest = int(measurement.t_ns[-1])
        else:
            waits.append(newest - measurement.t_ns)
    assert waits == ([0, 0, 0] if equal_stamps else [3, 3, 3])
