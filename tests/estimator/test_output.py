"""The published estimates: withheld until certain, and the events of the sensors."""

from dataclasses import replace

import numpy as np

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.initialization.initializer import InitializerConfig
from dronevio.estimator.output import Publisher
from dronevio.estimator.types import NO_FEATURES, NO_MATCHES, FramePacket, Matches
from dronevio.models.state import Health, HealthReport, NavState

RATE_HZ = 200.0
REPORT = HealthReport(Health.TRACKING, "constrained by 50 landmarks", innovation_px=1.0)


def state(velocity_sigma_m_s: float) -> NavState:
    """Return a state at 1 m/s with a standard deviation of the velocity."""
    covariance = 1e-8 * np.eye(15)
    covariance[6:9, 6:9] = velocity_sigma_m_s**2 * np.eye(3)
    return NavState(0, np.eye(4), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), covariance)


def packet(matched: tuple[int, ...] = (), miscalibrated: tuple[int, ...] = ()) -> FramePacket:
    def by(cameras: tuple[int, ...]) -> Matches:
        n = len(cameras)
        return Matches(np.arange(n), np.array(cameras), np.zeros((n, 2))) if n else NO_MATCHES

    return FramePacket(0, NO_INCREMENTS, replace(NO_FEATURES, matches=by(matched), miscalibrated=by(miscalibrated)))


def publisher() -> Publisher:
    return Publisher(InitializerConfig(), RATE_HZ)


def test_miscalibration_and_its_end_are_reported_once() -> None:
    published = publisher()
    shown = [
        packet((1, 1)),
        packet((2,), (1, 1)),
        packet(),
        packet((), (1, 2)),
        packet((1, 1)),
        packet((1,)),
    ]
    events = [published.without_state(each, "").events for each in shown]
    assert events == [
        (),
        ("camera 1 contradicts its extrinsic calibration: not used for depth",),
        (),
        ("camera 2 contradicts its extrinsic calibration: not used for depth",),
        ("camera 1 agrees with its extrinsic calibration: used for depth",),
        (),
    ]


def test_nothing_is_published_before_it_is_certain() -> None:
    published = publisher()
    found = [published.estimate(packet(), state(s), REPORT, ("keyframe",)) for s in (9.0, 0.051, 0.049, 9.0)]
    assert [each.state is None for each in found] == [True, True, False, False]
    assert found[0].health is Health.INITIALIZING and found[0].health_report is not None
    assert "1.00 ± 9.00 m/s" in found[0].health_report.reason
    assert [each.events for each in found[2:]] == [("initialized", "keyframe"), ("keyframe",)]
    lost = published.lost(packet(), HealthReport(Health.LOST, "a speed of 99 m/s"))
    assert lost.state is None and lost.events == ("lost: a speed of 99 m/s",)
    again = [published.estimate(packet(), state(s), REPORT) for s in (1.0, 0.01)]
    assert again[0].state is None and again[0].health is Health.LOST
    assert again[1].events == ("recovered",)


def test_an_imu_gap_is_reported_at_its_begin_and_end() -> None:
    def frame(longest_s: float) -> FramePacket:
        increments = Increments(np.array([0.005, longest_s]), np.zeros((2, 3)), np.zeros((2, 3)))
        return replace(packet(), increments=increments)

    published, gaps_s = publisher(), (0.015, 0.03, 0.005, 0.25, 0.25, 0.05, 0.005, 0.005, 0.25)
    events = [published.without_state(frame(s), "").events for s in gaps_s]
    short, long = ("no IMU for 0.03 s",), ("no IMU for 0.25 s",)
    assert events == [(), short, (), long, (), (), ("IMU again after a gap of 0.55 s",), (), long]
