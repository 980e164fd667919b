"""The order in which measurements are processed: that of a replay, whatever the latency of the images is.

A recording is read by the given offset: the samples of the IMU up to the exposure of a frame come before it. Where a
camera turns out to be exposed later than that by the clock of the IMU, a frame waits until they have come. If it is
exposed earlier, the frames are left out whose time is before that of the last one that was processed. On a vehicle, the
images of a frame come some time after its exposure, and the samples since then wait for the next frame.
"""

from collections.abc import Iterator

from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import RECENT_SAMPLES, exposure_delay_ns, received_count
from dronevio.models.rig import Rig
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


class SampleQueue:
    """Holds back IMU samples later than a frame, which then follows the same samples as in `measurements`."""

    def __init__(self, rig: Rig) -> None:
        """Begin without samples.

        Args:
            rig: The given calibration.
        """
        self._rig = rig
        self._received: list[ImuSamples] = []  # not joined before they are used, since no frame may come for hours
        self._returned = 0  # number of these that were returned

    def add(self, samples: ImuSamples) -> None:
        """Add later samples.

        Raises:
            ConfigError: They are not later than the last ones, or differ in `ImuSamples.sampling`.
        """
        if len(samples):
            if self._received:
                self._received[-1].check_order(samples)
            self._received.append(samples)

    def take(self, frame: CameraFrame) -> ImuSamples | None:
        """Return the samples that have come for a frame since the frame before; None without any."""
        if not self._received:
            return None
        samples, start = ImuSamples.concatenated(self._received), self._returned
        end_ns = frame.t_ns + exposure_delay_ns(self._rig, frame.image_delays_ns)
        end = max(received_count(samples.t_ns, end_ns, self._rig.imu.rate_hz), start)
        kept = max(end - RECENT_SAMPLES, 0)  # whose median interval tells how long a frame waits
        self._received, self._returned = [samples[kept:]], end - kept
        return samples[start:end]
