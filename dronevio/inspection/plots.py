"""Plots of an inspection. Each function draws into axes that it is given."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from dronevio.eval import colours
from dronevio.eval.report.figures import INK, set_log_scale
from dronevio.inspection.appearance import Appearance
from dronevio.inspection.inertial import VIBRATION_HZ, AllanDeviation, Spectrum
from dronevio.inspection.measured import Measured
from dronevio.inspection.offsets import OffsetCourse
from dronevio.inspection.relation import Relation, Rotations
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples, Times

MIN_WEIGHT = 0.2
"""Weight of a rotation of the images below which it is drawn as an outlier."""
_CURVE_POINTS = 1200


def draw_rotation(ax: Axes, measured: Measured, axis: int) -> None:
    """Draw the rate of rotation about an axis of the first camera: by the images, and by the gyroscope."""
    origin_ns = int(measured.recording.frame_times_ns[0])
    rotations, relation, gyroscope = measured.rotations, measured.relation, measured.gyroscope
    if relation is not None and gyroscope is not None:
        t_ns = np.linspace(rotations.start_ns[0], rotations.end_ns[-1], _CURVE_POINTS).astype(np.int64)
        half_ns = int(np.median(rotations.end_ns - rotations.start_ns)) // 2
        smooth = Rotations(t_ns - half_ns, t_ns + half_ns, np.zeros((len(t_ns), 3)))
        rates = np.degrees(relation.predicted(gyroscope.rates(smooth, relation.offset_s))[:, axis])
        ax.plot(
            (t_ns - origin_ns) * 1e-9, rates, color=colours.SIGMA, linewidth=1.6, label="gyroscope, moved and turned"
        )
    middle_s = (0.5 * (rotations.start_ns + rotations.end_ns) - origin_ns) * 1e-9
    rates = np.degrees(rotations.rate_rad_s[:, axis])
    sure = np.ones(len(rates), np.bool_) if relation is None else relation.weights > MIN_WEIGHT
    ax.plot(middle_s[~sure], rates[~sure], ".", color=colours.SURROUNDINGS, markersize=2.0, label="left out")
    ax.plot(middle_s[sure], rates[sure], ".", color=colours.ESTIMATE, markersize=3.0, label="images")
    low, high = np.percentile(rates, [1, 99]) if len(rates) else (-1.0, 1.0)
    margin = 0.3 * (high - low) + 1.0
    ax.set_ylim(low - margin, high + margin)
    ax.set(title=f"Rotation about {'xyz'[axis]} of the camera", xlabel="time [s]", ylabel="rate [°/s]")
    ax.margins(x=0.01)


def draw_offset_search(ax: Axes, relation: Relation, calibrated_s: float) -> None:
    """Draw the share of the rotation of the images that the gyroscope explains, at all offsets."""
    ax.plot(1e3 * relation.offsets_s, 100.0 * relation.curve, color=colours.SECOND)
    ax.axvline(1e3 * calibrated_s, color=INK, linewidth=0.8, linestyle="--", label="calibrated")
    ax.plot(
        1e3 * relation.offset_s, 100.0 * relation.agreement, "o", color=colours.ESTIMATE, markersize=5, label="found"
    )
    ax.set(title="Agreement by time offset", xlabel="offset of the images [ms]", ylabel="explained rotation [%]")
    ax.set_ylim(0.0, 104.0)


def draw_offset_course(ax: Axes, course: OffsetCourse) -> None:
    """Draw the offset in sections of the recording with 2σ bars."""
    ax.errorbar(
        course.t_s,
        1e3 * course.offset_s,
        2e3 * course.sigma_s,
        fmt="o",
        color=colours.ESTIMATE,
        markersize=4,
        capsize=2,
    )
    middle, reach = 1e3 * float(np.median(course.offset_s)), 1e3 * float(np.ptp(course.offset_s)) + 5.0
    ax.set_ylim(middle - reach, middle + reach)
    ax.set(title="Time offset over the recording", xlabel="time [s]", ylabel="offset [ms], ± 2σ")


def draw_imu(ax: Axes, imu: ImuSamples, values: Array, rest_ns: Sequence[tuple[int, int]], unit: str) -> None:
    """Draw the three axes of a sensor over time: means and extremes of short intervals, with the rest shaded."""
    origin_ns = int(imu.t_ns[0])
    for k, (a, b) in enumerate(rest_ns):
        ax.axvspan(
            (a - origin_ns) * 1e-9, (b - origin_ns) * 1e-9, color=colours.TRUTH, alpha=0.15, linewidth=0.0,
            label="at rest" if k == 0 else None,
        )  # fmt: skip
    step = max(1, len(imu) // 600)
    starts = np.arange(0, len(imu), step)
    seconds = (imu.t_ns[starts] - origin_ns) * 1e-9
    for axis, colour in enumerate(colours.AXES):
        low, high = (reduce.reduceat(values[:, axis], starts) for reduce in (np.minimum, np.maximum))
        mean = np.add.reduceat(values[:, axis], starts) / np.diff(np.append(starts, len(imu)))
        ax.fill_between(seconds, low, high, color=colour, alpha=0.25, linewidth=0.0)
        ax.plot(seconds, mean, color=colour, linewidth=0.9, label="xyz"[axis])
    title = "Gyroscope" if unit == "°/s" else "Accelerometer"
    ax.set(
        title=f"{title}: means and extremes",
        xlabel="time [s]",
        ylabel=f"{'rate' if unit == '°/s' else 'force'} [{unit}]",
    )
    ax.margins(x=0.01)


def draw_spectrum(ax: Axes, spectrum: Spectrum) -> None:
    """Draw the amplitude densities of accelerometer and gyroscope."""
    frequency = spectrum.frequency_hz[1:]
    accel, gyro = np.sqrt(spectrum.accel[1:]), np.sqrt(spectrum.gyro[1:])
    ax.plot(frequency, np.maximum(accel, 1e-9), color=colours.ESTIMATE, label="accelerometer [m/s²/√Hz]")
    ax.plot(frequency, np.maximum(gyro, 1e-9), color=colours.SECOND, label="gyroscope [rad/s/√Hz]")
    ax.axvspan(VIBRATION_HZ, frequency[-1], color=colours.SURROUNDINGS, alpha=0.12, linewidth=0.0, label="vibration")
    values = np.concatenate([accel, gyro])
    values = values[values > 0.0]
    set_log_scale(ax, "x", float(frequency[0]), float(frequency[-1]))
    if len(values):
        set_log_scale(ax, "y", 0.5 * float(values.min()), 2.0 * float(values.max()))
    ax.set(title="Spectrum of the IMU", xlabel="frequency [Hz]", ylabel="amplitude density")


def draw_allan(ax: Axes, allan: AllanDeviation) -> None:
    """Draw the Allan deviation of the longest rest."""
    for values, colour, label in (
        (allan.accel, colours.ESTIMATE, "accelerometer [m/s²]"),
        (allan.gyro, colours.SECOND, "gyroscope [rad/s]"),
    ):
        ax.plot(allan.tau_s, np.maximum(values, 1e-12), color=colour, marker=".", markersize=4, label=label)
    both = np.concatenate([allan.accel, allan.gyro])
    both = both[both > 0.0]
    set_log_scale(ax, "x", 0.8 * float(allan.tau_s[0]), 1.2 * float(allan.tau_s[-1]))
    if len(both):
        set_log_scale(ax, "y", 0.5 * float(both.min()), 2.0 * float(both.max()))
    ax.set(title="Allan deviation of the longest rest", xlabel="averaging time [s]", ylabel="deviation")


def draw_intervals(ax: Axes, frames_ns: Times, imu_ns: Times) -> None:
    """Draw the intervals between time stamps over time."""
    origin_ns = min(int(t[0]) for t in (frames_ns, imu_ns) if len(t))
    everything = []
    for t_ns, colour, label in ((frames_ns, colours.ESTIMATE, "images"), (imu_ns, colours.SECOND, "IMU")):
        if len(t_ns) < 2:
            continue
        intervals_ms = np.maximum(np.diff(t_ns) * 1e-6, 1e-3)
        seconds, step = (t_ns[1:] - origin_ns) * 1e-9, max(1, len(intervals_ms) // 1200)
        starts = np.arange(0, len(intervals_ms), step)
        for reduce in (np.minimum, np.maximum) if step > 1 else (np.maximum,):
            shown = reduce.reduceat(intervals_ms, starts)
            ax.plot(
                seconds[starts], shown, ".", color=colour, markersize=2.5, label=label if reduce is np.maximum else None
            )
        everything.append(intervals_ms)
    both = np.concatenate(everything)
    set_log_scale(ax, "y", 0.5 * float(both.min()), 2.0 * float(both.max()))
    ax.set(title="Intervals between time stamps", xlabel="time [s]", ylabel="interval [ms]")
    ax.margins(x=0.01)


def draw_appearance(
    ax: Axes, times_ns: Sequence[Sequence[int]], of: Sequence[Sequence[Appearance]], blur: bool
) -> None:
    """Draw the brightness or the blur of the images of each camera over time."""
    origin_ns = min(t[0] for t in times_ns if t)
    for k, (t_ns, values) in enumerate(zip(times_ns, of, strict=True)):
        if not values:
            continue
        seconds = (np.array(t_ns, dtype=np.int64) - origin_ns) * 1e-9
        colour = colours.ESTIMATORS[k % len(colours.ESTIMATORS)]
        if blur:
            ax.plot(
                seconds, [v.blur_px for v in values], ".-", color=colour, markersize=4, linewidth=0.7, label=f"cam{k}"
            )
            continue
        mean, spread = np.array([v.mean for v in values]), np.array([v.spread for v in values])
        ax.plot(seconds, mean, ".-", color=colour, markersize=4, linewidth=0.7, label=f"cam{k}, mean")
        ax.plot(seconds, spread, "--", color=colour, linewidth=0.9, label=f"cam{k}, contrast")
    ax.set_ylim(bottom=0.0)
    if blur:
        ax.set(title="Blur of edges", xlabel="time [s]", ylabel="width σ [px]")
    else:
        ax.set(title="Brightness of the images", xlabel="time [s]", ylabel="grey level")
        ax.set_ylim(0.0, 260.0)
