"""The segments of a folder: images grouped to frames and IMU samples in the order of time, with their defects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.defects import Defect
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.recordings.exported import increments_of_means
from dronevio.models.recordings.folder_contents import FolderContents
from dronevio.models.recordings.frame_groups import ABSENT, FrameGroups, grouped_frames
from dronevio.models.recordings.image_list import ImageList
from dronevio.models.recordings.repair import imu_defects, repaired_samples, unpaired_images
from dronevio.models.recordings.segments import split_at_steps, usable_segments
from dronevio.models.recordings.timed_table import TimedTable, check_table
from dronevio.models.rig import Rig


@dataclass(frozen=True, eq=False)
class SegmentFrames:
    """The frames of a segment."""

    t_ns: Times
    """(M,) Time stamps [ns]."""
    files: tuple[tuple[Path | None, ...], ...]
    """M image files of each camera, None where it has none."""
    delays_ns: Times
    """(M, C) How much later than its frame each image is stamped [ns]."""
    defects: tuple[Defect, ...] = ()
    """Defects of the images."""


@dataclass(frozen=True, eq=False)
class FolderSegment:
    """What a folder holds of one segment."""

    frames: SegmentFrames
    """The frames of the segment."""
    imu: ImuSamples
    """The IMU samples of the segment."""
    defects: tuple[Defect, ...] = ()
    """The defects of both."""


def strict_segments(contents: FolderContents) -> tuple[FolderSegment, ...]:
    """Return the only segment of a folder without defects.

    Raises:
        InputError: There is a defect.
    """
    frames = _strict_frames(contents.folder, contents.lists, contents.complete, contents.rig)
    if len(contents.imu.t_ns):
        check_table(contents.imu, contents.imu_form)
    return (FolderSegment(frames, _sampled(contents, point_samples(contents.imu.t_ns, contents.imu.values))),)


def repaired_segments(contents: FolderContents) -> tuple[FolderSegment, ...]:
    """Return the segments of a folder, one or more, with their defects.

    Raises:
        InputError: There is no IMU, or no segment has frames and IMU samples of the same time.
    """
    table, mav0, rig = contents.imu, contents.folder, contents.rig
    if not len(table.t_ns):
        raise InputError(mav0, "no IMU", "a recording with an IMU; dronevio sfm needs none")
    offsets_ns = [0, *(round((rig.time_offset_s + camera.time_offset_s) * 1e9) for camera in rig.cameras)]
    split = split_at_steps([table.t_ns, *(each.t_ns for each in contents.lists)], offsets_ns)
    table = replace(table, t_ns=split.stamps[0])
    lists = [replace(each, t_ns=t_ns) for each, t_ns in zip(contents.lists, split.stamps[1:], strict=True)]

    def part(segment: int) -> FolderSegment:
        rows = [np.arange(len(t_ns))[split.rows(k)[segment]] for k, t_ns in enumerate(split.stamps)]
        chosen = [each.selected(of) for each, of in zip(lists, rows[1:], strict=True)]
        frames = _repaired_frames(mav0, chosen, contents.complete, rig)
        imu, defects = _repaired_imu(table.selected(rows[0]))
        late = imu_defects(imu, frames.t_ns, rig.time_offset_s, mav0)
        steps = split.defects(segment, [table.place, *(each.place for each in lists)])
        return FolderSegment(
            replace(frames, defects=()), _sampled(contents, imu), (*frames.defects, *defects, *late, *steps)
        )

    return tuple(
        replace(usable, defects=(*left_out, *usable.defects))
        for usable, left_out in usable_segments(len(split.steps) + 1, part)
    )


def _sampled(contents: FolderContents, imu: ImuSamples) -> ImuSamples:
    """Return the IMU samples of a folder as the values that its calibration says they are."""
    return increments_of_means(imu) if contents.sampling == "increment" else imu


def point_samples(t_ns: Times, values: Array) -> ImuSamples:
    """Return point samples of time stamps (N,) [ns], angular velocities [rad/s] and specific forces [m/s²] (N, 6)."""
    return ImuSamples(t_ns, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]), "point")


def _strict_frames(mav0: Path, lists: Sequence[ImageList], complete: bool, rig: Rig) -> SegmentFrames:
    """Return the frames for which every camera has an image, or raise InputError if time stamps do not increase."""
    checked = [each.check() for each in lists]
    if not complete:
        checked = [each.selected(each.existing()) for each in checked]
    return _complete_frames(mav0, checked, complete, rig)


def _groups(lists: Sequence[ImageList], rig: Rig) -> FrameGroups:
    """Return the images of each frame."""
    return grouped_frames([each.t_ns for each in lists], [camera.time_offset_s for camera in rig.cameras])


def _complete_frames(mav0: Path, lists: Sequence[ImageList], complete: bool, rig: Rig) -> SegmentFrames:
    """Return the frames for which every camera has an image, or raise InputError if there is none."""
    groups = _groups(lists, rig)
    groups = groups[groups.is_complete]
    if not len(groups.t_ns) and not complete:
        raise InputError(mav0, "an incomplete recording without frames", "at least one frame")
    _require_frames(mav0, groups)
    files = tuple(each.selected(of).files for each, of in zip(lists, groups.rows.T, strict=True))
    return SegmentFrames(groups.t_ns, files, groups.delays_ns)


def _require_frames(mav0: Path, groups: FrameGroups) -> None:
    """Raise InputError if no frame has an image of every camera."""
    if not groups.is_complete.any():
        found = f"{groups.rows.shape[1]} cameras without a time stamp in common, or any close to one another"
        raise InputError(mav0, found, "cameras of one clock that record at the same time")


def _repaired_frames(mav0: Path, lists: Sequence[ImageList], complete: bool, rig: Rig) -> SegmentFrames:
    """Return the frames for which at least one camera has an image, with their defects.

    The images that an interrupted recording lacks are not defects; it has the frames with an image of every camera.

    Raises:
        InputError: A camera has no image, or no frame has an image of each camera.
    """
    ordered = [each.ordered() for each in lists]
    lists, defects = [each for each, _ in ordered], tuple(defect for _, of_list in ordered for defect in of_list)
    existing = [each.existing() for each in lists]
    if not complete:
        kept = [each.selected(exists) for each, exists in zip(lists, existing, strict=True)]
        return replace(_complete_frames(mav0, kept, complete, rig), defects=defects)
    for each, exists in zip(lists, existing, strict=True):
        if not exists.any():
            raise InputError(each.path, f"{len(exists)} images, none of which exists", "the images in the folder data")
    groups = _groups(lists, rig)
    _require_frames(mav0, groups)
    t_ns, rows = groups.t_ns, groups.rows
    has_image = np.stack([exists[of] & (of != ABSENT) for exists, of in zip(existing, rows.T, strict=True)], axis=1)
    seen = has_image.any(axis=1)
    files = tuple(
        tuple(each.files[row] if present else None for row, present in zip(of.tolist(), has.tolist(), strict=True))
        for each, of, has in zip(lists, rows[seen].T, has_image[seen].T, strict=True)
    )
    names = [each.path.parent.name for each in lists]
    defects = (
        *defects,
        *(defect for each in lists for defect in each.missing()),
        *unpaired_images(t_ns[seen], rows[seen], names),
    )
    return SegmentFrames(t_ns[seen], files, groups.delays_ns[seen], defects)


def _repaired_imu(table: TimedTable) -> tuple[ImuSamples, tuple[Defect, ...]]:
    """Return the samples of an IMU table as point samples in the order of time, and the defects.

    Raises:
        InputError: No sample is finite.
    """
    t_ns, rows, defects = repaired_samples(
        table.t_ns, table.values, lambda row: f"{table.place(row)}: sample at {table.t_ns[row]} ns"
    )
    if not len(rows):
        raise InputError(table.path, f"{len(table.t_ns)} samples, none of which is finite", "finite numbers")
    return point_samples(t_ns, table.values[rows]), defects
