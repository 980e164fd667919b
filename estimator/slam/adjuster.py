"""Bundle adjustment of a map during the flight, in a process of its own or in that of the map.

It takes many times longer than the interval between two keyframes, so that its result takes effect a number of
keyframes later, which depends on numbers of keyframes alone (`schedule`).
"""

import os
import signal
import threading
import time
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import connection, get_context, parent_process
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.bundle_adjustment import AdjustmentConfig, AdjustmentInputs, adjust

Array = npt.NDArray[np.float64]


class Adjuster(Protocol):
    """Adjusts one map at a time."""

    @property
    def cpu_s(self) -> float:
        """Processor time of the results so far, if it is not that of this process [s]."""

    def start(self, inputs: AdjustmentInputs, /) -> None:
        """Begin an adjustment."""

    def result(self) -> dict[int, Array] | None:
        """Return the adjusted poses (4, 4) by the numbers of the keyframes, once; None without a solution."""


class LocalAdjuster:
    """Adjusts a map when the result is due, in the same process."""

    def __init__(self, config: AdjustmentConfig) -> None:
        """Wait for the first adjustment.

        Args:
            config: Settings.
        """
        self._config = config
        self._inputs: AdjustmentInputs | None = None

    @property
    def cpu_s(self) -> float:
        """Zero: the processor time is that of this process."""
        return 0.0

    def start(self, inputs: AdjustmentInputs) -> None:
        """Keep the measurements."""
        self._inputs = inputs

    def result(self) -> dict[int, Array] | None:
        """Return the adjusted poses; see `Adjuster`."""
        inputs, self._inputs = self._inputs, None
        return None if inputs is None else solved(inputs, self._config)


class ProcessAdjuster:
    """Adjusts a map in another process, which starts with the first adjustment and ends with this one."""

    def __init__(self, config: AdjustmentConfig) -> None:
        """Prepare the process.

        Args:
            config: Settings.
        """
        self._config = config
        self._pool = ProcessPoolExecutor(1, get_context("spawn"), initializer=_end_with_parent)
        self._future: Future[tuple[dict[int, Array] | None, float]] | None = None
        self._cpu_s = 0.0

    @property
    def cpu_s(self) -> float:
        """Processor time of the results so far [s]."""
        return self._cpu_s

    def start(self, inputs: AdjustmentInputs) -> None:
        """Begin an adjustment in the other process."""
        self._future = self._pool.submit(_timed, inputs, self._config)

    def result(self) -> dict[int, Array] | None:
        """Return the adjusted poses, and wait for them if they are not ready; see `Adjuster`."""
        future, self._future = self._future, None
        if future is None:
            return None
        poses, cpu_s = future.result()
        self._cpu_s += cpu_s
        return poses


def solved(inputs: AdjustmentInputs, config: AdjustmentConfig) -> dict[int, Array] | None:
    """Return the adjusted poses of a map, see `adjust`; None if the system is singular."""
    try:
        return adjust(inputs, config)
    except RuntimeError:  # by GTSAM
        return None


def _timed(inputs: AdjustmentInputs, config: AdjustmentConfig) -> tuple[dict[int, Array] | None, float]:
    """Return the adjusted poses and the processor time [s]."""
    start_s = time.process_time()
    return solved(inputs, config), time.process_time() - start_s


def _end_with_parent() -> None:
    """Let this process end with the one that has started it, and only then."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_wait_and_end, args=(parent.sentinel,), daemon=True).start()


def _wait_and_end(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
