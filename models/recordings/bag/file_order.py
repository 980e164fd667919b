"""Messages in the order in which they were written to a bag.

The library rosbags yields them in the order of their log times. Where the clock of the recording computer steps, that
order mixes the messages before and after the step.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from io import BytesIO
from typing import Any

Message = tuple[Any, int, bytes]
"""Connection, log time [ns] and serialized bytes."""


def written_messages(reader: Any, connections: Sequence[Any]) -> Iterator[Message]:
    """Yield the messages of connections in the order in which they were written.

    Args:
        reader: An open reader of rosbags.
        connections: Connections of the reader.
    """
    if hasattr(reader, "indexes"):  # ROS 1; one list of index entries is read in its own order
        entries = [entry for connection in connections for entry in reader.indexes[connection.id]]
        by_place = copy(reader)
        by_place.current_chunk = (-1, BytesIO())
        by_place.indexes = {connections[0].id: sorted(entries, key=lambda entry: (entry.chunk_pos, entry.offset))}
        yield from by_place.messages(connections[:1])
        return
    storage = reader.storage
    files = getattr(storage, "storages", [storage])
    if reader.compression_mode == "message" or not all(map(_is_known, files)):
        yield from reader.messages(connections)
        return
    for file in files:
        ids = {own.id for own in file.connections if any(_is_same(own, asked) for asked in connections)}
        if ids and hasattr(file, "messages_scan"):  # MCAP
            yield from file.messages_scan([own for own in file.connections if own.id in ids])
        elif ids:  # SQLite
            by_id = {own.id: own for own in file.connections}
            marks = ",".join("?" * len(ids))
            query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
            for topic_id, logged_ns, raw in file.dbconn.execute(query, tuple(ids)):
                yield by_id[topic_id], logged_ns, raw


def _is_known(file: Any) -> bool:
    """Return whether the order of writing can be read from a file."""
    return hasattr(file, "messages_scan") or hasattr(file, "dbconn")


def _is_same(own: Any, asked: Any) -> bool:
    """Return whether a connection of a file is the one that is asked for."""
    return bool(own.topic == asked.topic and own.msgtype == asked.msgtype)
