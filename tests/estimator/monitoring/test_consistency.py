"""Consistency of an estimate: disturbances of an established one, and contradictions of one that is not established."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.consistency import ConsistencyMonitor

STEP_NS = 50_000_000
LIMITS = HealthConfig(
    consistency_window_s=0.6,
    max_consistent_nis=15.0,
    max_frame_nis=60.0,
    recovery_s=5.0,
    established_s=10.0,
    established_nis_ratio=2.0,
    disturbance_s=0.5,
)
ESTABLISHING = [1.0] * 201
"""NIS of the frames after which a moving estimate is established: ten seconds."""


def consistent_frames(nis: Sequence[float | None], limits: HealthConfig = LIMITS, *, moves: bool = True) -> list[bool]:
    """Return for each frame whether an estimate with these values of the NIS is consistent after it."""
    monitor = ConsistencyMonitor(limits, is_consistent=True)
    consistent = []
    for k, value in enumerate(nis):
        monitor.update(k * STEP_NS, value, moves=moves)
        consistent.append(monitor.is_consistent)
    return consistent


def test_disturbance_of_an_established_estimate_is_short() -> None:
    """After the last of two frames that contradict it, it has to be consistent for half a second."""
    consistent = consistent_frames([*ESTABLISHING, 130.0, 130.0, *[1.0] * 200])
    begin = len(ESTABLISHING)
    assert all(consistent[:begin]) and not any(consistent[begin : begin + 11]) and all(consistent[begin + 11 :])


@pytest.mark.parametrize("earlier", [ESTABLISHING[1:], [1.0]])
def test_contradiction_before_ten_seconds_is_inconsistent(earlier: list[float]) -> None:
    consistent = consistent_frames([*earlier, 65.0, *[1.0] * 200])
    begin = len(earlier)
    assert all(consistent[:begin]) and not any(consistent[begin : begin + 100]) and all(consistent[begin + 100 :])


def test_only_consistent_motion_establishes_an_estimate() -> None:
    """Neither standing still nor frames without landmarks show that a calibration is right."""
    jump: list[float | None] = [65.0, 1.0]
    assert consistent_frames([*ESTABLISHING, *jump])[-1]
    assert not consistent_frames([*ESTABLISHING, *jump], moves=False)[-1]
    assert not consistent_frames([1.0, *[None] * 300, *jump])[-1]


def test_established_estimate_has_twice_the_limits() -> None:
    """The limits of the median and of a single frame are 30 and 120 instead of 15 and 60."""
    for nis, expected in ((29.0, True), (31.0, False)):
        assert all(consistent_frames([*ESTABLISHING, *[nis] * 20])) is expected
    assert all(consistent_frames([*ESTABLISHING, 119.0, 1.0])) and not all(
        consistent_frames([*ESTABLISHING, 121.0, 1.0])
    )


def test_long_contradiction_is_no_disturbance() -> None:
    """Half a second of large values is a disturbance, and one frame more is not."""
    limits = replace(LIMITS, max_consistent_nis=float("inf"))
    for frames, inconsistent in ((11, 10), (12, 100)):
        consistent = consistent_frames([*ESTABLISHING, *[130.0] * frames, *[1.0] * 200], limits)
        end = len(ESTABLISHING) + frames - 1  # the last frame that contradicts the estimate
        assert not any(consistent[len(ESTABLISHING) : end + inconsistent]) and all(consistent[end + inconsistent :])


def test_second_disturbance_within_ten_seconds_is_inconsistent() -> None:
    again = [*ESTABLISHING, 130.0, *[1.0] * 100, 130.0, *[1.0] * 99]
    consistent = consistent_frames(again)
    begin = len(ESTABLISHING) + 101
    assert consistent[begin - 1] and not any(consistent[begin:])
    established_again = [*ESTABLISHING, 130.0, *[1.0] * 220, 130.0, *[1.0] * 99]
    assert consistent_frames(established_again)[-1]


def test_estimate_is_never_established_without_the_limit() -> None:
    """With an infinite time, the estimate is inconsistent as if no motion had confirmed it."""
    never = replace(LIMITS, established_s=float("inf"))
    assert not consistent_frames([*ESTABLISHING, 65.0, *[1.0] * 50], never)[-1]


def test_an_established_estimate_can_be_made_to_begin_anew() -> None:
    monitor = ConsistencyMonitor(LIMITS, is_consistent=True)
    for k, nis in enumerate(ESTABLISHING):
        monitor.update(k * STEP_NS, nis, moves=True)
    established = [monitor.is_established]
    monitor.restart_motion()
    established.append(monitor.is_established)
    assert established == [True, False]
    monitor.update(len(ESTABLISHING) * STEP_NS, 65.0, moves=True)
    assert not monitor.is_consistent


def test_three_frames_of_a_new_window_can_contradict() -> None:
    """A start in motion with a wrong velocity errs by decimetres before the window is full."""
    assert consistent_frames([16.0] * 3) == [True, True, False]
    assert consistent_frames([1.0, 16.0, 16.0]) == [True, True, False]
    assert all(consistent_frames([1.0, 16.0, 1.0, 1.0, 16.0]))
    assert consistent_frames([1.0, None, 16.0, 16.0, None, 16.0, 16.0, 16.0]) == [True] * 7 + [False]


def test_a_loss_requires_a_full_window() -> None:
    monitor, medians = ConsistencyMonitor(LIMITS, is_consistent=True), []
    for k, nis in enumerate([70.0] * 14):
        if k == 13:
            monitor.restart_motion()
        monitor.update(k * STEP_NS, nis, moves=True)
        medians.append(monitor.median_nis)
    assert medians == [0.0] * 12 + [70.0, 0.0]


def test_the_median_counts_in_a_window_of_two_frames() -> None:
    short = replace(LIMITS, consistency_window_s=0.05)
    assert consistent_frames([1.0, 16.0], short) == [True, False]


@pytest.mark.parametrize(("rate_hz", "frames"), [(20, 1), (60, 5), (200, 18)])
def test_jolt_at_the_start_is_short_at_any_frame_rate(rate_hz: int, frames: int) -> None:
    """A tenth of a second is needed for a median after an initialization, however many frames it has."""
    for count, consistent in ((frames, True), (frames + 5, False)):
        monitor = ConsistencyMonitor(LIMITS, is_consistent=True)
        for k in range(count):
            monitor.update(round(k * 1e9 / rate_hz), 50.0, moves=True)
        assert monitor.is_consistent is consistent


@pytest.mark.parametrize("error_ns", [0, 128, 100_000])
def test_median_counts_in_every_frame_of_a_full_window(error_ns: int) -> None:
    """Whether a frame is just older than the window, or just not, is a matter of its rounded time stamp."""
    monitor, medians = ConsistencyMonitor(LIMITS, is_consistent=True), []
    for k in range(60):
        monitor.update(k * STEP_NS + (k % 3) * error_ns, 7.0, moves=True)
        medians.append(monitor.median_nis)
    assert medians == [0.0] * 12 + [7.0] * 48


def test_median_counts_with_few_frames_in_the_window() -> None:
    """At 2 Hz, a window of 0.6 s has one or two frames."""
    monitor = ConsistencyMonitor(LIMITS, is_consistent=True)
    for k in range(5):
        monitor.update(k * 500_000_000, 20.0, moves=True)
    assert not monitor.is_consistent and monitor.median_nis == 20.0
