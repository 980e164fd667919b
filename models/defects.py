"""Defects of recordings: what is missing, damaged or out of order, and how a reader goes on.

Recordings of real flights have frames that are listed and not there, images that cannot be decoded, and time stamps
that occur twice. A reader that goes on with such a recording lists each occurrence as a `Defect`, so that a user sees
what the result is based on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from dronevio.models.errors import InputError


class DefectKind(StrEnum):
    """Kind of a defect."""

    MISSING_IMAGE = "missing image"
    """An image is listed, and there is no such file."""
    DAMAGED_IMAGE = "damaged image"
    """An image cannot be decoded."""
    UNPAIRED_IMAGE = "unpaired image"
    """Not all cameras have an image at a time stamp."""
    DUPLICATE_IMAGE_STAMP = "duplicate image stamp"
    """A time stamp occurs twice in the list of images of a camera."""
    UNORDERED_IMAGE_STAMP = "unordered image stamp"
    """A time stamp is earlier than one before it in the list of images of a camera."""
    DUPLICATE_IMU_STAMP = "duplicate IMU stamp"
    """A time stamp occurs twice in the list of IMU samples."""
    UNORDERED_IMU_STAMP = "unordered IMU stamp"
    """A time stamp is earlier than one before it in the list of IMU samples."""
    NON_FINITE_IMU_SAMPLE = "non-finite IMU sample"
    """An IMU sample contains NaN or infinity."""
    IMU_GAP = "IMU gap"
    """The IMU has no samples for more than `IMU_GAP_INTERVALS` sampling intervals."""
    FRAME_WITHOUT_IMU = "frame without IMU"
    """A frame is earlier than the first IMU sample, or later than the last one."""

    CLOCK_STEP = "clock step"
    """The time stamps of all sensors fall by 0.1 s or more, or advance by more than 2 s."""
    LONE_CLOCK_STEP = "clock step of one sensor"
    """The time stamps of one sensor fall by 0.1 s or more, while those of the others go on."""
    UNUSABLE_SEGMENT = "unusable segment"
    """What is between two steps of the clock is not enough for a recording."""
    IMU_BURST = "burst of IMU samples"
    """Several IMU samples have one time stamp, as most in the recording have."""
    UNSET_STAMP = "unset time stamp"
    """The header of a message has the time stamp 0, or all messages of a topic have the same one."""

    @property
    def key(self) -> str:
        """Key in JSON documents, such as ``missing_image``."""
        return self.value.lower().replace(" ", "_").replace("-", "_")

    @property
    def treatment(self) -> str:
        """Treatment of the defect where a reader goes on, in the words of a warning."""
        return _TREATMENTS[self]


_TREATMENTS = {
    DefectKind.MISSING_IMAGE: "left out",
    DefectKind.DAMAGED_IMAGE: "left out",
    DefectKind.UNPAIRED_IMAGE: "the frame has the images of the other cameras",
    DefectKind.DUPLICATE_IMAGE_STAMP: "the first image is used",
    DefectKind.UNORDERED_IMAGE_STAMP: "images are sorted by time",
    DefectKind.DUPLICATE_IMU_STAMP: "the first sample is used",
    DefectKind.UNORDERED_IMU_STAMP: "samples are sorted by time",
    DefectKind.NON_FINITE_IMU_SAMPLE: "left out",
    DefectKind.IMU_GAP: "the last sample is held",
    DefectKind.FRAME_WITHOUT_IMU: "the motion of the frame is not measured",
    DefectKind.CLOCK_STEP: "a new segment begins",
    DefectKind.LONE_CLOCK_STEP: "undone",
    DefectKind.UNUSABLE_SEGMENT: "left out",
    DefectKind.IMU_BURST: "spread evenly over the time before it",
    DefectKind.UNSET_STAMP: "the time of the log is used",
}


@dataclass(frozen=True)
class Defect:
    """An occurrence of a defect."""

    kind: DefectKind
    """Kind of the defect."""
    t_ns: int
    """Time stamp of the image or the IMU sample [ns]."""
    description: str
    """Place and details, such as the file and its line."""


@dataclass(frozen=True)
class DefectCount:
    """All occurrences of one kind of defect in a recording."""

    kind: DefectKind
    """Kind of the defect."""
    count: int
    """Number of occurrences."""
    first: str
    """Description of the first occurrence."""

    def __str__(self) -> str:
        """Return a warning on one line."""
        return f"{self.count} × {self.kind} ({self.kind.treatment}); first: {self.first}"


def count_defects(defects: Sequence[Defect]) -> tuple[DefectCount, ...]:
    """Return the number and the first occurrence of each kind of defect, in the order of `DefectKind`."""
    counts: list[DefectCount] = []
    for kind in DefectKind:
        mine = [defect for defect in defects if defect.kind is kind]
        if mine:
            first = min(mine, key=lambda defect: defect.t_ns)
            counts.append(DefectCount(kind, len(mine), first.description))
    return tuple(counts)


def defect_values(defects: Sequence[Defect]) -> dict[str, object]:
    """Return number and first occurrence of each kind of defect as a JSON object; empty without defects."""
    return {each.kind.key: {"count": each.count, "first": each.first} for each in count_defects(defects)}


def defects_text(defects: Sequence[Defect]) -> str:
    """Return the numbers of defects on one line, such as ``3 × missing image, 1 × IMU gap``; empty without defects."""
    return ", ".join(f"{each.count} × {each.kind}" for each in count_defects(defects))


def refuse_defects(path: Path | str, defects: Sequence[Defect]) -> None:
    """Refuse a recording with defects.

    Args:
        path: The recording.
        defects: Its defects.

    Raises:
        InputError: There is a defect.
    """
    counts = count_defects(defects)
    if counts:
        found = f"{defects_text(defects)} (first {counts[0].kind}: {counts[0].first})"
        raise InputError(path, found, "a recording without defects")


def defects_of(recording: object) -> tuple[Defect, ...]:
    """Return the defects that were found when a recording was opened; none for one that does not list them."""
    defects: tuple[Defect, ...] = getattr(recording, "defects", ())
    return defects
