"""Findings about the motion: where the flight rests and how fast it turns."""

from collections.abc import Iterator, Sequence

import numpy as np

from dronevio.inspection.measured import Measured
from dronevio.inspection.model import Finding, Topic, Verdict
from dronevio.models.imu import Times


def motion_findings(measured: Measured, rest_ns: Sequence[tuple[int, int]]) -> Iterator[Finding]:
    """Yield the findings about the motion.

    Args:
        measured: The recording.
        rest_ns: Beginning and end of each interval of rest [ns].
    """
    imu = measured.recording.imu
    if len(imu) < 3:
        return
    start_ns, duration_s = int(imu.t_ns[0]), float(imu.t_ns[-1] - imu.t_ns[0]) * 1e-9
    total_s = sum(b - a for a, b in rest_ns) * 1e-9
    spans = ", ".join(f"{(a - start_ns) * 1e-9:.1f}–{(b - start_ns) * 1e-9:.1f} s" for a, b in rest_ns[:4])
    begins = bool(rest_ns) and _first_frame_ns(measured) >= rest_ns[0][0] and rest_ns[0][0] - start_ns < 1e9
    always = total_s > 0.95 * duration_s
    yield Finding(
        Topic.MOTION,
        "rest",
        total_s,
        Verdict.SUSPECT if always else Verdict.GOOD,
        (f"{total_s:.1f} of {duration_s:.1f} s: {spans}{' …' if len(rest_ns) > 4 else ''}" if rest_ns else "none")
        + ("; it begins at rest" if begins else "; it begins in motion"),
        "any: the odometry starts at rest or in motion",
        "the drone does not move: only a start at rest can be tried" if always else "",
    )
    bias = measured.relation.bias_rad_s if measured.relation is not None and measured.belongs else 0.0
    rate = np.degrees(np.linalg.norm(imu.gyro_rad_s - bias, axis=1))
    yield Finding(
        Topic.MOTION,
        "rotation",
        float(np.radians(np.median(rate))),
        Verdict.GOOD,
        f"{np.median(rate):.0f} °/s (median), {np.percentile(rate, 99):.0f} °/s (99 %)",
        "any",
    )


def _first_frame_ns(measured: Measured) -> int:
    t_ns: Times = measured.recording.frame_times_ns
    return int(t_ns[0]) if len(t_ns) else int(measured.recording.imu.t_ns[0])
