"""A map that is built in a worker process, while the odometry goes on.

GTSAM holds Python's global lock while it solves, so a thread would stop the odometry. The worker is a plain Python
process, since `multiprocessing` would import the caller's script again, and allows none in its own daemonic processes.
It starts with the map, so that its imports take place while the odometry initializes.
"""

import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import IO, TypeVar

from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.files.saved_map import KnownMap
from dronevio.estimator.slam.mapper import Mapper
from dronevio.estimator.slam.worker.map_builder import MapCost, MapMessage
from dronevio.estimator.slam.worker.map_worker import Answer, Begin, Failure, Question, Request, Update, read, write
from dronevio.models.errors import DefectError, DronevioError
from dronevio.models.rig import Rig

Result = TypeVar("Result")

MOST_UNANSWERED = 64
"""Number of messages without answer at which the odometry waits, so that the images in the queue have a limit."""
_WORKER = "from dronevio.estimator.slam.worker.map_worker import main; main()"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_END_S = 10.0  # time in which a process that has closed its pipe ends [s]


class MapProcess:
    """Builds the map in a worker process; an `OdometryMap`.

    Every call may raise `DefectError` if the worker has died or failed, and `DronevioError` if it reports an error that
    the user can correct.
    """

    def __init__(self, rig: Rig, config: SlamConfig, known: KnownMap | None = None) -> None:
        """Start the worker process.

        Args:
            rig: The calibration.
            config: Settings.
            known: A saved map to continue; None for an empty one.
        """
        requests_fd, requests = os.pipe()
        answers, answers_fd = os.pipe()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _WORKER, str(requests_fd), str(answers_fd)],
                stdin=subprocess.DEVNULL,
                stdout=self._errors,
                stderr=self._errors,
                pass_fds=(requests_fd, answers_fd),
                env={**os.environ, **dict.fromkeys(_THREADS, "1")},
            )
        except BaseException:
            for fd in (requests, answers):
                os.close(fd)
            raise
        finally:
            os.close(requests_fd)
            os.close(answers_fd)
        self._answers = Connection(answers, writable=False)
        self._requests: queue.SimpleQueue[Request | None] = queue.SimpleQueue()
        self._unanswered = 0
        self._early: deque[Correction | None] = deque()  # answers that were read before they were due
        self._results = self._waits = 0
        self._cpu_s = 0.0
        # A thread writes, since a pipe that is full would stop the odometry.
        pipe = Connection(requests, readable=False)
        threading.Thread(target=_write_all, args=(self._requests, pipe), name="map", daemon=True).start()
        self._end = weakref.finalize(
            self, _end, self._process, self._requests, self._answers, self._errors, os.getpid()
        )
        self._requests.put(Begin(rig, config, known))

    @property
    def pid(self) -> int:
        """Identifier of the worker process."""
        return self._process.pid

    def send(self, message: MapMessage) -> None:
        """Send a message to the worker; wait only if it has very many to answer."""
        while self._unanswered >= MOST_UNANSWERED:
            self._waits += not self._answers.poll()
            self._early.append(self._next())
        self._requests.put(Update(message))
        self._unanswered += 1

    def receive(self) -> Correction | None:
        """Return the oldest answer; wait for it if the worker is not ready."""
        self._results += 1
        if self._early:
            return self._early.popleft()
        self._waits += not self._answers.poll()
        return self._next()

    def ask(self, function: Callable[[Mapper], Result]) -> Result:
        """Return a copy of what a function returns for the mapper in the worker."""
        self._read_all()
        self._requests.put(Question(function))
        result: Result = self._read().value
        return result

    def cost(self, frames: int) -> MapCost:
        """Return the cost of the map, after all messages have been answered."""
        self._read_all()
        return MapCost(frames, self._results, self._waits, self._cpu_s)

    def close(self) -> None:
        """End the worker process."""
        self._end()

    def _read_all(self) -> None:
        """Wait for all answers."""
        while self._unanswered:
            self._early.append(self._next())

    def _next(self) -> Correction | None:
        """Return the answer to the oldest message."""
        correction: Correction | None = self._read().value
        self._unanswered -= 1
        return correction

    def _read(self) -> Answer:
        """Wait for the next answer."""
        try:
            answer: Answer | Failure = read(self._answers)
        except (EOFError, OSError):
            raise self._death() from None
        if isinstance(answer, Answer):
            self._cpu_s = answer.cpu_s
            return answer
        if answer.is_input:
            raise DronevioError(answer.text)
        error = DefectError(f"the mapping process failed: {answer.text}")
        error.add_note(answer.trace)
        raise error

    def _death(self) -> DefectError:
        """Return the error of a worker that has ended without an answer."""
        if not self._end.alive:
            return DefectError("the mapping process is closed")
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        code = self._process.returncode
        self._errors.seek(0)
        text = self._errors.read().decode(errors="replace").strip()
        how = f"ended with code {code}" if code is None or code >= 0 else f"was killed by {_name(-code)}"
        error = DefectError(f"the mapping process {how}")
        error.add_note(text)
        return error


def _name(number: int) -> str:
    """Return the name of a signal."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _write_all(requests: "queue.SimpleQueue[Request | None]", pipe: Connection) -> None:
    """Write requests to the worker until there are no more or it has ended, which the next reading reports."""
    with pipe, suppress(OSError):
        while (request := requests.get()) is not None:
            write(pipe, request)


def _end(
    process: "subprocess.Popen[bytes]",
    requests: "queue.SimpleQueue[Request | None]",
    answers: Connection,
    errors: IO[bytes],
    owner: int,
) -> None:
    """End a worker process, which has nothing to save; a fork of the process that started it does nothing."""
    if os.getpid() != owner:
        return
    process.kill()
    process.wait()
    requests.put(None)
    answers.close()
    errors.close()
