"""Processes that share a piece of work, each with its own OpenGL.

These are plain processes: multiprocessing would run the caller's script again in each. A worker gets its task pickled
on stdin, from its own parent, and writes a byte to stdout whenever a unit is done.
"""

import json
import os
import pickle
import selectors
import signal
import subprocess
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Protocol

from dronevio.models.errors import DronevioError, GraphicsError
from dronevio.models.progress import Progress, silent

_WORKER = "from dronevio.sim.rendering.worker_pool import work; work()"
_MOST_WORKERS = 4  # each holds the world's textures, some 350 MB
_KNOWN_ERROR = 3  # exit code of a worker whose last line on stderr is meant for the user
_SYSTEM_ERROR = 4  # exit code of one that the system refused something: errno and file name, as JSON


class Task(Protocol):
    """What one worker does."""

    def run(self) -> Iterator[None]:
        """Do the work, and yield whenever a unit of it is done."""


def default_workers(units: int, units_worth_a_worker: int) -> int:
    """Return how many processes are worth starting."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, _MOST_WORKERS, -(-units // units_worth_a_worker)))


def run_tasks(tasks: Sequence[Task], units: int, progress: Progress = silent) -> None:
    """Carry out tasks, each in a process of its own; whatever happens, no process is left behind.

    Args:
        tasks: The tasks, one a worker.
        units: How many units they have together.
        progress: Told how many are done.

    Raises:
        OSError: The system refused a worker something, such as more room on the disk.
        GraphicsError: A worker failed otherwise.
    """
    progress(0, units)
    with _started(tasks) as processes:
        _follow(processes, units, progress)


@contextmanager
def _started(tasks: Sequence[Task]) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Run a worker a task, and end them all in the end."""
    environment = {**os.environ, "LP_NUM_THREADS": "1"}  # Mesa's renderer would start a thread a core in each
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for task in tasks:
            process = subprocess.Popen(
                [sys.executable, "-c", _WORKER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches the parent only, which ends the workers
            )
            processes.append(process)
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # it died before it listened: `_check` says of what
                pickle.dump(task, process.stdin)
                process.stdin.close()
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout, process.stderr):
                if stream is not None:
                    with suppress(BrokenPipeError):
                        stream.close()


def _follow(processes: Sequence["subprocess.Popen[bytes]"], units: int, progress: Progress) -> None:
    """Report the workers' progress, a byte on stdout a unit, until all are done."""
    done = 0
    with selectors.DefaultSelector() as selector:
        for process in processes:
            assert process.stdout is not None
            selector.register(process.stdout, selectors.EVENT_READ, process)
        while selector.get_map():
            for key, _ in selector.select():
                marks = os.read(key.fd, 4096)
                if marks:
                    done += len(marks)
                    progress(done, units)
                    continue
                selector.unregister(key.fileobj)
                _check(key.data)


def _check(process: "subprocess.Popen[bytes]") -> None:
    """Raise a worker's error as our own."""
    assert process.stderr is not None
    said = process.stderr.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
    code = process.wait()
    if code == _SYSTEM_ERROR:
        number, name = json.loads(said[-1])
        raise OSError(number, os.strerror(number), name or None)
    if code == _KNOWN_ERROR:
        raise GraphicsError(said[-1])
    if code < 0:
        raise GraphicsError(f"a rendering process was killed by {signal.Signals(-code).name}")
    if code:
        raise GraphicsError(f"a rendering process failed: {said[-1]}")


def work() -> None:
    """Carry out the task on stdin: what a worker's process does."""
    import cv2

    cv2.setNumThreads(1)
    task: Task = pickle.load(sys.stdin.buffer)
    try:
        for _ in task.run():
            os.write(1, b".")
    except DronevioError as error:
        print(error, file=sys.stderr)  # noqa: T201
        sys.exit(_KNOWN_ERROR)
    except OSError as error:
        if error.errno is None:
            raise
        print(json.dumps([error.errno, str(error.filename or "")]), file=sys.stderr)  # noqa: T201
        sys.exit(_SYSTEM_ERROR)
    except Exception:
        traceback.print_exc()
        sys.exit(1)
