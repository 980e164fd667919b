"""Findings about what the reader of a recording had to repair."""

from collections.abc import Iterator, Sequence

from dronevio.inspection.measured import Measured
from dronevio.inspection.model import Finding, Topic, Verdict, graded
from dronevio.models.defects import Defect, DefectKind, count_defects, defects_of
from dronevio.models.protocols import Recording

MAX_SHARE = 0.2
"""Share of defective images or samples beyond which what is left is another recording."""
FEW = 0.005
"""Share of frames without IMU, at the ends of a recording, that costs nothing."""

_CLOCK_WORDS = ("clock", "segment", "stamp", "burst")
_JUDGED_ELSEWHERE = (DefectKind.IMU_GAP,)  # by its duration


def defect_findings(measured: Measured, source: Recording) -> Iterator[Finding]:
    """Yield a row for each kind of defect.

    Args:
        measured: The recording, or the segment of it that is inspected.
        source: The recording with its defects.
    """
    recording = measured.recording
    defects: Sequence[Defect] = (*defects_of(source), *measured.sample.defects)
    for each in count_defects(defects):
        if each.kind in _JUDGED_ELSEWHERE:
            continue
        name = str(each.kind)
        of_imu = "IMU" in name and each.kind is not DefectKind.FRAME_WITHOUT_IMU
        total = len(recording.imu) if of_imu else len(recording.frame_times_ns)
        share = each.count / max(total, 1)
        verdict = graded(share, FEW if each.kind is DefectKind.FRAME_WITHOUT_IMU else 0.0, MAX_SHARE)
        portion = f", {100 * share:.1f} %"
        if any(word in name for word in _CLOCK_WORDS):  # of several sensors, so that there is no share
            portion = ""
            topic, verdict = Topic.CLOCKS, Verdict.SUSPECT
        else:
            topic = Topic.IMU if of_imu else Topic.CAMERAS
        yield Finding(
            topic,
            name,
            float(each.count),
            verdict,
            f"{each.count}{portion} ({each.kind.treatment}); first: {each.first}",
            "none",
            "" if verdict is Verdict.GOOD else _advice(each.kind),
        )


def _advice(kind: DefectKind) -> str:
    """Return what to do about a kind of defect."""
    name = str(kind)
    if "unset" in name:
        return "let the driver set the stamp of the header; times of the log vary with the load of the computer"
    if "burst" in name:
        return "let the driver stamp each sample; sampling must be even for the samples to be spread right"
    if "clock" in name or "segment" in name:
        return "do not set the clock while recording; each segment is estimated by itself"
    if "unpaired" in name:
        return "trigger the cameras together; a frame then has the images of all"
    if "stamp" in name:
        return "look for a driver that repeats or delays messages"
    if kind is DefectKind.FRAME_WITHOUT_IMU:
        return "start the IMU before the cameras and stop it after them"
    return "copy the recording again, or look for a full disk"
