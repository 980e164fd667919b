"""When frames are taken: offset, jitter, losses and darkness are what they say, and the truth of them is kept."""

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.sim.cameras.schedule import FrameSchedule, nominal_stamps, schedule_frames

START_NS = 1_403_715_273_262_142_976  # does not fit into a float: a real recording's
BEAT_NS = nominal_stamps(START_NS, START_NS + 1000 * 50_000_000, 20.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_an_undisturbed_camera_is_stamped_with_the_truth() -> None:
    schedule = schedule_frames(BEAT_NS, rng())
    assert len(BEAT_NS) == 1000
    assert BEAT_NS[1] - BEAT_NS[0] == 50_000_000
    np.testing.assert_array_equal(schedule.stamps_ns, BEAT_NS)
    np.testing.assert_array_equal(schedule.exposed_ns, BEAT_NS)
    assert schedule.lit.all()


def test_frames_are_taken_an_offset_after_their_stamps() -> None:
    schedule = schedule_frames(BEAT_NS, rng(), time_offset_s=-0.0123)
    np.testing.assert_array_equal(schedule.exposed_ns - schedule.stamps_ns, -12_300_000)
    cut = schedule.within(START_NS, START_NS + 100_000_000)
    assert cut.exposed_ns[0] >= START_NS and cut.exposed_ns[-1] <= START_NS + 100_000_000
    np.testing.assert_array_equal(cut.stamps_ns, BEAT_NS[1:3])


def test_jitter_is_the_stamps_own() -> None:
    schedule = schedule_frames(BEAT_NS, rng(), stamp_jitter_s=0.002)
    error_s = (schedule.stamps_ns - schedule.exposed_ns) * 1e-9
    assert error_s.std() == pytest.approx(0.002, rel=0.1)
    assert abs(error_s.mean()) < 3e-4
    np.testing.assert_array_equal(schedule.exposed_ns, BEAT_NS)
    wild = schedule_frames(BEAT_NS, rng(), stamp_jitter_s=10.0)
    assert np.all(np.diff(wild.stamps_ns) > 0)


def test_frames_are_lost_but_never_the_first() -> None:
    schedule = schedule_frames(BEAT_NS, rng(), dropped_frames=0.3)
    assert 1.0 - len(schedule) / 1000 == pytest.approx(0.3, abs=0.05)
    assert set(schedule.stamps_ns.tolist()) < set(BEAT_NS.tolist())
    most = schedule_frames(BEAT_NS, rng(), dropped_frames=0.9999)
    assert most.stamps_ns[0] == BEAT_NS[0]
    # One fault does not change what another draws.
    both = schedule_frames(BEAT_NS, rng(), dropped_frames=0.3, dark_for_s=1.0, time_offset_s=0.01)
    np.testing.assert_array_equal(both.stamps_ns, schedule.stamps_ns)


def test_light_fails_for_as_long_as_it_says() -> None:
    schedule = schedule_frames(BEAT_NS, rng(), dark_from_s=1.0, dark_for_s=0.5)
    np.testing.assert_array_equal(np.flatnonzero(~schedule.lit), np.arange(20, 30))


def test_one_frame_or_none_can_be_scheduled() -> None:
    assert len(schedule_frames(BEAT_NS[:1], rng(), stamp_jitter_s=0.001)) == 1
    assert len(schedule_frames(BEAT_NS[:0], rng(), stamp_jitter_s=0.001)) == 0


def test_schedules_that_make_no_sense_are_refused() -> None:
    lit = np.ones(2, dtype=bool)
    with pytest.raises(ConfigError, match="increasing"):
        FrameSchedule(BEAT_NS[:2][::-1], BEAT_NS[:2], lit)
    with pytest.raises(ConfigError, match="2 time stamps, 1 exposures"):
        FrameSchedule(BEAT_NS[:2], BEAT_NS[:1], lit)
