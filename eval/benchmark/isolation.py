"""A function called in a process of its own: whatever it does to that, the caller hears how it ended and goes on.

A plain process, as multiprocessing would run the caller's script again. It gets function and arguments pickled on its
standard input, from its own parent, and answers on its standard output. Its standard input stays open: once that ends,
because the parent was killed, it takes itself and all that it started down, so that nothing goes on unseen.
"""

import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from dronevio.eval.benchmark.rows import Status
from dronevio.models.errors import DronevioError

_CHILD = "from dronevio.eval.benchmark.isolation import serve; serve()"
_LOOK_EVERY_S = 0.02
_TOLD = 4  # exit code of a child that has written its answer
_BYTES_PER_RU_MAXRSS = 1 if sys.platform == "darwin" else 1024


class CrashError(DronevioError):
    """A program that was started died without a word of its own."""


@dataclass(frozen=True)
class Outcome:
    """How a call in a process of its own ended."""

    status: Status
    """Whether there is a value, and if not, what kind of end it was."""
    reason: str
    """Why there is none; empty where there is."""
    value: Any
    """What the function returned."""
    wall_s: float
    """How long the process lived [s]."""
    cpu_s: float
    """Processor time of the process and of those that it waited for [s]."""
    peak_mb: float | None
    """The most memory that it, or any one of those, held [MB]; None where it could not tell any more."""


def isolated(
    function: Callable[..., object],
    *arguments: object,
    timeout_s: float = float("inf"),
    environment: Mapping[str, str] | None = None,
) -> Outcome:
    """Call a function in a process of its own, and return how that ended; it raises nothing that the function does.

    Args:
        function: A function of a module, which can be pickled.
        *arguments: Its arguments, which can be pickled too.
        timeout_s: After that long [s], the process and all that it started are killed.
        environment: Variables to set for it.
    """
    start = time.perf_counter()
    with tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _CHILD],  # -P: the folder where we are holds no modules
            stdin=subprocess.PIPE,
            stdout=answer,
            stderr=complaints,
            start_new_session=True,
            env={**os.environ, **(environment or {})},
        )
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # it has died before it could listen, and will tell why
                pickle.dump((function, arguments), process.stdin)
                process.stdin.flush()
            in_time, usage = _wait(process, start + timeout_s)
        finally:
            _kill_group(process.pid)  # what it started and left behind, too
            with suppress(BrokenPipeError):
                process.stdin.close()
        wall_s = time.perf_counter() - start
        status, reason, value, peak_mb = _ending(process.returncode, answer, complaints)
    if not in_time:
        status, reason, value, peak_mb = "timeout", f"no end after {timeout_s:g} s", None, None
    return Outcome(status, reason, value, wall_s, usage.ru_utime + usage.ru_stime, peak_mb)


def serve() -> None:
    """Be the process: read what to call, call it, answer."""
    function, arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    try:
        told = ("ok", "", function(*arguments))
    except CrashError as error:
        told = ("crashed", str(error), None)
    except DronevioError as error:
        told = ("failed", str(error), None)
    except Exception as error:
        told = ("failed", f"{type(error).__name__}: {error}", None)
    with answer:
        pickle.dump((*told, _peak_mb()), answer)
    sys.stderr.flush()
    os._exit(_TOLD)  # a library that dies while it is taken down changes nothing any more


def _die_with_parent() -> None:
    """Wait for the end of the standard input; take down the whole process group."""
    while os.read(0, 4096):
        pass
    _kill_group(os.getpid())


def _kill_group(group: int) -> None:
    with suppress(ProcessLookupError, PermissionError):  # macOS says the latter of one that has ended
        os.killpg(group, signal.SIGKILL)


def _wait(process: "subprocess.Popen[bytes]", deadline: float) -> tuple[bool, Any]:
    """Wait for a process, and kill its group at the deadline; say whether it kept it, and what it used."""
    in_time = True
    try:
        while True:
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            if in_time and time.perf_counter() > deadline:
                in_time = False
                _kill_group(process.pid)
            time.sleep(_LOOK_EVERY_S)
    except BaseException:
        _kill_group(process.pid)
        process.wait()
        raise
    process.returncode = os.waitstatus_to_exitcode(status)
    return in_time, usage


def _ending(code: int, answer: IO[bytes], complaints: IO[bytes]) -> tuple[Status, str, Any, float | None]:
    """Return status, reason, value and peak memory that a process left."""
    if code == _TOLD:
        answer.seek(0)
        status, reason, value, peak_mb = pickle.load(answer)
        return status, reason, value, peak_mb
    return "crashed", death(code, complaints), None, None


def _peak_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the most memory that this process held, or a process that it waited for [MB]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    try:  # getrusage would count the process that started this one, before it became itself
        lines = status.read_text(encoding="ascii").splitlines()
        own = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    except OSError:
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return max(own, children) * _BYTES_PER_RU_MAXRSS * 1e-6


def death(code: int, complaints: IO[bytes]) -> str:
    """Return in words how a process died, from its exit code and the last line that it wrote."""
    size = complaints.seek(0, os.SEEK_END)
    complaints.seek(max(0, size - 4096))
    lines = [line.strip() for line in complaints.read().decode(errors="replace").splitlines() if line.strip()]
    try:
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
    except ValueError:
        how = f"killed by signal {-code}"
    return f"{how}: {lines[-1][:300]}" if lines else how
