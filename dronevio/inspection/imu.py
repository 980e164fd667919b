"""Findings about the samples of the IMU and their time stamps."""

from collections.abc import Iterator, Sequence

import numpy as np

from dronevio.estimator.imu.outliers import outlying_samples
from dronevio.estimator.imu.saturation import MIN_ACCEL_RANGE_M_S2, MIN_GYRO_RANGE_RAD_S, SaturationDetector
from dronevio.inspection.inertial import (
    AXES,
    VIBRATION_HZ,
    AllanDeviation,
    Spectrum,
    mean_force_m_s2,
    spread_of_axes,
)
from dronevio.inspection.measured import Measured
from dronevio.inspection.model import Finding, Topic, Verdict, graded, more_severe
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, IMU_GAP_INTERVALS, ImuSamples

MIN_RATE_HZ = 50.0
"""At a lower rate, motion of 10 Hz, as fast as a small drone is, has fewer than five samples a period."""
MAX_RATE_RATIO = 1.2
"""Ratio of the calibrated to the measured rate above which samples are missing; below it, the clock is off."""
MAX_JITTER = 0.2
"""Jitter of the stamps relative to the interval; more is that of a bus or an operating system, not of the sensor."""
SUSPECT_GAP_S, WRONG_GAP_S = 0.1, 1.0
"""Over a gap, an acceleration of 1 m/s² that is not measured displaces by 5 mm after 0.1 s and by 0.5 m after 1 s."""
MAX_CLIPPED = 1e-3
"""Share of clipped samples beyond which the motion is often not measured."""
MAX_OUTLIERS = 1e-4
"""Share of outliers in a sound sensor; the tests for them fail about as often by chance."""
GRAVITY_TOLERANCE, UNIT_TOLERANCE = 0.06, 0.25
"""Relative deviation of the mean specific force from gravity: accelerometers err by less than the first, and beyond the
second the unit is not m/s²."""
MAX_RATE_RAD_S = 70.0
"""Rate of 4000 °/s, the range of the fastest gyroscopes [rad/s]."""
MAX_VIBRATION = 0.5
"""Amplitude of vibration relative to gravity: then a nonlinearity of 1 % shifts the mean by a bias of cm/s²."""
MAX_NOISE_RATIO = 30.0
"""Ratio of the noise at rest to the calibrated one up to which the odometry corrects the calibrated one by itself; with
running motors, 10 is usual."""
MIN_SPREAD_RATIO, MIN_SPREAD = 2.0, 0.5
"""Ratio, and difference [(m/s²)²], by which wrong axes increase the variance of the levelled specific force
over that with other axes. The acceleration of the vehicle is the same in both."""

_UNITS = {1.0: "g", 1e3: "mg", 32.2: "ft/s²", 981.0: "cm/s²"}
_NAMES = "xyz"


def imu_findings(
    measured: Measured, rest: Sequence[ImuSamples], spectrum: Spectrum | None, allan: AllanDeviation | None
) -> Iterator[Finding]:
    """Yield the findings about the IMU.

    Args:
        measured: The recording.
        rest: The samples of each interval of rest.
        spectrum: Spectrum of all samples.
        allan: Allan deviation of the longest rest.
    """
    imu = measured.recording.imu
    if len(imu) < 3:
        yield Finding(
            Topic.IMU, "samples", len(imu), Verdict.WRONG, f"{len(imu)} samples", "an IMU", "record its samples"
        )
        return
    yield from _stamps(measured)
    yield _clipping(imu)
    yield _outliers(measured)
    yield from _values(measured)
    yield _vibration(spectrum)
    yield _noise(measured, rest, allan)


def _stamps(measured: Measured) -> Iterator[Finding]:
    """Yield rate, gaps and jitter of the samples."""
    imu, nominal_hz = measured.recording.imu, measured.recording.rig.imu.rate_hz
    intervals_s = np.diff(imu.t_ns) * 1e-9
    median_s, mean_s = float(np.median(intervals_s)), float(intervals_s[intervals_s < 1.0].mean())
    rate = 1.0 / median_s
    ratio = nominal_hz / rate
    verdict = Verdict.GOOD if 1.0 / MAX_RATE_RATIO < ratio < MAX_RATE_RATIO else Verdict.SUSPECT
    left_out = f", 1 of {ratio:.0f} samples" if ratio > 1.5 else ""
    found = f"{rate:.1f} Hz"
    if verdict is Verdict.SUSPECT:
        found += f"; the calibration states {nominal_hz:g} Hz{left_out and ': only' + left_out[1:]}"
    if rate < MIN_RATE_HZ:
        verdict = Verdict.SUSPECT
    yield Finding(
        Topic.IMU,
        "rate",
        rate,
        verdict,
        found,
        f"the rate of the sensor, and {MIN_RATE_HZ:g} Hz or more, five samples a period of fast motion",
        ""
        if verdict is Verdict.GOOD
        else "record all samples: leaving some out folds vibration into the motion; else state the rate and its noise",
    )
    gaps = intervals_s > IMU_GAP_INTERVALS * median_s
    longest = float(intervals_s.max())
    verdict = graded(longest, max(SUSPECT_GAP_S, IMU_GAP_INTERVALS * median_s), WRONG_GAP_S)
    verdict = more_severe(verdict, graded(float(gaps.mean()), 0.01, 0.2))
    at_s = (imu.t_ns[int(np.argmax(intervals_s))] - imu.t_ns[0]) * 1e-9
    yield Finding(
        Topic.IMU,
        "gaps",
        longest,
        verdict,
        f"{int(gaps.sum())} gaps, the longest of {longest:.3f} s at {at_s:.1f} s" if gaps.any() else "none",
        f"none beyond {SUSPECT_GAP_S:g} s, in which 1 m/s² that is not measured displaces by 5 mm",
        "" if verdict is Verdict.GOOD else "look for dropped samples in the driver or the recorder",
    )
    even = intervals_s[~gaps]
    jitter = 1.4826 * float(np.median(np.abs(even - np.median(even)))) / median_s
    bursts = float(np.mean(intervals_s < 0.25 * mean_s))
    verdict = more_severe(graded(jitter, MAX_JITTER, 2.0), graded(bursts, 0.05, 2.0))
    yield Finding(
        Topic.IMU,
        "jitter",
        jitter * median_s,
        verdict,
        f"{1e3 * jitter * median_s:.2f} ms, {100 * jitter:.0f} % of the interval"
        + (f"; {100 * bursts:.0f} % of the samples come in bursts" if bursts > 0.05 else ""),
        f"less than {100 * MAX_JITTER:.0f} % of the interval: a sensor samples evenly",
        "" if verdict is Verdict.GOOD else "use the stamps of the sensor rather than those of the arrival",
    )


def _clipping(imu: ImuSamples) -> Finding:
    """Return whether readings are at the limit of the range."""
    clipped = np.zeros(len(imu), np.bool_)
    limits = []
    for values, least, unit in (
        (imu.gyro_rad_s, MIN_GYRO_RANGE_RAD_S, "rad/s"),
        (imu.accel_m_s2, MIN_ACCEL_RANGE_M_S2, "m/s²"),
    ):
        detector = SaturationDetector(np.inf, least)
        detector.update(values)
        if np.isfinite(detector.limit):
            clipped |= (detector.saturation_limits(values) > 0.0).any(axis=1)
            limits.append(f"{detector.limit:.4g} {unit}")
    share = float(clipped.mean())
    verdict = Verdict.GOOD if not share else graded(share, 0.0, 20.0 * MAX_CLIPPED)
    return Finding(
        Topic.IMU,
        "clipping",
        share,
        verdict,
        f"{int(clipped.sum())} samples are at the limit of the range, {' and '.join(limits)}" if share else "none",
        "none: where the sensor clips, the motion is not measured",
        "" if not share else "set a larger range, or mount the IMU on dampers",
    )


def _outliers(measured: Measured) -> Finding:
    """Return whether single readings are impossible."""
    imu = measured.recording.imu
    is_outlier = outlying_samples(imu, measured.recording.rig.imu)
    share = float(is_outlier.mean())
    # One of a short recording is no defect of the sensor, since the test errs, too.
    verdict = graded(share, max(MAX_OUTLIERS, 1.0 / len(imu)), 0.05)
    times = ", ".join(f"{t:.2f} s" for t in ((imu.t_ns[is_outlier] - imu.t_ns[0]) * 1e-9)[:3].tolist())
    return Finding(
        Topic.IMU,
        "outliers",
        share,
        verdict,
        f"{int(is_outlier.sum())} single readings that their neighbours contradict, at {times}"
        f"{' …' if is_outlier.sum() > 3 else ''}"
        if is_outlier.any()
        else "none",
        "none: a filtered sensor does not jump and return within a few samples",
        "" if verdict is Verdict.GOOD else "look for transfer errors on the bus; the odometry leaves the samples out",
    )


def _values(measured: Measured) -> Iterator[Finding]:
    """Yield units, gravity, unchanging axes and the axes of the accelerometer."""
    imu = measured.recording.imu
    gyro, force = (float(np.median(np.linalg.norm(v, axis=1))) for v in (imu.gyro_rad_s, imu.accel_m_s2))
    if abs(gyro - GRAVITY_M_S2) < 0.15 * GRAVITY_M_S2 and force < 0.4 * GRAVITY_M_S2:
        yield Finding(
            Topic.IMU,
            "units",
            gyro,
            Verdict.WRONG,
            f"the angular velocity has the magnitude of gravity, {gyro:.2f}, and the specific force is {force:.2f}",
            "angular velocity in rad/s and specific force in m/s²",
            "gyroscope and accelerometer are swapped: exchange their columns or topics",
        )
        return
    yield _dead_axes(imu)
    yield _gyroscope_unit(measured)
    bias = measured.relation.bias_rad_s if measured.relation is not None and measured.belongs else None
    sound = measured.belongs and measured.relation is not None and not measured.relation.is_reflected
    sound = sound and measured.relation is not None and 0.5 < measured.relation.scale < 2.0
    gravity = mean_force_m_s2(imu, bias) if sound and bias is not None else force
    deviation = abs(gravity / GRAVITY_M_S2 - 1.0)
    verdict = graded(deviation, GRAVITY_TOLERANCE, UNIT_TOLERANCE)
    unit = next((name for size, name in _UNITS.items() if abs(gravity / size - 1.0) < 0.1), None)
    yield Finding(
        Topic.IMU,
        "gravity",
        gravity,
        verdict,
        f"the mean specific force is {gravity:.3f} m/s²"
        + (f", as it is in {unit}" if unit and deviation > 0.2 else ""),
        f"{GRAVITY_M_S2} m/s² within {100 * GRAVITY_TOLERANCE:.0f} %, more than accelerometers err by",
        ""
        if verdict is Verdict.GOOD
        else f"the accelerometer is in {unit}: convert it to m/s²"
        if unit
        else "check the unit of the accelerometer, and whether gravity has been removed",
    )
    if not sound or bias is None:
        yield Finding(
            Topic.IMU,
            "axes of the accelerometer",
            None,
            Verdict.UNKNOWN,
            "the bias and the axes of the gyroscope are not known from the images",
            "those of the gyroscope",
        )
        return
    spread = spread_of_axes(imu, bias)
    # Of axes that agree about as well, those are stated that change least.
    near = np.flatnonzero(spread < 1.1 * spread.min())
    best = int(near[np.argmin([np.abs(AXES[k] - np.eye(3)).sum() for k in near])])
    ratio = float(spread[0] / max(spread[best], 1e-12))
    wrong = ratio > MIN_SPREAD_RATIO and spread[0] - spread[best] > MIN_SPREAD * (gravity / GRAVITY_M_S2) ** 2
    yield Finding(
        Topic.IMU,
        "axes of the accelerometer",
        ratio,
        Verdict.WRONG if wrong else Verdict.GOOD,
        f"gravity turns against the gyroscope; it would not with x, y, z = {_axes_text(AXES[best])}"
        if wrong
        else "gravity keeps its direction while the gyroscope turns",
        f"no other axes for which the levelled specific force varies {MIN_SPREAD_RATIO:g} times less",
        "exchange or reverse the axes of the accelerometer as stated" if wrong else "",
    )


def _dead_axes(imu: ImuSamples) -> Finding:
    """Return whether an axis never changes."""
    dead = [
        f"{sensor} {_NAMES[axis]}"
        for sensor, values in (("gyroscope", imu.gyro_rad_s), ("accelerometer", imu.accel_m_s2))
        for axis in range(3)
        if np.ptp(values[:, axis]) == 0.0
    ]
    return Finding(
        Topic.IMU,
        "axes",
        float(len(dead)),
        Verdict.WRONG if dead else Verdict.GOOD,
        f"{', '.join(dead)} never changes" if dead else "all six change",
        "noise on all six axes",
        "check the wiring, and the columns or fields that were recorded" if dead else "",
    )


def _gyroscope_unit(measured: Measured) -> Finding:
    """Return whether the gyroscope is in rad/s, by the images or else by what gyroscopes can measure."""
    largest = float(np.percentile(np.abs(measured.recording.imu.gyro_rad_s), 99.9))
    expected = "a rate that is that of the images, in rad/s"
    if measured.relation is not None and measured.belongs:
        scale = measured.relation.scale
        wrong = not 0.5 < scale < 2.0
        degrees = abs(np.log(scale / np.radians(1.0))) < 0.3
        found = f"the images turn {scale:.3f} times as fast as the gyroscope"
        advice = "the gyroscope is in degrees: convert it to rad/s" if degrees else "check the unit of the gyroscope"
        return Finding(
            Topic.IMU,
            "unit of the gyroscope",
            scale,
            Verdict.WRONG if wrong else Verdict.GOOD,
            found + (", as in °/s" if degrees else ""),
            expected,
            advice if wrong else "",
        )
    wrong = largest > MAX_RATE_RAD_S
    return Finding(
        Topic.IMU,
        "unit of the gyroscope",
        largest,
        Verdict.WRONG if wrong else Verdict.UNKNOWN,
        f"rates of up to {largest:.1f} rad/s",
        f"less than {MAX_RATE_RAD_S:g} rad/s, the range of the fastest gyroscopes",
        "the gyroscope is probably in degrees: convert it to rad/s" if wrong else "",
    )


def _vibration(spectrum: Spectrum | None) -> Finding:
    """Return how strongly the IMU vibrates."""
    expected = f"an amplitude below {MAX_VIBRATION:g} g above {VIBRATION_HZ:g} Hz, at which nonlinearity is no bias yet"
    if spectrum is None:
        return Finding(Topic.IMU, "vibration", None, Verdict.UNKNOWN, "too few samples for a spectrum", expected)
    gyro, accel, peak_hz = spectrum.vibration()
    verdict = graded(np.sqrt(2.0) * accel, MAX_VIBRATION * GRAVITY_M_S2, np.inf)
    return Finding(
        Topic.IMU,
        "vibration",
        accel,
        verdict,
        f"{accel:.2f} m/s² and {gyro:.3f} rad/s (r.m.s.), strongest at {peak_hz:.0f} Hz",
        expected,
        "" if verdict is Verdict.GOOD else "balance the propellers, and mount the IMU on dampers; expect less accuracy",
    )


def _noise(measured: Measured, rest: Sequence[ImuSamples], allan: AllanDeviation | None) -> Finding:
    """Return the noise at rest, compared with the calibrated one."""
    model = measured.recording.rig.imu
    expected = f"at most {MAX_NOISE_RATIO:g} times the calibrated densities, with the motors running"
    if allan is None:
        text = "the recording has no rest of a second" if not rest else "the rest is too short"
        return Finding(Topic.IMU, "noise at rest", None, Verdict.UNKNOWN, text, expected)
    gyro, accel = allan.density()
    ratios = [
        density / given
        for density, given in ((gyro, model.gyro_noise_density), (accel, model.accel_noise_density))
        if given
    ]
    ratio = max(ratios, default=1.0)
    verdict = graded(ratio, MAX_NOISE_RATIO, np.inf)
    return Finding(
        Topic.IMU,
        "noise at rest",
        ratio,
        verdict,
        f"{gyro:.2e} rad/s/√Hz and {accel:.2e} m/s²/√Hz over {sum(map(_duration_s, rest)):.1f} s, at most {ratio:.1f}"
        " times the calibrated ones",
        expected,
        "" if verdict is Verdict.GOOD else "state the noise densities of this sensor in the calibration",
    )


def _duration_s(imu: ImuSamples) -> float:
    return float(imu.t_ns[-1] - imu.t_ns[0]) * 1e-9


def _axes_text(axes: Array) -> str:
    """Return what the accelerometer's columns have to be, such as ``y, x, z``."""
    rows = [int(np.argmax(np.abs(row))) for row in axes]
    return ", ".join(("−" if axes[k, row] < 0.0 else "") + _NAMES[row] for k, row in enumerate(rows))
