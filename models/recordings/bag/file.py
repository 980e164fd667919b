"""Topics and messages of a bag of ROS 1 or ROS 2, with damage reported as InputError.

The library rosbags reads bags of ROS 1, MCAP, SQLite and folders with ``metadata.yaml``, compressed or not. Messages
are decoded by the standard definitions of ROS 2 and not by those in the bag, which would have to be compiled to code.
Those of ROS 1 differ in their serialization only: no alignment, and a counter in front of the time stamp of a header.
"""

import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dronevio.models.errors import DronevioError, InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.bag.file_order import written_messages
from dronevio.models.recordings.bag.messages import ros1_stamp_ns, stamp_ns
from dronevio.models.recordings.bag.options import ROS1_SUFFIX, STORAGES
from dronevio.models.recordings.bag.stamps import TopicStamps
from dronevio.models.recordings.files import check_regular_file

_EXPECTED = "a bag of ROS 1 (.bag) or ROS 2: an .mcap or .db3 file, or a folder with metadata.yaml"
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # before ROS Groovy; the contents are the same


@cache
def typestore() -> Typestore:
    """Return the definitions of the standard messages, whose serialization has not changed since ROS 2 Humble."""
    return get_typestore(Stores.ROS2_HUMBLE)


@contextmanager
def any_as_input_error(path: Path) -> Iterator[None]:
    """Convert any exception into an InputError about a bag.

    Damaged bags cause exceptions of many types in the libraries (struct, sqlite3, zstd, assertions), so all types are
    converted.

    Raises:
        InputError: The body raised an exception.
    """
    try:
        yield
    except DronevioError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(path, f"a bag that cannot be read ({reason})", _EXPECTED) from None


class BagFile:
    """A bag that is open for reading. It is closed when the object is garbage-collected."""

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            InputError: The bag is missing or damaged.
        """
        self.path = path
        with any_as_input_error(path):
            storage = _storage(path)
            for file in [file for file in storage.iterdir() if not file.is_dir()] if storage.is_dir() else [storage]:
                check_regular_file(file, _EXPECTED)
                _check_not_truncated(file)
            self._is_ros1 = storage.suffix == ROS1_SUFFIX and not storage.is_dir()
            self._reader = Ros1Reader(storage) if self._is_ros1 else Ros2Reader(storage)
            self._reader.open()
            weakref.finalize(self, self._reader.close)
            used = [connection for connection in self._reader.connections if connection.msgcount]
            self.topics: dict[str, str] = {c.topic: _RENAMED.get(c.msgtype, c.msgtype) for c in used}
            """Message type of each topic that has messages, by its name in ROS 2."""

    def topics_of_type(self, *types: str) -> tuple[str, ...]:
        """Return the topics with messages of the given types, sorted by name."""
        return tuple(sorted(topic for topic, kind in self.topics.items() if kind in types))

    def raw_messages(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield the log time [ns] and the serialized bytes of each message of a topic.

        Args:
            topic: Name of the topic.
            start_ns: First log time of the messages, which come in the order of log times [ns]; None for all messages,
                which come in the order in which they were written.

        Raises:
            InputError: The bag is damaged.
        """
        with any_as_input_error(self.path):
            connections = [c for c in self._reader.connections if c.topic == topic and c.msgcount]
            if start_ns is None:
                messages = written_messages(self._reader, connections)
            else:
                messages = self._reader.messages(connections, start=start_ns)
            for _, logged_ns, raw in messages:
                yield logged_ns, raw

    def messages(self, topic: str) -> Iterator[object]:
        """Yield the messages of a topic.

        Raises:
            InputError: The bag is damaged.
        """
        for _, raw in self.raw_messages(topic):
            yield self.decode(topic, raw)

    def first_message(self, topic: str) -> object:
        """Return the first message of a topic.

        Raises:
            InputError: The bag is damaged.
        """
        for message in self.messages(topic):
            return message
        raise self._empty(topic)

    def decode(self, topic: str, raw: bytes) -> object:
        """Return the message of a topic with given serialized bytes.

        Raises:
            InputError: The bytes are damaged.
        """
        kind = self.topics[topic]
        with any_as_input_error(self.path):
            return typestore().deserialize_cdr(typestore().ros1_to_cdr(raw, kind) if self._is_ros1 else raw, kind)

    def stamp_ns(self, topic: str, raw: bytes) -> int:
        """Return the time stamp [ns] in the header of a serialized message.

        Raises:
            InputError: The message has no header.
        """
        try:
            return ros1_stamp_ns(raw) if self._is_ros1 else stamp_ns(raw)
        except ValueError as error:
            raise InputError(self.path, f"{topic}: {error}", "messages with a time stamp") from None

    def stamped_messages(self, topic: str, rows: slice = slice(None)) -> tuple[Times, list[object]]:
        """Return the time stamps (N,) [ns] and some of the messages of a topic, sorted by time stamp.

        Raises:
            InputError: The messages are damaged, or two have the same time stamp.
        """
        stamps, messages = self.listed_messages(topic)
        t_ns, messages = stamps.t_ns[rows], messages[rows]
        order = np.argsort(t_ns, kind="stable")
        self.check_stamps(topic, t_ns[order])
        return t_ns[order], [messages[i] for i in order.tolist()]

    def listed_messages(self, topic: str) -> tuple[TopicStamps, list[object]]:
        """Return the time stamps (N,) and the messages of a topic, in the order of the bag.

        Raises:
            InputError: The messages are damaged.
        """
        logged = list(self.raw_messages(topic))
        if not logged:
            raise self._empty(topic)
        messages = [self.decode(topic, raw) for _, raw in logged]
        return self._stamps(topic, [(self.stamp_ns(topic, raw), logged_ns) for logged_ns, raw in logged]), messages

    def stamps(self, topic: str) -> TopicStamps:
        """Return the time stamps (N,) of the messages of a topic, in the order of the bag.

        Raises:
            InputError: There are no messages, or they are damaged.
        """
        logged = self.raw_messages(topic)
        return self._stamps(topic, [(self.stamp_ns(topic, raw), logged_ns) for logged_ns, raw in logged])

    def _stamps(self, topic: str, stamps: Sequence[tuple[int, int]]) -> TopicStamps:
        """Return the time stamps (N,) of pairs of a stamp in a header and a log time [ns]."""
        if not stamps:
            raise self._empty(topic)
        header_ns, logged_ns = np.array(stamps, dtype=np.int64).T
        return TopicStamps.of(topic, header_ns, logged_ns)

    def check_stamps(self, topic: str, t_ns: Times) -> None:
        """Check that the sorted time stamps (N,) [ns] of a topic are distinct.

        Raises:
            InputError: Two time stamps are equal.
        """
        twice = np.flatnonzero(np.diff(t_ns) <= 0)
        if twice.size:
            raise self.error(f"{topic}: two messages of {t_ns[twice[0]]} ns", "distinct time stamps")

    def _empty(self, topic: str) -> InputError:
        """Return the error for a topic without readable messages."""
        return self.error(f"{topic}: no messages, although the bag lists some", "the messages that it lists")

    def error(self, found: str, expected: str) -> InputError:
        """Return the error for contents of the bag that differ from what is expected."""
        return InputError(self.path, found, expected)


def _storage(path: Path) -> Path:
    """Return the path that rosbags opens, or raise InputError."""
    if not path.exists():
        raise InputError(path, "no such file", _EXPECTED)
    if not path.is_dir():
        return path
    if (path / "metadata.yaml").exists():
        return path
    files = _storage_files(path)
    if len(files) != 1:
        raise InputError(path, f"no metadata.yaml and {len(files)} storage files", _EXPECTED)
    return files[0]


def _check_not_truncated(path: Path) -> None:
    """Raise InputError if a database ends before its last page, where SQLite would silently read zeros.

    Page size and number of pages are in the header (https://www.sqlite.org/fileformat2.html, 1.3).
    """
    if path.suffix != ".db3":
        return
    with path.open("rb") as file:
        database = file.read(100)
    if len(database) < 100 or database[24:28] != database[92:96]:
        return  # not a database, or one without a valid size in its header
    page = int.from_bytes(database[16:18], "big")
    size = (65536 if page == 1 else page) * int.from_bytes(database[28:32], "big")
    if path.stat().st_size < size:
        raise InputError(path, f"{path.stat().st_size} bytes of {size}", "a complete file, not a truncated one")


def _storage_files(folder: Path) -> Sequence[Path]:
    """Return the storage files in a folder; none if the path is not a folder."""
    if not folder.is_dir():
        return ()
    return sorted(path for path in folder.iterdir() if path.suffix in STORAGES)
