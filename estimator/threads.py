"""Threads: one for linear algebra and OpenCV within the estimators, and pools with progress for work on several cores.

The matrices of an estimator are small. On them, the threads that BLAS libraries start wait for each other most of the
time, and they sum floating-point numbers in an order that depends on their number.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import cv2
from threadpoolctl import LibController, OpenBLASController, ThreadpoolController

from dronevio.models.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_with_progress(
    pool: ThreadPoolExecutor, function: Callable[[Item], Result], items: Iterable[Item], progress: Progress
) -> list[Result]:
    """Return the results of a function in the order of the items, which a pool processes, and report the progress."""
    items, results = list(items), []
    progress(0, len(items))
    for result in pool.map(function, items):
        results.append(result)
        progress(len(results), len(items))
    return results


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let BLAS libraries and OpenCV use one thread within the context, or within a function that it decorates.

    The numbers of threads belong to the process: other threads have one, too, as long as any thread is within such a
    context. The numbers from before are restored when the last one leaves.
    """
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


class _Limit:
    """The limit that all contexts share; the first one saves the numbers of threads, the last one restores them."""

    def __init__(self) -> None:
        self._lock, self._contexts = threading.Lock(), 0
        self._before: tuple[list[int], int] = ([], 1)  # of each BLAS library, and of OpenCV

    def enter(self) -> None:
        with self._lock:
            self._contexts += 1
            if self._contexts > 1:
                return
            self._before = [library.get_num_threads() for library in _blas_libraries()], cv2.getNumThreads()
            if self._is_limited:
                _set_threads([1] * len(self._before[0]), 1)

    def leave(self) -> None:
        with self._lock:
            self._contexts -= 1
            if not self._contexts and self._is_limited:
                _set_threads(*self._before)

    @property
    def _is_limited(self) -> bool:
        """Whether a number of threads before was another than one."""
        blas, opencv = self._before
        return any(threads != 1 for threads in (*blas, opencv))


def _set_threads(blas: list[int], opencv: int) -> None:
    """Set the numbers of threads of the BLAS libraries, in their order, and of OpenCV."""
    OpenBLASController.clear_controlling_thread(force=True)  # contexts may end in another thread than they begin in
    for library, threads in zip(_blas_libraries(), blas, strict=True):
        library.set_num_threads(threads)
    OpenBLASController.clear_controlling_thread(force=True)
    cv2.setNumThreads(opencv)


@cache
def _blas_libraries() -> tuple[LibController, ...]:
    """Return the BLAS libraries of the process; those of NumPy and SciPy are loaded before any estimator."""
    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)


_LIMIT = _Limit()
