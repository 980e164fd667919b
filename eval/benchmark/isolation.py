"""Calls of functions in processes of their own, so that the caller survives crashes, hangs and memory exhaustion.

The child is a plain Python process, because `multiprocessing` would run the caller's script again. It reads the pickled
function and arguments from its standard input and writes the pickled result to its standard output. The parent keeps
the standard input open: when it is closed because the parent was killed, the child kills its process group, so that no
process outlives the benchmark.
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
from typing import IO, Any, Literal, TypeAlias

from dronevio.models.errors import DEFECT, DronevioError

Status: TypeAlias = Literal["ok", "failed", "timeout", "crashed"]
"""How a run ended: with a result, with an error message, at the time limit, or with the death of its process."""
_CHILD_CODE = "from dronevio.eval.benchmark.isolation import serve; serve()"
_POLL_INTERVAL_S = 0.02
_EXIT_WITH_RESULT = 4  # exit code of a child that has written its result
_BYTES_PER_RU_MAXRSS = 1 if sys.platform == "darwin" else 1024


class CrashError(DronevioError):
    """An external program died without an error message of its own."""


@dataclass(frozen=True)
class Outcome:
    """How a call in a process of its own ended."""

    status: Status
    """Whether there is a value and, if not, how the call ended."""
    reason: str
    """Why there is no value; empty if there is one."""
    value: Any
    """Return value of the function."""
    wall_s: float
    """Elapsed time of the process [s]."""
    cpu_s: float
    """Processor time of the process and of the children that it waited for [s]."""
    peak_mb: float | None
    """Peak memory of the process, or of one of those children [MB]; None if the process died or was killed."""


def call_in_process(
    function: Callable[..., object],
    *arguments: object,
    timeout_s: float = float("inf"),
    environment: Mapping[str, str] | None = None,
) -> Outcome:
    """Call a function in a process of its own and return how the call ended; exceptions become outcomes.

    Args:
        function: A function of a module, which can be pickled.
        *arguments: Arguments of the function, which can be pickled.
        timeout_s: Time after which the process and its children are killed [s].
        environment: Environment variables to set for the process.
    """
    start = time.perf_counter()
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _CHILD_CODE],  # -P: no modules from the current folder
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=errors,
            start_new_session=True,
            env={**os.environ, **(environment or {})},
        )
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # the child died before it read; its exit code gives the reason
                pickle.dump((function, arguments), process.stdin)
                process.stdin.flush()
            in_time, usage = _wait(process, start + timeout_s)
        finally:
            _kill_group(process.pid)  # includes children that it left behind
            with suppress(BrokenPipeError):
                process.stdin.close()
        wall_s = time.perf_counter() - start
        status, reason, value, peak_mb = _result(process.returncode, output, errors)
    if not in_time:
        status, reason, value, peak_mb = "timeout", f"not finished after {timeout_s:g} s", None, None
    return Outcome(status, reason, value, wall_s, usage.ru_utime + usage.ru_stime, peak_mb)


def serve() -> None:
    """Run in the child: read the call, execute it, write the result, and exit."""
    function, arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # text that libraries print is not part of the result
    try:
        result = ("ok", "", function(*arguments))
    except CrashError as error:
        result = ("crashed", str(error), None)
    except Exception as error:
        result = ("failed", failure_reason(error), None)
    with output:
        pickle.dump((*result, peak_memory_mb()), output)
    sys.stderr.flush()
    os._exit(_EXIT_WITH_RESULT)  # a library that crashes at shutdown does not change the result


def failure_reason(error: Exception) -> str:
    """Return the reason of a failure as text: the message of an error that the user can correct, or else a defect."""
    if isinstance(error, DronevioError):
        return str(error)
    text = f"{type(error).__name__}: {error}"
    return text if isinstance(error, (OSError, MemoryError)) else f"{DEFECT}: {text}"


def _die_with_parent() -> None:
    """Wait until the standard input is closed, then kill the whole process group."""
    while os.read(0, 4096):
        pass
    _kill_group(os.getpid())


def _kill_group(group: int) -> None:
    with suppress(ProcessLookupError, PermissionError):  # macOS raises the latter for a group that has ended
        os.killpg(group, signal.SIGKILL)


def _wait(process: "subprocess.Popen[bytes]", deadline: float) -> tuple[bool, Any]:
    """Wait for a process, whose group is killed at the deadline.

    Returns:
        Whether the process ended in time, and its resource usage.
    """
    in_time = True
    try:
        while True:
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            if in_time and time.perf_counter() > deadline:
                in_time = False
                _kill_group(process.pid)
            time.sleep(_POLL_INTERVAL_S)
    except BaseException:
        _kill_group(process.pid)
        process.wait()
        raise
    process.returncode = os.waitstatus_to_exitcode(status)
    return in_time, usage


def _result(code: int, output: IO[bytes], errors: IO[bytes]) -> tuple[Status, str, Any, float | None]:
    """Return status, reason, value and peak memory [MB] of a process that has ended with an exit code."""
    if code == _EXIT_WITH_RESULT:
        output.seek(0)
        status, reason, value, peak_mb = pickle.load(output)
        return status, reason, value, peak_mb
    return "crashed", f"{DEFECT}: {exit_description(code, errors)}", None, None


def peak_memory_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the peak memory of this process, or of a child that it waited for [MB]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    try:  # getrusage would count the memory of the parent before exec
        lines = status.read_text(encoding="ascii").splitlines()
        own = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    except OSError:
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return max(own, children) * _BYTES_PER_RU_MAXRSS * 1e-6


def exit_description(code: int, errors: IO[bytes]) -> str:
    """Return how a process died, in words: its signal or exit code, and the last line of its standard error."""
    size = errors.seek(0, os.SEEK_END)
    errors.seek(max(0, size - 4096))
    lines = [line.strip() for line in errors.read().decode(errors="replace").splitlines() if line.strip()]
    try:
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
    except ValueError:
        how = f"killed by signal {-code}"
    return f"{how}: {lines[-1][:300]}" if lines else how
