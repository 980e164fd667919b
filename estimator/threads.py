"""Work on several cores by threads, with progress."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2

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
def one_opencv_thread() -> Iterator[None]:
    """Run OpenCV without threads of its own within the context, while a pool keeps the cores busy."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
