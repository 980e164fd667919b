"""Frames of several cameras from the time stamps of their images: each image belongs to the frame nearest in time.

Cameras that share a trigger stamp their images with the same time; others are exposed at times of their own. An image
of another camera belongs to the frame of the image of the first camera that is nearest to it in time of exposure, if
each is the nearest of the other. An image without such a partner is a frame of its camera alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import Times

Rows = npt.NDArray[np.int64]

SYNC_TOLERANCE_S = 1e-3
"""Difference of time stamps up to which cameras are taken as exposed at one time, if the median is below it [s]."""
MAX_DIFFERENCE_S = 0.025
"""Largest difference between two images of one frame where frames are far apart [s]; an estimator can compensate it."""
ABSENT = -1
"""Index in place of an image that a camera lacks."""


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """The frames of C cameras."""

    t_ns: Times
    """(M,) Time stamps of the frames, increasing: each that of the first camera with an image [ns]."""
    rows: Rows
    """(M, C) Index of each image in the list of its camera, `ABSENT` where it has none."""
    delays_ns: Times
    """(M, C) How much later than the frame each image is stamped [ns]; 0 where it has none, and between cameras that
    are taken as exposed at one time."""

    def __getitem__(self, frames: npt.NDArray[np.bool_]) -> "FrameGroups":
        """Return some of the frames."""
        return FrameGroups(self.t_ns[frames], self.rows[frames], self.delays_ns[frames])

    @property
    def is_complete(self) -> npt.NDArray[np.bool_]:
        """(M,) Whether each frame has an image of every camera."""
        return np.asarray((self.rows != ABSENT).all(axis=1))


def grouped_frames(
    stamps: Sequence[Times], offsets_s: Sequence[float] | None = None, tolerance_s: float | None = None
) -> FrameGroups:
    """Return the frames of C cameras: one for each time at which at least one camera has an image.

    Args:
        stamps: Increasing time stamps of the images of each camera [ns].
        offsets_s: Time offset of each camera: time of exposure less time stamp [s]; 0 by default.
        tolerance_s: Largest difference between the exposures of two images of one frame [s]; half of the time between
            frames by default, at most `MAX_DIFFERENCE_S`.
    """
    offsets_ns = [round(1e9 * offset_s) for offset_s in offsets_s or (0.0,) * len(stamps)]
    if all(np.array_equal(stamps[0], other) for other in stamps[1:]) and len(set(offsets_ns)) == 1:
        rows = np.tile(np.arange(len(stamps[0]))[:, None], (1, len(stamps)))
        return FrameGroups(stamps[0], rows, np.zeros_like(rows))
    tolerance_ns = _half_interval_ns(stamps) if tolerance_s is None else round(tolerance_s * 1e9)
    exposed = [of + offset for of, offset in zip(stamps, offsets_ns, strict=True)]
    rows, t_ns = _sorted(np.concatenate(_groups(exposed, tolerance_ns)), stamps)
    # Images of a camera in another order than the frames are frames of their own
    while np.any(crossing := _crossing(rows)):
        alone = np.full((np.count_nonzero(crossing), len(stamps)), ABSENT, dtype=np.int64)
        frame, camera = np.nonzero(crossing)
        alone[np.arange(len(alone)), camera] = rows[frame, camera]
        rows, t_ns = _sorted(np.concatenate([np.where(crossing, ABSENT, rows), alone]), stamps)
    present, of_image = rows != ABSENT, _stamps_of(rows, stamps)
    delays_ns = np.where(present, of_image - t_ns[:, None], 0)
    return FrameGroups(t_ns, rows, _without_noise(delays_ns, present))


def _stamps_of(rows: Rows, stamps: Sequence[Times]) -> Times:
    """Return the time stamps (M, C) of images [ns]; arbitrary ones where they are absent."""
    columns = zip(stamps, rows.T, strict=True)
    return np.stack([of[np.maximum(column, 0)] if len(of) else 0 * column for of, column in columns], axis=1)


def _sorted(rows: Rows, stamps: Sequence[Times]) -> tuple[Rows, Times]:
    """Return frames in the order of their times, and these (M,) [ns]; of several at one time, the first."""
    rows = rows[(rows != ABSENT).any(axis=1)]
    t_ns = _stamps_of(rows, stamps)[np.arange(len(rows)), (rows != ABSENT).argmax(axis=1)]
    order = np.argsort(t_ns, kind="stable")
    order = order[np.concatenate([[True], np.diff(t_ns[order]) > 0])] if len(order) else order
    return rows[order], t_ns[order]


def _crossing(rows: Rows) -> npt.NDArray[np.bool_]:
    """Return which images (M, C) of frames with several come after a later one of their camera, or else before one."""
    present, beyond = rows != ABSENT, np.full((1, rows.shape[1]), np.iinfo(np.int64).max)
    before = np.vstack([np.full_like(beyond, ABSENT), np.maximum.accumulate(rows, axis=0)[:-1]])
    after = np.minimum.accumulate(np.vstack([np.where(present, rows, beyond)[1:], beyond])[::-1], axis=0)[::-1]
    shared = present & (present.sum(axis=1, keepdims=True) > 1)
    late = shared & (rows < before)
    return np.asarray(late if late.any() else shared & (rows > after), dtype=np.bool_)


def _groups(exposed: Sequence[Times], tolerance_ns: int) -> list[Rows]:
    """Return the rows (M, C) of groups of images, by the times of exposure of each camera [ns]."""
    left = [np.arange(len(of)) for of in exposed]
    groups = []
    for anchor, own in enumerate(exposed):
        rows = np.full((len(left[anchor]), len(exposed)), ABSENT, dtype=np.int64)
        rows[:, anchor] = left[anchor]
        first_ns = last_ns = own[left[anchor]]
        for camera in range(anchor + 1, len(exposed)):
            others = exposed[camera][left[camera]]
            mine, theirs = _nearest_pairs(own[left[anchor]], others)
            first = np.minimum(first_ns[mine], others[theirs])
            last = np.maximum(last_ns[mine], others[theirs])
            fits = last - first <= tolerance_ns
            mine, theirs = mine[fits], theirs[fits]
            rows[mine, camera] = left[camera][theirs]
            first_ns, last_ns = first_ns.copy(), last_ns.copy()
            first_ns[mine], last_ns[mine] = first[fits], last[fits]
            left[camera] = np.delete(left[camera], theirs)
        groups.append(rows)
    return groups


def _nearest_pairs(a: Times, b: Times) -> tuple[Rows, Rows]:
    """Return the rows of times of each of two increasing arrays that are the nearest of one another."""
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    of_a, of_b = _nearest(a, b), _nearest(b, a)
    mine = np.flatnonzero(of_b[of_a] == np.arange(len(a)))
    return mine, of_a[mine]


def _nearest(times: Times, others: Times) -> Rows:
    """Return the row of the nearest of increasing times for each time, the earlier one of two."""
    after = np.clip(np.searchsorted(others, times), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)


def _half_interval_ns(stamps: Sequence[Times]) -> int:
    """Return half of the shortest median interval of a camera, at most `MAX_DIFFERENCE_S` [ns]."""
    intervals = [float(np.median(np.diff(of))) for of in stamps if len(of) > 1]
    return round(min([0.5 * each for each in intervals] + [MAX_DIFFERENCE_S * 1e9]))


def _without_noise(delays_ns: Times, present: npt.NDArray[np.bool_]) -> Times:
    """Return delays (M, C) without those of cameras that share a trigger, whose stamps differ a little."""
    tolerance_ns, cleaned = round(SYNC_TOLERANCE_S * 1e9), delays_ns.copy()
    for camera in range(delays_ns.shape[1]):
        mine = np.abs(delays_ns[present[:, camera], camera])
        if len(mine) and np.median(mine) <= tolerance_ns:
            cleaned[np.abs(delays_ns[:, camera]) <= tolerance_ns, camera] = 0
    return cleaned


def delays_of_frame(delays_ns: Times) -> tuple[int, ...]:
    """Return the delays (C,) of the images of a frame as `CameraFrame` has them: none if they are all zero [ns]."""
    return tuple(delays_ns.tolist()) if delays_ns.any() else ()
