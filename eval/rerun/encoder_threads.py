"""Threads of the SVT-AV1 encoder, to which FFmpeg and PyAV give no access.

SVT-AV1 (seen in 4.1) has a race in its low-delay mode. The picture manager hands a picture to the next thread, and only
then reads from it which reference pictures it replaces. The encoder has one such picture and uses it again for the next
image. If the picture manager loses its processor until then, it reads the list of the next image, and a reference
picture is never released. The fastest presets have no picture to spare, and the encoder waits for one forever.
`wait_until_idle` prevents this: an image is sent when all threads have finished with the one before.
"""

import contextlib
import os
import time
from collections.abc import Collection
from pathlib import Path

import av

_TASKS = Path("/proc/self/task")  # the threads of this process, on Linux
_SLEEPS = b"S"  # state of a thread that waits for an event; other threads run, or wait for a processor or for memory
_POLL_S = 1e-4
_PAUSE_S = 1e-3


def open_encoder(encoder: av.VideoCodecContext) -> frozenset[int]:
    """Open an encoder without real-time priority.

    Args:
        encoder: An encoder with all its settings.

    Returns:
        Identifiers of the threads of the encoder; none if the system does not list the threads of a process.
    """
    before = _thread_ids()
    _open_with_normal_priority(encoder)
    return _thread_ids() - before


def wait_until_idle(threads: Collection[int], limit_s: float = 1.0) -> None:
    """Wait until each thread sleeps or has ended, or for a millisecond if no threads are known.

    Args:
        threads: Identifiers of the threads.
        limit_s: Longest time to wait [s]. A thread that another library starts while the encoder is opened counts as
            one of the encoder's, and may never sleep.
    """
    if not threads:
        time.sleep(_PAUSE_S)
    deadline = time.monotonic() + limit_s
    for thread in threads:
        while not _is_idle(thread) and time.monotonic() < deadline:
            time.sleep(_POLL_S)


def _thread_ids() -> frozenset[int]:
    return frozenset(int(task.name) for task in _TASKS.iterdir()) if _TASKS.is_dir() else frozenset()


def _is_idle(thread: int) -> bool:
    try:
        file = os.open(f"{_TASKS}/{thread}/stat", os.O_RDONLY)  # three times as fast as a file object
        try:
            status = os.read(file, 64)
        finally:
            os.close(file)
    except (FileNotFoundError, ProcessLookupError):  # the thread has ended
        return True
    return status.rpartition(b") ")[2][:1] == _SLEEPS  # the name before it may contain any character


def _open_with_normal_priority(encoder: av.VideoCodecContext) -> None:
    """Open an encoder, and undo the real-time priority that SVT-AV1, run as root, gives its threads and the caller.

    Child processes would inherit the priority, and on a machine with few cores they would halt all other programs.
    """
    if not hasattr(os, "sched_getscheduler"):
        encoder.open()
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    encoder.open()
    if os.sched_getscheduler(0) != policy:
        for thread in _thread_ids():
            with contextlib.suppress(ProcessLookupError):  # the thread has ended
                os.sched_setscheduler(thread, policy, parameters)
