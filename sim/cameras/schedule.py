"""Frame times: recorded time stamps, true exposure times, and faults of the frames.

All cameras of a rig share one trigger. The time stamp of a frame is the middle of its exposure on the clock of the
cameras; the true time is stored beside it on the clock of the IMU.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times

_LARGEST_JITTER = 0.4  # of the time between two frames, so that they stay in order


@dataclass(frozen=True, eq=False)
class FrameSchedule:
    """Recorded and true times of the frames of a flight."""

    stamps_ns: Times
    """(M,) Recorded time stamps [ns], strictly increasing."""
    exposed_ns: Times
    """(M,) True times of the middle of the exposure of the middle row, on the clock of the IMU [ns]."""
    lit: npt.NDArray[np.bool_]
    """(M,) Whether light reaches the cameras."""

    def __post_init__(self) -> None:
        """Check shapes and order.

        Raises:
            ConfigError: The lengths differ, or the time stamps do not increase.
        """
        count = len(self.stamps_ns)
        if self.exposed_ns.shape != (count,) or self.lit.shape != (count,):
            raise ConfigError(
                f"{count} time stamps, {len(self.exposed_ns)} exposures, {len(self.lit)} flags; expected as many each"
            )
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise ConfigError("frames out of order; expected increasing time stamps")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, rows: slice | npt.NDArray[np.bool_]) -> "FrameSchedule":
        return FrameSchedule(self.stamps_ns[rows], self.exposed_ns[rows], self.lit[rows])

    def within(self, first_ns: int, last_ns: int) -> "FrameSchedule":
        """Return the frames whose true times lie between two times [ns], both included."""
        return self[(self.exposed_ns >= first_ns) & (self.exposed_ns <= last_ns)]


def nominal_stamps(first_ns: int, end_ns: int, rate_hz: float) -> Times:
    """Return the nominal time stamps of a camera [ns], from ``first_ns`` to before ``end_ns``."""
    return np.arange(first_ns, end_ns, round(1e9 / rate_hz), dtype=np.int64)


def schedule_frames(
    nominal_ns: Times,
    rng: np.random.Generator,
    time_offset_s: float = 0.0,
    stamp_jitter_s: float = 0.0,
    dropped_frames: float = 0.0,
    dark_from_s: float = 0.0,
    dark_for_s: float = 0.0,
) -> FrameSchedule:
    """Return recorded and true times of frames with faults.

    Args:
        nominal_ns: (N,) Nominal time stamps [ns], increasing, at any intervals.
        rng: Generator of jitter and losses.
        time_offset_s: Time offset of the cameras: t_imu = t_cam + offset [s].
        stamp_jitter_s: Standard deviation of the error of the time stamps [s]; the order of frames is kept.
        dropped_frames: Fraction of lost frames; the first frame is never lost.
        dark_from_s: Start of the darkness, from the first time stamp [s].
        dark_for_s: Duration of the darkness [s].
    """
    count = len(nominal_ns)
    error_s, loss = rng.standard_normal(count) * stamp_jitter_s, rng.random(count)  # always drawn
    reach_s = _LARGEST_JITTER * 1e-9 * float(np.diff(nominal_ns).min(initial=np.iinfo(np.int64).max))
    error_ns = np.rint(np.clip(error_s, -reach_s, reach_s) * 1e9).astype(np.int64)
    since_s = (nominal_ns - nominal_ns[:1]) * 1e-9
    lit = (since_s < dark_from_s) | (since_s >= dark_from_s + dark_for_s)
    kept = loss >= dropped_frames
    kept[:1] = True
    return FrameSchedule(nominal_ns + error_ns, nominal_ns + round(time_offset_s * 1e9), lit)[kept]
