"""IMU samples that share time stamps: bursts are spread, single duplicates are not."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.recordings.bursts import spread_bursts

DT_NS = 5_000_000


def samples(count: int) -> npt.NDArray[np.float64]:
    return np.random.default_rng(0).normal(size=(count, 6))


def burst_stamps(t_ns: npt.NDArray[np.int64], size: int) -> npt.NDArray[np.int64]:
    """Each sample with the stamp of the last one of its burst."""
    last = np.minimum(np.arange(len(t_ns)) // size * size + size - 1, len(t_ns) - 1)
    return np.asarray(t_ns[last])


@pytest.mark.parametrize("size", [2, 3, 4, 8, 16, 50])
@pytest.mark.parametrize("start_ns", [0, -(10**9), 1_403_715_278 * 10**9])
def test_regular_bursts_are_spread_to_the_true_stamps(size: int, start_ns: int) -> None:
    t_ns = start_ns + np.arange(10 * size, dtype=np.int64) * DT_NS
    spread, first = spread_bursts(burst_stamps(t_ns, size), samples(len(t_ns)))
    np.testing.assert_array_equal(spread, t_ns)
    np.testing.assert_array_equal(first, np.arange(0, len(t_ns), size))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(2, 20), st.integers(10**6, 10**8)), min_size=2, max_size=30))
def test_a_burst_is_spread_evenly_since_the_stamp_before_it(bursts: list[tuple[int, int]]) -> None:
    counts = np.array([count for count, _ in bursts])
    ends = np.cumsum([since for _, since in bursts])
    stamps = np.repeat(ends, counts).astype(np.int64)
    spread, first = spread_bursts(stamps, samples(len(stamps)))
    assert len(first) == len(bursts) and np.all(np.diff(spread) > 0)
    per_sample = np.array([since / count for count, since in bursts][1:])
    for k, row in enumerate(first.tolist()):
        mine = spread[row : row + counts[k]]
        assert mine[-1] == ends[k]
        assert np.ptp(np.diff(mine)) <= 1 if len(mine) > 2 else True
        if k and per_sample[k - 1] <= 2 * np.median(per_sample) * (1 - 1e-9):
            assert abs(int(mine[0]) - (ends[k - 1] + bursts[k][1] / counts[k])) <= 1


def test_most_samples_decide_not_most_stamps() -> None:
    """Between bursts of eight, two samples arrive alone."""
    counts = np.tile([1, 1, 8], 10)
    t_ns = np.arange(counts.sum(), dtype=np.int64) * DT_NS
    ends = np.cumsum(counts) - 1
    spread, first = spread_bursts(np.repeat(t_ns[ends], counts), samples(len(t_ns)))
    np.testing.assert_array_equal(spread, t_ns)
    assert len(first) == 10


def test_a_gap_is_not_filled() -> None:
    t_ns = burst_stamps(np.arange(80, dtype=np.int64) * DT_NS, 8)
    t_ns[40:] += 10**9
    spread, _ = spread_bursts(t_ns, samples(80))
    assert np.diff(spread)[39] == 10**9 + DT_NS
    assert np.all(np.delete(np.diff(spread), 39) == DT_NS)


@settings(max_examples=100, deadline=None)
@given(st.sets(st.integers(0, 99), max_size=30))
def test_single_duplicates_stay(rows: set[int]) -> None:
    """Stamps that occur twice now and then, and samples that were logged twice, are for the reader."""
    t_ns = np.arange(100, dtype=np.int64) * DT_NS
    repeated = np.sort(np.concatenate([t_ns, t_ns[sorted(rows)]]))
    for stamps, values in (
        (repeated, samples(len(repeated))),
        (np.repeat(t_ns, 3), np.repeat(samples(100), 3, axis=0)),
    ):
        spread, first = spread_bursts(stamps, values)
        np.testing.assert_array_equal(spread, stamps)
        assert len(first) == 0


def test_few_samples() -> None:
    for count in (0, 1):
        t_ns = np.zeros(count, np.int64)
        assert len(spread_bursts(t_ns, samples(count))[0]) == count
    spread, first = spread_bursts(np.full(8, 7), samples(8))
    assert np.all(spread == 7) and first.tolist() == [0]  # the time that they cover is unknown
