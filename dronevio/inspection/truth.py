"""Findings about the ground truth: its rate, and its agreement with the gyroscope."""

from collections.abc import Iterator

import numpy as np

from dronevio.inspection.measured import BELONGS, Measured, angle_deg
from dronevio.inspection.model import Finding, Topic, Verdict, graded
from dronevio.inspection.relation import Rotations, relate
from dronevio.models.rotation import log_so3
from dronevio.models.state import Trajectory

PAIR_S = 0.1
"""Time over which the rotation of the ground truth is compared [s], so that its noise is small beside it."""
MAX_PAIRS = 600
"""Number of these rotations, spread over the recording."""
SUSPECT_OFFSET_S, WRONG_OFFSET_S = 0.01, 0.2
"""Offset at which a drone of 2 m/s is 2 cm elsewhere, the error of a good estimate, and one that is another clock."""
SUSPECT_ROTATION_DEG, WRONG_ROTATION_DEG = 5.0, 30.0
"""Rotation between the frames that a marker body on a drone explains, and one that is another convention [°]."""
MIN_RATE_HZ = 4.0
"""At a lower rate, interpolated positions of a drone that accelerates by 1 m/s² err by a centimetre."""
SIGMAS = 4.0
"""Number of standard deviations of a significant difference."""


def truth_findings(measured: Measured) -> Iterator[Finding]:
    """Yield the findings about the ground truth, none without one."""
    recording = measured.recording
    truth = recording.ground_truth
    if truth is None or len(truth) < 3:
        return
    intervals_s = np.diff(truth.t_ns) * 1e-9
    rate = 1.0 / float(np.median(intervals_s))
    frames = recording.frame_times_ns
    inside = float(np.mean((frames >= truth.t_ns[0]) & (frames <= truth.t_ns[-1]))) if len(frames) else 1.0
    verdict = (
        Verdict.WRONG if inside == 0.0 else Verdict.SUSPECT if inside < 0.5 or rate < MIN_RATE_HZ else Verdict.GOOD
    )
    yield Finding(
        Topic.TRUTH,
        "rate",
        rate,
        verdict,
        f"{rate:.1f} Hz over {truth.t_s[-1]:.1f} s and {truth.length_m:.1f} m, {100 * inside:.0f} % of the frames",
        f"{MIN_RATE_HZ:g} Hz or more, during half of the frames or more",
        "" if verdict is Verdict.GOOD else "check the clock of the ground truth; scores use the frames inside alone",
    )
    if measured.gyroscope is None:
        return
    expected = "that of the gyroscope, in its frame and on its clock"
    relation = relate(_rotations(truth), measured.gyroscope)
    if relation is None or relation.excitation_rad_s < 0.02:
        why = "too few poses" if relation is None else "the drone hardly turns"
        yield Finding(Topic.TRUTH, "rotation", None, Verdict.UNKNOWN, why, expected)
        return
    if relation.agreement < BELONGS:
        # Wrong axes or a wrong unit of the gyroscope agree up to a matrix, and are found by the images.
        yield Finding(
            Topic.TRUTH,
            "rotation",
            relation.agreement,
            Verdict.SUSPECT,
            f"the gyroscope explains {100 * max(relation.agreement, 0.0):.0f} % of it",
            expected,
            "the ground truth is of another flight or another body, or its orientations are in another order",
        )
        return
    difference_deg = angle_deg(relation.Q) if not relation.is_reflected else 180.0
    sigma_deg = float(np.degrees(relation.rotation_sigma_rad))
    certain = sigma_deg < 5.0 and not (0.5 < relation.proper_ratio < 2.0)
    verdict = Verdict.GOOD
    if certain:
        limit = max(SUSPECT_ROTATION_DEG, SIGMAS * sigma_deg)
        verdict = graded(difference_deg, limit, max(WRONG_ROTATION_DEG, limit))
    yield Finding(
        Topic.TRUTH,
        "rotation",
        float(np.radians(difference_deg)),
        verdict,
        f"the gyroscope explains {100 * relation.agreement:.1f} % of it"
        + (f", turned by {difference_deg:.1f} ± {sigma_deg:.1f}°" if certain else ""),
        expected,
        ""
        if verdict is Verdict.GOOD
        else "the ground truth is that of another body, or the gyroscope's axes are wrong",
    )
    offset_s = relation.offset_s
    verdict = graded(abs(offset_s), max(SUSPECT_OFFSET_S, SIGMAS * relation.offset_sigma_s), WRONG_OFFSET_S)
    yield Finding(
        Topic.TRUTH,
        "time offset",
        offset_s,
        verdict,
        f"{1e3 * offset_s:+.1f} ± {1e3 * relation.offset_sigma_s:.1f} ms to the IMU",
        f"less than {1e3 * SUSPECT_OFFSET_S:g} ms, 2 cm at 2 m/s",
        "" if verdict is Verdict.GOOD else f"shift the stamps of the ground truth by {offset_s:+.3f} s",
    )


def _rotations(truth: Trajectory) -> Rotations:
    """Return the mean rates of a ground truth over intervals of about `PAIR_S`."""
    step = max(1, round(PAIR_S / float(np.median(np.diff(truth.t_ns)) * 1e-9)))
    first = np.unique(np.linspace(0, max(len(truth) - 1 - step, 0), MAX_PAIRS).astype(int))
    last = np.minimum(first + step, len(truth) - 1)
    duration_s = (truth.t_ns[last] - truth.t_ns[first]) * 1e-9
    near = (duration_s > 0.0) & (duration_s < 5.0 * PAIR_S)
    R = truth.rotations
    phi = log_so3(np.swapaxes(R[first], 1, 2) @ R[last])
    return Rotations(truth.t_ns[first], truth.t_ns[last], phi / np.maximum(duration_s, 1e-9)[:, None])[near]
