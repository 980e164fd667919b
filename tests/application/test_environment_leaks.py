"""The script that looks for leaks of environments: it finds those that there are."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="reads the resources of a process as Linux lists them")
def test_leaks_are_found(script: Callable[[str], Any]) -> None:
    leaks = script("environment_leaks")
    opened = []
    clean = leaks.growth(lambda number: None, 20)
    assert not leaks.leaks(*clean)
    files = leaks.growth(lambda number: opened.append(Path(__file__).open(encoding="utf-8")), 20)  # noqa: SIM115
    assert files[1].files - files[0].files == 18
    assert leaks.leaks(*files)
    for file in opened:
        file.close()
    before, _ = clean
    assert leaks.leaks(before, replace(before, memory_mb=before.memory_mb + 9.0))
    assert leaks.leaks(before, replace(before, contexts=before.contexts + 1))
