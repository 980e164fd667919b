"""The schedule of corrections: frames at which answers are due, by counts alone."""

from dronevio.estimator.slam.schedule import CorrectionSchedule, DelayConfig


def due_frames(schedule: CorrectionSchedule, frames: int = 200) -> list[int]:
    """Return the frame at which each answer is due."""
    return [frame for frame in range(frames) for _ in range(schedule.take_due(frame))]


def test_delay_is_the_number_of_frames() -> None:
    schedule = CorrectionSchedule(DelayConfig(frames=6))
    schedule.add(10, keyframes=1, loops=0)
    schedule.add(14, keyframes=2, loops=0)
    assert due_frames(schedule) == [16, 20]


def test_delay_grows_with_loops_and_keyframes() -> None:
    schedule = CorrectionSchedule(DelayConfig(frames=6, loops_per_frame=100, keyframes_per_frame=500))
    schedule.add(10, keyframes=499, loops=99)  # 6
    schedule.add(20, keyframes=500, loops=99)  # 6 + 1
    schedule.add(30, keyframes=1000, loops=250)  # 6 + 2 + 2
    assert due_frames(schedule) == [16, 27, 40]


def test_messages_of_one_frame_are_due_one_after_another() -> None:
    schedule = CorrectionSchedule(DelayConfig(frames=3))
    for number in range(4):
        schedule.add(10, keyframes=number, loops=0)
    schedule.add(11, keyframes=5, loops=0)
    assert due_frames(schedule) == [13, 14, 15, 16, 17]


def test_answers_that_are_overdue_are_taken_together() -> None:
    schedule = CorrectionSchedule(DelayConfig(frames=1))
    schedule.add(1, keyframes=1, loops=0)
    schedule.add(2, keyframes=2, loops=0)
    assert [schedule.take_due(frame) for frame in (1, 5, 6)] == [0, 2, 0]
