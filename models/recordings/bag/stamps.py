"""Time stamps of the messages in a bag, and their substitutes where a driver has not set them.

In ROS, the time stamp 0 of a header means that it is unset. The log time of a message is later by its latency.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.defects import Defect, DefectKind
from dronevio.models.imu import Times

MIN_EQUAL = 3
"""Smallest number of messages whose equal time stamps are taken for unset."""
_CLOSE_NS = 10**9  # a stamp of 0 that the log confirms is the start of a clock that counts from 0


@dataclass(frozen=True, eq=False)
class TopicStamps:
    """Times of the messages of a topic, in the order of the bag."""

    topic: str
    """Name of the topic."""
    header_ns: Times
    """(N,) Time stamps in the headers [ns]."""
    logged_ns: Times
    """(N,) Times at which the messages were logged [ns]."""
    t_ns: Times
    """(N,) Time stamps to use [ns]."""
    unset: npt.NDArray[np.bool_]
    """(N,) Whether the header has no time stamp."""
    twins: npt.NDArray[np.int64]
    """(N, 2) Number of messages in the bag with the same header stamp and log time, those before it and all of them."""

    @classmethod
    def of(cls, topic: str, header_ns: Times, logged_ns: Times) -> "TopicStamps":
        """Return the time stamps of messages (N,), those of the log where a header has none.

        A header is unset if its stamp is 0, or if all of `MIN_EQUAL` or more messages have the same one. If others are
        set, the time of the log is corrected by the median of their differences to it.
        """
        unset = header_ns == 0
        if len(header_ns) >= MIN_EQUAL and (header_ns == header_ns[0]).all():
            unset[:] = True
        delays_ns = (header_ns - logged_ns)[~unset]
        logged = logged_ns + (int(np.median(delays_ns)) if len(delays_ns) else 0)
        if unset.sum() == 1 and abs(int(logged[unset][0])) < _CLOSE_NS:
            unset[:] = False
        return cls(topic, header_ns, logged_ns, np.where(unset, logged, header_ns), unset, _twins(header_ns, logged_ns))

    def place(self, row: int) -> str:
        """Return topic and number of a message, counted from 1."""
        return f"{self.topic}: message {row + 1}"

    def selected(self, rows: npt.NDArray[np.int64] | slice) -> "TopicStamps":
        """Return the time stamps of some of the messages."""
        header_ns, logged_ns, t_ns = self.header_ns[rows], self.logged_ns[rows], self.t_ns[rows]
        return TopicStamps(self.topic, header_ns, logged_ns, t_ns, self.unset[rows], self.twins[rows])

    @property
    def defects(self) -> tuple[Defect, ...]:
        """The messages without a time stamp."""
        return tuple(
            Defect(
                DefectKind.UNSET_STAMP,
                int(self.t_ns[row]),
                f"{self.topic}: {self.header_ns[row]} ns in the header, logged at {self.logged_ns[row]} ns",
            )
            for row in np.flatnonzero(self.unset).tolist()
        )


def _twins(header_ns: Times, logged_ns: Times) -> npt.NDArray[np.int64]:
    """Return for each message (N,) the numbers (N, 2) of equal ones: those before it, and all of them."""
    order = np.lexsort((header_ns, logged_ns))  # stable
    differs = (np.diff(header_ns[order]) != 0) | (np.diff(logged_ns[order]) != 0)
    group = np.concatenate([[0], np.cumsum(differs)])
    count = np.bincount(group)
    twins = np.empty((len(order), 2), dtype=np.int64)
    twins[order, 0] = np.arange(len(order)) - (np.cumsum(count) - count)[group]
    twins[order, 1] = count[group]
    return twins
