"""Steps of the clock, and the segments of a recording between them.

The clock of a computer steps when it is set, for example by GPS or NTP in flight, when a driver restarts, or where two
recordings were joined. Behind a step nothing is known of the motion before it, so that each segment is a recording of
its own. A list whose rows are merely late has no step: its rows are sorted. Neither has a pause of one sensor, while
the others go on. Only what the streams have in common tells a step of the clock from these.

A stream whose stamps step back alone, while time goes on in the others, has a clock of its own, and its step is undone.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dronevio.models.defects import Defect, DefectKind
from dronevio.models.errors import InputError
from dronevio.models.imu import Times

if TYPE_CHECKING:
    from dronevio.models.protocols import Recording

Part = TypeVar("Part")
SomeRecording = TypeVar("SomeRecording", bound="Recording")

MIN_FALL_S = 0.1
"""Smallest fall of the time stamps from one row to the next that is a step [s]."""
MIN_ADVANCE_S = 2.0
"""A step forward exceeds this time [s]."""
MIN_ROWS = 3
"""Number of rows that go on from a step."""
MAX_OFFSET_S = 0.5
"""Largest difference of two clocks for which their steps are compared [s]."""
_MAX_FALLS = 0.05  # share of the rows; with more falls, a list has no order from which anything goes on


@dataclass(frozen=True)
class Step:
    """A step of the time stamps in a list."""

    row: int
    """Index of the first row after the step."""
    before_ns: int
    """Time stamp of the row before it [ns]."""
    after_ns: int
    """Time stamp of the first row after it [ns]."""
    interval_ns: int
    """Median interval of the rows [ns]."""

    @property
    def change_ns(self) -> int:
        """Difference of the first stamp to that of a clock that runs on: negative for a step back [ns]."""
        return self.after_ns - self.before_ns - self.interval_ns

    @property
    def is_fall(self) -> bool:
        """Whether it is a step back."""
        return self.after_ns < self.before_ns

    def __str__(self) -> str:
        """Return the stamps and the size of the step."""
        return f"{self.after_ns} ns after {self.before_ns} ns ({self.change_ns * 1e-9:+.3f} s)"


@dataclass(frozen=True, eq=False)
class Split:
    """The time stamps of several streams, split where all of them step."""

    stamps: tuple[Times, ...]
    """(N,) Time stamps of each stream in the order of its rows, in which steps of one stream alone are undone [ns]."""
    steps: tuple[tuple[Step, ...], ...]
    """The steps that all streams have in common: for each of them, its step in each stream."""
    lone: tuple[tuple[Step, ...], ...]
    """The steps of each stream that were undone."""

    def defects(self, segment: int, places: Sequence[Callable[[int], str]]) -> tuple[Defect, ...]:
        """Return the step at the end of a segment, and the steps of one stream alone that were undone in it.

        Args:
            segment: Index of the segment.
            places: For each stream, a function that returns the place of a row.
        """
        defects = []
        for stream, steps in enumerate(self.lone):
            rows = self.rows(stream)[segment]
            defects += [
                Defect(DefectKind.LONE_CLOCK_STEP, step.before_ns, f"{places[stream](step.row)}: {step}")
                for step in steps
                if rows.start <= step.row < rows.stop
            ]
        if segment < len(self.steps):
            step, *others = zip(self.steps[segment], places, strict=True)
            also = "".join(f"; {place(other.row)}" for other, place in others)
            defects.append(Defect(DefectKind.CLOCK_STEP, step[0].before_ns, f"{step[1](step[0].row)}: {step[0]}{also}"))
        return tuple(defects)

    def rows(self, stream: int) -> tuple[slice, ...]:
        """Return the rows of a stream in each segment; there is one more segment than steps."""
        return _between([step[stream].row for step in self.steps], len(self.stamps[stream]))


def split_at_steps(streams: Sequence[Times], offsets_ns: Sequence[int] | None = None) -> Split:
    """Split streams of time stamps at the steps that they have in common.

    Args:
        streams: (N,) Time stamps of each stream in the order of its rows, for example of the IMU and of each camera.
        offsets_ns: What is added to the stamps of each stream to compare them; 0 by default [ns].
    """
    offsets = [0] * len(streams) if offsets_ns is None else list(offsets_ns)
    steps_of = [clock_steps(t_ns) for t_ns in streams]
    steps = common_steps(steps_of, offsets)
    stamps, lone = [], []
    for stream, t_ns in enumerate(streams):
        shared = [step[stream] for step in steps]
        falls = [step for step in steps_of[stream] if step.is_fall and step not in shared]
        undone, kept = _without(t_ns, falls, _between([step.row for step in shared], len(t_ns)))
        stamps.append(undone)
        lone.append(kept)
    return Split(tuple(stamps), steps, tuple(lone))


def clock_steps(t_ns: Times) -> tuple[Step, ...]:
    """Return the steps of a stream.

    The time stamps fall by `MIN_FALL_S` or more from one row to the next, or advance by more than `MIN_ADVANCE_S`, and
    `MIN_ROWS` rows go on from there. A row that is late, or far ahead, is no step: the rows next to it undo its
    difference by at least half.

    Args:
        t_ns: (N,) Time stamps in the order of the rows [ns].
    """
    changes = np.diff(t_ns)
    advances = changes[changes > 0]
    if not len(advances):
        return ()
    interval_ns = int(np.median(advances))
    is_fall = changes <= -round(MIN_FALL_S * 1e9)
    if is_fall.sum() > max(1.0, _MAX_FALLS * len(t_ns)):
        return ()
    steps: list[Step] = []
    for before in np.flatnonzero(is_fall | (changes > round(MIN_ADVANCE_S * 1e9))).tolist():
        row = before + 1
        neighbours = np.abs(np.concatenate([changes[max(before - 2, 0) : before], changes[row : row + MIN_ROWS - 1]]))
        goes_on = bool((neighbours < interval_ns + 0.5 * abs(int(changes[before]))).all())
        if goes_on and len(t_ns) - row >= MIN_ROWS:
            steps.append(Step(row, int(t_ns[before]), int(t_ns[row]), interval_ns))
    return tuple(steps)


def common_steps(streams: Sequence[Sequence[Step]], offsets_ns: Sequence[int]) -> tuple[tuple[Step, ...], ...]:
    """Return the steps that all streams have, in their order: for each of them, its step in each stream.

    Steps are the same if they have the same direction, and the times that they repeat, or leave out, overlap by more
    than half of the shorter one; clocks may differ by `MAX_OFFSET_S`.

    Args:
        streams: Steps of each stream.
        offsets_ns: What is added to the stamps of each stream to compare them [ns].
    """
    common: list[tuple[Step, ...]] = []
    used = [-1] * len(streams)
    for step in streams[0]:
        partners = [
            next(
                (k for k in range(after + 1, len(steps)) if _same(step, steps[k], offset_ns - offsets_ns[0])),
                None,
            )
            for steps, after, offset_ns in zip(streams, used, offsets_ns, strict=True)
        ]
        chosen = [k for k in partners if k is not None]
        if len(chosen) == len(streams):
            used = chosen
            common.append(tuple(steps[k] for steps, k in zip(streams, chosen, strict=True)))
    return tuple(common)


def usable_segments(count: int, read: Callable[[int], Part]) -> Iterator[tuple[Part, tuple[Defect, ...]]]:
    """Yield the segments that can be read, each with the defects of those before it that cannot.

    Args:
        count: Number of segments.
        read: Returns the segment of an index, or raises InputError.

    Raises:
        InputError: No segment can be read.
    """
    left_out: list[Defect] = []
    first: InputError | None = None
    any_read = False
    for index in range(count):
        try:
            part = read(index)
        except InputError as error:
            first = first or error
            left_out.append(Defect(DefectKind.UNUSABLE_SEGMENT, 0, f"segment {index + 1} of {count}: {error}"))
            continue
        yield part, tuple(left_out)
        left_out, any_read = [], True
    if not any_read and first is not None:
        raise first


def segment_name(name: str, number: int, count: int) -> str:
    """Return the name of a segment, counted from 1, of a recording; that of the recording if it is the only one."""
    return name if count == 1 else f"{name}, segment {number} of {count}"


def segments_of(recording: SomeRecording) -> tuple[SomeRecording, ...]:
    """Return the segments of a recording, each without later ones: itself, and those after steps of its clock."""
    later: tuple[SomeRecording, ...] = getattr(recording, "later", ())
    return (replace(recording, later=()), *later) if later else (recording,)  # type: ignore[type-var]


def most_common(times: Sequence[Times], t_ns: Times) -> int:
    """Return the index of the segment whose frames have the most of some time stamps; of equal ones the first.

    Args:
        times: (M,) Time stamps of the frames of each segment [ns].
        t_ns: (N,) Time stamps of poses [ns].
    """
    return int(np.argmax([np.isin(t_ns, frames).sum() for frames in times]))


def _same(one: Step, other: Step, offset_ns: int) -> bool:
    """Return whether two streams have a step in common; the offset is added to the stamps of the other one."""
    if one.is_fall != other.is_fall:
        return False
    first, last = sorted((one.before_ns, one.after_ns))
    other_first, other_last = sorted((other.before_ns + offset_ns, other.after_ns + offset_ns))
    overlap_ns = min(last, other_last) - max(first, other_first)
    return overlap_ns + MAX_OFFSET_S * 1e9 > 0.5 * min(last - first, other_last - other_first)


def _between(rows: Sequence[int], count: int) -> tuple[slice, ...]:
    """Return the slices of ``count`` rows that begin at the first row and at the given ones."""
    edges = [0, *rows, count]
    return tuple(slice(start, end) for start, end in pairwise(edges))


def _without(t_ns: Times, falls: Sequence[Step], segments: Sequence[slice]) -> tuple[Times, tuple[Step, ...]]:
    """Return the stamps (N,) of a stream in which falls are undone that repeat time, and these falls.

    Behind such a fall, the rows of its segment go on one interval after the row before it. Falls into a gap are rows
    that were written late.
    """
    undone, kept = t_ns.copy(), []
    for step in falls:
        segment = next(each for each in segments if each.start <= step.row < each.stop)
        last_ns = min(step.before_ns, int(t_ns[step.row : segment.stop].max()))
        rows = np.sum((t_ns[segment] >= step.after_ns) & (t_ns[segment] <= last_ns))
        if rows > 1.5 * ((last_ns - step.after_ns) / step.interval_ns + 1.0):  # 2 if they were there before, else 1
            undone[step.row : segment.stop] -= step.change_ns
            kept.append(step)
    return undone, tuple(kept)
