"""Output of rows to a rerun file or viewer, in columns.

The data of a flight are on the timeline ``time``, in seconds of flight. Many rows are sent at a time, because a call
for each row takes about a millisecond.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from dronevio.eval import colours
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.rotation import quat_wxyz_from_matrix, quat_xyzw_from_wxyz

APPLICATION = "dronevio"
TIMELINE = "time"


class Sink:
    """A rerun recording stream to which columns with time stamps in nanoseconds are written."""

    def __init__(self, stream: rr.RecordingStream, origin_ns: int) -> None:
        """Take the stream, and the time stamp [ns] that is zero on the timeline."""
        self._stream = stream
        self._origin_ns = origin_ns

    @classmethod
    @contextmanager
    def to_file(cls, path: Path, name: str, blueprint: rrb.Blueprint, origin_ns: int) -> Iterator[Self]:
        """Write a file, whose index is written when the context is left.

        The file is flushed five times a second. It can be read while it grows, and after its writer was killed.
        """
        stream = rr.RecordingStream(APPLICATION)
        stream.save(path)
        with cls._opened(stream, name, blueprint, origin_ns) as sink:
            yield sink

    @classmethod
    @contextmanager
    def to_viewer(cls, url: str, name: str, blueprint: rrb.Blueprint, origin_ns: int) -> Iterator[Self]:
        """Send to a viewer or server at a URL such as ``rerun+http://127.0.0.1:9876/proxy``."""
        stream = rr.RecordingStream(APPLICATION)
        stream.connect_grpc(url)
        with cls._opened(stream, name, blueprint, origin_ns) as sink:
            yield sink

    @classmethod
    @contextmanager
    def _opened(cls, stream: rr.RecordingStream, name: str, blueprint: rrb.Blueprint, origin_ns: int) -> Iterator[Self]:
        stream.send_blueprint(blueprint)  # as the active one: a viewer would keep the layout of the previous flight
        stream.send_recording_name(name)
        try:
            yield cls(stream, origin_ns)
        finally:
            stream.flush()
            stream.disconnect()

    def static(self, entity: str, archetype: rr.AsComponents) -> None:
        """Log data that are valid at all times."""
        self._stream.log(entity, archetype, static=True, strict=True)

    def columns(self, entity: str, t_ns: Times, columns: rr.ComponentColumnList) -> None:
        """Log N rows at times (N,) [ns]."""
        if len(t_ns):
            times = rr.TimeColumn(TIMELINE, duration=(t_ns - self._origin_ns).astype("timedelta64[ns]"))
            self._stream.send_columns(entity, [times], columns, strict=True)

    def row(self, entity: str, timeline: str, index: int, columns: rr.ComponentColumnList) -> None:
        """Log one row at an index of a timeline that counts."""
        self._stream.send_columns(entity, [rr.TimeColumn(timeline, sequence=[index])], columns, strict=True)

    def poses(self, entity: str, t_ns: Times, Ts: Array) -> None:
        """Log poses (N, 4, 4) of an entity in its parent frame at times (N,) [ns]."""
        if len(t_ns):
            columns = rr.Transform3D.columns(translation=Ts[:, :3, 3], quaternion=quat_xyzw(Ts[:, :3, :3]))
            self.columns(entity, t_ns, columns)

    def segments(self, entity: str, t_ns: Times, start: Array, end: Array) -> None:
        """Log N line segments from ``start`` (N, 3) to ``end`` (N, 3) [m] at times (N,) [ns]."""
        if len(t_ns):
            strips = np.stack([start, end], axis=1).astype(np.float32)
            self.columns(entity, t_ns, rr.LineStrips3D.columns(strips=strips))

    def curve_styles(
        self, entity: str, names: Sequence[str], curve_colours: Sequence[str], width_points: float = 1.5
    ) -> None:
        """Log names, colours and width of the curves of an entity whose `values` are plotted."""
        rgb = [colours.rgb(colour) for colour in curve_colours]
        self.static(entity, rr.SeriesLines(names=list(names), colors=rgb, widths=[width_points] * len(names)))

    def values(self, entity: str, t_ns: Times, values: Array) -> None:
        """Log values (N, C) or (N,) of a plot at times (N,) [ns]."""
        if len(t_ns):
            self.columns(entity, t_ns, rr.Scalars.columns(scalars=values.reshape(len(t_ns), -1)))


def quat_xyzw(R: Array) -> npt.NDArray[np.float32]:
    """Return rotations (N, 3, 3) as rerun's quaternions xyzw (N, 4)."""
    return np.asarray(quat_xyzw_from_wxyz(quat_wxyz_from_matrix(R)), dtype=np.float32)
