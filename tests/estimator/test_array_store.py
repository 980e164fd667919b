"""Tests of intermediate results that are kept as files."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.array_store import ArrayStore


def test_one_thread_at_a_time_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, load, reading, most = ArrayStore(tmp_path), np.load, [0], [0]
    for i in range(4):
        store.save(f"{i}.npz", "key", x=np.arange(i))

    def slow_load(*args: Any, **options: Any) -> Any:
        reading[0] += 1
        most[0] = max(most[0], reading[0])
        time.sleep(0.02)
        reading[0] -= 1
        return load(*args, **options)

    monkeypatch.setattr(np, "load", slow_load)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda i: store.load(f"{i}.npz", "key"), range(4)))
    assert most == [1]
    assert [each is not None and len(each["x"]) for each in found] == [0, 1, 2, 3]
