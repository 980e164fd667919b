"""Trust in an estimate: disturbances of an established estimate, and contradictions of one that is not established."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from dronevio.estimator.monitoring.consistency import Trust, TrustLimits

STEP_NS = 50_000_000
LIMITS = TrustLimits(
    window_s=0.6,
    max_median_nis=15.0,
    max_frame_nis=60.0,
    distrust_s=5.0,
    established_s=10.0,
    established_ratio=2.0,
    disturbance_s=0.5,
)
ESTABLISHING = [1.0] * 201
"""NIS of the frames after which a moving estimate is established: ten seconds."""


def trusted_frames(nis: Sequence[float | None], limits: TrustLimits = LIMITS, *, moves: bool = True) -> list[bool]:
    """Return for each frame whether an estimate with these values of the NIS is trusted after it."""
    trust = Trust(limits, is_trusted=True)
    trusted = []
    for k, value in enumerate(nis):
        trust.update(k * STEP_NS, value, moves=moves)
        trusted.append(trust.is_trusted)
    return trusted


def test_disturbance_of_an_established_estimate_is_short() -> None:
    """After the last of two frames that contradict it, it has to be consistent for half a second."""
    trusted = trusted_frames([*ESTABLISHING, 130.0, 130.0, *[1.0] * 200])
    begin = len(ESTABLISHING)
    assert all(trusted[:begin]) and not any(trusted[begin : begin + 11]) and all(trusted[begin + 11 :])


@pytest.mark.parametrize("earlier", [ESTABLISHING[1:], [1.0]])
def test_contradiction_before_ten_seconds_is_distrusted(earlier: list[float]) -> None:
    trusted = trusted_frames([*earlier, 65.0, *[1.0] * 200])
    begin = len(earlier)
    assert all(trusted[:begin]) and not any(trusted[begin : begin + 100]) and all(trusted[begin + 100 :])


def test_only_consistent_motion_establishes_an_estimate() -> None:
    """Neither standing still nor frames without landmarks show that a calibration is right."""
    jump: list[float | None] = [65.0, 1.0]
    assert trusted_frames([*ESTABLISHING, *jump])[-1]
    assert not trusted_frames([*ESTABLISHING, *jump], moves=False)[-1]
    assert not trusted_frames([1.0, *[None] * 300, *jump])[-1]


def test_established_estimate_has_twice_the_limits() -> None:
    """The limits of the median and of a single frame are 30 and 120 instead of 15 and 60."""
    for nis, expected in ((29.0, True), (31.0, False)):
        assert all(trusted_frames([*ESTABLISHING, *[nis] * 20])) is expected
    assert all(trusted_frames([*ESTABLISHING, 119.0, 1.0])) and not all(trusted_frames([*ESTABLISHING, 121.0, 1.0]))


def test_long_contradiction_is_no_disturbance() -> None:
    """Half a second of large values is a disturbance, and one frame more is not."""
    limits = replace(LIMITS, max_median_nis=float("inf"))
    for frames, distrusted in ((11, 10), (12, 100)):
        trusted = trusted_frames([*ESTABLISHING, *[130.0] * frames, *[1.0] * 200], limits)
        end = len(ESTABLISHING) + frames - 1  # the last frame that contradicts the estimate
        assert not any(trusted[len(ESTABLISHING) : end + distrusted]) and all(trusted[end + distrusted :])


def test_second_disturbance_within_ten_seconds_is_distrusted() -> None:
    again = [*ESTABLISHING, 130.0, *[1.0] * 100, 130.0, *[1.0] * 99]
    trusted = trusted_frames(again)
    begin = len(ESTABLISHING) + 101
    assert trusted[begin - 1] and not any(trusted[begin:])
    established_again = [*ESTABLISHING, 130.0, *[1.0] * 220, 130.0, *[1.0] * 99]
    assert trusted_frames(established_again)[-1]


def test_estimate_is_never_established_without_the_limit() -> None:
    """With an infinite time, the estimate is distrusted as if no motion had confirmed it."""
    never = replace(LIMITS, established_s=float("inf"))
    assert not trusted_frames([*ESTABLISHING, 65.0, *[1.0] * 50], never)[-1]


def test_an_established_estimate_can_be_made_to_begin_anew() -> None:
    trust = Trust(LIMITS, is_trusted=True)
    for k, nis in enumerate(ESTABLISHING):
        trust.update(k * STEP_NS, nis, moves=True)
    established = [trust.is_established]
    trust.restart_motion()
    established.append(trust.is_established)
    assert established == [True, False]
    trust.update(len(ESTABLISHING) * STEP_NS, 65.0, moves=True)
    assert not trust.is_trusted


def test_three_frames_of_a_new_window_can_contradict() -> None:
    """A start in motion with a wrong velocity errs by decimetres before the window is full."""
    assert trusted_frames([16.0] * 3) == [True, True, False]
    assert trusted_frames([1.0, 16.0, 16.0]) == [True, True, False]
    assert all(trusted_frames([1.0, 16.0, 1.0, 1.0, 16.0]))
    assert trusted_frames([1.0, None, 16.0, 16.0, None, 16.0, 16.0, 16.0]) == [True] * 7 + [False]


def test_a_loss_requires_a_full_window() -> None:
    trust, medians = Trust(LIMITS, is_trusted=True), []
    for k, nis in enumerate([70.0] * 14):
        if k == 13:
            trust.restart_motion()
        trust.update(k * STEP_NS, nis, moves=True)
        medians.append(trust.median_nis)
    assert medians == [0.0] * 12 + [70.0, 0.0]


def test_the_median_counts_in_a_window_of_two_frames() -> None:
    short = replace(LIMITS, window_s=0.05)
    assert trusted_frames([1.0, 16.0], short) == [True, False]


@pytest.mark.parametrize(("rate_hz", "frames"), [(20, 1), (60, 5), (200, 18)])
def test_jolt_at_the_start_is_short_at_any_frame_rate(rate_hz: int, frames: int) -> None:
    """A tenth of a second is needed for a median after an initialization, however many frames it has."""
    for count, trusted in ((frames, True), (frames + 5, False)):
        trust = Trust(LIMITS, is_trusted=True)
        for k in range(count):
            trust.update(round(k * 1e9 / rate_hz), 50.0, moves=True)
        assert trust.is_trusted is trusted


@pytest.mark.parametrize("error_ns", [0, 128, 100_000])
def test_median_counts_in_every_frame_of_a_full_window(error_ns: int) -> None:
    """Whether a frame is just older than the window, or just not, is a matter of its rounded time stamp."""
    trust, medians = Trust(LIMITS, is_trusted=True), []
    for k in range(60):
        trust.update(k * STEP_NS + (k % 3) * error_ns, 7.0, moves=True)
        medians.append(trust.median_nis)
    assert medians == [0.0] * 12 + [7.0] * 48


def test_median_counts_with_few_frames_in_the_window() -> None:
    """At 2 Hz, a window of 0.6 s has one or two frames."""
    trust = Trust(LIMITS, is_trusted=True)
    for k in range(5):
        trust.update(k * 500_000_000, 20.0, moves=True)
    assert not trust.is_trusted and trust.median_nis == 20.0
