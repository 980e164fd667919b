"""One function decides the health of an estimate: the gravest of what is known comes first."""

from dataclasses import replace

import pytest

from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.health import Assessment, health_report
from dronevio.models.state import Health, HealthQuantities

CONFIG = HealthConfig()
EVERYTHING = Assessment(
    tracks=50,
    landmarks=CONFIG.min_landmarks - 1,
    inertial_only_s=CONFIG.settling_s + 0.1,
    loss=Reason.of(Cause.SPEED, speed_m_s=90.0),
    is_consistent=False,
    is_calibration_plausible=False,
    is_calibration_known=False,
    is_noise_aliased=True,
)


def test_the_gravest_cause_comes_first() -> None:
    """Where all of them hold, each is stated after those before it are removed."""
    assessment, causes = EVERYTHING, []
    for removed in (
        {},
        {"loss": None},
        {"is_calibration_plausible": True},
        {"is_calibration_known": True},
        {"is_consistent": True},
        {"landmarks": CONFIG.min_landmarks},
        {"is_noise_aliased": False},
        {"landmarks": 0, "stationary": True},
        {"stationary": False, "has_image": False, "inertial_only_s": CONFIG.settling_s},
        {"has_image": True},
    ):
        assessment = replace(assessment, **removed)
        report = health_report(assessment, CONFIG)
        causes.append((report.health, report.cause))
    assert causes == [
        (Health.LOST, Cause.SPEED),
        (Health.INERTIAL_ONLY, Cause.IMPLAUSIBLE_CALIBRATION),
        (Health.INERTIAL_ONLY, Cause.UNKNOWN_CALIBRATION),
        (Health.INERTIAL_ONLY, Cause.INCONSISTENT),
        (Health.INERTIAL_ONLY, Cause.FEW_LANDMARKS),
        (Health.INERTIAL_ONLY, Cause.EXCESSIVE_NOISE),
        (Health.TRACKING, Cause.LANDMARKS),
        (Health.TRACKING, Cause.STATIONARY),
        (Health.TRACKING, Cause.NO_IMAGE),
        (Health.TRACKING, Cause.NOT_TRIANGULATED),
    ]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"landmarks": 3}, "constrained by 3 landmarks; 8 are needed"),
        ({"landmarks": 12, "inertial_only_s": 0.0}, "constrained by 12 landmarks"),
        ({"has_image": False, "inertial_only_s": 0.25}, "no image for 0.25 s"),
        ({"loss": Reason.of(Cause.SPEED, speed_m_s=89.6)}, "a speed of 90 m/s"),
    ],
)
def test_texts_have_the_numbers_of_the_frame(changes: dict[str, object], text: str) -> None:
    known = {"landmarks": 0, "inertial_only_s": 9.0} | changes
    assert health_report(Assessment(**known), CONFIG).reason == text  # type: ignore[arg-type]


def test_a_stationary_vehicle_may_move_to_calibrate_itself() -> None:
    """An autopilot that waits for `tracking` would otherwise wait forever."""
    report = health_report(Assessment(is_calibration_known=False, stationary=True), CONFIG)
    assert (report.health, report.cause) == (Health.TRACKING, Cause.STATIONARY)


def test_few_tracks_with_an_image_are_not_settling() -> None:
    few = Assessment(tracks=CONFIG.min_landmarks - 1)
    assert health_report(few, CONFIG).cause is Cause.FEW_LANDMARKS
    assert health_report(replace(few, has_image=False), CONFIG).health is Health.TRACKING


def test_report_has_the_quantities_of_the_assessment() -> None:
    report = health_report(replace(EVERYTHING, innovation_px=1.5, bias_sigmas=0.2), CONFIG)
    assert report.quantities == HealthQuantities(
        tracks=50,
        landmarks=CONFIG.min_landmarks - 1,
        inertial_only_s=CONFIG.settling_s + 0.1,
        innovation_px=1.5,
        bias_sigmas=0.2,
    )
