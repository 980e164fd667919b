"""The order in which frames are processed where a time offset is found in flight.

A recording is read by the given offset: the samples of the IMU up to the exposure of a frame come before it. If its
camera turns out to be exposed later than that by the clock of the IMU, a frame waits until they have come. If it is
exposed earlier, the frames are left out whose time is before that of the last one that was processed.
"""

from collections.abc import Iterator

from dronevio.models.state import CameraFrame


class FrameQueue:
    """Returns frames when the IMU samples of their exposure have come."""

    def __init__(self) -> None:
        """Begin without a difference to the given time offset."""
        self._waiting: tuple[CameraFrame, ...] = ()
        self._offset_ns = 0  # relative to the given one
        self._newest_ns: int | None = None  # time of the last frame that was returned
        self._not_before_ns: int | None = None  # the same at the last shift

    def add(self, frame: CameraFrame) -> Iterator[CameraFrame]:
        """Add the next frame and yield those that are due, in their order: itself, if the offset is the given one."""
        self._waiting = (*self._waiting, frame)
        while self._waiting and self._waiting[0].t_ns + max(self._offset_ns, 0) <= frame.t_ns:
            due, *waiting = self._waiting
            self._waiting, exposed_ns = tuple(waiting), due.t_ns + self._offset_ns
            if self._not_before_ns is None or exposed_ns > self._not_before_ns:
                self._newest_ns = exposed_ns
                yield due

    def shift(self, offset_s: float) -> None:
        """Change the offset to another one relative to the given one [s]."""
        self._not_before_ns, self._offset_ns = self._newest_ns, round(offset_s * 1e9)
