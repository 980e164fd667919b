"""Bundle adjustment of a map in a process of its own, which ends with the one that has started it."""

import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import psutil
import pytest

from dronevio.estimator.slam import adjuster
from dronevio.estimator.slam.adjuster import LocalAdjuster, ProcessAdjuster, solved
from dronevio.estimator.slam.bundle_adjustment import AdjustmentConfig, AdjustmentInputs

CONFIG = AdjustmentConfig(iterations=3)
STARTED = """
import sys, time
from dronevio.estimator.slam.adjuster import ProcessAdjuster
from dronevio.estimator.slam.bundle_adjustment import AdjustmentConfig
adjuster = ProcessAdjuster(AdjustmentConfig())
print(adjuster._pool.submit(__import__("os").getpid).result(), flush=True)
time.sleep(600.0)
"""
"""A program with an adjuster, which prints the number of the process that adjusts."""


def test_results_do_not_depend_on_the_process(adjustment_inputs: AdjustmentInputs) -> None:
    some = replace(adjustment_inputs, keyframes=adjustment_inputs.keyframes[:30], loops=[])
    local, other = LocalAdjuster(CONFIG), ProcessAdjuster(CONFIG)
    assert local.result() is None and other.result() is None
    for each in (local, other):
        each.start(some)
    expected, found = local.result(), other.result()
    assert expected is not None and found is not None
    assert all(found[number].tobytes() == T.tobytes() for number, T in expected.items())
    assert local.cpu_s == 0.0 < other.cpu_s
    assert local.result() is None and other.result() is None  # a result is returned once


def test_singular_system_has_no_result(monkeypatch: pytest.MonkeyPatch, adjustment_inputs: AdjustmentInputs) -> None:
    def fail(inputs: AdjustmentInputs, config: AdjustmentConfig) -> None:
        raise RuntimeError("Indeterminate linear system")

    monkeypatch.setattr(adjuster, "adjust", fail)
    assert solved(adjustment_inputs, CONFIG) is None


@pytest.mark.parametrize("end", [lambda p: p.kill(), lambda p: p.terminate()], ids=["killed", "terminated"])
def test_process_ends_with_the_one_that_started_it(end: Callable[["subprocess.Popen[str]"], None]) -> None:
    with subprocess.Popen([sys.executable, "-c", STARTED], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        child.send_signal(signal.SIGINT)  # as Ctrl-C sends to all processes of a terminal
        assert child.is_running()
        end(parent)
        assert psutil.wait_procs([child], timeout=60.0)[1] == []
