"""The worker process in which a map is built: its protocol, and its main function.

Requests and answers are pickled and pass through two pipes. Both ends are processes of one program that start and end
together; nothing from outside is unpickled. The worker ends when its requests end, so it does not outlive its parent.
"""

import os
import pickle
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.estimator.slam.files.saved_map import KnownMap
    from dronevio.estimator.slam.mapper import Mapper
    from dronevio.estimator.slam.worker.map_builder import MapBuilder, MapMessage
    from dronevio.models.rig import Rig


@dataclass(frozen=True, eq=False)
class Begin:
    """The first request; it has no answer."""

    rig: "Rig"
    """The calibration of cameras and IMU."""
    config: "SlamConfig"
    """Settings of the map."""
    known: "KnownMap | None" = None
    """A saved map to continue."""


@dataclass(frozen=True, eq=False)
class Update:
    """Request to process a message of the odometry; the answer has its correction."""

    message: "MapMessage"
    """The message to process."""


@dataclass(frozen=True, eq=False)
class Question:
    """Request to call a function of the mapper; the answer has what it returns."""

    function: "Callable[[Mapper], Any]"
    """A function of a module, or a method of `Mapper`."""


Request = Begin | Update | Question
"""What the worker receives."""


@dataclass(frozen=True, eq=False)
class Answer:
    """The result of a request."""

    value: Any
    """The result, None for a message that changes no correction."""
    cpu_s: float
    """Processor time of the worker since its start was complete, and of the adjustments that it has started [s]."""


@dataclass(frozen=True)
class Failure:
    """An exception that ended the worker."""

    text: str
    """The message of the exception."""
    trace: str
    """Its traceback, as text."""
    is_input: bool
    """Whether the user can correct it."""


def write(connection: Connection, value: object) -> None:
    """Write an object to the other process; arrays are copied once."""
    connection.send_bytes(pickle.dumps(value, protocol=5))


def read(connection: Connection) -> Any:
    """Return the next object of the other process.

    Raises:
        EOFError: The other process has ended.
    """
    return pickle.loads(connection.recv_bytes())  # from the parent or the child of this process


def serve(requests_fd: int, answers_fd: int) -> None:
    """Run the worker: answer the requests until there are no more.

    Args:
        requests_fd: File descriptor of the pipe with the requests.
        answers_fd: File descriptor of the pipe for the answers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C interrupts the parent, whose end is that of the requests
    requests, answers = Connection(requests_fd, writable=False), Connection(answers_fd, readable=False)
    try:
        with suppress(EOFError, BrokenPipeError):  # the parent has ended, or discards the map
            _answer(requests, answers)
    except Exception as error:
        from dronevio.models.errors import DronevioError

        is_input = isinstance(error, DronevioError)
        text = str(error) if is_input else f"{type(error).__name__}: {error}"
        with suppress(BrokenPipeError):
            write(answers, Failure(text, traceback.format_exc(), is_input))


def _answer(requests: Connection, answers: Connection) -> None:
    """Answer all requests."""
    from dronevio.estimator.slam.adjustment.adjuster import ProcessAdjuster
    from dronevio.estimator.slam.worker.map_builder import MapBuilder

    start_s = time.process_time()
    begin: Begin = read(requests)
    builder = MapBuilder(begin.rig, begin.config, begin.known, ProcessAdjuster(begin.config.adjustment))
    while True:
        request: Update | Question = read(requests)
        value = _result(builder, request)
        write(answers, Answer(value, time.process_time() - start_s + builder.adjustment_cpu_s))


def _result(builder: "MapBuilder", request: Update | Question) -> Any:
    """Return the result of a request."""
    if isinstance(request, Update):
        return builder.process(request.message)
    return request.function(builder.mapper)


def main() -> None:
    """Run the worker with the file descriptors of its arguments; it does not run the handlers at exit."""
    import sys

    serve(*map(int, sys.argv[1:]))
    os._exit(0)
