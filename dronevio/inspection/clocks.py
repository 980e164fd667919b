"""Findings about the clocks of cameras and IMU: whether both measure the same motion, and at the same time."""

from collections.abc import Iterator

from dronevio.inspection.measured import BELONGS, Measured, calibrated_offset_s
from dronevio.inspection.model import Finding, Topic, Verdict, graded

MIN_ROTATION_RAD_S = 0.03
"""Rotation below which the error of the images, a tenth of a pixel in 50 ms, is a tenth of it [rad/s]."""
SUSPECT_OFFSET_S, WRONG_OFFSET_S = 0.005, 0.2
"""Offset that moves the image by two pixels at 1 rad/s, and an implausible one."""
SUSPECT_STEP_S = 0.003
"""Change of the offset that moves the image by a pixel at 1 rad/s."""
SIGMAS = 4.0
"""Number of standard deviations by which an offset must differ from the calibrated one."""


def clock_findings(measured: Measured) -> Iterator[Finding]:
    """Yield the findings about the clocks, none without images and IMU."""
    if measured.gyroscope is None or not len(measured.recording.frame_times_ns):
        return
    yield _belonging(measured)
    relation, course = measured.relation, measured.course
    stepped = course is not None and course.step_is_significant
    if relation is None or not (measured.belongs or stepped):
        yield _unknown("time offset", "the offset of the calibration")
        return
    calibrated_s = calibrated_offset_s(measured.recording)
    difference_s = abs(relation.offset_s - calibrated_s)
    verdict = graded(difference_s, max(SUSPECT_OFFSET_S, SIGMAS * relation.offset_sigma_s), WRONG_OFFSET_S)
    yield Finding(
        Topic.CLOCKS,
        "time offset",
        relation.offset_s,
        verdict,
        f"images are {_milliseconds(relation.offset_s)} ± {1e3 * relation.offset_sigma_s:.1f} ms against the IMU;"
        f" the calibration states {1e3 * calibrated_s:+.1f} ms",
        f"within {1e3 * SUSPECT_OFFSET_S:g} ms of the calibration, two pixels at 1 rad/s",
        "" if verdict is Verdict.GOOD else f"set the time offset (timeshift_cam_imu) to {relation.offset_s:+.4f} s",
    )
    if course is None:
        yield _unknown("steps and drift", "one offset for the whole recording", "too few sections with rotation")
        return
    yield Finding(
        Topic.CLOCKS,
        "steps of the offset",
        course.step_s if stepped else 0.0,
        graded(abs(course.step_s), SUSPECT_STEP_S, 0.05) if stepped else Verdict.GOOD,
        f"from {course.step_at_s:.1f} s on, the stamps of the images are {_milliseconds(course.step_s)}"
        if stepped
        else f"none in {len(course.t_s)} sections",
        "one offset for the whole recording",
        "record both on one clock, and do not set the clock while recording" if stepped else "",
    )
    duration_s = float(course.t_s[-1] - course.t_s[0])
    drifts = course.drift_is_significant and not stepped
    change_s = abs(course.drift) * duration_s
    yield Finding(
        Topic.CLOCKS,
        "drift of the offset",
        course.drift,
        Verdict.SUSPECT if drifts and change_s > SUSPECT_STEP_S else Verdict.GOOD,
        f"{1e6 * course.drift:+.0f} ± {1e6 * course.drift_sigma:.0f} ppm, {1e3 * change_s:.1f} ms in {duration_s:.0f} s"
        if drifts
        else f"none beyond the {1e6 * SIGMAS * course.drift_sigma:.0f} ppm that can be told"
        if not stepped
        else "not told beside a step",
        f"a change of less than {1e3 * SUSPECT_STEP_S:g} ms, a pixel at 1 rad/s",
        f"stamp both on one clock, or multiply the times of the images by {1.0 + course.drift:.6f}" if drifts else "",
    )


def _belonging(measured: Measured) -> Finding:
    """Return whether images and gyroscope measure the same rotation."""
    relation = measured.relation
    expected = f"{100 * BELONGS:.0f} % or more of the rotation of the images is that of the gyroscope, at some offset"
    name = "images and gyroscope"
    if relation is None or relation.excitation_rad_s < MIN_ROTATION_RAD_S:
        why = "too few images with features" if relation is None else "the drone hardly turns"
        return Finding(Topic.CLOCKS, name, None, Verdict.UNKNOWN, why, expected)
    if measured.belongs:
        found = f"the gyroscope explains {100 * relation.agreement:.1f} % of the rotation of the images"
        return Finding(Topic.CLOCKS, name, relation.agreement, Verdict.GOOD, found, expected)
    found = f"the gyroscope explains {100 * max(relation.agreement, 0.0):.0f} % of the rotation of the images"
    if measured.backwards > 0.8:
        found += f", and {100 * measured.backwards:.0f} % if the images are played backwards"
        advice = "the images are in reverse order: sort them by time"
    elif measured.course is not None and measured.course.step_is_significant:
        found += " at one offset; see the steps of the offset"
        advice = "see the steps of the offset"
        return Finding(Topic.CLOCKS, name, relation.agreement, Verdict.SUSPECT, found, expected, advice)
    else:
        advice = "images and IMU are of different flights, or their clocks differ by more than a second, or the lens is"
        advice += " another one"
    return Finding(Topic.CLOCKS, name, relation.agreement, Verdict.WRONG, found, expected, advice)


def _unknown(name: str, expected: str, why: str = "images and gyroscope do not agree") -> Finding:
    return Finding(Topic.CLOCKS, name, None, Verdict.UNKNOWN, why, expected)


def _milliseconds(offset_s: float) -> str:
    """Return an offset in words: t_imu = t_cam + offset, so that a positive one means early stamps of the images."""
    return f"{abs(1e3 * offset_s):.1f} ms {'early' if offset_s > 0.0 else 'late'}"
