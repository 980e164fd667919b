"""Shared objects are created once, kept while in use, and closed in bounded number afterwards."""

import gc
import threading

from dronevio.models.errors import GraphicsError
from dronevio.sim.rendering.shared import SharedPool


class Thing:
    """An object that records whether it was closed, and that can be lost like graphics memory."""

    def __init__(self) -> None:
        self.closed = self.lost = False

    def usable(self) -> bool:
        return not self.lost

    def close(self) -> None:
        if self.lost:
            raise GraphicsError("lost")
        self.closed = True


def test_users_of_a_key_share_one_object() -> None:
    pool: SharedPool[Thing] = SharedPool()
    first, second, other = (pool.lease(key, Thing) for key in ("a", "a", "b"))
    assert first.value is second.value
    assert other.value is not first.value
    assert len(pool) == 2


def test_objects_in_use_stay_open() -> None:
    pool: SharedPool[Thing] = SharedPool(idle_max=0)
    first, second = pool.lease("a", Thing), pool.lease("a", Thing)
    first.release()
    first.release()  # once more has no effect
    assert len(pool) == 1 and not second.value.closed
    second.release()
    assert len(pool) == 0
    assert first.value.closed


def test_the_most_recently_used_are_kept() -> None:
    pool: SharedPool[Thing] = SharedPool(idle_max=2)
    leases = {key: pool.lease(key, Thing) for key in "abc"}
    pool.lease("a", Thing).release()  # used again
    for lease in leases.values():
        lease.release()
    assert [key for key, lease in leases.items() if lease.value.closed] == ["b"]
    again = pool.lease("a", Thing)
    assert again.value is leases["a"].value
    pool.clear()
    assert leases["c"].value.closed and not leases["a"].value.closed  # a is in use again


def test_unreachable_leases_are_released() -> None:
    pool: SharedPool[Thing] = SharedPool(idle_max=0)
    thing = pool.lease("a", Thing).value
    gc.collect()
    assert not thing.closed  # not during garbage collection, when another context may be current
    pool.lease("b", Thing)
    assert thing.closed


def test_threads_do_not_share() -> None:
    pool: SharedPool[Thing] = SharedPool(idle_max=0)
    here = pool.lease("a", Thing)
    there: list[Thing] = []

    def work() -> None:
        lease = pool.lease("a", Thing)
        there.append(lease.value)
        pool.clear()
        lease.release()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert there[0] is not here.value
    assert there[0].closed and not here.value.closed


def test_lost_objects_are_replaced() -> None:
    pool: SharedPool[Thing] = SharedPool()
    old = pool.lease("a", Thing)
    old.value.lost = True
    new = pool.lease("a", Thing)
    assert new.value is not old.value
    new.value.lost = True
    old.release()
    new.release()
    pool.clear()  # closing a lost object raises nothing
    assert len(pool) == 0
