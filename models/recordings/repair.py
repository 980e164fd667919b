"""Detection of the defects of a recording, and repair of its time stamps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.defects import Defect, DefectKind
from dronevio.models.errors import InputError
from dronevio.models.imu import IMU_GAP_INTERVALS, ImuSamples, Times
from dronevio.models.protocols import MAX_WAIT_INTERVALS
from dronevio.models.recordings.bursts import spread_bursts
from dronevio.models.recordings.frame_groups import ABSENT

Rows = npt.NDArray[np.int64]
Describe = Callable[[int], str]
"""Function that returns the place of a row, such as its file and line."""


@dataclass(frozen=True)
class StampKinds:
    """Kinds of defects of the time stamps in a list."""

    duplicate: DefectKind
    """Kind of a time stamp that occurs again."""
    unordered: DefectKind
    """Kind of a time stamp that is earlier than one before it."""


IMAGE_STAMPS = StampKinds(DefectKind.DUPLICATE_IMAGE_STAMP, DefectKind.UNORDERED_IMAGE_STAMP)
"""Kinds of defects of the time stamps of images."""
IMU_STAMPS = StampKinds(DefectKind.DUPLICATE_IMU_STAMP, DefectKind.UNORDERED_IMU_STAMP)
"""Kinds of defects of the time stamps of IMU samples."""


def increasing_rows(t_ns: Times, kinds: StampKinds, describe: Describe) -> tuple[Rows, tuple[Defect, ...]]:
    """Return the rows of a list in the order of time, the first of each time stamp, and the defects.

    Args:
        t_ns: (N,) Time stamps in the order of the list [ns].
        kinds: Kinds of the defects.
        describe: Returns the place of a row.

    Returns:
        The indices (K,) of rows with increasing time stamps, and the defects in the order of the list. Duplicates do
        not count as unordered.
    """
    order = np.argsort(t_ns, kind="stable")
    is_first = np.concatenate([[True], np.diff(t_ns[order]) > 0]) if len(t_ns) else np.zeros(0, np.bool_)
    is_duplicate = np.zeros(len(t_ns), np.bool_)
    is_duplicate[order[~is_first]] = True
    is_unordered = (t_ns < np.maximum.accumulate(t_ns)) & ~is_duplicate if len(t_ns) else is_duplicate
    defects = [
        Defect(kinds.duplicate if is_duplicate[row] else kinds.unordered, int(t_ns[row]), describe(row))
        for row in np.flatnonzero(is_duplicate | is_unordered).tolist()
    ]
    return order[is_first], tuple(defects)


def finite_rows(t_ns: Times, values: npt.NDArray[np.float64], describe: Describe) -> tuple[Rows, tuple[Defect, ...]]:
    """Return the rows (K,) of IMU samples (N, 6) whose values are finite, and the defects.

    Args:
        t_ns: (N,) Time stamps [ns].
        values: (N, 6) Angular velocities and specific forces.
        describe: Returns the place of a row.
    """
    is_finite = np.isfinite(values).all(axis=1)
    defects = [
        Defect(DefectKind.NON_FINITE_IMU_SAMPLE, int(t_ns[row]), describe(row))
        for row in np.flatnonzero(~is_finite).tolist()
    ]
    return np.flatnonzero(is_finite), tuple(defects)


def repaired_samples(
    t_ns: Times, values: npt.NDArray[np.float64], describe: Describe
) -> tuple[Times, Rows, tuple[Defect, ...]]:
    """Return what a reader makes of the rows of an IMU: finite samples in the order of time, with bursts spread.

    Args:
        t_ns: (N,) Time stamps in the order of the rows [ns].
        values: (N, 6) Angular velocities and specific forces.
        describe: Returns the place of a row.

    Returns:
        Increasing time stamps (K,) [ns], the row (K,) of each sample, and the defects.
    """
    finite, not_finite = finite_rows(t_ns, values, describe)
    spread, bursts = spread_bursts(t_ns[finite], values[finite])
    spread_rows = finite[bursts].tolist()
    defects = (*not_finite, *(Defect(DefectKind.IMU_BURST, int(t_ns[row]), describe(row)) for row in spread_rows))
    increasing, unordered = increasing_rows(spread, IMU_STAMPS, lambda row: describe(int(finite[row])))
    return spread[increasing], finite[increasing], (*defects, *unordered)


def unpaired_images(times_ns: Times, rows: Rows, names: Sequence[str]) -> tuple[Defect, ...]:
    """Return the defects of frames (M,) that lack the image of a camera.

    Args:
        times_ns: (M,) Time stamps of the frames [ns].
        rows: (M, C) Index of each image, `ABSENT` where a camera has none.
        names: Names of the C cameras.
    """
    lacking = np.flatnonzero((rows == ABSENT).any(axis=1))
    return tuple(
        Defect(DefectKind.UNPAIRED_IMAGE, int(times_ns[k]), f"no image of {absent} at {times_ns[k]} ns")
        for k in lacking.tolist()
        for absent in [" and ".join(name for name, row in zip(names, rows[k], strict=True) if row == ABSENT)]
    )


def imu_defects(imu: ImuSamples, frame_times_ns: Times, time_offset_s: float, path: Path) -> tuple[Defect, ...]:
    """Return the gaps of an IMU, and the frames without IMU.

    Args:
        imu: The samples.
        frame_times_ns: (M,) Time stamps of the frames, M > 0 [ns].
        time_offset_s: Time offset of the camera clock: t_imu = t_cam + offset [s].
        path: The recording, for the error message.

    Raises:
        InputError: The IMU and the cameras do not overlap in time.
    """
    intervals_ns = np.diff(imu.t_ns)
    interval_ns = float(np.median(intervals_ns)) if len(intervals_ns) else 0.0
    gaps = [
        Defect(
            DefectKind.IMU_GAP,
            int(imu.t_ns[row]),
            f"no IMU sample for {intervals_ns[row] * 1e-9:.3f} s after {imu.t_ns[row]} ns",
        )
        for row in np.flatnonzero(intervals_ns > IMU_GAP_INTERVALS * interval_ns).tolist()
        if interval_ns > 0.0
    ]
    t_ns, tolerance_ns = frame_times_ns + round(time_offset_s * 1e9), round(MAX_WAIT_INTERVALS * interval_ns)
    first_ns, last_ns = int(imu.t_ns[0]), int(imu.t_ns[-1])
    is_outside = (t_ns < first_ns - tolerance_ns) | (t_ns > last_ns + tolerance_ns)
    if is_outside.all():
        found = f"IMU and camera do not overlap: IMU from {_span(imu.t_ns)}, camera from {_span(t_ns)}"
        raise InputError(path, found, "measurements of the same time on one clock")
    lacking = [
        Defect(DefectKind.FRAME_WITHOUT_IMU, int(frame_times_ns[k]), _distance(int(t_ns[k]), first_ns, last_ns))
        for k in np.flatnonzero(is_outside).tolist()
    ]
    return (*gaps, *lacking)


def _span(t_ns: Times) -> str:
    """Return the first and the last of some times as text."""
    return f"{t_ns[0] * 1e-9:.3f} to {t_ns[-1] * 1e-9:.3f} s"


def _distance(t_ns: int, first_ns: int, last_ns: int) -> str:
    """Return how far a frame is outside the time of the IMU as text."""
    if t_ns < first_ns:
        return f"the frame at {t_ns} ns is {(first_ns - t_ns) * 1e-9:.3f} s before the first IMU sample"
    return f"the frame at {t_ns} ns is {(t_ns - last_ns) * 1e-9:.3f} s after the last IMU sample"
