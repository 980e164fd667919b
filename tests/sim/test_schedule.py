"""Frame schedules: time offset, jitter, dropped frames and darkness, with their ground truth."""

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.sim.cameras.schedule import FrameSchedule, nominal_stamps, schedule_frames

START_NS = 1_403_715_273_262_142_976  # of a real recording; not representable as a float
NOMINAL_NS = nominal_stamps(START_NS, START_NS + 1000 * 50_000_000, 20.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_stamps_without_faults_are_the_exposure_times() -> None:
    schedule = schedule_frames(NOMINAL_NS, rng())
    assert len(NOMINAL_NS) == 1000
    assert NOMINAL_NS[1] - NOMINAL_NS[0] == 50_000_000
    np.testing.assert_array_equal(schedule.stamps_ns, NOMINAL_NS)
    np.testing.assert_array_equal(schedule.exposed_ns, NOMINAL_NS)
    assert schedule.lit.all()


def test_exposures_differ_from_stamps_by_the_time_offset() -> None:
    schedule = schedule_frames(NOMINAL_NS, rng(), time_offset_s=-0.0123)
    np.testing.assert_array_equal(schedule.exposed_ns - schedule.stamps_ns, -12_300_000)
    cut = schedule.within(START_NS, START_NS + 100_000_000)
    assert cut.exposed_ns[0] >= START_NS and cut.exposed_ns[-1] <= START_NS + 100_000_000
    np.testing.assert_array_equal(cut.stamps_ns, NOMINAL_NS[1:3])


def test_jitter_changes_the_stamps_only() -> None:
    schedule = schedule_frames(NOMINAL_NS, rng(), stamp_jitter_s=0.002)
    error_s = (schedule.stamps_ns - schedule.exposed_ns) * 1e-9
    assert error_s.std() == pytest.approx(0.002, rel=0.1)
    assert abs(error_s.mean()) < 3e-4
    np.testing.assert_array_equal(schedule.exposed_ns, NOMINAL_NS)
    large = schedule_frames(NOMINAL_NS, rng(), stamp_jitter_s=10.0)
    assert np.all(np.diff(large.stamps_ns) > 0)


def test_frames_are_dropped_except_the_first() -> None:
    schedule = schedule_frames(NOMINAL_NS, rng(), dropped_frames=0.3)
    assert 1.0 - len(schedule) / 1000 == pytest.approx(0.3, abs=0.05)
    assert set(schedule.stamps_ns.tolist()) < set(NOMINAL_NS.tolist())
    most = schedule_frames(NOMINAL_NS, rng(), dropped_frames=0.9999)
    assert most.stamps_ns[0] == NOMINAL_NS[0]
    # The random numbers of one fault do not depend on other faults.
    both = schedule_frames(NOMINAL_NS, rng(), dropped_frames=0.3, dark_for_s=1.0, time_offset_s=0.01)
    np.testing.assert_array_equal(both.stamps_ns, schedule.stamps_ns)


def test_darkness_lasts_for_the_given_time() -> None:
    schedule = schedule_frames(NOMINAL_NS, rng(), dark_from_s=1.0, dark_for_s=0.5)
    np.testing.assert_array_equal(np.flatnonzero(~schedule.lit), np.arange(20, 30))


def test_schedules_of_one_frame_or_none_are_valid() -> None:
    assert len(schedule_frames(NOMINAL_NS[:1], rng(), stamp_jitter_s=0.001)) == 1
    assert len(schedule_frames(NOMINAL_NS[:0], rng(), stamp_jitter_s=0.001)) == 0


def test_invalid_schedules_are_refused() -> None:
    lit = np.ones(2, dtype=bool)
    with pytest.raises(ConfigError, match="increasing"):
        FrameSchedule(NOMINAL_NS[:2][::-1], NOMINAL_NS[:2], lit)
    with pytest.raises(ConfigError, match="2 time stamps, 1 exposures"):
        FrameSchedule(NOMINAL_NS[:2], NOMINAL_NS[:1], lit)
