"""The schedules of corrections and adjustments: when they are due, by counts alone."""

from dronevio.estimator.slam.schedule import (
    AdjustmentSchedule,
    AdjustmentScheduleConfig,
    CorrectionSchedule,
    DelayConfig,
)


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


def test_adjustments_begin_with_loops_and_with_growth() -> None:
    config = AdjustmentScheduleConfig(min_loops=10, growth=1.5, keyframes=20, keyframes_per_keyframe=10)
    schedule = AdjustmentSchedule(config)
    assert not schedule.begins(100, loops=9)
    assert schedule.begins(100, loops=10)
    assert not schedule.begins(129, loops=500)  # one at a time
    assert [k for k in range(100, 140) if schedule.takes_effect(k)] == [130]  # 20 + 100 / 10 later
    assert not schedule.begins(149, loops=500)
    assert schedule.begins(150, loops=500)
    assert [k for k in range(150, 200) if schedule.takes_effect(k)] == [185]


def test_adjustments_can_be_disabled() -> None:
    schedule = AdjustmentSchedule(AdjustmentScheduleConfig(enabled=False))
    assert not schedule.begins(1000, loops=1000) and not schedule.takes_effect(10_000)
