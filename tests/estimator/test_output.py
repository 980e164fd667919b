"""What is told of a frame: the events that come of what it shows."""

from dataclasses import replace

import numpy as np

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.output import Answers
from dronevio.estimator.types import NO_MATCHES, NOTHING_SEEN, FramePacket, Matches
from dronevio.models.state import Health, HealthReport, NavState

RATE_HZ = 200.0
STATE = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))


class Undecided:
    """In place of an initializer: doubts a start for some frames."""

    def __init__(self, frames: int) -> None:
        self.left, self.believed = frames, 0

    def doubt(self, state: NavState) -> str | None:
        self.left -= 1
        return "a velocity of 1.00 ± 9.00 m/s" if self.left >= 0 else None

    def believe(self, state: NavState) -> None:
        self.believed += 1


def packet(matched: tuple[int, ...] = (), miscalibrated: tuple[int, ...] = ()) -> FramePacket:
    def by(cameras: tuple[int, ...]) -> Matches:
        n = len(cameras)
        return Matches(np.arange(n), np.array(cameras), np.zeros((n, 2))) if n else NO_MATCHES

    return FramePacket(0, NO_INCREMENTS, replace(NOTHING_SEEN, matches=by(matched), miscalibrated=by(miscalibrated)))


def answers(undecided: Undecided) -> Answers:
    return Answers(undecided, RATE_HZ, max_innovation_px=12.0)  # type: ignore[arg-type]


def test_miscalibration_and_its_end_are_reported_once() -> None:
    told = answers(Undecided(0))
    shown = [
        packet((1, 1)),
        packet((2,), (1, 1)),
        packet(),
        packet((), (1, 2)),
        packet((1, 1)),
        packet((1,)),
    ]
    events = [told.unknown(each, "").events for each in shown]
    assert events == [
        (),
        ("camera 1 is not mounted as calibrated: not used for depth",),
        (),
        ("camera 2 is not mounted as calibrated: not used for depth",),
        ("camera 1 agrees with its calibration: used for depth",),
        (),
    ]


def test_nothing_is_published_before_it_is_certain() -> None:
    undecided = Undecided(2)
    told, report = answers(undecided), HealthReport(Health.TRACKING, "landmarks hold it", innovation_px=1.0)
    found = [told.known(packet(), STATE, report, ("keyframe",)) for _ in range(4)]
    assert [each.state is None for each in found] == [True, True, False, False]
    assert found[0].health is Health.INITIALIZING and "9.00 m/s" in found[0].health_report.reason
    assert [each.events for each in found[2:]] == [("initialized", "keyframe"), ("keyframe",)]
    assert undecided.believed == 2
    told.known(packet(), STATE, replace(report, innovation_px=13.0))
    assert undecided.believed == 2  # told, but nothing to go on from
    undecided.left = 1
    lost = told.lost(packet(), HealthReport(Health.LOST, "a speed of 99 m/s"))
    assert lost.state is None and lost.events == ("lost: a speed of 99 m/s",)
    again = [told.known(packet(), STATE, report) for _ in range(2)]
    assert again[0].state is None and again[0].health is Health.LOST
    assert again[1].events == ("recovered",)


def test_an_imu_gap_is_reported_at_its_begin_and_end() -> None:
    def frame(longest_s: float) -> FramePacket:
        increments = Increments(np.array([0.005, longest_s]), np.zeros((2, 3)), np.zeros((2, 3)))
        return replace(packet(), increments=increments)

    told = answers(Undecided(0))
    events = [told.unknown(frame(s), "").events for s in (0.015, 0.03, 0.005, 0.25, 0.25, 0.05, 0.005, 0.005, 0.25)]
    short, long = ("no IMU for 0.03 s",), ("no IMU for 0.25 s",)
    assert events == [(), short, (), long, (), (), ("no IMU for 0.55 s: it is back",), (), long]
