"""Search for the time offset of camera and IMU while images and IMU contradict each other.

The online calibration (`dronevio.estimator.calibration.online`) finds an offset of some milliseconds, which hardly
disturbs an estimate. With tens of milliseconds, there is no such estimate: an initialization fails, or images and
prediction contradict each other soon. The rotation of the last frames is then compared with the gyroscope at all
offsets (`rotation_offset`), which needs no estimate.
"""

import numpy as np

from dronevio.estimator.calibration.image_rotation import NO_ROTATIONS, image_rotations
from dronevio.estimator.calibration.rotation_offset import RotationOffset, rotation_offset
from dronevio.estimator.imu.buffer import joined
from dronevio.estimator.types import FramePacket
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples

MAX_OFFSET_S = 0.25
"""Largest offset that is searched for [s], beyond what drivers and transmission of images cause."""
WINDOW_S = 1.4
"""Time over which the rotations are compared at least [s], less than the window of a start with one camera. Of images
that do not belong to the gyroscope, the best offset explains half of the rotation or less (`docs/tuning.md`)."""
SPAN_S = 2.75
"""Time for which frames are kept [s]."""
MIN_RANGE_S = 0.03
"""Smallest range of offsets that is searched [s]."""
INTERVAL_S = 0.25
"""Time between searches [s]."""
MIN_OFFSET_S = 0.008
"""Smallest offset that is adopted [s]; the online calibration finds smaller ones."""


class OffsetSearch:
    """Keeps the frames of the last seconds, and searches the offset from them on request."""

    def __init__(self) -> None:
        """Begin without frames."""
        self._packets: tuple[FramePacket, ...] = ()
        self._rotations = NO_ROTATIONS
        self._searched_ns: int | None = None  # the rotations up to this frame are known

    def add(self, packet: FramePacket) -> None:
        """Add the next frame."""
        oldest_ns = packet.t_ns - round(SPAN_S * 1e9)
        self._packets = (*(p for p in self._packets if p.t_ns >= oldest_ns), packet)

    def offset(self, Ts_imu_cam: Array, *, at_once: bool = False) -> RotationOffset | None:
        """Return a significant offset relative to the one in use, if there is one; at most every `INTERVAL_S`.

        The frames at both ends are those of the offsets that are tried: the more frames there are, the larger offsets.

        Args:
            Ts_imu_cam: (C, 4, 4) Poses of the cameras in the IMU frame.
            at_once: Whether the offset is searched for, however soon after the last time.
        """
        packets, last_ns = self._packets, self._searched_ns
        span_s = (packets[-1].t_ns - packets[0].t_ns) * 1e-9 if packets else 0.0
        range_s = min(MAX_OFFSET_S, 0.5 * (span_s - WINDOW_S))
        if range_s < MIN_RANGE_S:
            return None
        now_ns = packets[-1].t_ns
        if not at_once and last_ns is not None and (now_ns - last_ns) * 1e-9 < INTERVAL_S:
            return None
        # The rotations between frames; only those that are new are computed
        times_ns, features = [p.t_ns for p in packets], [p.observations for p in packets]
        added = image_rotations(times_ns, features, Ts_imu_cam, last_ns)
        self._rotations = self._rotations[self._rotations.start_ns >= packets[0].t_ns].joined(added)
        self._searched_ns = now_ns
        # The offset that explains them best
        imu = _samples(packets)
        best = rotation_offset(self._rotations, imu, range_s) if len(imu) > 1 else None
        return best if best is not None and best.excludes_zero and abs(best.offset_s) >= MIN_OFFSET_S else None


def _samples(packets: tuple[FramePacket, ...]) -> ImuSamples:
    """Return the IMU increments between the first and the last of successive frames as samples."""
    increments = joined([packet.increments for packet in packets[1:]])
    ends_s = np.cumsum(increments.dt_s[::-1])[::-1] - increments.dt_s  # before the last frame
    t_ns = packets[-1].t_ns - np.rint(ends_s * 1e9).astype(np.int64)
    kept = np.diff(t_ns, prepend=t_ns[:1] - 1) > 0
    return ImuSamples(t_ns[kept], increments.gyro_rad_s[kept], increments.accel_m_s2[kept], "increment")
