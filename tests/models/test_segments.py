"""Steps of the clock: what splits a recording, and what does not."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.imu import Times
from dronevio.models.recordings.segments import Split, clock_steps, segments_of, split_at_steps

IMU_NS, FRAME_NS = 5_000_000, 50_000_000
DURATION_NS = 10 * 10**9


def streams(start_ns: int = 0, jitter: float = 0.0, seed: int = 0) -> list[Times]:
    """Ten seconds of an IMU at 200 Hz and two cameras at 20 Hz, with uniform jitter as a part of the interval."""
    random = np.random.default_rng(seed)
    regular = [np.arange(start_ns, start_ns + DURATION_NS, dt, dtype=np.int64) for dt in (IMU_NS, FRAME_NS, FRAME_NS)]
    noise = [
        np.int64(dt) * random.uniform(-jitter, jitter, len(t))
        for dt, t in zip((IMU_NS, FRAME_NS, FRAME_NS), regular, strict=True)
    ]
    return [t + n.astype(np.int64) for t, n in zip(regular, noise, strict=True)]


def stepped(t_ns: Times, at_ns: int, change_ns: int) -> Times:
    """The stamps of a clock that steps after the row at a time."""
    return t_ns + np.where(np.arange(len(t_ns)) >= np.searchsorted(t_ns, at_ns), change_ns, 0)


def check_split(split: Split, of: list[Times], segments: int) -> None:
    """Segments are runs of file order that together are all rows."""
    assert len(split.steps) == segments - 1
    for stream, t_ns in enumerate(of):
        rows = [np.arange(len(t_ns))[part] for part in split.rows(stream)]
        assert len(rows) == segments and all(len(part) for part in rows)
        np.testing.assert_array_equal(np.concatenate(rows), np.arange(len(t_ns)))


STEPS_S = [-3600.0, -3.013, -3.0, -3.025, -1.0, -0.15, 2.1, 5.0, 1.6e9]


@pytest.mark.parametrize("change_s", STEPS_S)
@pytest.mark.parametrize("start_ns", [0, -20 * 10**9, 1_403_715_278 * 10**9])
def test_a_step_of_all_streams_splits(change_s: float, start_ns: int) -> None:
    at_ns = start_ns + 6 * 10**9
    of = [stepped(t_ns, at_ns, round(change_s * 1e9)) for t_ns in streams(start_ns)]
    split = split_at_steps(of)
    check_split(split, of, 2)
    assert split.lone == ((), (), ())
    assert [step.row for step in split.steps[0]] == [1200, 120, 120]
    assert all(step.change_ns == round(change_s * 1e9) for step in split.steps[0])
    assert f"({change_s:+.3f} s)" in str(split.steps[0][0])
    for before, after in zip(of, split.stamps, strict=True):
        np.testing.assert_array_equal(before, after)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0.5, 2.0),
            st.one_of(st.floats(-1000.0, -0.2), st.floats(2.1, 1000.0)),
        ),
        max_size=4,
    ),
    st.floats(0.0, 0.3),
    st.integers(0, 100),
)
def test_several_steps_make_segments(steps: list[tuple[float, float]], jitter: float, seed: int) -> None:
    of, at_s = streams(seed * 10**9, jitter, seed), seed + 0.0
    expected: list[int] = []
    changed = [t_ns.copy() for t_ns in of]
    for duration_s, change_s in steps:
        at_s += duration_s
        for original, t_ns in zip(of, changed, strict=True):
            row = int(np.searchsorted(original, round(at_s * 1e9)))
            t_ns[row:] += round(change_s * 1e9)
        expected.append(int(np.searchsorted(of[1], round(at_s * 1e9))))
    split = split_at_steps(changed)
    check_split(split, changed, len(steps) + 1)
    assert [step[1].row for step in split.steps] == expected
    for stream, t_ns in enumerate(split.stamps):
        for part in split.rows(stream):
            assert np.all(np.abs(np.diff(t_ns[part])) < 10**8)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 180), st.integers(1, 19)), max_size=8), st.integers(0, 2), st.floats(0.0, 0.3))
def test_single_late_rows_are_no_step(moves: list[tuple[int, int]], seed: int, jitter: float) -> None:
    """Rows of all streams that are written late by up to a second, each with others between it and the next."""
    of = streams(seed * 10**9, jitter, seed)
    shuffled = []
    for t_ns, interval_ns in zip(of, (IMU_NS, FRAME_NS, FRAME_NS), strict=True):
        key = t_ns.astype(np.float64)
        for row, late in {row // 6 * 6: late for row, late in moves}.items():
            start = round(row * FRAME_NS / interval_ns)
            key[start] += (late + 0.5) * FRAME_NS
        shuffled.append(t_ns[np.argsort(key, kind="stable")])
    split = split_at_steps(shuffled)
    check_split(split, shuffled, 1)
    for before, after in zip(shuffled, split.stamps, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("gap_s", [0.3, 1.9, 2.5, 6.0])
@pytest.mark.parametrize("stream", [0, 1])
def test_a_gap_of_one_stream_is_no_step(gap_s: float, stream: int) -> None:
    of = streams()
    is_gap = (of[stream] > 2 * 10**9) & (of[stream] < 2 * 10**9 + round(gap_s * 1e9))
    of[stream] = of[stream][~is_gap]
    check_split(split_at_steps(of), of, 1)


def test_a_pause_of_all_streams_is_a_step_from_two_seconds_on() -> None:
    for gap_s, segments in ((1.9, 1), (2.1, 2)):
        of = [t_ns[(t_ns < 3 * 10**9) | (t_ns >= 3 * 10**9 + round(gap_s * 1e9))] for t_ns in streams()]
        check_split(split_at_steps(of), of, segments)
    apart = [
        t_ns[(t_ns < begin) | (t_ns > begin + 3 * 10**9)]
        for t_ns, begin in zip(streams(), (10**9, 5 * 10**9, 5 * 10**9), strict=True)
    ]
    check_split(split_at_steps(apart), apart, 1)  # at different times


def test_less_than_three_rows_are_no_segment() -> None:
    for rows, segments in ((2, 1), (3, 2)):
        of = [
            t_ns[: 120 * (10 if dt == IMU_NS else 1) + rows * (10 if dt == IMU_NS else 1)]
            for t_ns, dt in zip(streams(), (IMU_NS, FRAME_NS, FRAME_NS), strict=True)
        ]
        of = [stepped(t_ns, 6 * 10**9, -3 * 10**9) for t_ns in of]
        assert len(split_at_steps(of).steps) == segments - 1


def test_a_stamp_far_ahead_is_no_step() -> None:
    for rows in (1, 2):
        of = streams()
        for t_ns in of:
            t_ns[60 : 60 + rows] += 1000 * 10**9
        check_split(split_at_steps(of), of, 1)


@pytest.mark.parametrize("change_s", [-3.013, -3.0, -0.5])
@pytest.mark.parametrize("stream", [0, 1])
def test_a_step_of_one_stream_is_undone(change_s: float, stream: int) -> None:
    of = streams()
    original, of[stream] = of[stream], stepped(of[stream], 6 * 10**9, round(change_s * 1e9))
    split = split_at_steps(of)
    check_split(split, of, 1)
    np.testing.assert_array_equal(split.stamps[stream], original)
    assert [len(lone) for lone in split.lone] == [1 if k == stream else 0 for k in range(3)]


def test_lists_without_order_are_left_to_sorting() -> None:
    """Files in the order of a folder, or of their names as texts: no time is repeated."""
    random = np.random.default_rng(1)
    for order in (random.permutation, lambda t: np.array(sorted(t.tolist(), key=str)), lambda t: t[::-1]):
        of = streams()
        of[1] = np.asarray(order(of[1]))
        split = split_at_steps(of)
        check_split(split, of, 1)
        np.testing.assert_array_equal(split.stamps[1], of[1])
        assert split.lone == ((), (), ())
    assert all(clock_steps(random.permutation(t_ns)) == () for t_ns in streams())


def test_a_block_of_late_images_is_sorted() -> None:
    """One camera writes ten images late, into the gap that they left."""
    of = streams()
    order = np.concatenate([np.arange(50), np.arange(60, 80), np.arange(50, 60), np.arange(80, 200)])
    of[1] = of[1][order]
    split = split_at_steps(of)
    np.testing.assert_array_equal(split.stamps[1], of[1])


def test_a_step_back_of_one_is_not_the_pause_of_another() -> None:
    """The IMU goes from 10 s to 7 s, the cameras go from 7 s to 10 s."""
    of = [stepped(t_ns + 4 * 10**9, 10 * 10**9, -3 * 10**9) for t_ns in streams()]
    paused = [t_ns[(t_ns < 7 * 10**9) | (t_ns >= 10 * 10**9)] for t_ns in (t + 4 * 10**9 for t in streams())]
    split = split_at_steps([of[0], *paused[1:]])
    assert split.steps == () and len(split.lone[0]) == 1


def test_offsets_count_where_steps_are_compared() -> None:
    of = [stepped(t_ns, 6 * 10**9, -3 * 10**9) for t_ns in streams()]
    late = [of[0], of[1] - 3600 * 10**9, of[2] - 3600 * 10**9]
    assert len(split_at_steps(late, [0, 3600 * 10**9, 3600 * 10**9]).steps) == 1
    assert len(split_at_steps(late).steps) == 0


def test_short_lists_have_no_steps() -> None:
    for t in ([], [5], [5, 5], [5, 4]):
        t_ns: npt.NDArray[np.int64] = np.array(t, dtype=np.int64)
        assert clock_steps(t_ns) == () and len(split_at_steps([t_ns]).rows(0)) == 1


def test_a_recording_without_steps_is_its_own_segment() -> None:
    class One:
        """No recording that lists segments."""

    one: Any = One()
    assert segments_of(one) == (one,)
