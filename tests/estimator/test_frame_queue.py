"""Frames wait for the IMU samples of their exposure, and samples for their frame, in the order of a replay."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.frame_queue import FrameQueue, SampleQueue
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.state import CameraFrame

STEP_NS = 50_000_000


def processed(queue: FrameQueue, first: int, last: int) -> list[list[int]]:
    """Return the indices of the frames that are due after each of some frames."""
    return [[f.t_ns // STEP_NS for f in queue.add(CameraFrame(k * STEP_NS, ()))] for k in range(first, last)]


def test_frames_are_due_at_once_with_the_given_offset() -> None:
    assert processed(FrameQueue(), -2, 3) == [[-2], [-1], [0], [1], [2]]


def test_frames_of_a_later_exposure_wait() -> None:
    """With 120 ms, a frame is due when the third one after it comes; none is left out."""
    queue = FrameQueue()
    processed(queue, 0, 2)
    queue.shift(0.12)
    assert processed(queue, 2, 8) == [[], [], [], [2], [3], [4]]


def test_frames_exposed_before_the_last_one_are_left_out() -> None:
    queue = FrameQueue()
    processed(queue, 0, 2)
    queue.shift(-0.12)
    assert processed(queue, 2, 7) == [[], [], [4], [5], [6]]


def test_a_second_shift_counts_from_the_first() -> None:
    """From +100 ms to 0: the frames that waited come at once, without those whose time has passed."""
    queue = FrameQueue()
    queue.shift(0.1)
    assert processed(queue, 0, 4) == [[], [], [0], [1]]  # frame 1 was exposed at the time of the stamp of frame 3
    queue.shift(0.0)
    assert processed(queue, 4, 6) == [[4], [5]]


@settings(max_examples=60, deadline=None)
@given(
    steps_ms=st.lists(st.sampled_from([4, 5, 6, 11, 90]), min_size=30, max_size=120),
    early=st.lists(st.integers(0, 40), min_size=20, max_size=20),
    offset_ms=st.integers(-20, 20),
)
def test_samples_are_divided_as_those_of_a_replay(steps_ms: list[int], early: list[int], offset_ms: int) -> None:
    """Whatever has already come when a frame comes, with gaps and jitter of the IMU."""
    t_ns = np.cumsum(steps_ms) * 1_000_000
    imu = ImuSamples(t_ns, np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3)))
    rig = replace(euroc_rig(), time_offset_s=1e-3 * offset_ms)
    recording, queue = _Recording(rig, imu, STEP_NS * np.arange(1, 10)), SampleQueue(rig)
    sent = taken = expected_from = 0
    for index, measurement in enumerate(measurements(recording)):
        if isinstance(measurement, ImuSamples):
            taken += len(measurement)
        else:
            end = min(max(taken + early[index % len(early)], sent), len(imu))
            for row in range(sent, end):
                queue.add(imu[row : row + 1])
            sent = end
            found = queue.take(measurement)
            expected = imu.t_ns[expected_from:taken]
            expected_from = taken
            assert np.array_equal(expected, np.zeros(0, np.int64) if found is None else found.t_ns)


def test_samples_that_are_not_later_are_refused() -> None:
    queue, zero = SampleQueue(euroc_rig()), np.zeros((2, 3))
    queue.add(ImuSamples(np.array([0, 5]), zero, zero))
    with pytest.raises(ConfigError):
        queue.add(ImuSamples(np.array([5, 10]), zero, zero))


class _Recording:
    """IMU samples and frames without images."""

    name, ground_truth = "samples", None

    def __init__(self, rig: Rig, imu: ImuSamples, frame_times_ns: npt.NDArray[np.int64]) -> None:
        self.rig, self.imu, self.frame_times_ns = rig, imu, frame_times_ns

    def frame(self, index: int) -> CameraFrame:
        return CameraFrame(int(self.frame_times_ns[index]), ())
