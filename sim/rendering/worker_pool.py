"""Worker pool: processes that share the rendering, each with its own OpenGL context.

The workers are plain processes, since multiprocessing would import the caller's script in each. A worker receives its
pickled task on stdin from its parent and writes a byte to stdout after each unit of work.
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

from dronevio.models.errors import DefectError, DronevioError, GraphicsError
from dronevio.models.progress import Progress, silent

_WORKER = "from dronevio.sim.rendering.worker_pool import work; work()"
_MOST_WORKERS = 4  # each holds the textures of the world, about 350 MB
_KNOWN_ERROR = 3  # exit code of a worker whose last line on stderr is a message for the user
_SYSTEM_ERROR = 4  # exit code of a worker with a system error: errno and file name as JSON on stderr


class Task(Protocol):
    """Interface of the task of a worker."""

    def run(self) -> Iterator[None]:
        """Run the task, and yield after each unit of work."""


def default_workers(units: int, units_worth_a_worker: int) -> int:
    """Return the number of processes for some units of work."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, _MOST_WORKERS, -(-units // units_worth_a_worker)))


def run_tasks(tasks: Sequence[Task], units: int, progress: Progress = silent) -> None:
    """Run tasks, each in its own process; all processes have ended on return.

    Args:
        tasks: The tasks, one per worker.
        units: Number of units of work of all tasks.
        progress: Callback that receives the number of completed units and their total.

    Raises:
        OSError: A system error occurred in a worker, such as a full disk.
        GraphicsError: OpenGL failed in a worker.
        DefectError: A worker was killed, or failed for another reason.
    """
    progress(0, units)
    with _started(tasks) as processes:
        _follow(processes, units, progress)


@contextmanager
def _started(tasks: Sequence[Task]) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Start a worker for each task, and end them all at the end of the context."""
    environment = {**os.environ, "LP_NUM_THREADS": "1"}  # Mesa's renderer would start one thread per core in each
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for task in tasks:
            process = subprocess.Popen(
                [sys.executable, "-c", _WORKER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment,
                start_new_session=True,  # Ctrl-C interrupts the parent only, which ends the workers
            )
            processes.append(process)
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # the worker ended early: `_check` reports the reason
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
    """Report the progress of the workers, one byte on stdout per unit, until all have ended."""
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
    """Raise the error of a worker in this process."""
    assert process.stderr is not None
    lines = process.stderr.read().decode(errors="replace").strip().splitlines() or ["no error message"]
    code = process.wait()
    if code == _SYSTEM_ERROR:
        number, name = json.loads(lines[-1])
        raise OSError(number, os.strerror(number), name or None)
    if code == _KNOWN_ERROR:
        raise GraphicsError(lines[-1])
    if code:
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"failed: {lines[-1]}"
        error = DefectError(f"a rendering process {how}")
        error.add_note("\n".join(lines))  # the traceback of the worker
        raise error


def work() -> None:
    """Run the task on stdin: the main function of a worker process."""
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
