"""Shared renderers: objects in graphics memory that all users of a process share, and that are kept for later users."""

import atexit
import threading
import weakref
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from dronevio.models.errors import GraphicsError

IDLE_MAX = 2
"""Number of objects without users that each thread keeps."""


class Shareable(Protocol):
    """Interface of objects that can be shared."""

    def usable(self) -> bool:
        """Return whether the object still works; the driver may have lost its graphics memory."""

    def close(self) -> None:
        """Release the resources."""


T = TypeVar("T", bound=Shareable)


class Lease(Generic[T]):
    """The use of a shared object. Release it after use; the garbage collector releases an unreachable one."""

    def __init__(self, value: T, users: set[object], trim: Callable[[], None]) -> None:
        """Enter a new user among the users of an object; ``trim`` closes objects that no longer have users."""
        self.value = value
        """The shared object."""
        user = object()
        users.add(user)
        self._trim = trim
        # Without trimming: the garbage collector may run while another OpenGL context is in use.
        self._discard = weakref.finalize(self, users.discard, user)
        self._discard.atexit = False

    def release(self) -> None:
        """End the use of the object; further calls have no effect."""
        if self._discard.alive:
            self._discard()
            self._trim()


@dataclass(frozen=True, eq=False)
class _Entry(Generic[T]):
    """A shared object and its users."""

    value: T
    users: set[object] = field(default_factory=set)


class SharedPool(Generic[T]):
    """Pool of shared objects by key.

    Objects in use stay open. Of those without users, each thread keeps the most recently used. An OpenGL context
    belongs to one thread at a time, so that threads do not share objects.
    """

    def __init__(self, idle_max: int = IDLE_MAX) -> None:
        """Create an empty pool.

        Args:
            idle_max: Number of objects without users that each thread keeps.
        """
        self._idle_max = idle_max
        self._entries: dict[tuple[int, Hashable], _Entry[T]] = {}  # least recently leased first
        self._invalid: list[T] = []  # kept, since their destructors would act on the current OpenGL context
        self._closes_at_exit = threading.Event()

    def lease(self, key: Hashable, create: Callable[[], T]) -> Lease[T]:
        """Return a lease of the object of a key, which ``create`` makes if there is no usable one."""
        place = threading.get_ident(), key
        entry = self._entries.pop(place, None)
        if entry is not None and not entry.value.usable():
            self._invalid.append(entry.value)
            entry = None
        entry = entry or _Entry(create())
        self._entries[place] = entry
        if not self._closes_at_exit.is_set():  # after the first object, so that it runs before OpenGL's own exit
            self._closes_at_exit.set()
            atexit.register(self._close, idle_max=0, in_use=True)
        lease = Lease(entry.value, entry.users, self._close)
        self._close()
        return lease

    def clear(self) -> None:
        """Close the objects of this thread that have no users."""
        self._close(idle_max=0)

    def __len__(self) -> int:
        """Return the number of open objects."""
        return len(self._entries)

    def _close(self, idle_max: int | None = None, in_use: bool = False) -> None:
        """Close objects of this thread, least recently leased first, until ``idle_max`` of them remain."""
        own = threading.get_ident()
        closable = [place for place, entry in self._entries.items() if place[0] == own and (in_use or not entry.users)]
        kept = self._idle_max if idle_max is None else idle_max
        for place in closable[: max(len(closable) - kept, 0)]:
            value = self._entries.pop(place).value
            try:
                value.close()
            except GraphicsError:  # the driver has lost it
                self._invalid.append(value)
