"""A ROS 2 bag as a file that may be damaged: its topics and messages, or one error that says what is wrong with it.

rosbags does the reading: MCAP, SQLite, a folder with ``metadata.yaml``, compressed or not. Messages are decoded by the
definitions that we know, never by those that the bag brings along, which would have to be turned into code.
"""

import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dronevio.models.errors import DronevioError, InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.bag.messages import stamp_ns

_EXPECTED = "a ROS 2 bag: an .mcap or .db3 file, or a folder with metadata.yaml"
_STORAGES = (".mcap", ".db3")


@cache
def typestore() -> Typestore:
    """Return the definitions of the standard messages, which have not changed on the wire since Humble."""
    return get_typestore(Stores.ROS2_HUMBLE)


@contextmanager
def blamed_on_bag(path: Path) -> Iterator[None]:
    """Turn whatever reading a bag raises into one error that names it.

    A damaged bag makes the libraries below fail in every way there is (struct, sqlite, zstd, assertions, ord() of
    nothing ...), so here, at their door, every exception is the file's fault.

    Raises:
        InputError: In place of it.
    """
    try:
        yield
    except DronevioError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(path, f"a bag that cannot be read ({reason})", _EXPECTED) from None


class BagFile:
    """A bag that is open for reading; it closes itself when nobody uses it any longer."""

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            InputError: There is none, or it is damaged.
        """
        self.path = path
        with blamed_on_bag(path):
            for database in (path, *_storages_in(path)):
                _check_whole(database)
            self._reader = Reader(_storage(path))
            self._reader.open()
            weakref.finalize(self, self._reader.close)
            self.topics: dict[str, str] = {c.topic: c.msgtype for c in self._reader.connections if c.msgcount}
            """The type of message of each topic that has any."""

    def of_type(self, *types: str) -> tuple[str, ...]:
        """Return the topics of the given types, sorted."""
        return tuple(sorted(topic for topic, kind in self.topics.items() if kind in types))

    def raw(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield when each message of a topic was written [ns], and its bytes, in that order.

        Args:
            topic: Which.
            start_ns: Only messages that were written then or later.

        Raises:
            InputError: The bag is damaged there.
        """
        with blamed_on_bag(self.path):
            connections = [c for c in self._reader.connections if c.topic == topic]
            for _, logged_ns, raw in self._reader.messages(connections, start=start_ns):
                yield logged_ns, raw

    def decoded(self, topic: str) -> Iterator[object]:
        """Yield the messages of a topic.

        Raises:
            InputError: The bag is damaged there.
        """
        for _, raw in self.raw(topic):
            yield self.decode(topic, raw)

    def first(self, topic: str) -> object:
        """Return the first message of a topic.

        Raises:
            InputError: The bag is damaged there.
        """
        for message in self.decoded(topic):
            return message
        raise self._empty(topic)

    def decode(self, topic: str, raw: bytes) -> object:
        """Return a message from its bytes.

        Raises:
            InputError: They are damaged.
        """
        with blamed_on_bag(self.path):
            return typestore().deserialize_cdr(raw, self.topics[topic])

    def stamp_ns(self, topic: str, raw: bytes) -> int:
        """Return the time stamp [ns] in the header of a message.

        Raises:
            InputError: It has none.
        """
        try:
            return stamp_ns(raw)
        except ValueError as error:
            raise InputError(self.path, f"{topic}: {error}", "messages with a time stamp") from None

    def stamped(self, topic: str) -> tuple[Times, list[object]]:
        """Return the messages of a topic by their time stamps (N,) [ns], increasing.

        Raises:
            InputError: They are damaged, or two have the same.
        """
        raws = [raw for _, raw in self.raw(topic)]
        if not raws:
            raise self._empty(topic)
        t_ns = np.array([self.stamp_ns(topic, raw) for raw in raws], dtype=np.int64)
        order = np.argsort(t_ns, kind="stable")
        self.check_stamps(topic, t_ns[order])
        return t_ns[order], [self.decode(topic, raws[i]) for i in order.tolist()]

    def check_stamps(self, topic: str, t_ns: Times) -> None:
        """Check that the time stamps (N,) [ns] of a topic, sorted, increase.

        Raises:
            InputError: Two are the same.
        """
        twice = np.flatnonzero(np.diff(t_ns) <= 0)
        if twice.size:
            raise self.fault(f"{topic}: two messages of {t_ns[twice[0]]} ns", "a time stamp of its own for each")

    def _empty(self, topic: str) -> InputError:
        """Return the error that says that a topic has no messages."""
        return self.fault(f"{topic}: no messages, though the bag counts some", "as many as it counts")

    def fault(self, found: str, expected: str) -> InputError:
        """Return the error that says that something in the bag is not what it should be."""
        return InputError(self.path, found, expected)


def _storage(path: Path) -> Path:
    """Return what to hand to rosbags, or raise InputError."""
    if not path.exists():
        raise InputError(path, "no such file", _EXPECTED)
    if not path.is_dir():
        return path
    if (path / "metadata.yaml").exists():
        return path
    inside = _storages_in(path)
    if len(inside) != 1:
        raise InputError(path, f"no metadata.yaml and {len(inside)} storage files", _EXPECTED)
    return inside[0]


def _check_whole(path: Path) -> None:
    """Raise InputError if a database ends before its last page: SQLite would read zeros there without a word.

    Page size and number of pages stand in the header (https://www.sqlite.org/fileformat2.html, 1.3).
    """
    if path.suffix != ".db3" or not path.is_file():
        return
    with path.open("rb") as file:
        database = file.read(100)
    if len(database) < 100 or database[24:28] != database[92:96]:
        return  # no database, or one whose header does not tell
    page = int.from_bytes(database[16:18], "big")
    size = (65536 if page == 1 else page) * int.from_bytes(database[28:32], "big")
    if path.stat().st_size < size:
        raise InputError(path, f"{path.stat().st_size} bytes of {size}", "a whole file; this one is cut off")


def _storages_in(folder: Path) -> Sequence[Path]:
    """Return the storage files in a folder; none where it is none."""
    if not folder.is_dir():
        return ()
    return sorted(path for path in folder.iterdir() if path.suffix in _STORAGES)
