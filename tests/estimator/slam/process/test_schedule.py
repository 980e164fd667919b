"""The schedules of corrections and adjustments: when they are due, by time stamps and counts alone."""

import pytest

from dronevio.estimator.slam.schedule import (
    AdjustmentSchedule,
    AdjustmentScheduleConfig,
    CorrectionSchedule,
    DelayConfig,
)

PERIOD_NS = 50_000_000


def due_frames(schedule: CorrectionSchedule, frames: int = 200, period_ns: int = PERIOD_NS) -> list[int]:
    """Return the frame at which each answer is due."""
    return [frame for frame in range(frames) for _ in range(schedule.take_due(frame * period_ns))]


@pytest.mark.parametrize(("rate_hz", "expected"), [(20.0, [16, 20]), (60.0, [48, 60]), (12.0, [10, 12])])
def test_delay_is_a_time_at_any_frame_rate(rate_hz: float, expected: list[int]) -> None:
    """Answers 0.3 s after messages at 0.5 s and 0.7 s, at the first frame from then on."""
    schedule = CorrectionSchedule(DelayConfig(initial_s=0.3))
    schedule.add(500_000_000, keyframes=1, loops=0)
    schedule.add(700_000_000, keyframes=2, loops=0)
    assert due_frames(schedule, period_ns=round(1e9 / rate_hz)) == expected


def test_rounded_time_stamps_do_not_delay_a_frame() -> None:
    schedule = CorrectionSchedule(DelayConfig(initial_s=0.3))
    schedule.add(500_000_128, keyframes=1, loops=0)
    assert [schedule.take_due(t_ns) for t_ns in (750_000_000, 800_000_000)] == [0, 1]


def test_delay_grows_with_loops_and_keyframes() -> None:
    schedule = CorrectionSchedule(DelayConfig(initial_s=0.3, step_s=0.05, loops_per_step=100, keyframes_per_step=500))
    schedule.add(10 * PERIOD_NS, keyframes=499, loops=99)  # 0.3 s
    schedule.add(20 * PERIOD_NS, keyframes=500, loops=99)  # one step more
    schedule.add(30 * PERIOD_NS, keyframes=1000, loops=250)  # four steps more
    assert due_frames(schedule) == [16, 27, 40]


def test_messages_of_one_frame_are_due_one_after_another() -> None:
    schedule = CorrectionSchedule(DelayConfig(initial_s=0.15))
    for number in range(4):
        schedule.add(10 * PERIOD_NS, keyframes=number, loops=0)
    schedule.add(11 * PERIOD_NS, keyframes=5, loops=0)
    assert due_frames(schedule) == [13, 14, 15, 16, 17]


def test_answers_that_are_overdue_are_taken_together() -> None:
    schedule = CorrectionSchedule(DelayConfig(initial_s=0.05))
    schedule.add(PERIOD_NS, keyframes=1, loops=0)
    schedule.add(2 * PERIOD_NS, keyframes=2, loops=0)
    assert [schedule.take_due(frame * PERIOD_NS) for frame in (1, 5, 6)] == [0, 2, 0]


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
