"""Delay of frames in `measurements`: up to the exposure of their last row on the IMU clock, plus one sample."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import MAX_WAIT_INTERVALS, exposure_delay_ns, measurements
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


def received_ns(flight: Stamps) -> list[tuple[int, int]]:
    """Return for each frame its time stamp and that of the newest preceding IMU sample, -1 without one [ns]."""
    newest, found = -1, []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            newest = int(measurement.t_ns[-1])
        else:
            found.append((measurement.t_ns, newest))
    return found


@st.composite
def gapped_recordings(draw: st.DrawFn) -> Stamps:
    """Recordings with jittered IMU samples, of which up to 90 % are missing."""
    flight = recording(draw(st.sampled_from([0.0, 0.012, -0.012])), (draw(st.sampled_from([0.0, 0.02])),))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    jitter_ns = rng.integers(-2_000_000, 2_000_000, len(flight.imu))
    kept = rng.random(len(flight.imu)) < draw(st.sampled_from([0.1, 0.5, 0.9, 1.0]))
    t_ns = (flight.imu.t_ns + jitter_ns)[kept]
    rows = np.zeros((len(t_ns), 3))
    return replace(flight, imu=ImuSamples(t_ns, rows, rows))


@settings(max_examples=60, deadline=None)
@given(gapped_recordings())
def test_no_frame_follows_a_sample_that_is_late(flight: Stamps) -> None:
    """A frame follows all samples up to the end of its exposure, and at most one after it, which it waits for."""
    t_ns = flight.imu.t_ns
    for stamp_ns, newest_ns in received_ns(flight):
        end_ns = stamp_ns + exposure_delay_ns(flight.rig)
        earlier, later = t_ns[t_ns < end_ns], t_ns[t_ns >= end_ns]
        last_ns = int(earlier[-1]) if len(earlier) else -1
        interval_ns = max(IMU_STEP_NS, np.median(np.diff(earlier[-20:])) if len(earlier) > 1 else 0.0)
        waits = len(later) > 0 and later[0] - end_ns <= MAX_WAIT_INTERVALS * interval_ns
        assert newest_ns == (later[0] if waits else last_ns)
    samples = [m for m in measurements(flight) if isinstance(m, ImuSamples)]
    np.testing.assert_array_equal(np.concatenate([s.t_ns for s in samples] or [t_ns]), t_ns)


@settings(max_examples=60, deadline=None)
@given(gapped_recordings(), st.integers(0, 10**9))
def test_later_stamps_change_no_earlier_frame(flight: Stamps, shift_ns: int) -> None:
    """If all samples that a frame does not follow come later, or never, it follows the same samples."""
    for index, (stamp_ns, newest_ns) in enumerate(received_ns(flight)):
        later = flight.imu.t_ns > newest_ns
        for t_ns in (flight.imu.t_ns + shift_ns * later, flight.imu.t_ns[~later]):
            rows = np.zeros((len(t_ns), 3))
            other = replace(flight, imu=ImuSamples(t_ns, rows, rows))
            assert received_ns(other)[index] == (stamp_ns, newest_ns)


def test_a_slower_imu_than_stated_is_waited_for() -> None:
    """The interval is that of the samples, where the stated rate is too high."""
    flight = recording(0.0, (0.0,))
    slow = ImuSamples(flight.imu.t_ns[::8], flight.imu.gyro_rad_s[::8], flight.imu.accel_m_s2[::8])
    assert imu_lead_ns(replace(flight, imu=slow)) == [39_000_000, 29_000_000, 19_000_000, 9_000_000]
