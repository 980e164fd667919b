"""The order in which frames are processed where a time offset is found in flight.

A recording is read by the given offset: the samples of the IMU up to the exposure of a frame come before it. If its
camera turns out to be exposed later than that by the clock of the IMU, a frame waits until they have come. If it is
exposed earlier, the frames are left out whose time is before that of the last one that was processed.
"""

from dronevio.models.state import CameraFrame


class FrameQueue:
    """Returns frames when the IMU samples of their exposure have come."""

    def __init__(self) -> None:
        """Begin without a difference to the given time offset."""
        self._waiting: tuple[CameraFrame, ...] = ()
        self._offset_ns = 0  # relative to the given one
        self._last_ns: int | None = None  # time of the last processed frame at the time of the last shift

    def add(self, frame: CameraFrame) -> tuple[CameraFrame, ...]:
        """Add the next frame and return those that are due, in their order: itself, if the offset is the given one."""
        waiting = (*self._waiting, frame)
        due = tuple(f for f in waiting if f.t_ns + max(self._offset_ns, 0) <= frame.t_ns)
        self._waiting = waiting[len(due) :]
        return tuple(f for f in due if self._last_ns is None or f.t_ns + self._offset_ns > self._last_ns)

    def shift(self, offset_s: float, newest_ns: int) -> None:
        """Change the offset.

        Args:
            offset_s: Time offset relative to the given one [s].
            newest_ns: Time stamp of the last processed frame [ns].
        """
        self._last_ns, self._offset_ns = newest_ns + self._offset_ns, round(offset_s * 1e9)
