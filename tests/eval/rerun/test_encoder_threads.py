"""Waiting for the threads of the video encoder."""

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from dronevio.eval.rerun import video
from dronevio.eval.rerun.encoder_threads import wait_until_idle
from dronevio.eval.rerun.video import Av1Encoder, VideoSettings

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the system does not list threads")


@contextmanager
def running(function: Callable[[], object]) -> Iterator[Thread]:
    """Run a function in a thread, which then sleeps until the context is left."""
    left = Event()
    thread = Thread(target=lambda: (function(), left.wait()))
    thread.start()
    yield thread
    left.set()
    thread.join()


def compute() -> None:
    """Compute for some tenths of a second, without the global interpreter lock."""
    hashlib.pbkdf2_hmac("sha256", b"", b"", 300_000)


def processor_time_s(thread: Thread) -> float:
    """Return the processor time that a thread has used [s]."""
    assert thread.ident is not None
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def identifier(thread: Thread) -> int:
    """Return the system's identifier of a thread."""
    assert thread.native_id is not None
    return thread.native_id


def test_a_busy_thread_is_waited_for_until_it_sleeps() -> None:
    with running(compute) as thread:
        wait_until_idle([identifier(thread)], limit_s=60.0)
        used_s = processor_time_s(thread)
        time.sleep(0.02)
        assert processor_time_s(thread) - used_s < 0.002
        assert used_s > 0.02


def test_waiting_for_a_busy_thread_has_a_limit() -> None:
    with running(compute) as thread:
        wait_until_idle([identifier(thread)], limit_s=0.01)
        used_s = processor_time_s(thread)
        wait_until_idle([identifier(thread)], limit_s=60.0)
        assert processor_time_s(thread) - used_s > 0.01


def test_threads_that_sleep_or_have_ended_are_idle() -> None:
    with running(lambda: None) as thread:
        time.sleep(0.02)
        start_s = time.monotonic()
        wait_until_idle([identifier(thread)], limit_s=60.0)
    wait_until_idle([identifier(thread)], limit_s=60.0)
    assert time.monotonic() - start_s < 30.0


def test_the_encoder_is_waited_for_after_each_image(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[frozenset[int]] = []

    def wait(threads: frozenset[int]) -> None:
        waits.append(threads)
        wait_until_idle(threads)

    monkeypatch.setattr(video, "wait_until_idle", wait)
    encoder = Av1Encoder(20.0, VideoSettings())
    for _ in range(3):
        encoder.encode(np.zeros((48, 64), np.uint8))
    encoder.finish()
    assert len(waits) == 3
    assert len(waits[0]) > 10  # one for each stage of SVT-AV1
    assert set(waits) == {waits[0]}
