"""The published estimates: states are withheld until their velocity is certain, and events describe the sensors."""

from dataclasses import replace

import numpy as np

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.initialization.initializer import InitializerConfig
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.health import Assessment
from dronevio.estimator.output import INCONSISTENT, MAX_CONTRADICTION_NS, MIN_CAUSE_NS, REPEATED_IMAGES, Publisher
from dronevio.estimator.types import NO_FEATURES, NO_MATCHES, FramePacket, Matches
from dronevio.models.state import Health, NavState

RATE_HZ = 200.0
TRACKED = Assessment(landmarks=50, innovation_px=1.0)
WAITING = Reason.of(Cause.NOT_OBSERVABLE, reason="")
TOO_FAST = Reason.of(Cause.SPEED, speed_m_s=99.0)


def state(velocity_sigma_m_s: float) -> NavState:
    """Return a state at 1 m/s with a standard deviation of the velocity."""
    covariance = 1e-8 * np.eye(15)
    covariance[6:9, 6:9] = velocity_sigma_m_s**2 * np.eye(3)
    return NavState(0, np.eye(4), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), covariance)


def packet(matched: tuple[int, ...] = (), miscalibrated: tuple[int, ...] = ()) -> FramePacket:
    """Return a frame with matches in the given cameras, and others that contradict the extrinsic calibration."""

    def matches_in(cameras: tuple[int, ...]) -> Matches:
        n = len(cameras)
        return Matches(np.arange(n), np.array(cameras), np.zeros((n, 2))) if n else NO_MATCHES

    observations = replace(NO_FEATURES, matches=matches_in(matched), miscalibrated=matches_in(miscalibrated))
    return FramePacket(0, NO_INCREMENTS, observations)


def new_publisher() -> Publisher:
    return Publisher(InitializerConfig(), HealthConfig(), RATE_HZ)


def test_miscalibration_and_its_end_are_reported_once() -> None:
    publisher = new_publisher()
    packets = [
        packet((1, 1)),
        packet((2,), (1, 1)),
        packet(),
        packet((), (1, 2)),
        packet((1, 1)),
        packet((1,)),
    ]
    events = [publisher.without_state(each, WAITING).events for each in packets]
    assert events == [
        (),
        ("camera 1 contradicts its calibration: not used for depth",),
        (),
        ("camera 2 contradicts its calibration: not used for depth",),
        ("camera 1 agrees with its calibration: used for depth",),
        (),
    ]


def test_nothing_is_published_before_it_is_certain() -> None:
    publisher = new_publisher()
    estimates = [publisher.estimate(packet(), state(s), TRACKED, ("keyframe",)) for s in (9.0, 0.051, 0.049, 9.0)]
    assert [each.state is None for each in estimates] == [True, True, False, False]
    assert estimates[0].health is Health.INITIALIZING and estimates[0].health_report is not None
    assert "1.00 ± 9.00 m/s" in estimates[0].health_report.reason
    assert [each.events for each in estimates[2:]] == [("initialized", "keyframe"), ("keyframe",)]
    lost = publisher.lost(packet(), TOO_FAST, TRACKED)
    assert lost.state is None and lost.events == ("lost: a speed of 99 m/s",)
    later = [publisher.estimate(packet(), state(s), TRACKED) for s in (1.0, 0.01)]
    assert later[0].state is None and later[0].health is Health.LOST
    assert later[1].events == ("recovered",)


def test_a_first_state_that_contradicts_the_images_is_held_back() -> None:
    """For as long as a search for the time offset takes; what agrees is published at once, and so is all after it."""
    contradicting = Assessment(landmarks=50, is_consistent=False)

    def published(publisher: Publisher, t_ns: int, assessment: Assessment) -> bool:
        found = publisher.estimate(replace(packet(), t_ns=t_ns), state(0.01), assessment)
        assert found.state is not None or (found.health_report and found.health_report.cause is Cause.CONTRADICTION)
        return found.state is not None

    agreeing, late = new_publisher(), new_publisher()
    assert not published(agreeing, -5, contradicting) and published(agreeing, 10**9, TRACKED)
    assert published(agreeing, 2 * 10**9, contradicting)
    assert not published(late, -5, contradicting) and not published(late, MAX_CONTRADICTION_NS - 6, contradicting)
    assert published(late, MAX_CONTRADICTION_NS - 5, contradicting)
    agreeing.lost(packet(), TOO_FAST, TRACKED)
    assert published(agreeing, 2 * 10**9 + 1, contradicting)  # after a loss, a pose is better than none


def test_a_first_state_with_aliased_vibration_is_published_with_the_cause() -> None:
    """Vibration is no contradiction of images and IMU, so that waiting for another time offset does not help."""
    estimate = new_publisher().estimate(packet(), state(0.01), replace(TRACKED, is_noise_aliased=True))
    assert estimate.state is not None and estimate.health is Health.INERTIAL_ONLY
    assert estimate.events == ("initialized", f"probable cause: {Cause.EXCESSIVE_NOISE}")


def test_repeated_images_and_outliers_are_stated() -> None:
    publisher = new_publisher()

    def events_at(t_s: float, *, repeats: bool, outliers: int = 0) -> tuple[str, ...]:
        at = replace(packet(), t_ns=round(t_s * 1e9), repeats_image=repeats, imu_outliers=outliers)
        return publisher.without_state(at, WAITING).events

    assert events_at(0.0, repeats=True) == (REPEATED_IMAGES,)
    assert events_at(0.5, repeats=False) == events_at(1.0, repeats=True) == events_at(2.0, repeats=True) == ()
    assert events_at(3.1, repeats=True, outliers=2) == (REPEATED_IMAGES, "2 outlying samples of the IMU: left out")


def test_cause_that_lasts_is_stated_once_for_each_cause() -> None:
    publisher, second = new_publisher(), 1_000_000_000

    def events_at(t_s: float, cause: Cause | None) -> tuple[str, ...]:
        at = replace(packet(), t_ns=round(t_s * second))
        return publisher.not_initialized(at, NotObservable("60% of the landmarks disagree", cause)).events

    axes, units = Cause.ROTATION_DISAGREES, Cause.FORCE_IS_NOT_GRAVITY
    a, b = (f"probable cause: {axes}",), (f"probable cause: {units}",)
    given = [(0.0, axes), (0.9, axes), (1.0, None), (1.1, axes), (1.2, axes), (1.3, units), (2.2, units)]
    assert [events_at(*each) for each in given] == [(), (), (), a, (), (), ()]
    assert (events_at(2.3, units), events_at(9.0, units)) == (b, ())


def test_accelerometer_is_not_stated_after_the_gyroscope() -> None:
    """That the accelerometer disagrees presumes that the gyroscope agrees; in the other order, both are stated."""
    for causes, count in (
        ((Cause.ROTATION_DISAGREES, Cause.ACCEL_DISAGREES), 1),
        ((Cause.ACCEL_DISAGREES, Cause.ROTATION_DISAGREES), 2),
    ):
        publisher, events = new_publisher(), list[str]()
        for k in range(8):
            at = replace(packet(), t_ns=k * MIN_CAUSE_NS)
            events += publisher.not_initialized(at, NotObservable("not yet", causes[k // 4])).events
        assert events == [f"probable cause: {cause}" for cause in causes[:count]]


def test_cause_does_not_last_over_an_initialization() -> None:
    publisher, obstacle = new_publisher(), NotObservable("60% of the landmarks disagree", Cause.ACCEL_DISAGREES)
    assert publisher.not_initialized(packet(), obstacle).events == ()
    publisher.estimate(packet(), state(0.0), TRACKED)
    later = [replace(packet(), t_ns=t_ns) for t_ns in (2 * MIN_CAUSE_NS, 3 * MIN_CAUSE_NS)]
    assert [publisher.not_initialized(each, obstacle).events for each in later] == [
        (),
        (f"probable cause: {Cause.ACCEL_DISAGREES}",),
    ]
    assert str(obstacle) == f"not observable yet: 60% of the landmarks disagree; {Cause.ACCEL_DISAGREES}"


def test_an_imu_gap_is_reported_at_its_begin_and_end() -> None:
    def packet_with_gap(gap_s: float) -> FramePacket:
        increments = Increments(np.array([0.005, gap_s]), np.zeros((2, 3)), np.zeros((2, 3)))
        return replace(packet(), increments=increments)

    publisher, gaps_s = new_publisher(), (0.015, 0.03, 0.005, 0.25, 0.25, 0.05, 0.005, 0.005, 0.25)
    events = [publisher.without_state(packet_with_gap(s), WAITING).events for s in gaps_s]
    short, long = ("no IMU for 0.03 s",), ("no IMU for 0.25 s",)
    assert events == [(), short, (), long, (), (), ("IMU again after a gap of 0.55 s",), (), long]


def test_inconsistency_is_an_event_of_its_own_and_few_landmarks_are_none() -> None:
    """Each time that an estimate is inconsistent for longer than a disturbance and as long again, and then once."""
    publisher, few = new_publisher(), replace(TRACKED, landmarks=2, inertial_only_s=9.0)
    contradicted = replace(TRACKED, is_consistent=False)
    disturbed = [contradicted] * 18  # 1.19 s at an interval of 70 ms
    assessments = [TRACKED, few, *disturbed, TRACKED, *disturbed, contradicted, contradicted, few, *disturbed]
    events = [
        publisher.estimate(replace(packet(), t_ns=70_000_000 * k), state(0.01), each).events
        for k, each in enumerate(assessments)
    ]
    assert [k for k, each in enumerate(events) if INCONSISTENT in each] == [2 + 18 + 1 + 18]
