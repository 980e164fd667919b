"""Frames wait for the IMU samples of their exposure, and those before the last one are left out."""

from dronevio.estimator.frame_queue import FrameQueue
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
